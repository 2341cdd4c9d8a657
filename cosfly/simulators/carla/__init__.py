"""CARLA's protocol, as an unmodified client of 0.9.16 speaks it."""
