"""The pedestrian stage from above: obstacles, region of interest, usable ground and every walk, for a look before going on."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np

from cosfly.look.topview import INK, TopView, draw_dot, draw_line, draw_text, png_bytes
from cosfly.pedestrians.walkable import WalkableGround
from cosfly.products.walks import Walk

LONGER_SIDE_PX = 1600
STRIP_PX = 64  # legend below the map

# RGB
OBSTACLE, MARGIN, UNUSED, USED = (74, 76, 84), (158, 158, 164), (232, 228, 218), (190, 219, 238)
ROI_LINE, PAPER = (226, 120, 20), (252, 251, 247)
LEGEND = (("obstacle", OBSTACLE), ("safety margin", MARGIN), ("free, not used", UNUSED), ("walkable", USED))


def draw_overview(ground: WalkableGround, paths: list[Walk]) -> bytes:
    """Draw the ground and the walks; a ring is a start, a dot a goal, and north is up; PNG bytes."""
    picture, view = _ground_picture(ground)
    thickness = max(1, round(LONGER_SIDE_PX / 600))
    if ground.is_in_roi is not None:
        outlines, _ = cv2.findContours(ground.is_in_roi.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        for outline in outlines:
            draw_line(picture, view.pixels(ground.grid.centers_of(outline[:, 0])), ROI_LINE, thickness, closed=True)
    for number, path in enumerate(paths):
        color, line = path_color(number), view.pixels(path.polyline_m)
        draw_line(picture, line, color, thickness)
        draw_dot(picture, line[0], 7, PAPER)
        draw_dot(picture, line[0], 7, color, thickness)
        draw_dot(picture, line[-1], 6, color)
    legend = _legend(picture.shape[1], view.pixels_per_m, ground.is_in_roi is not None, len(paths))
    return png_bytes(np.vstack([picture, legend]))


def path_color(number: int) -> tuple[int, int, int]:
    """Give a strong RGB colour, neighbours far apart on the colour circle (golden ratio)."""
    red, green, blue = colorsys.hsv_to_rgb((0.02 + number * 0.618034) % 1.0, 0.85, (0.62, 0.85)[number % 2])
    return round(red * 255), round(green * 255), round(blue * 255)


def _ground_picture(ground: WalkableGround) -> tuple[np.ndarray, TopView]:
    """Paint the cells, north up; gives the picture and where it lies."""
    grid = ground.grid
    num_x, num_y = grid.size
    scale = LONGER_SIDE_PX / max(num_x, num_y)
    classes = np.full((num_y, num_x), 2, dtype=np.uint8)
    classes[ground.walkable] = 3
    classes[ground.inflated.occupied] = 1
    classes[grid.occupied] = 0
    cells = np.array([OBSTACLE, MARGIN, UNUSED, USED], dtype=np.uint8)[classes[::-1]]
    width, height = max(1, round(num_x * scale)), max(1, round(num_y * scale))
    picture = cv2.resize(cells, (width, height), interpolation=cv2.INTER_NEAREST if scale >= 1 else cv2.INTER_AREA)
    per_m = scale / grid.resolution_m
    # A cell's colour fills its pixels; a place is 0 in the middle of the first pixel.
    view = TopView(grid.x_min_m + 0.5 / per_m, grid.y_min_m + (height - 0.5) / per_m, per_m, (width, height))
    return picture, view


def _legend(width_px: int, pixels_per_m: float, has_roi: bool, num_paths: int) -> np.ndarray:
    strip = np.full((STRIP_PX, width_px, 3), PAPER, dtype=np.uint8)
    x, y = 16, 38
    for name, color in LEGEND:
        cv2.rectangle(strip, (x, 22), (x + 20, 42), color, -1)
        cv2.rectangle(strip, (x, 22), (x + 20, 42), INK, 1)
        x = draw_text(strip, name, x + 30, y) + 24
    if has_roi:
        draw_line(strip, np.array([[x, 32], [x + 26, 32]]), ROI_LINE, 3)
        x = draw_text(strip, "region of interest", x + 36, y) + 24
    draw_dot(strip, np.array([x + 8, 32]), 7, INK, 2)
    x = draw_text(strip, "start", x + 24, y) + 16
    draw_dot(strip, np.array([x + 8, 32]), 6, INK)
    x = draw_text(strip, f"goal of {num_paths} walks", x + 24, y) + 32
    bar_m = next(m for m in (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1) if m * pixels_per_m < 220 or m == 1)
    end = x + round(bar_m * pixels_per_m)
    draw_line(strip, np.array([[x, 32], [end, 32]]), INK, 2)
    draw_text(strip, f"{bar_m} m", end + 10, y)
    return strip
