"""Captions to a training set."""
