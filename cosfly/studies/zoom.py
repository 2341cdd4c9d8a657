"""`cosfly study zoom`: the same flights at every level of zoom (tab:zoom_eval), and optical against digital zoom.

Every flight is flown clean at each level, so that differences are the lens's alone. What is measured of a frame: the
size of the target's projected 3D box, its rendered visibility, and the IoU of that box with the box of the person's
pixels (track quality). Means are taken over the frames of a flight that show some of the target, then over flights; the
spread is over flights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import BaseModel, Field

from cosfly.formats.boxes import check_ground, read_boxes
from cosfly.formats.frames import Camera, level_name, rgb_bytes
from cosfly.formats.traces import read_traces
from cosfly.geometry.axes import box_iou, intrinsic_matrix
from cosfly.render.contract import Renderer
from cosfly.render.perturbation import Surroundings
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import make_track_script, renderer_of
from cosfly.render.track import MARGIN_M, TrackScript, check_track, draw_frame
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder, result_of
from cosfly.runtime.worker import Item, Outcome, Work, advance
from cosfly.viz.tables import TextTable
from cosfly.viz.topview import add_caption

FORMAT = FileFormat("cosfly.zoom_study", "2.0")
STAGE = "zoom_study"
FIGURES = ("width_px", "height_px", "visibility", "track_quality")
KERNELS = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}
MAGNIFICATION = 5.0  # of digital zoom, as in fig:zoom_fidelity
MOST_FLIGHTS = 4
TILE_WIDTH_PX, PANEL_WIDTH_PX = 480, 960
TARGET_COLOR, CROP_COLOR = (255, 214, 10), (255, 40, 40)


class ZoomStudyConfig(RenderConfig):
    """Settings of the study: those of rendering, and what is looked at."""

    num_flights: int = Field(50, ge=1, description="flights, the first of the traces that the planner kept")
    every: int = Field(2, ge=1, description="every how many frames of a flight are drawn")

    @property
    def levels_deg(self) -> list[float]:
        """All levels, widest first."""
        return sorted(set(self.fovs_deg), reverse=True)


class Level(BaseModel):
    """Means of one flight at one level, over its frames that show the target; None where none does."""

    frames: int
    frames_visible: int
    width_px: float | None
    height_px: float | None
    visibility: float | None
    track_quality: float | None


class Studied(BaseModel):
    """What the journal holds of a flight, by level. best_frame: shows most of the target at the widest level."""

    levels: dict[str, Level]
    best_frame: int


def camera_of(cfg: RenderConfig, fov_deg: float) -> Camera:
    """Return the camera of the settings with another field of view, degrees, horizontal."""
    return Camera(cfg.width_px, cfg.height_px, intrinsic_matrix(cfg.width_px, cfg.height_px, fov_deg))


def at_level(script: TrackScript, camera: Camera) -> TrackScript:
    """Return the same flight through another lens."""
    return replace(script, cameras=(camera,) * len(script.cameras))


def enlarged_camera(camera: Camera, magnification: float) -> Camera:
    """Return the camera that shows the middle of another's picture so many times as large."""
    intrinsic = camera.intrinsic.copy()
    intrinsic[[0, 1], [0, 1]] *= magnification
    return replace(camera, intrinsic=intrinsic)


def digital_zoom(rgb: np.ndarray, magnification: float, kernel: str) -> np.ndarray:
    """Enlarge the middle of a picture, (h, w, 3) uint8, to all of it, as exactly as `enlarged_camera` does."""
    height, width = rgb.shape[:2]
    # Pixel (u, v) of the result samples the place that the same ray has in the wide picture; centres lie at + 0.5.
    offsets = [(side - 1) / 2.0 * (1.0 - 1.0 / magnification) for side in (width, height)]
    matrix = np.array([[1.0 / magnification, 0.0, offsets[0]], [0.0, 1.0 / magnification, offsets[1]]])
    how = KERNELS[kernel] | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(rgb, matrix, (width, height), flags=how, borderMode=cv2.BORDER_REPLICATE)


# --- one flight -------------------------------------------------------------------------------------------------------


def make_worker(cfg: ZoomStudyConfig, boxes: Path, simplified: Path, traces: Path, seed: int) -> Work:
    """Worker factory: return the function that studies one flight."""
    surroundings, all_traces = Surroundings(read_boxes(simplified)), read_traces(traces)
    renderer = renderer_of(cfg, read_boxes(boxes), seed)

    def work(item: Item) -> Outcome:
        trace = all_traces[item.payload]
        check_track(trace, surroundings)
        script = make_track_script(trace, item.payload, "clean", "study", surroundings, cfg, seed)
        ready(renderer, script)
        levels, best_frame = {}, 0
        for fov in reversed(cfg.levels_deg):
            levels[f"{fov:g}"], best_frame = _level(renderer, at_level(script, camera_of(cfg, fov)), cfg)
        return Outcome(Studied(levels=levels, best_frame=best_frame).model_dump())

    return work


