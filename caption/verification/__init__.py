"""What the geometry says: facts, labels, verdicts, evidence."""
