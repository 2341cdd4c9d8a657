"""The one gate for what stands on disk: nothing else in the project opens a file to read it."""
