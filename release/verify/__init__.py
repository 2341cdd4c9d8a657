"""Is a release what it says."""
