"""One view under every weather and time of day: the paper's nine pictures, and a sheet of all presets (app:weather)."""

import contextlib
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from cosfly.formats.boxes import check_ground, read_boxes
from cosfly.formats.traces import read_traces
from cosfly.formats.weather import TIMES, WEATHERS, resolved
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.render.contract import PERSON_ID
from cosfly.render.person import choose_clothes, gait_of
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import renderer_of
from cosfly.render.track import MARGIN_M
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.seeding import rng_for
from cosfly.viz.frame_views import encode_picture
from cosfly.viz.topview import captioned_grid

FIGURE = (  # fig:weather_gallery
    ("clear", "morning"), ("clear", "noon"), ("clear", "dusk"),
    ("heavy_rain", "noon"), ("dense_fog", "morning"), ("smog", "dusk"),
    ("overcast", "night"), ("snow_haze", "noon"), ("dust_haze", "morning"),
)  # fmt: skip
FIGURE_COLUMNS = 3
FIGURE_TILE_PX = (640, 360)  # width, height
SHEET_TILE_PX = (320, 180)
JPEG_QUALITY = 88
FIGURE_NAME, SHEET_NAME = "weather_gallery.jpg", "weather_sheet.jpg"
FOV_DEG = 67.38  # 90 degrees at a zoom of 1.5: 2 atan(tan(45 deg) / 1.5)


def run(cfg: RenderConfig, boxes: Path, traces: Path, out: Path, *, seed: int = 0) -> tuple[Path, Path]:
    """Read `boxes_3d.json` and `drone_trace.json`; write the figure and the sheet and return their paths.

    They show the frame of the first trajectory that looks down least.
    """
    all_traces = read_traces(traces)
    if not all_traces:
        raise InputError("the file contains no drone trajectory", where=traces, fix="run the plan stage again")
    trace = all_traces[0]
    index = int(np.argmax(trace.rotations_deg[:, 0]))
    box_map = read_boxes(boxes)
    check_ground(box_map, boxes)
    pose = world_from_camera(trace.positions_m[index], trace.rotations_deg[index])
    clothes = choose_clothes(rng_for(seed, "weather_gallery", trace.path_id))
    person = gait_of(trace.targets_m, trace.time_s).posed(index, trace.targets_m[index], clothes)
    points_m = np.concatenate([trace.positions_m, trace.targets_m])
    low_m = points_m.min(axis=0) - MARGIN_M
    high_m = points_m.max(axis=0) + MARGIN_M
    intrinsic = intrinsic_matrix(cfg.width_px, cfg.height_px, FOV_DEG)
    pictures = {}
    with (
        contextlib.closing(renderer_of(cfg, box_map)) as renderer,
        progress_bar("study weather: pictures", len(WEATHERS) * len(TIMES)) as advance,
    ):
        for weather, time_of_day in product(WEATHERS, TIMES):
            renderer.prepare(low_m, high_m, resolved(WEATHERS[weather], TIMES[time_of_day]))
            rgb = renderer.render(pose, intrinsic, {PERSON_ID: person}).rgb
            name = f"{weather}, {time_of_day}".replace("_", " ")
            pictures[weather, time_of_day] = name, cv2.resize(rgb, FIGURE_TILE_PX, interpolation=cv2.INTER_AREA)
            advance(1)
    figure = captioned_grid([pictures[pair] for pair in FIGURE], FIGURE_COLUMNS)
    sheet = captioned_grid(list(pictures.values()), len(TIMES), SHEET_TILE_PX)
    for name, picture in ((FIGURE_NAME, figure), (SHEET_NAME, sheet)):
        write_bytes(out / name, encode_picture(picture, "jpeg", JPEG_QUALITY))
    return out / FIGURE_NAME, out / SHEET_NAME
