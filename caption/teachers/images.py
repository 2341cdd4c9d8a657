"""Pictures for a request: each frame is encoded once and reused by the windows that share it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import numpy as np

from caption.schema import ImageConfig, ObservedWindow
from cosfly.llm.student_chat import EncodedImage
from cosfly.viz.frame_views import VIEW_FILES, Pictures, scaled_size

CACHE_FRAMES = 256  # encoded frames in memory, for the windows that share them


EncodeFrame = Callable[[Path, Pictures], list[EncodedImage]]  # the pictures of a frame, by its folder


def pictures_of(window: ObservedWindow, cfg: ImageConfig) -> Pictures:
    """Return which pictures of a window are sent: the wanted views that every observed frame has.

    Public trees can lack depth. Without any view, pixels are the camera's; if none is wanted, those of the settings.
    """
    in_all = frozenset.intersection(*window.frame_files)
    views = tuple([view for view in cfg.modalities if VIEW_FILES[view] in in_all])
    size_px = scaled_size(window.width_px, window.height_px, cfg.max_side_px if views or not cfg.modalities else None)
    return Pictures(views, size_px, cfg.layout, cfg.depth_range_m)


class FrameEncoder:
    """Reads and encodes frames on any thread, each once; keeps the last CACHE_FRAMES of them."""

    def __init__(self, encode: Callable[[np.ndarray], EncodedImage]) -> None:
        self._encode = encode
        self._cache: OrderedDict[tuple[Path, Pictures], Future[list[EncodedImage]]] = OrderedDict()
        self._lock = threading.Lock()

    def encode(self, frame: Path, pictures: Pictures) -> list[EncodedImage]:
        """Return the pictures of one frame, one per view or a tiled one; InputError if a file cannot be read."""
        key = (frame, pictures)
        with self._lock:
            is_new = key not in self._cache
            future = self._cache.setdefault(key, Future())
            self._cache.move_to_end(key)
            if len(self._cache) > CACHE_FRAMES:
                self._cache.popitem(last=False)
        if is_new:  # other threads wait for it
            try:
                future.set_result([self._encode(picture) for picture in pictures.read(frame)])
            except Exception as error:
                future.set_exception(error)
        return future.result()
