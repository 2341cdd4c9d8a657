"""The configurations that ship with cosfly, installed as package data (see cosfly.runtime.config.shipped)."""
