"""Chain-of-Cause captions: windows, teachers, verification against the geometry, repair, two languages."""
