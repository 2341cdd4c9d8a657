"""One view under every weather and time of day: the paper's nine pictures, and a sheet of all presets (app:weather)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from cosfly.formats.boxes import check_ground, read_boxes
from cosfly.formats.traces import read_traces
from cosfly.formats.weather import TIMES, WEATHERS, resolved
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.render.person import choose_clothes, gait_of
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import renderer_of
from cosfly.render.track import MARGIN_M
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.seeding import rng_for
from cosfly.viz.frame_views import encode_picture
from cosfly.viz.topview import PAPER, draw_text

FIGURE = (  # fig:weather_gallery
    ("clear", "morning"), ("clear", "noon"), ("clear", "dusk"),
    ("heavy_rain", "noon"), ("dense_fog", "morning"), ("smog", "dusk"),
    ("overcast", "night"), ("snow_haze", "noon"), ("dust_haze", "morning"),
)  # fmt: skip
FIGURE_COLUMNS = 3
FIGURE_TILE_PX = (640, 360)  # width, height
SHEET_TILE_PX = (320, 180)
STRIP_PX = 26  # height of the names below a picture
JPEG_QUALITY = 88
FIGURE_NAME, SHEET_NAME = "weather_gallery.jpg", "weather_sheet.jpg"
FOV_DEG = 67.38  # 90 degrees at a zoom of 1.5


def run(
    cfg: RenderConfig, boxes: Path, traces: Path, out: Path, *, frame: int | None = None,
    fov_deg: float = FOV_DEG, seed: int = 0, advance: Callable[[], object] = lambda: None,
) -> tuple[Path, Path]:  # fmt: skip
    """Read `boxes_3d.json` and `drone_trace.json`; write the figure and the sheet and return their paths.

    Args:
        frame: Index of a frame of the first clean track, as in the paper; None takes the frame that looks down least.
        advance: Called for each picture that is drawn.

    Raises:
        InputError: There is no trajectory, no such frame, or an input is malformed.
    """
    all_traces = read_traces(traces)
    if not all_traces:
        raise InputError("the file contains no drone trajectory", where=traces)
    trace = all_traces[0]
    index = int(np.argmax(trace.rotations_deg[:, 0])) if frame is None else frame
    if not 0 <= index < len(trace.time_s):
        expected = f"an index from 0 to {len(trace.time_s) - 1}"
        where = f"{traces}: {trace.path_id}"
        raise InputError("the trajectory has no frame with this index", where=where, got=index, expected=expected)
    box_map = read_boxes(boxes)
    check_ground(box_map, boxes)
    pose = world_from_camera(trace.positions_m[index], trace.rotations_deg[index])
    clothes = choose_clothes(rng_for(seed, "weather_gallery", trace.path_id))
    person = gait_of(trace.targets_m, trace.time_s).posed(index, trace.targets_m[index], clothes)
    points_m = np.concatenate([trace.positions_m, trace.targets_m])
    low_m = points_m.min(axis=0) - MARGIN_M
    high_m = points_m.max(axis=0) + MARGIN_M
    intrinsic = intrinsic_matrix(cfg.width_px, cfg.height_px, fov_deg)
    pictures = {}
    renderer = renderer_of(cfg, box_map, seed)
    try:
        for weather, time_of_day in product(WEATHERS, TIMES):
            renderer.prepare(low_m, high_m, resolved(WEATHERS[weather], TIMES[time_of_day]))
            rgb = renderer.render(pose, intrinsic, person).rgb
            pictures[weather, time_of_day] = cv2.resize(rgb, FIGURE_TILE_PX, interpolation=cv2.INTER_AREA)
            advance()
    finally:
        renderer.close()
    figure = _grid([_tile(pictures[pair], pair, FIGURE_TILE_PX) for pair in FIGURE], FIGURE_COLUMNS)
    sheet = _grid([_tile(picture, pair, SHEET_TILE_PX) for pair, picture in pictures.items()], len(TIMES))
    for name, picture in ((FIGURE_NAME, figure), (SHEET_NAME, sheet)):
        write_bytes(out / name, encode_picture(picture, "jpeg", JPEG_QUALITY))
    return out / FIGURE_NAME, out / SHEET_NAME


def _tile(picture: np.ndarray, pair: tuple[str, str], size_px: tuple[int, int]) -> np.ndarray:
    """Return a picture of the grid with the names of its presets below it."""
    strip = np.full((STRIP_PX, size_px[0], 3), PAPER, np.uint8)
    draw_text(strip, ", ".join(pair).replace("_", " "), size_px[0] / 2.0, 18, 0.5, align=0.5)
    return np.vstack([cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA), strip])


def _grid(tiles: list[np.ndarray], num_columns: int) -> np.ndarray:
    return np.vstack([np.hstack(tiles[k : k + num_columns]) for k in range(0, len(tiles), num_columns)])