def ready(renderer: Renderer, script: TrackScript) -> None:
    """Prepare a renderer for a flight, as drawing it does."""
    places = np.concatenate([script.perturbed.poses.positions_m, script.perturbed.poses.targets_m])
    renderer.prepare(places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M)


def _level(renderer: Renderer, script: TrackScript, cfg: ZoomStudyConfig) -> tuple[Level, int]:
    """Measure a flight at one level; and the frame that shows most of the target."""
    rows, visibility = [], np.zeros(len(script.time_s))
    frames = range(0, len(script.time_s), cfg.every)
    for i in frames:
        _, seen = draw_frame(renderer, script, i, script.perturbed.poses, cfg.visible_threshold)
        advance()
        visibility[i] = seen.visibility
        if seen.visibility > 0:
            box, mask = seen.view.bbox_px, seen.mask_bbox_px
            quality = 0.0 if np.isnan(mask).any() else box_iou(box, mask)
            rows.append((box[2] - box[0], box[3] - box[1], seen.visibility, quality))
    means = np.array(rows).mean(axis=0).round(4).tolist() if rows else [None] * len(FIGURES)
    named = dict(zip(FIGURES, means, strict=True))
    return Level(frames=len(frames), frames_visible=len(rows), **named), int(np.argmax(visibility))


# --- all flights ------------------------------------------------------------------------------------------------------


def run(
    cfg: ZoomStudyConfig,
    boxes: Path,
    simplified: Path,
    traces: Path,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 0,
    watch: Watch = Watch(),
    resume: Resume = "if-same",
) -> Path:
    """Reads both maps and the flights, writes `zoom_study.json`, `zoom_levels.png` and `zoom_fidelity.png`; returns the
    first's path.

    Raises:
        NothingKept: no flight could be drawn.
    """
    inputs = {"boxes": boxes, "simplified": simplified, "traces": traces}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs, seed=seed, resume=resume)
    product = out / "zoom_study.json"
    if stage.is_complete:
        return product
    cfg = cfg.model_copy(update={"first_timestamp": 0})  # flights are drawn, not named
    box_map = read_boxes(boxes)
    check_ground(box_map, boxes)
    all_traces = read_traces(traces)
    passed = [(k, trace) for k, trace in enumerate(all_traces) if trace.drop_reason is None][: cfg.num_flights]
    steps = len(cfg.levels_deg)
    items = [Item(t.path_id, k, steps * len(range(0, len(t.time_s), cfg.every))) for k, t in passed]
    arguments = (cfg, boxes, simplified, traces, seed)
    finished = run_items(stage, items, make_worker, arguments, workers=workers, watch=watch, label="study zoom: frames")
    if not finished.tally.kept:
        raise stage.nothing_kept(finished.tally, expected="a flight that can be drawn")
    studied = {record.id: result_of(record, Studied) for record in finished.kept}
    write_json(product, {**FORMAT.header, "map": box_map.name, "seed": seed, **summarize(studied, cfg)})
    surroundings = Surroundings(read_boxes(simplified))
    renderer = renderer_of(cfg, box_map, seed)
    shown = [
        (make_track_script(trace, k, "clean", "study", surroundings, cfg, seed), studied[trace.path_id].best_frame)
        for k, trace in passed
        if trace.path_id in studied
    ]
    write_bytes(out / "zoom_levels.png", draw_levels(renderer, shown, cfg))
    write_bytes(out / "zoom_fidelity.png", draw_fidelity(renderer, *shown[0], cfg))
    renderer.close()
    stage.finish([product, out / "zoom_levels.png", out / "zoom_fidelity.png"], finished.tally)
    return product


def summarize(studied: dict[str, Studied], cfg: ZoomStudyConfig) -> dict[str, Any]:
    """Return the content of `zoom_study.json`: means and spreads over flights, and the flights' own figures."""
    levels = []
    for fov in cfg.levels_deg:
        flights = [one.levels[f"{fov:g}"] for one in studied.values()]
        camera = camera_of(cfg, fov)
        levels.append(
            {
                "level": level_name(fov),
                "fov_deg": fov,
                "focal_length_px": round(camera.focal_px, 2),
                "focal_length_35mm_mm": round(camera.focal_35mm_mm, 2),
                "flights": len(flights),
                "frames": sum(flight.frames for flight in flights),
                "frames_visible": sum(flight.frames_visible for flight in flights),
                **{name: spread([getattr(flight, name) for flight in flights]) for name in FIGURES},
            }
        )
    by_flight = {name: one.model_dump() for name, one in studied.items()}
    return {"settings": cfg.model_dump(mode="json"), "levels": levels, "by_flight": by_flight}


