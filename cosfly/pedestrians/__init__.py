"""Step 3: walks over the free ground."""
