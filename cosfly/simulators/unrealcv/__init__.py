"""UnrealCV's protocol, as an unmodified client of the package `unrealcv` speaks it."""
