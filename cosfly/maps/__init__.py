"""Step 1: boxes from a map source."""
