"""Styles of a flight: what it should be at each waypoint, drawn from a table."""
