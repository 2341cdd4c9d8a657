"""Step 6: measure, accept, review or reject every track."""
