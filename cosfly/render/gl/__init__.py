"""The default renderer: OpenGL without a window."""
