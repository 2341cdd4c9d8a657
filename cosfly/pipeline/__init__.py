"""The application: stages in one run, and what looks at runs."""
