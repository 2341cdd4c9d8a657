"""Accepted tracks and captions to a release."""
