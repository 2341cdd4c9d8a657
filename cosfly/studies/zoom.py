"""`cosfly study zoom`: the same flights at every level of zoom (tab:zoom_eval), and optical against digital zoom.

Every flight is flown clean at each level, so that differences are the lens's alone. What is measured of a frame: the
size of the target's projected 3D box, its rendered visibility, and the IoU of that box with the box of the person's
pixels (track quality). Means are taken over the frames of a flight that show some of the target, then over flights; the
spread is over flights, and so are the intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import BaseModel, Field

from cosfly.geometry import box_iou, intrinsic_matrix
from cosfly.look.topview import add_caption
from cosfly.products.boxes import check_ground, read_boxes
from cosfly.products.frames import Camera, level_name, rgb_bytes
from cosfly.products.traces import read_traces
from cosfly.reading.documents import FileFormat
from cosfly.render.contract import Renderer
from cosfly.render.flight import MARGIN_M, FlightScript, check_flight, draw_frame
from cosfly.render.perturbation import Surroundings
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import renderer_of, script_flight
from cosfly.work.chance import rng_for
from cosfly.work.runner import Item, Outcome, Watch, Work, advance, run_items
from cosfly.work.stage_folder import Resume, StageFolder, result_of
from cosfly.work.store import write_bytes, write_json

FORMAT = FileFormat("cosfly.zoom_study", "1.0")
STAGE = "zoom_study"
NUM_RESAMPLES, INTERVAL_PERCENT = 1000, (2.5, 97.5)  # of flights
HEAD = ("level", "deg", "35 mm", "target px", "visibility %", "IoU")  # of `text_rows`
FIGURES = ("width_px", "height_px", "visibility", "track_quality")
PAPER = {
    110: (12, 24, 89.2, 0.72),
    90: (18, 36, 85.7, 0.81),
    60: (32, 64, 71.3, 0.88),
    30: (68, 136, 52.1, 0.93),
}  # tab:zoom_eval
KERNELS = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}
# Structural similarity of Wang, Bovik, Sheikh and Simoncelli 2004: an 11 px Gaussian window of 1.5 px, and its two
# constants.
WINDOW_PX, SIGMA_PX, K1, K2 = 11, 1.5, 0.01, 0.03
MOST_FLIGHTS = 4
TILE_WIDTH_PX, PANEL_WIDTH_PX = 480, 960
BOX_COLOR = (255, 40, 40)


class ZoomStudyConfig(RenderConfig):
    """Settings of the study: those of rendering, and what is looked at."""

    num_flights: int = Field(50, ge=1, description="flights, the first of the traces that the planner kept")
    every: int = Field(2, ge=1, description="every how many frames of a flight are drawn")
    magnifications: tuple[float, ...] = Field(
        (2.0, 5.0),
        min_length=1,
        description="how many times digital zoom enlarges the middle of the widest level's picture",
    )
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
    """What the journal holds of a flight: by level, and by magnification and kernel. best_frame: shows most of the
    target at the widest level."""

    levels: dict[str, Level]
    fidelity: dict[str, dict[str, dict[str, float]]]
    best_frame: int


def camera_of(cfg: RenderConfig, fov_deg: float) -> Camera:
    """Give the camera of the settings with another field of view, degrees, horizontal."""
    return Camera(cfg.width_px, cfg.height_px, intrinsic_matrix(cfg.width_px, cfg.height_px, fov_deg))


def at_level(script: FlightScript, camera: Camera) -> FlightScript:
    """The same flight through another lens."""
    return replace(script, cameras=(camera,) * len(script.cameras))


# --- optical against digital zoom (fig:zoom_fidelity) -----------------------------------------------------------------


@dataclass(frozen=True)
class Fidelity:
    """A digital picture against the optical one of the same view. psnr_db of all three channels; ssim of brightness;
    sharpness: its mean squared gradient of brightness as a share of the optical one's, 1 where it is as sharp.
    """

    psnr_db: float
    ssim: float
    sharpness: float

    def as_json(self) -> dict[str, float]:
        return {name: round(value, 4) for name, value in asdict(self).items()}


def enlarged_camera(camera: Camera, magnification: float) -> Camera:
    """The camera whose picture shows the middle of another's so many times as large."""
    intrinsic = camera.intrinsic.copy()
    intrinsic[[0, 1], [0, 1]] *= magnification
    return replace(camera, intrinsic=intrinsic)


