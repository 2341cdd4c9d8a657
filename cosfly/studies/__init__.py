"""Studies of depth formats, zoom and weather on the same frames and trajectories."""
