"""A student learns."""
