"""Step 2: fewer boxes that keep the layout of obstacles."""