def digital_zoom(rgb: np.ndarray, magnification: float, kernel: str) -> np.ndarray:
    """Enlarge the middle of a picture, (h, w, 3) uint8, to all of it, as exactly as `enlarged_camera` does."""
    height, width = rgb.shape[:2]
    # Pixel (u, v) of the result samples the place that the same ray has in the wide picture; centres lie at + 0.5.
    offsets = [(side - 1) / 2.0 * (1.0 - 1.0 / magnification) for side in (width, height)]
    matrix = np.array([[1.0 / magnification, 0.0, offsets[0]], [0.0, 1.0 / magnification, offsets[1]]])
    return cv2.warpAffine(
        rgb, matrix, (width, height), flags=KERNELS[kernel] | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )


def compare(digital: np.ndarray, optical: np.ndarray) -> Fidelity:
    """Measure a digital picture against an optical one, (h, w, 3) uint8 each."""
    error = float(np.mean((digital.astype(np.float64) - optical.astype(np.float64)) ** 2))
    psnr_db = float("inf") if error == 0 else 10.0 * np.log10(255.0**2 / error)
    mine, theirs = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float64) for rgb in (digital, optical))
    edges = _edges(theirs)
    return Fidelity(min(psnr_db, 99.0), ssim(mine, theirs), _edges(mine) / edges if edges else 1.0)


def ssim(one: np.ndarray, two: np.ndarray) -> float:
    """Mean structural similarity of two grey pictures, (h, w) float64 from 0 to 255; 1 for equal ones."""

    def blurred(picture: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(picture, (WINDOW_PX, WINDOW_PX), SIGMA_PX)

    mean_one, mean_two = blurred(one), blurred(two)
    var_one, var_two = blurred(one * one) - mean_one**2, blurred(two * two) - mean_two**2
    shared = blurred(one * two) - mean_one * mean_two
    c1, c2 = (K1 * 255.0) ** 2, (K2 * 255.0) ** 2
    above = (2.0 * mean_one * mean_two + c1) * (2.0 * shared + c2)
    below = (mean_one**2 + mean_two**2 + c1) * (var_one + var_two + c2)
    return float((above / below).mean())


def _edges(grey: np.ndarray) -> float:
    return float(np.mean(np.diff(grey, axis=0)[:, :-1] ** 2 + np.diff(grey, axis=1)[:-1] ** 2))


# --- one flight -------------------------------------------------------------------------------------------------------


def make_worker(cfg: ZoomStudyConfig, boxes: Path, simplified: Path, traces: Path, seed: int) -> Work:
    """Worker factory: give the function that studies one flight."""
    surroundings, all_traces = Surroundings(read_boxes(simplified)), read_traces(traces)
    renderer = renderer_of(cfg, read_boxes(boxes), seed)

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
    found: dict[str, dict[str, list[list[float]]]] = {
        f"{m:g}": {kernel: [] for kernel in KERNELS} for m in cfg.magnifications
    }
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
            kernel: dict(zip(names, np.mean(rows, axis=0).round(4).tolist(), strict=True))
            for kernel, rows in kernels.items()
        }
        for magnification, kernels in found.items()
    }


def optical_and_digital(
    renderer: Renderer, script: FlightScript, i: int, cfg: ZoomStudyConfig
) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Draw frame i: magnification -> the picture of a longer lens, and the digital ones by kernel."""
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
    """Reads both maps and the flights, writes `zoom_study.json`, `zoom_levels.png` and `zoom_fidelity.png`; gives the
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
    summary = summarize(studied, cfg, rng_for(seed, STAGE, "intervals"))
    write_json(product, {**FORMAT.header, "map": box_map.name, "seed": seed, **summary})
    surroundings = Surroundings(read_boxes(simplified))
    renderer = renderer_of(cfg, box_map, seed)
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
        levels.append(
            {
                "level": level_name(fov),
                "fov_deg": fov,
                "focal_length_px": round(camera.focal_px, 2),
                "focal_length_35mm_mm": round(camera.focal_35mm_mm, 2),
                "flights": len(flights),
                "flights_never_visible": sum(flight.frames_visible == 0 for flight in flights),
                "frames": sum(flight.frames for flight in flights),
                "frames_visible": sum(flight.frames_visible for flight in flights),
                **{name: spread([getattr(flight, name) for flight in flights], rng) for name in FIGURES},
            }
        )
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
    """Give mean, deviation and the mean's 95 % interval over flights drawn with replacement (Efron 1979), or None."""
    known = np.array([value for value in values if value is not None])
    if not len(known):
        return dict.fromkeys(("mean", "std", "low", "high"))
    draws = known[rng.integers(len(known), size=(NUM_RESAMPLES, len(known)))].mean(axis=1)
    low, high = np.percentile(draws, INTERVAL_PERCENT)
    std = known.std(ddof=1) if len(known) > 1 else 0.0
    return {
        name: round(float(v), 4) for name, v in (("mean", known.mean()), ("std", std), ("low", low), ("high", high))
    }


