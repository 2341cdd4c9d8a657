"""`cosfly render zoom-study`: the same flights at every level of zoom (tab:zoom_eval), and optical against digital zoom.

Every flight is flown clean at each level, so that differences are the lens's alone. What is measured of a frame: the size of the target's
projected 3D box, its rendered visibility, and the IoU of that box with the box of the person's pixels (track quality). Means are taken over
the frames of a flight that show some of the target, then over flights; the spread is over flights, and so are the intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from cosfly.geometry import box_iou, intrinsic_matrix
from cosfly.products.boxes import check_ground, read_boxes
from cosfly.products.frames import Camera, level_name
from cosfly.products.traces import read_traces
from cosfly.render.contract import Renderer
from cosfly.render.flight import MARGIN_M, FlightScript, draw_frame
from cosfly.render.perturbation import Surroundings
from cosfly.render.sense import check_flight
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import open_renderer, script_flight
from cosfly.render.zoom.fidelity import KERNELS, compare, digital_zoom, enlarged_camera
from cosfly.work.chance import rng_for
from cosfly.work.runner import Item, Outcome, Watch, Work, advance, run_items
from cosfly.work.stage_folder import Resume, StageFolder, result_of
from cosfly.work.store import write_bytes, write_json

SCHEMA, VERSION = "cosfly.zoom_study", "1.0"
STAGE = "zoom_study"
NUM_RESAMPLES, INTERVAL_PERCENT = 1000, (2.5, 97.5)  # of flights
FIGURES = ("width_px", "height_px", "visibility", "track_quality")
PAPER = {
    110: (12, 24, 89.2, 0.72),
    90: (18, 36, 85.7, 0.81),
    60: (32, 64, 71.3, 0.88),
    30: (68, 136, 52.1, 0.93),
}  # tab:zoom_eval


class ZoomStudyConfig(RenderConfig):
    """Settings of the study: those of rendering, and what is looked at."""

    num_flights: int = Field(50, ge=1, description="flights, the first of the traces that the planner kept")
    every: int = Field(2, ge=1, description="every how many frames of a flight are drawn")
    magnifications: tuple[float, ...] = Field(
        (2.0, 5.0), min_length=1, description="how many times digital zoom enlarges the middle of the widest level's picture"
    )  # fmt: skip
    fidelity_frames: int = Field(
        3, ge=1, description="frames of a flight at which optical and digital zoom are compared"
    )

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
    """What the journal holds of a flight: by level, and by magnification and kernel. best_frame: shows most of the target at the widest level."""

    levels: dict[str, Level]
    fidelity: dict[str, dict[str, dict[str, float]]]
    best_frame: int


def camera_of(cfg: RenderConfig, fov_deg: float) -> Camera:
    """Give the camera of the settings with another field of view, degrees, horizontal."""
    return Camera(cfg.width_px, cfg.height_px, intrinsic_matrix(cfg.width_px, cfg.height_px, fov_deg))


def at_level(script: FlightScript, camera: Camera) -> FlightScript:
    """The same flight through another lens."""
    return replace(script, cameras=(camera,) * len(script.cameras))


# --- one flight -------------------------------------------------------------------------------------------------------


def make_worker(cfg: ZoomStudyConfig, boxes: Path, simplified: Path, traces: Path, seed: int) -> Work:
    """Worker factory: give the function that studies one flight."""
    surroundings, all_traces = Surroundings(read_boxes(simplified)), read_traces(traces)
    renderer = open_renderer(cfg.backend, read_boxes(boxes), cfg.width_px, cfg.height_px, cfg.look)

    def work(item: Item) -> Outcome:
        trace = all_traces[item.payload]
        check_flight(trace, surroundings)
        script = script_flight(trace, item.payload, "clean", "study", surroundings, cfg, seed)
        ready(renderer, script)
        levels, seen = {}, np.zeros(len(script.time_s))
        for fov in cfg.levels_deg:
            levels[f"{fov:g}"], visibility = _level(renderer, at_level(script, camera_of(cfg, fov)), cfg)
            seen = visibility if fov == cfg.levels_deg[0] else seen
        fidelity = _fidelity(renderer, script, cfg)
        return Outcome(Studied(levels=levels, fidelity=fidelity, best_frame=int(np.argmax(seen))).model_dump())

    return work


def ready(renderer: Renderer, script: FlightScript) -> None:
    """Prepare a renderer for a flight, as drawing it does."""
    places = np.concatenate([script.perturbed.poses.positions_m, script.perturbed.poses.targets_m])
    renderer.prepare(places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M)


def _level(renderer: Renderer, script: FlightScript, cfg: ZoomStudyConfig) -> tuple[Level, np.ndarray]:
    """Measure a flight at one level; and the visibility of its frames, (n,), 0 of those that are left out."""
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
    return Level(frames=len(frames), frames_visible=len(rows), **named), visibility


def _fidelity(renderer: Renderer, script: FlightScript, cfg: ZoomStudyConfig) -> dict[str, dict[str, dict[str, float]]]:
    """Compare optical with digital zoom at some frames of a flight: magnification -> kernel -> means of Fidelity."""
    frames = np.unique(np.linspace(0, len(script.time_s) - 1, cfg.fidelity_frames + 2).round().astype(int)[1:-1])
    found: dict[str, dict[str, list[list[float]]]] = {f"{m:g}": {kernel: [] for kernel in KERNELS} for m in cfg.magnifications}  # fmt: skip
    names: list[str] = []
    for i in frames.tolist():
        pictures = optical_and_digital(renderer, script, i, cfg)
        for magnification, (optical, digital) in pictures.items():
            for kernel, picture in digital.items():
                measured = compare(picture, optical).as_json()
                names = list(measured)
                found[magnification][kernel].append(list(measured.values()))
    return {
        magnification: {
            kernel: dict(zip(names, np.mean(rows, axis=0).round(4).tolist(), strict=True)) for kernel, rows in kernels.items()
        }
        for magnification, kernels in found.items()
    }  # fmt: skip


def optical_and_digital(
    renderer: Renderer, script: FlightScript, i: int, cfg: ZoomStudyConfig
) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Draw frame i: magnification -> the picture of a longer lens, and the digital ones of the widest level by kernel."""
    wide = camera_of(cfg, cfg.levels_deg[0])
    rgb = draw_frame(renderer, at_level(script, wide), i, script.perturbed.poses, 0.0)[0].rgb
    found = {}
    for magnification in cfg.magnifications:
        longer = at_level(script, enlarged_camera(wide, magnification))
        optical = draw_frame(renderer, longer, i, script.perturbed.poses, 0.0)[0].rgb
        found[f"{magnification:g}"] = optical, {k: digital_zoom(rgb, magnification, k) for k in KERNELS}
    return found


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
    """Reads both maps and the flights, writes `zoom_study.json`, `zoom_levels.png` and `zoom_fidelity.png`; gives the first's path.

    Raises:
        NothingKept: no flight could be drawn.
    """
    from cosfly.render.zoom.figures import draw_fidelity, draw_levels

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
    finished = run_items(stage, items, make_worker, arguments, workers=workers, watch=watch, label="zoom-study: frames")
    if not finished.kept:
        raise stage.nothing_kept(finished.tally, expected="a flight that can be drawn")
    studied = {record.id: result_of(record, Studied) for record in finished.kept}
    summary = summarize(studied, cfg, rng_for(seed, STAGE, "intervals"))
    write_json(product, {"schema": SCHEMA, "schema_version": VERSION, "map": box_map.name, "seed": seed, **summary})
    surroundings = Surroundings(read_boxes(simplified))
    renderer = open_renderer(cfg.backend, box_map, cfg.width_px, cfg.height_px, cfg.look)
    shown = [
        (script_flight(trace, k, "clean", "study", surroundings, cfg, seed), studied[trace.path_id].best_frame)
        for k, trace in passed
        if trace.path_id in studied
    ]
    write_bytes(out / "zoom_levels.png", draw_levels(renderer, shown, cfg))
    write_bytes(out / "zoom_fidelity.png", draw_fidelity(renderer, *shown[0], cfg))
    renderer.close()
    stage.finish([product, out / "zoom_levels.png", out / "zoom_fidelity.png"], finished.tally)
    return product


