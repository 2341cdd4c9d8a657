"""The card and its numbers."""
