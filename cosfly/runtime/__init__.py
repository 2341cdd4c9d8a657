"""How work is done and stored: settings, run directories, journals, and items on worker processes."""
