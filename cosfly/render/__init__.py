"""Step 5: flights to frames."""
