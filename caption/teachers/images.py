"""Pictures for a request: RGB, depth in pseudo-colour, segmentation with the pedestrian highlighted.

Each frame is encoded once and reused by the windows that share it.
"""

from __future__ import annotations

import base64
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from caption.schema import ImageConfig, Modality, ObservedWindow
from cosfly.errors import RenderError
from cosfly.products.frames import SKY_DEPTH_M, read_depth, read_instance, read_rgb
from cosfly.products.kinds import KINDS

MODALITY_FILES: dict[Modality, str] = {"rgb": "rgb.png", "depth": "depth.npy", "segmentation": "instance.png"}
HIGHLIGHT_RGB = (255, 40, 40)
NUM_SHADES = 24


@dataclass(frozen=True)
class EncodedImage:
    """One picture of a request."""

    url: str  # base64 data URL
    digest: str  # of the encoded bytes


def available_modalities(window: ObservedWindow, wanted: Sequence[Modality]) -> tuple[Modality, ...]:
    """Give the wanted modalities that every observed frame has (public trees can lack depth)."""
    return tuple(
        modality for modality in wanted if all(MODALITY_FILES[modality] in names for names in window.frame_files)
    )


class FrameEncoder:
    """Reads, scales and encodes frames; keeps the last `cache_frames` of them."""

    def __init__(self, cfg: ImageConfig) -> None:
        self.cfg = cfg
        self.num_encoded = 0
        self._cache: OrderedDict[tuple[Path, tuple[Modality, ...]], list[EncodedImage]] = OrderedDict()
        self._lock = threading.Lock()  # frames are encoded on several threads

    def holds(self, frame: Path, modalities: tuple[Modality, ...]) -> bool:
        """Tell whether a frame is encoded already."""
        return (frame, modalities) in self._cache

    def encode(self, frame: Path, modalities: tuple[Modality, ...]) -> list[EncodedImage]:
        """Give the pictures of one frame: one per modality, or one in all when tiled.

        Raises:
            InputError: a file is missing or not an image.
        """
        key = (frame, modalities)
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        views = [self._view(frame, modality) for modality in modalities]
        if self.cfg.layout == "tiled":
            height = min(view.shape[0] for view in views)
            views = [np.hstack([view[:height] for view in views])]
        images = [self._encode(view, frame) for view in views]
        with self._lock:
            self.num_encoded += 1
            self._cache[key] = images
            while len(self._cache) > self.cfg.cache_frames:
                self._cache.popitem(last=False)
        return images

    def _view(self, frame: Path, modality: Modality) -> np.ndarray:
        if modality == "rgb":
            return _bounded(read_rgb(frame), self.cfg.max_side_px)
        if modality == "depth":
            return depth_colors(_bounded(read_depth(frame), self.cfg.max_side_px, nearest=True), self.cfg.depth_range_m)
        kinds, ids = read_instance(frame)
        return segmentation_colors(
            _bounded(kinds, self.cfg.max_side_px, nearest=True), _bounded(ids, self.cfg.max_side_px, nearest=True)
        )

    def _encode(self, rgb: np.ndarray, frame: Path) -> EncodedImage:
        suffix, options = ".png", [cv2.IMWRITE_PNG_COMPRESSION, 6]
        if self.cfg.encoding == "jpeg":
            suffix, options = ".jpg", [cv2.IMWRITE_JPEG_QUALITY, self.cfg.jpeg_quality]
        done, data = cv2.imencode(suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
        if not done:
            raise RenderError("cannot encode the image", where=frame, got=str(rgb.shape))
        encoded = data.tobytes()
        url = f"data:image/{self.cfg.encoding};base64,{base64.b64encode(encoded).decode('ascii')}"
        return EncodedImage(url, hashlib.sha256(encoded).hexdigest())


def depth_colors(depth_m: np.ndarray, range_m: float) -> np.ndarray:
    """Colour z-depth (h, w) with inferno reversed: near is bright, `range_m` and the sky are black; (h, w, 3) RGB.

    The scale is fixed, not stretched per frame, so that the same colour is the same distance in every frame.
    """
    share = np.clip(np.where(depth_m >= SKY_DEPTH_M, range_m, depth_m) / range_m, 0.0, 1.0)
    share = np.where(depth_m <= 0.0, 1.0, share)  # 0.0 means invalid, not near
    reversed_level = np.round(255.0 * (1.0 - share)).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(reversed_level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def segmentation_colors(kinds: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Colour classes in muted, fixed tones and pedestrians in red; kinds (h, w), ids (h, w) -> (h, w, 3) RGB."""
    # Neighbouring instances of one class differ a little, so that single buildings can be told apart.
    shades = (ids % NUM_SHADES) * 37 % NUM_SHADES
    rows = np.minimum(kinds, len(KINDS) - 1) * np.uint16(NUM_SHADES) + shades
    return np.take(_PALETTE, rows, axis=0)


def _palette() -> np.ndarray:
    """Muted tones, NUM_SHADES of each class, (29 * NUM_SHADES, 3): hues by golden-angle steps, low saturation, so that only the
    pedestrians are vivid.
    """
    hues = (np.arange(len(KINDS)) * 111) % 180
    hsv = np.stack([hues, np.full(len(KINDS), 70), np.full(len(KINDS), 150)], axis=-1).astype(np.uint8)
    tones = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0].astype(np.int64)
    shades = np.arange(NUM_SHADES) - NUM_SHADES // 2
    colors = np.clip(tones[:, None] + shades[:, None], 0, 255).astype(np.uint8)
    colors[KINDS["Pedestrians"]] = HIGHLIGHT_RGB
    return colors.reshape(-1, 3)


_PALETTE = _palette()


def _bounded(image: np.ndarray, max_side_px: int, *, nearest: bool = False) -> np.ndarray:
    height, width = image.shape[:2]
    scale = max_side_px / max(height, width)
    if scale >= 1.0:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA)