def summarize(studied: dict[str, Studied], cfg: ZoomStudyConfig, rng: np.random.Generator) -> dict[str, Any]:
    """Give the content of `zoom_study.json`: means and spreads over flights, and the flights' own figures."""
    levels = []
    for fov in cfg.levels_deg:
        flights = [one.levels[f"{fov:g}"] for one in studied.values()]
        camera = camera_of(cfg, fov)
        levels.append({
            "level": level_name(fov), "fov_deg": fov, "focal_length_px": round(camera.focal_px, 2),
            "focal_length_35mm_mm": round(camera.focal_35mm_mm, 2), "flights": len(flights),
            "flights_never_visible": sum(flight.frames_visible == 0 for flight in flights),
            "frames": sum(flight.frames for flight in flights), "frames_visible": sum(flight.frames_visible for flight in flights),
            **{name: spread([getattr(flight, name) for flight in flights], rng) for name in FIGURES},
        })  # fmt: skip
    fidelity = {
        magnification: {
            kernel: {
                name: spread([one.fidelity[magnification][kernel][name] for one in studied.values()], rng)
                for name in ("psnr_db", "ssim", "sharpness")
            }
            for kernel in KERNELS
        }
        for magnification in (f"{m:g}" for m in cfg.magnifications)
    }
    return {
        "settings": cfg.model_dump(mode="json"), "levels": levels, "fidelity": fidelity,
        "by_flight": {name: one.model_dump() for name, one in studied.items()},
    }  # fmt: skip


