"""A release, or a part of it, from another place: `cosfly release get`."""
