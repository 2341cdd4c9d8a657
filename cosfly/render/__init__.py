"""Step 5: drone trajectories to frames."""
