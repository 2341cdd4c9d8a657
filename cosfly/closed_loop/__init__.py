"""The closed loop: a student flies, and what it sees next is what it flew to."""