def text_rows(product: dict[str, Any]) -> list[list[str]]:
    """Give tab:zoom_eval as rows of text: level, degrees, 35 mm, size, visibility, IoU; under each the paper's."""
    rows = []
    for level in product["levels"]:
        width, height, quality = (
            _cell(level[name], digits) for name, digits in (("width_px", 1), ("height_px", 1), ("track_quality", 3))
        )
        lens = [level["level"], f"{level['fov_deg']:g}", f"{level['focal_length_35mm_mm']:.1f}"]
        rows.append([*lens, f"{width} x {height}", _cell(level["visibility"], 1, 100.0), quality])
        if paper := PAPER.get(round(level["fov_deg"], 3)):
            rows.append(["  the paper", "", "", f"{paper[0]} x {paper[1]}", f"{paper[2]:g}", f"{paper[3]:g}"])
    return rows


def _cell(found: dict[str, float | None], digits: int, scale: float = 1.0) -> str:
    if found["mean"] is None or found["std"] is None:
        return "-"
    return f"{scale * found['mean']:.{digits}f} ± {scale * found['std']:.{digits}f}"


# --- pictures: flights by levels (fig:zoom_demo), optical beside digital zoom
# ---------------------------------------------


def draw_levels(renderer: Renderer, shown: Sequence[tuple[FlightScript, int]], cfg: ZoomStudyConfig) -> bytes:
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
            rgb = frame.rgb.copy()
            if seen.view.in_view:
                x0, y0, x1, y1 = seen.view.bbox_px.round().astype(int).tolist()
                cv2.rectangle(rgb, (x0, y0), (x1, y1), (255, 214, 10), max(1, cfg.width_px // 640))
            size = "" if not seen.view.in_view else f", target {x1 - x0} x {y1 - y0} px"
            tiles.append(add_caption(_scaled(rgb, TILE_WIDTH_PX), f"{level_name(fov)} {fov:g} deg{size}"))
        rows.append(np.hstack(tiles))
    return rgb_bytes(np.vstack(rows))


def draw_fidelity(renderer: Renderer, script: FlightScript, i: int, cfg: ZoomStudyConfig) -> bytes:
    """Draw the widest picture, digital enlargements of its middle, and what a longer lens shows; a PNG."""
    ready(renderer, script)
    wide = at_level(script, camera_of(cfg, cfg.levels_deg[0]))
    rgb = draw_frame(renderer, wide, i, script.perturbed.poses, 0.0)[0].rgb.copy()
    most = max(cfg.magnifications)
    optical, digital = optical_and_digital(renderer, script, i, cfg)[f"{most:g}"]
    (width, height), half = (cfg.width_px, cfg.height_px), 0.5 / most
    corner, other = (
        (round(width * (0.5 - half)), round(height * (0.5 - half))),
        (round(width * (0.5 + half)), round(height * (0.5 + half))),
    )
    cv2.rectangle(rgb, corner, other, BOX_COLOR, max(2, width // 400))
    panels = [(rgb, f"{cfg.levels_deg[0]:g} deg, 1.0x")]
    for kernel, picture in digital.items():
        found = compare(picture, optical)
        panels.append(
            (
                picture,
                f"digital {most:g}x, {kernel}: {found.psnr_db:.1f} dB, SSIM {found.ssim:.2f}, "
                f"sharpness {found.sharpness:.2f}",
            )
        )
    panels.append((optical, f"optical {most:g}x"))
    tiles = [add_caption(_scaled(picture, PANEL_WIDTH_PX), title) for picture, title in panels]
    return rgb_bytes(np.vstack([np.hstack(tiles[:2]), np.hstack(tiles[2:])]))


def _scaled(rgb: np.ndarray, width_px: int) -> np.ndarray:
    height_px = max(1, round(width_px * rgb.shape[0] / rgb.shape[1]))
    method = cv2.INTER_AREA if rgb.shape[1] > width_px else cv2.INTER_NEAREST
    return cv2.resize(rgb, (width_px, height_px), interpolation=method)
