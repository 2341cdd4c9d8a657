"""The closed loop: the decisions of a student move the drone, and it decides again on the new view."""
