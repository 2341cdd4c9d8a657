"""cosfly: from a 3D map to a data set that teaches a model to follow a person from the air.

As a library: `load_map`, `plan`, `render_frames` and `read_captions` (docs/library.md), which load what they need.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosfly.pipeline.library import load_map, plan, read_captions, render_frames

__all__ = ["__version__", "load_map", "plan", "read_captions", "render_frames"]

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Return a name of the library; nothing is loaded before."""
    if name not in __all__:
        raise AttributeError(f"module 'cosfly' has no attribute {name!r}")
    return getattr(importlib.import_module("cosfly.pipeline.library"), name)
