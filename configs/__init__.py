"""The configurations that ship with cosfly, installed as package data under this name (see cosfly.work.config.shipped)."""
