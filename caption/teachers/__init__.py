"""Who answers: prompts, pictures, and the teachers."""
