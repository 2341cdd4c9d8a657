"""A student answers."""
