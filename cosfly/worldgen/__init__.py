"""Worlds from text: a plan, its layout, the named objects placed in it, and SimWorld's world file."""
