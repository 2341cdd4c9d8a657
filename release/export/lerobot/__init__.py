"""A release as a LeRobot data set, v3.0 and v2.1."""
