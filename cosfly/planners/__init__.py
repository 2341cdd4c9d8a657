"""Step 4: a drone flight for every walk."""
