"""Scores next to baselines."""
