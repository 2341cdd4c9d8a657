"""Step 3: pedestrian trajectories over the free ground."""
