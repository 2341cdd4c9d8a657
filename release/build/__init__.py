"""Accepted flights and captions to a release."""
