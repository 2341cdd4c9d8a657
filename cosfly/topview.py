"""Top-down pictures of box maps, for people who check a map before they pay for the stages after it."""

from __future__ import annotations

import cv2
import numpy as np

from cosfly.geometry import box_corners
from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import KINDS

# Softer than CARLA's palette, which is made for masks and not for eyes; RGB. Other kinds: OTHER_COLOR.
COLORS: dict[str, tuple[int, int, int]] = {
    "Roads": (120, 120, 126), "Sidewalks": (196, 190, 180), "RoadLines": (245, 245, 240), "Terrain": (176, 204, 146),
    "Ground": (205, 196, 170), "Water": (112, 158, 204), "Vegetation": (72, 128, 62), "Buildings": (186, 106, 84),
    "Walls": (120, 84, 70), "Fences": (150, 120, 90), "Bridge": (158, 134, 134), "Car": (44, 74, 160),
    "Truck": (30, 44, 110), "Poles": (60, 60, 60), "TrafficLight": (240, 160, 20), "TrafficSigns": (224, 204, 0),
    "Static": (150, 60, 150),
}  # fmt: skip
OTHER_COLOR = (230, 90, 140)
BACKGROUND = (250, 248, 242)
TEXT_COLOR = (30, 30, 30)


def draw_overview(box_map: BoxMap, *, size_px: int = 1200, low_xy=None, high_xy=None) -> np.ndarray:
    """Draw a map from above, low boxes first, the higher the lighter.

    Args:
        size_px: the longer side. low_xy, high_xy: (2,) m, the window; the map's bounds by default.
    Returns:
        (height, width, 3) uint8, RGB, north up.
    """
    if len(box_map) == 0:
        raise ValueError("there is nothing to draw")
    bounds = box_map.bounds()
    low = np.asarray(bounds[0][:2] if low_xy is None else low_xy, dtype=np.float64) - 2.0
    high = np.asarray(bounds[1][:2] if high_xy is None else high_xy, dtype=np.float64) + 2.0
    scale = size_px / (high - low).max()
    width, height = np.maximum(1, np.ceil((high - low) * scale)).astype(int)
    picture = np.full((height, width, 3), BACKGROUND, dtype=np.uint8)
    tops = box_map.centers[:, 2] + box_map.half_extents[:, 2]
    names = {number: name for name, number in KINDS.items()}
    for row in np.argsort(tops, kind="stable"):
        corners = box_corners(
            box_map.centers[row], box_map.half_extents[row], np.radians(box_map.rotations_deg[row, 1])
        )
        footprint = corners[[0, 2, 6, 4], :2]  # box_corners varies z fastest, then y, then x
        pixels = np.stack([(footprint[:, 0] - low[0]), (high[1] - footprint[:, 1])], axis=1) * scale
        color = np.array(COLORS.get(names[int(box_map.kinds[row])], OTHER_COLOR), dtype=np.float64)
        color += (255 - color) * np.clip(tops[row] / 80.0, 0.0, 0.5)
        points = np.round(pixels * 16).astype(np.int32)  # four fractional bits
        cv2.fillPoly(picture, [points], color.tolist(), cv2.LINE_AA, shift=4)
        if tops[row] > 0.5:
            cv2.polylines(picture, [points], True, (color * 0.6).tolist(), 1, cv2.LINE_AA, shift=4)
    return picture


def add_caption(picture: np.ndarray, text: str) -> np.ndarray:
    """Give the picture with one line of text in a strip on top."""
    strip = np.full((36, picture.shape[1], 3), BACKGROUND, dtype=np.uint8)
    cv2.putText(strip, text, (10, 25), cv2.FONT_HERSHEY_SIMPLEX, 0.6, TEXT_COLOR, 1, cv2.LINE_AA)
    return np.vstack([strip, picture])


def png_bytes(picture: np.ndarray) -> bytes:
    """Encode an RGB picture."""
    ok, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    assert ok, "OpenCV encodes any 8-bit picture"
    return data.tobytes()
