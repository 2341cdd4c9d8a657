"""Step 4: a drone trajectory for every pedestrian trajectory."""
