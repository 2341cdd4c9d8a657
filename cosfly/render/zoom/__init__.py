"""Zoom: levels, changes between them, and what they cost (app:zoom)."""
