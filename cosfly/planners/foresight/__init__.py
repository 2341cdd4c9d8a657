"""Foresight: a search over the whole walk for places that will see, then smoothing that keeps what they see."""
