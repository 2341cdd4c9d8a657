"""cosfly: from a 3D map to a data set that teaches a model to follow a person from the air."""

__version__ = "0.1.0"
