"""How work is done and kept: settings, stage folders, journals, items on workers."""
