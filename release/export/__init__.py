"""A release in other formats: `cosfly release export`."""
