"""TA*+Smooth: a search for sight, then smoothing."""
