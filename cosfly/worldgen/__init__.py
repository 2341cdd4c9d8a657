"""Worlds from text: a plan, a layout that follows it, what the prompt names placed in it, SimWorld's world file."""