def spread(values: Sequence[float | None], rng: np.random.Generator) -> dict[str, float | None]:
    """Give mean, standard deviation and the 95 % interval of the mean over flights drawn with replacement (Efron 1979), None without flights."""
    known = np.array([value for value in values if value is not None])
    if not len(known):
        return dict.fromkeys(("mean", "std", "low", "high"))
    draws = known[rng.integers(len(known), size=(NUM_RESAMPLES, len(known)))].mean(axis=1)
    low, high = np.percentile(draws, INTERVAL_PERCENT)
    std = known.std(ddof=1) if len(known) > 1 else 0.0
    return {name: round(float(v), 4) for name, v in (("mean", known.mean()), ("std", std), ("low", low), ("high", high))}  # fmt: skip


def text_rows(product: dict[str, Any]) -> list[list[str]]:
    """Give tab:zoom_eval as rows of text: level, degrees, 35 mm, size, visibility, IoU; under a level of the paper what that has."""
    rows = []
    for level in product["levels"]:
        width, height, quality = (_cell(level[name], digits) for name, digits in (("width_px", 1), ("height_px", 1), ("track_quality", 3)))  # fmt: skip
        lens = [level["level"], f"{level['fov_deg']:g}", f"{level['focal_length_35mm_mm']:.1f}"]
        rows.append([*lens, f"{width} x {height}", _cell(level["visibility"], 1, 100.0), quality])
        if paper := PAPER.get(round(level["fov_deg"], 3)):
            rows.append(["  the paper", "", "", f"{paper[0]} x {paper[1]}", f"{paper[2]:g}", f"{paper[3]:g}"])
    return rows


def _cell(found: dict[str, float | None], digits: int, scale: float = 1.0) -> str:
    if found["mean"] is None or found["std"] is None:
        return "-"
    return f"{scale * found['mean']:.{digits}f} ± {scale * found['std']:.{digits}f}"
