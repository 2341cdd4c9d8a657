"""The published data set: selection, packaging, card, verification."""
