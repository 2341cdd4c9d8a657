"""Studies of depth formats, zoom, weather and TA*'s beam on the same frames and trajectories."""
