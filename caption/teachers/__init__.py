"""Teachers, their prompts and their pictures."""
