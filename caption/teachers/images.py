"""Pictures for a request: each frame is encoded once and reused by the windows that share it."""

from __future__ import annotations

import base64
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caption.schema import ImageConfig, ObservedWindow
from cosfly.frame_views import VIEW_FILES, View, encode_picture, read_view


@dataclass(frozen=True)
class EncodedImage:
    """One picture of a request."""

    url: str  # base64 data URL
    digest: str  # of the encoded bytes


def available_views(window: ObservedWindow, wanted: Sequence[View]) -> tuple[View, ...]:
    """Give the wanted views that every observed frame has (public trees can lack depth)."""
    return tuple(view for view in wanted if all(VIEW_FILES[view] in names for names in window.frame_files))


class FrameEncoder:
    """Reads, scales and encodes frames; keeps the last `cache_frames` of them."""

    def __init__(self, cfg: ImageConfig) -> None:
        self.cfg = cfg
        self.num_encoded = 0
        self._cache: OrderedDict[tuple[Path, tuple[View, ...]], list[EncodedImage]] = OrderedDict()
        self._lock = threading.Lock()  # frames are encoded on several threads

    def holds(self, frame: Path, views: tuple[View, ...]) -> bool:
        """Tell whether a frame is encoded already."""
        return (frame, views) in self._cache

    def encode(self, frame: Path, views: tuple[View, ...]) -> list[EncodedImage]:
        """Give the pictures of one frame: one per view, or one in all when tiled.

        Raises:
            InputError: a file is missing or not an image.
        """
        key = (frame, views)
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        limits: dict[str, Any] = {"max_side_px": self.cfg.max_side_px, "depth_range_m": self.cfg.depth_range_m}
        pictures = [read_view(frame, view, **limits) for view in views]
        if self.cfg.layout == "tiled":
            height = min(picture.shape[0] for picture in pictures)
            pictures = [np.hstack([picture[:height] for picture in pictures])]
        images = [self._encode(picture) for picture in pictures]
        with self._lock:
            self.num_encoded += 1
            self._cache[key] = images
            while len(self._cache) > self.cfg.cache_frames:
                self._cache.popitem(last=False)
        return images

    def _encode(self, rgb: np.ndarray) -> EncodedImage:
        data = encode_picture(rgb, self.cfg.encoding, self.cfg.jpeg_quality)
        url = f"data:image/{self.cfg.encoding};base64,{base64.b64encode(data).decode('ascii')}"
        return EncodedImage(url, hashlib.sha256(data).hexdigest())
