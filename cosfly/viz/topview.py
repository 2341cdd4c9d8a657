"""Drawing of maps from above, and of lines, dots and texts for overviews and plots.

Places on a picture are floats, px from its top left corner, rounded to a sixteenth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Self

import cv2
import numpy as np
import shapely

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KIND_NAMES
from cosfly.geometry.axes import box_corners
from cosfly.geometry.grid import upward_order

# RGB, softer than CARLA's palette, which is made for masks. Other kinds: OTHER_COLOR.
COLORS: dict[str, tuple[int, int, int]] = {
    "Roads": (120, 120, 126), "Sidewalks": (196, 190, 180), "RoadLines": (245, 245, 240), "Terrain": (176, 204, 146),
    "Ground": (205, 196, 170), "Water": (112, 158, 204), "Vegetation": (72, 128, 62), "Buildings": (186, 106, 84),
    "Walls": (120, 84, 70), "Fences": (150, 120, 90), "Bridge": (158, 134, 134), "Car": (44, 74, 160),
    "Truck": (30, 44, 110), "Poles": (60, 60, 60), "TrafficLight": (240, 160, 20), "TrafficSigns": (224, 204, 0),
    "Static": (150, 60, 150),
}  # fmt: skip
OTHER_COLOR = (230, 90, 140)
PAPER, INK, HALO = (250, 248, 242), (30, 30, 30), (255, 255, 255)
FONT, TEXT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.55
FRACTION_BITS = 4  # of a place's fixed-point coordinates, for OpenCV
Color = Sequence[float]  # RGB, 0..255


@dataclass(frozen=True)
class TopView:
    """A window of the world, north up."""

    west_m: float  # x of pixel (0, 0)
    north_m: float  # y of pixel (0, 0)
    pixels_per_m: float
    size_px: tuple[int, int]  # width, height

    @classmethod
    def around(cls, points_m: np.ndarray, longer_side_px: int, margin_m: float = 2.0) -> Self:
        """Return a window that shows all points, (n, 2 or 3) m, with a margin."""
        low, high = points_m[:, :2].min(axis=0) - margin_m, points_m[:, :2].max(axis=0) + margin_m
        scale = longer_side_px / (high - low).max()
        width, height = np.maximum(1, np.ceil((high - low) * scale)).astype(int).tolist()
        return cls(float(low[0]), float(high[1]), float(scale), (width, height))

    def pixels(self, points_m: np.ndarray) -> np.ndarray:
        """Return the places of (n, 2 or 3) m on the picture, (n, 2)."""
        offsets_m = np.stack([points_m[:, 0] - self.west_m, self.north_m - points_m[:, 1]], axis=1)
        return _fixed(offsets_m * self.pixels_per_m) / 2**FRACTION_BITS


def footprint(box_map: BoxMap, row: int) -> np.ndarray:
    """Return the corners of a box from above, in order, (4, 2) m."""
    corners = box_corners(box_map.centers[row], box_map.half_extents[row], np.radians(box_map.rotations_deg[row, 1]))
    return corners[[0, 2, 6, 4], :2]  # box_corners varies z fastest, then y, then x


def draw_map(box_map: BoxMap, view: TopView) -> np.ndarray:
    """Draw a map from above, low boxes first, high ones lighter; (height, width, 3) uint8 RGB."""
    picture = np.full((*view.size_px[::-1], 3), PAPER, dtype=np.uint8)
    tops = box_map.centers[:, 2] + box_map.half_extents[:, 2]
    for row in upward_order(box_map):
        outline = view.pixels(footprint(box_map, row))
        color = np.array(COLORS.get(KIND_NAMES[int(box_map.kinds[row])], OTHER_COLOR), dtype=np.float64)
        color += (255 - color) * np.clip(tops[row] / 80.0, 0.0, 0.5)
        draw_area(picture, outline, color.tolist())
        if tops[row] > 0.5:
            draw_line(picture, outline, (color * 0.6).tolist(), closed=True)
    return picture


def draw_area(picture: np.ndarray, points: np.ndarray, color: Color) -> None:
    cv2.fillPoly(picture, [_fixed(points)], color, cv2.LINE_AA, shift=FRACTION_BITS)


def draw_line(
    picture: np.ndarray, points: np.ndarray, color: Color, width: int = 1, *, closed: bool = False, halo: int = 0
) -> None:
    """Draw a line through points, (n, 2) px; halo: width of the white line under it, 0 for none."""
    fixed = _fixed(points)
    if halo:
        cv2.polylines(picture, [fixed], closed, HALO, halo, cv2.LINE_AA, shift=FRACTION_BITS)
    cv2.polylines(picture, [fixed], closed, color, width, cv2.LINE_AA, shift=FRACTION_BITS)


def draw_dot(picture: np.ndarray, point: np.ndarray, radius_px: int, color: Color, width: int = -1) -> None:
    """Draw a disc around a point, (2,) px, or a ring of a width."""
    center = _fixed(point).tolist()
    cv2.circle(picture, center, radius_px << FRACTION_BITS, color, width, cv2.LINE_AA, shift=FRACTION_BITS)


def draw_text(
    picture: np.ndarray, text: str, x: float, y: float, scale: float = TEXT_SCALE, color: Color = INK, *,
    align: float = 0.0, halo: Color | None = None,
) -> int:  # fmt: skip
    """Write text with its baseline at y; return the x of its end. align: 0 begins at x, 0.5 is centred, 1 ends at x."""
    width = cv2.getTextSize(text, FONT, scale, 1)[0][0]
    left = round(x - align * width)
    base = round(y)
    if halo is not None:  # of shifted letters: thicker ones are wider in OpenCV 5
        for dx, dy in product((-1, 0, 1), repeat=2):
            cv2.putText(picture, text, (left + dx, base + dy), FONT, scale, halo, 1, cv2.LINE_AA)
    cv2.putText(picture, text, (left, base), FONT, scale, color, 1, cv2.LINE_AA)
    return left + width


def draw_scale(picture: np.ndarray, view: TopView) -> None:
    """Draw a bar of a round length at the lower left, at most a fifth of the width."""
    most_m = picture.shape[1] / 5 / view.pixels_per_m
    length_m = max(m for k in range(-2, 6) for m in (10**k, 2 * 10**k, 5 * 10**k) if m <= most_m)
    bar = np.array([(12, picture.shape[0] - 12), (12 + length_m * view.pixels_per_m, picture.shape[0] - 12)])
    draw_line(picture, bar, INK, 3, halo=7)
    draw_text(picture, f"{length_m:g} m", 12, picture.shape[0] - 22, halo=HALO)


def draw_labels(picture: np.ndarray, labels: Sequence[tuple[str, np.ndarray]]) -> None:
    """Write names at their places, (2,) px; a name that would cover another name or place is moved, with a line."""
    frame = shapely.box(0, 0, picture.shape[1], picture.shape[0])
    taken: list[shapely.Geometry] = [shapely.Point(place).buffer(6) for _, place in labels]
    directions = [np.array([np.cos(angle), np.sin(angle)]) for angle in np.linspace(-np.pi, np.pi, 17)]
    offsets = [away_px * direction for away_px in range(0, 400, 8) for direction in directions]  # the nearest first
    for k, (name, place) in enumerate(labels):
        (width, height), _ = cv2.getTextSize(name, FONT, TEXT_SCALE, 1)
        others = shapely.union_all(taken[:k] + taken[k + 1 :])
        half = np.array([width + 6, height + 8]) / 2
        middles = ((middle, shapely.box(*(middle - half), *(middle + half))) for middle in place + offsets)
        free = ((middle, box) for middle, box in middles if frame.contains(box) and not box.intersects(others))
        middle, box = next(free, (place, taken[k]))
        taken.append(box)
        if line := list(shapely.LineString([place, middle]).difference(box).coords):
            draw_line(picture, np.array(line), INK, halo=3)
            draw_dot(picture, place, 3, INK)
    for (name, _), box in zip(labels, taken[len(labels) :], strict=True):
        draw_text(picture, name, box.centroid.x, box.bounds[3] - 4, align=0.5, halo=HALO)


def add_caption(picture: np.ndarray, text: str) -> np.ndarray:
    """Return the picture with one line of text in a strip on top."""
    strip = np.full((36, picture.shape[1], 3), PAPER, dtype=np.uint8)
    draw_text(strip, text, 10, 25, 0.6)
    return np.vstack([strip, picture])


def captioned_grid(
    panels: Sequence[tuple[str, np.ndarray]], num_columns: int, size_px: tuple[int, int] | None = None
) -> np.ndarray:
    """Return pictures of one size in rows, each below its caption; size_px: width and height, if they are scaled."""
    tiles = [
        add_caption(panel if size_px is None else cv2.resize(panel, size_px, interpolation=cv2.INTER_AREA), title)
        for title, panel in panels
    ]
    return np.vstack([np.hstack(tiles[k : k + num_columns]) for k in range(0, len(tiles), num_columns)])


def png_bytes(picture: np.ndarray) -> bytes:
    """Encode an RGB picture."""
    ok, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    assert ok, "OpenCV encodes any 8-bit picture"
    return data.tobytes()


def _fixed(points: np.ndarray) -> np.ndarray:
    """Return points in whole sixteenths of a pixel, int32."""
    return np.round(np.asarray(points, dtype=np.float64) * 2**FRACTION_BITS).astype(np.int32)
