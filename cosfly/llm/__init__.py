"""The OpenAI-compatible chat endpoint, for teachers, judges and students alike."""
