"""Geometry of boxes, cells, trajectories and frames."""
