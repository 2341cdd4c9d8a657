"""The files of one frame folder of the playback tree: rgb.png, depth.npy, instance.png, meta.json."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cosfly.errors import InputError
from cosfly.store import read_json

FRAMES_DIR = "frames_playback"
FRAME_FILES = ("rgb.png", "depth.npy", "instance.png", "meta.json")
SKY_DEPTH_M, INVALID_DEPTH_M = 1000.0, 0.0


def frame_name(index: int) -> str:
    return f"{FRAMES_DIR}/frame_{index:05d}"


def read_rgb(frame: Path) -> np.ndarray:
    """Read `rgb.png` of a frame folder, (h, w, 3) uint8 RGB; an alpha channel is left out.

    Raises:
        InputError: missing or not an image.
    """
    return cv2.cvtColor(_read_png(frame / "rgb.png"), cv2.COLOR_BGR2RGB)


def read_instance(frame: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read `instance.png` of a frame folder.

    Returns:
        semantic kinds (h, w) uint8 and instance ids (h, w) uint16.
    """
    bgr = _read_png(frame / "instance.png")
    # OpenCV loads B, G, R: R is the semantic tag, G the low and B the high byte of the id.
    return bgr[..., 2], bgr[..., 1].astype(np.uint16) | (bgr[..., 0].astype(np.uint16) << 8)


def read_depth(frame: Path) -> np.ndarray:
    """Read `depth.npy` of a frame folder, (h, w) float32 z-depth in m; 1000.0 is sky, 0.0 invalid."""
    path = frame / "depth.npy"
    try:
        depth = np.load(path, allow_pickle=False)
    except OSError as error:
        raise InputError("cannot read the depth", where=path, got=error.strerror or str(error)) from None
    except (ValueError, EOFError) as error:
        raise InputError("not a NumPy array", where=path, got=str(error)) from None
    if depth.ndim != 2 or depth.dtype != np.float32:
        raise InputError("not a depth image", where=path, got=f"{depth.dtype} {depth.shape}", expected="float32 (h, w)")
    return depth


def read_meta(frame: Path) -> dict:
    """Read `meta.json` of a frame folder."""
    meta = read_json(frame / "meta.json", what="frame annotation")
    if not isinstance(meta, dict):
        raise InputError("not an annotation", where=frame / "meta.json", got=type(meta).__name__, expected="an object")
    return meta


def _read_png(path: Path) -> np.ndarray:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError("cannot read the image", where=path, got=error.strerror) from None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if image is None:
        raise InputError("not an image", where=path, got=f"{len(data)} bytes", expected="a PNG")
    return image
