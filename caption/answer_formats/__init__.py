"""Ways of writing: how a teacher states its reasons so that they can be held against the facts."""
