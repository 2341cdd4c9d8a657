"""A rendered map from above: the backdrop of the editor of regions (sec:appendix_g_mask_editor).

Each square tile is drawn from straight above its middle. So the ground is in place to the pixel, and a wall of 30 m
leans by 2 m at most.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cosfly.formats.boxes import BoxMap, check_ground, read_boxes
from cosfly.formats.roi import WorldFrame, write_backdrop
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import renderer_of
from cosfly.runtime.errors import ConfigError
from cosfly.runtime.png import LONGEST_SIDE_PX
from cosfly.viz.topview import TopView, png_bytes

HEIGHT_M = 400.0  # of the camera over the ground
TILE_M = 50.0  # side of a tile
NORTH_UP_DEG = np.array([-90.0, 90.0, 0.0])
NO_HAZE_M = 1e9
Bounds = tuple[float, float, float, float]  # west, south, east, north, m


def draw_backdrop(cfg: RenderConfig, box_map: BoxMap, view: TopView) -> np.ndarray:
    """Draw a window of the world by the backend of the settings, without weather and haze.

    Returns:
        (h, w, 3) uint8 RGB of the view's size.
    """
    side_px = max(16, round(TILE_M * view.pixels_per_m))
    side_m = side_px / view.pixels_per_m
    look = cfg.look.model_copy(update={"haze_m": NO_HAZE_M})
    cfg = cfg.model_copy(update={"width_px": side_px, "height_px": side_px, "look": look})
    intrinsic = intrinsic_matrix(side_px, side_px, float(np.degrees(2.0 * np.arctan(side_m / 2.0 / HEIGHT_M))))
    width, height = view.size_px
    picture = np.empty((height, width, 3), dtype=np.uint8)
    renderer = renderer_of(cfg, box_map)
    try:
        for top in range(0, height, side_px):
            for left in range(0, width, side_px):
                middle_m = np.array([left + side_px / 2.0, -top - side_px / 2.0]) / view.pixels_per_m
                middle_m += [view.west_m, view.north_m]
                place_m = np.append(middle_m, box_map.ground_z_m)
                eye_m = np.add(place_m, [0.0, 0.0, HEIGHT_M])
                renderer.prepare(place_m - side_m / 2.0, eye_m + side_m / 2.0)
                pose = world_from_camera(eye_m, NORTH_UP_DEG)
                room = picture[top : top + side_px, left : left + side_px]
                room[:] = renderer.render(pose, intrinsic, None).rgb[: room.shape[0], : room.shape[1]]
        return picture
    finally:
        renderer.close()


def run(cfg: RenderConfig, boxes: Path, out: Path, *, bounds_m: Bounds | None = None, pixels_per_m: float) -> Path:
    """Read `boxes_3d.json`, write the PNG `out` and its world frame, and return `out`.

    Args:
        bounds_m: Shown part; None shows the whole map.
    """
    box_map = read_boxes(boxes)
    check_ground(box_map, boxes)
    low, high = box_map.bounds()
    west, south, east, north = bounds_m or (*low[:2].tolist(), *high[:2].tolist())
    size = np.ceil(np.array([east - west, north - south]) * pixels_per_m)
    if not ((size >= 1).all() and (size <= LONGEST_SIDE_PX).all()):
        got = f"{size[0]:g} x {size[1]:g} px for the bounds {west:g} {south:g} {east:g} {north:g}"
        expected = f"1 to {LONGEST_SIDE_PX} px on each side"
        fix = "change --bounds or --pixels-per-m"
        raise ConfigError(
            "the backdrop picture would be too large or empty", where="--bounds", got=got, expected=expected, fix=fix
        )
    frame = WorldFrame(west_m=west, north_m=north, metres_per_px=1.0 / pixels_per_m)
    view = TopView(west, north, pixels_per_m, (int(size[0]), int(size[1])))
    write_backdrop(out, png_bytes(draw_backdrop(cfg, box_map, view)), frame)
    return out
