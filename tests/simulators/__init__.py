"""Servers that speak the protocols of CARLA 0.9.16 and of UnrealCV, over a town of boxes: fixtures of tests."""
