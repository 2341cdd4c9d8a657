"""The pedestrian stage from above: obstacles, region of interest, usable ground and every walk, for a look before going on."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np

from cosfly.grid import OccupancyGrid
from cosfly.products.walks import Walk

LONGER_SIDE_PX = 1600
STRIP_PX = 64  # legend below the map

# RGB
OBSTACLE, MARGIN, UNUSED, USED = (74, 76, 84), (158, 158, 164), (232, 228, 218), (190, 219, 238)
ROI_LINE, INK, PAPER = (226, 120, 20), (30, 30, 30), (252, 251, 247)
LEGEND = (("obstacle", OBSTACLE), ("safety margin", MARGIN), ("free, not used", UNUSED), ("walkable", USED))


def draw_overview(
    grid: OccupancyGrid,
    inflated: OccupancyGrid,
    parts: np.ndarray,
    is_in_roi: np.ndarray | None,
    paths: list[Walk],
) -> bytes:
    """Draw the ground and the walks; a ring is a start, a dot a goal, and north is up.

    Args:
        grid, inflated: occupied cells before and after inflation. parts: (ny, nx), 0 where nobody walks.
        is_in_roi: (ny, nx) bool, or None for the whole map.
    Returns:
        a PNG file.
    """
    picture, scale = _ground_picture(grid, inflated, parts)
    thickness = max(1, round(LONGER_SIDE_PX / 600))
    if is_in_roi is not None:
        outlines, _ = cv2.findContours(is_in_roi.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        for outline in outlines:
            points = _pixels((outline[:, 0] + 0.5) * grid.resolution_m, grid.resolution_m, scale, len(picture))
            cv2.polylines(picture, [points], True, ROI_LINE, thickness, cv2.LINE_AA, shift=4)
    for number, path in enumerate(paths):
        color = path_color(number)
        origin_m = np.array([grid.x_min_m, grid.y_min_m])
        points = _pixels(path.polyline_m - origin_m, grid.resolution_m, scale, len(picture))
        cv2.polylines(picture, [points], False, color, thickness, cv2.LINE_AA, shift=4)
        start, goal = points[0].tolist(), points[-1].tolist()
        cv2.circle(picture, start, 7 << 4, PAPER, -1, cv2.LINE_AA, shift=4)
        cv2.circle(picture, start, 7 << 4, color, thickness, cv2.LINE_AA, shift=4)
        cv2.circle(picture, goal, 6 << 4, color, -1, cv2.LINE_AA, shift=4)
    whole = np.vstack(
        [picture, _legend(picture.shape[1], scale / grid.resolution_m, is_in_roi is not None, len(paths))]
    )
    done, data = cv2.imencode(".png", np.ascontiguousarray(whole[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    assert done, "OpenCV encodes any 8-bit picture"
    return data.tobytes()


def path_color(number: int) -> tuple[int, int, int]:
    """Give a strong RGB colour, neighbours far apart on the colour circle (golden ratio)."""
    red, green, blue = colorsys.hsv_to_rgb((0.02 + number * 0.618034) % 1.0, 0.85, (0.62, 0.85)[number % 2])
    return round(red * 255), round(green * 255), round(blue * 255)


def _ground_picture(grid: OccupancyGrid, inflated: OccupancyGrid, parts: np.ndarray) -> tuple[np.ndarray, float]:
    """Paint the cells, north up; gives the picture and its pixels per cell."""
    num_x, num_y = grid.size
    scale = LONGER_SIDE_PX / max(num_x, num_y)
    classes = np.full((num_y, num_x), 2, dtype=np.uint8)
    classes[parts > 0] = 3
    classes[inflated.occupied] = 1
    classes[grid.occupied] = 0
    cells = np.array([OBSTACLE, MARGIN, UNUSED, USED], dtype=np.uint8)[classes[::-1]]
    size = max(1, round(num_x * scale)), max(1, round(num_y * scale))
    return cv2.resize(cells, size, interpolation=cv2.INTER_NEAREST if scale >= 1 else cv2.INTER_AREA), scale


def _pixels(points_m: np.ndarray, resolution_m: float, scale: float, height_px: int) -> np.ndarray:
    """Map (k, 2) metres from the grid's low corner to (k, 2) int32 pixels with four fractional bits."""
    pixels = points_m / resolution_m * scale
    pixels[:, 1] = height_px - pixels[:, 1]
    return np.round((pixels - 0.5) * 16).astype(np.int32)


def _legend(width_px: int, pixels_per_m: float, has_roi: bool, num_paths: int) -> np.ndarray:
    strip = np.full((STRIP_PX, width_px, 3), PAPER, dtype=np.uint8)
    x = 16
    for name, color in LEGEND:
        cv2.rectangle(strip, (x, 22), (x + 20, 42), color, -1)
        cv2.rectangle(strip, (x, 22), (x + 20, 42), INK, 1)
        x = _text(strip, name, x + 30) + 24
    if has_roi:
        cv2.line(strip, (x, 32), (x + 26, 32), ROI_LINE, 3, cv2.LINE_AA)
        x = _text(strip, "region of interest", x + 36) + 24
    cv2.circle(strip, (x + 8, 32), 7, INK, 2, cv2.LINE_AA)
    x = _text(strip, "start", x + 24) + 16
    cv2.circle(strip, (x + 8, 32), 6, INK, -1, cv2.LINE_AA)
    x = _text(strip, f"goal of {num_paths} walks", x + 24) + 32
    bar_m = next(m for m in (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1) if m * pixels_per_m < 220 or m == 1)
    cv2.line(strip, (x, 32), (x + round(bar_m * pixels_per_m), 32), INK, 2, cv2.LINE_AA)
    _text(strip, f"{bar_m} m", x + round(bar_m * pixels_per_m) + 10)
    return strip


def _text(strip: np.ndarray, text: str, x: int) -> int:
    """Write text at x; gives the x where it ends."""
    cv2.putText(strip, text, (x, 38), cv2.FONT_HERSHEY_SIMPLEX, 0.55, INK, 1, cv2.LINE_AA)
    return x + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)[0][0]
