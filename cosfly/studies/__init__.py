"""What depth formats, zoom and weather do to the same frames and flights: `cosfly study ...`."""
