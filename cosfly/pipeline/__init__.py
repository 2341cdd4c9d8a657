"""All stages in one run, and summaries, estimates and measurements of runs."""
