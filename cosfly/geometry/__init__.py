"""Geometry of boxes, cells, flights and frames."""
