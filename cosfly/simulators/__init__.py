"""Servers of our own that speak a simulator's protocol, with a town of boxes: `cosfly sim ...`."""