def spread(values: Sequence[float | None]) -> dict[str, float | None]:
    """Return mean and deviation over the flights that have a value, or None."""
    known = np.array([value for value in values if value is not None])
    if not len(known):
        return {"mean": None, "std": None}
    std = known.std(ddof=1) if len(known) > 1 else 0.0
    return {"mean": round(float(known.mean()), 4), "std": round(float(std), 4)}


def text_table(product: dict[str, Any]) -> TextTable:
    """Return tab:zoom_eval as text."""
    rows = []
    for level in product["levels"]:
        width, height, seen, quality = (_cell(level[name], 1 if name.endswith("_px") else 3) for name in FIGURES)
        lens = [level["level"], f"{level['fov_deg']:g}", f"{level['focal_length_35mm_mm']:.1f}"]
        rows.append([*lens, f"{width} x {height}", seen, quality])
    columns = ["level", "deg", "35 mm", "target px", "visibility", "IoU"]
    return TextTable("Zoom (mean ± standard deviation over flights)", columns, rows)


def _cell(found: dict[str, float | None], digits: int) -> str:
    return "-" if found["mean"] is None else f"{found['mean']:.{digits}f} ± {found['std']:.{digits}f}"


# --- pictures: flights by levels (fig:zoom_demo), optical and digital zoom (fig:zoom_fidelity) ------------------------


def draw_levels(renderer: Renderer, shown: Sequence[tuple[TrackScript, int]], cfg: ZoomStudyConfig) -> bytes:
    """Draw one frame of up to four flights, a row each, at every level, widest first; a PNG.

    Args:
        shown: flights, and which of their frames.
    """
    rows = []
    picked = np.unique(np.linspace(0, len(shown) - 1, min(len(shown), MOST_FLIGHTS)).round().astype(int))
    for script, i in (shown[k] for k in picked.tolist()):
        ready(renderer, script)
        tiles = []
        for fov in cfg.levels_deg:
            drawn = at_level(script, camera_of(cfg, fov))
            frame, seen = draw_frame(renderer, drawn, i, script.perturbed.poses, cfg.visible_threshold)
            rgb, size = frame.rgb.copy(), ""
            if seen.view.in_view:
                x0, y0, x1, y1 = seen.view.bbox_px.round().astype(int).tolist()
                cv2.rectangle(rgb, (x0, y0), (x1, y1), TARGET_COLOR, max(1, cfg.width_px // 640))
                size = f", target {x1 - x0} x {y1 - y0} px"
            tiles.append(add_caption(_scaled(rgb, TILE_WIDTH_PX), f"{level_name(fov)} {fov:g} deg{size}"))
        rows.append(np.hstack(tiles))
    return rgb_bytes(np.vstack(rows))


def draw_fidelity(renderer: Renderer, script: TrackScript, i: int, cfg: ZoomStudyConfig) -> bytes:
    """Draw the widest picture, digital enlargements of its middle, and what a longer lens shows; a PNG."""
    ready(renderer, script)
    wide = camera_of(cfg, cfg.levels_deg[0])
    longer = at_level(script, enlarged_camera(wide, MAGNIFICATION))
    rgb, optical = (
        draw_frame(renderer, lens, i, script.perturbed.poses, 0.0)[0].rgb for lens in (at_level(script, wide), longer)
    )
    size, half = np.array([cfg.width_px, cfg.height_px]), 0.5 / MAGNIFICATION
    low, high = (np.round(size * share).astype(int).tolist() for share in (0.5 - half, 0.5 + half))
    marked = cv2.rectangle(rgb.copy(), low, high, CROP_COLOR, max(2, cfg.width_px // 400))
    panels = [(marked, f"{cfg.levels_deg[0]:g} deg, 1.0x")]
    for kernel in KERNELS:
        digital = digital_zoom(rgb, MAGNIFICATION, kernel)
        error = np.mean((digital.astype(np.float64) - optical) ** 2)
        psnr_db = 10.0 * np.log10(255.0**2 / max(float(error), 1e-5))
        panels.append((digital, f"digital {MAGNIFICATION:g}x, {kernel}: {psnr_db:.1f} dB"))
    panels.append((optical, f"optical {MAGNIFICATION:g}x"))
    tiles = [add_caption(_scaled(picture, PANEL_WIDTH_PX), title) for picture, title in panels]
    return rgb_bytes(np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[2:])]))


def _scaled(rgb: np.ndarray, width_px: int) -> np.ndarray:
    height_px = max(1, round(width_px * rgb.shape[0] / rgb.shape[1]))
    method = cv2.INTER_AREA if rgb.shape[1] > width_px else cv2.INTER_NEAREST
    return cv2.resize(rgb, (width_px, height_px), interpolation=method)
