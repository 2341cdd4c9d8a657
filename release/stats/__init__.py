"""What a release covers."""
