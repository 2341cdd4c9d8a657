"""`cosfly study zoom`: the same trajectories at every level of zoom (tab:zoom_eval), and optical against digital zoom.

The render stage draws the clean tracks once per level, so only the lens differs. Figures of a frame: the size of the
target's projected 3D box, its rendered visibility, and the IoU of that box with the box of the target's pixels (track
quality). Means are taken over the frames of a track that show some of the target, then over tracks.
"""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cosfly.formats.frames import Camera, level_name, read_rgb, rgb_bytes
from cosfly.formats.playback import Track
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import box_iou
from cosfly.render import stage as rendering
from cosfly.render.camera import ZoomConfig
from cosfly.render.settings import RenderConfig
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import FileFormat, write_json
from cosfly.viz.frame_views import spread
from cosfly.viz.tables import TextTable, cells
from cosfly.viz.topview import captioned_grid

FORMAT = FileFormat("cosfly.zoom_study", "3.0")
FIGURES = ("width_px", "height_px", "visibility", "track_quality")
KERNELS = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}
MAGNIFICATION = 5.0  # of digital zoom, as in fig:zoom_fidelity
MOST_SHOWN = 4  # tracks in zoom_levels.png
TILE_WIDTH_PX, PANEL_WIDTH_PX = 480, 960
TARGET_COLOR, CROP_COLOR = (255, 214, 10), (255, 40, 40)  # RGB


def enlarged_fov_deg(fov_deg: float, magnification: float) -> float:
    """Return the field of view that shows the middle of a picture enlarged."""
    return math.degrees(2.0 * math.atan(math.tan(math.radians(fov_deg) / 2.0) / magnification))


def tree_of(out: Path, fov_deg: float) -> Path:
    """Return the folder of the playback tree of a level."""
    return out / f"fov_{fov_deg:.6g}"


def run(
    cfg: RenderConfig, boxes: Path, simplified: Path, traces: Path, out: Path, *, every: int = 2, **options: Any
) -> Path:
    """Read both maps and `drone_trace.json`; write a playback tree per level, `zoom_study.json`, whose path is
    returned, and two pictures.

    Args:
        every: Every how many poses of a track are drawn.
        options: `seed`, `workers` and `watch` of the render stage.
    """

    def draw(fov_deg: float, path_index: int | None = None) -> list[Track]:
        level = {"fovs_deg": (fov_deg,), "zoom": ZoomConfig(), "frame_stride": every, "path_index": path_index}
        files = {"tracks": ("clean",), "modalities": ("rgb",), "first_timestamp": 0}
        settings = cfg.model_copy(update=level | files | {"weather_mode": "off"})
        tree = rendering.run(settings, boxes, simplified, traces, tree_of(out, fov_deg), **options)
        return [read_track(folder) for folder in find_tracks(tree)]

    levels = {fov: draw(fov) for fov in sorted(set(cfg.fovs_deg), reverse=True)}
    wide_deg, wide = next(iter(levels.items()))
    first = wide[0]
    (longer,) = draw(enlarged_fov_deg(wide_deg, MAGNIFICATION), first.source["path_index"])
    write_bytes(out / "zoom_levels.png", _draw_levels(levels))
    write_bytes(out / "zoom_fidelity.png", _draw_fidelity(first, longer))
    rows = [_level_row(rendering.camera_of(cfg, fov), tracks) for fov, tracks in levels.items()]
    settings = cfg.model_dump(mode="json") | {"every": every}
    product = out / "zoom_study.json"
    write_json(product, {**FORMAT.header, "town": first.town, "settings": settings, "levels": rows})
    return product


def _track_figures(track: Track) -> dict[str, Any]:
    """Return the counts of frames of a track and its means by figure; None where no frame shows the target."""
    seen = np.flatnonzero(track.target.visibility > 0)
    boxes = track.target.bbox
    masks = np.full_like(boxes, np.nan) if track.target.mask_bbox is None else track.target.mask_bbox
    quality = [0.0 if np.isnan(masks[i]).any() else box_iou(boxes[i], masks[i]) for i in seen]
    rows = np.column_stack([boxes[seen, 2:] - boxes[seen, :2], track.target.visibility[seen], quality])
    means = rows.mean(axis=0).round(4).tolist() if len(rows) else [None] * len(FIGURES)
    return {"frames": len(track), "frames_visible": len(rows), **dict(zip(FIGURES, means, strict=True))}


def _level_row(camera: Camera, tracks: list[Track]) -> dict[str, Any]:
    """Return the row of a level: mean and standard deviation over tracks, and the figures of each track."""
    by_flight = {track.source["scenario_id"]: _track_figures(track) for track in tracks}
    row: dict[str, Any] = {
        "level": level_name(camera.fov_deg), "fov_deg": round(camera.fov_deg, 6),
        "focal_length_px": round(camera.focal_px, 2), "focal_length_35mm_mm": round(camera.focal_35mm_mm, 2),
        "flights": len(tracks),
        **{name: sum(figures[name] for figures in by_flight.values()) for name in ("frames", "frames_visible")},
    }  # fmt: skip
    for name in FIGURES:
        row[name] = {"mean": None, "std": None}
        if means := [figures[name] for figures in by_flight.values() if figures[name] is not None]:
            std = float(np.std(means, ddof=1)) if len(means) > 1 else 0.0
            row[name] = {"mean": round(float(np.mean(means)), 4), "std": round(std, 4)}
    return row | {"by_flight": by_flight}


def text_table(product: dict[str, Any]) -> TextTable:
    """Return tab:zoom_eval as text."""
    rows = []
    for level in product["levels"]:
        digits = [1 if name.endswith("_px") else 3 for name in FIGURES]
        pairs = [cells([level[name]["mean"], level[name]["std"]], k) for name, k in zip(FIGURES, digits, strict=True)]
        width, height, seen, quality = ("-" if mean == "-" else f"{mean} ± {std}" for mean, std in pairs)
        lens = [level["level"], f"{level['fov_deg']:g}", f"{level['focal_length_35mm_mm']:.1f}"]
        rows.append([*lens, f"{width} x {height}", seen, quality])
    columns = ["level", "field of view, deg", "35 mm equivalent, mm", "target, px", "visibility", "IoU"]
    return TextTable("Zoom (mean ± standard deviation over tracks)", columns, rows)


def _best_frame(track: Track) -> int:
    """Return the frame that shows most of the target."""
    return int(np.argmax(np.nan_to_num(track.target.visibility)))


def _draw_levels(levels: dict[float, list[Track]]) -> bytes:
    """Draw one frame of up to four tracks, one row each, at every level (fig:zoom_demo); return a PNG."""
    wide = next(iter(levels.values()))
    panels = []
    for k in spread(len(wide), MOST_SHOWN):
        i = _best_frame(wide[k])
        for fov, tracks in levels.items():
            rgb = read_rgb(tracks[k].frame_folder(i)).copy()
            title = f"{level_name(fov)} {fov:g} deg"
            if tracks[k].target.in_view[i]:
                x0, y0, x1, y1 = tracks[k].target.bbox[i].round().astype(int).tolist()
                cv2.rectangle(rgb, (x0, y0), (x1, y1), TARGET_COLOR, max(1, rgb.shape[1] // 640))
                title += f", target {x1 - x0} x {y1 - y0} px"
            panels.append((title, _scaled(rgb, TILE_WIDTH_PX)))
    return rgb_bytes(captioned_grid(panels, len(levels)))


def _draw_fidelity(wide: Track, longer: Track) -> bytes:
    """Draw a wide picture, digital enlargements of its middle, and the optical one (fig:zoom_fidelity)."""
    rgb, optical = (read_rgb(track.frame_folder(_best_frame(wide))) for track in (wide, longer))
    size = np.array(rgb.shape[1::-1])
    half = 0.5 / MAGNIFICATION
    low, high = (np.round(size * share).astype(int).tolist() for share in (0.5 - half, 0.5 + half))
    marked = cv2.rectangle(rgb.copy(), low, high, CROP_COLOR, max(2, int(size[0]) // 400))
    panels = [(f"{wide.camera.fov_deg:.3g} deg, 1.0x", marked)]
    for kernel, method in KERNELS.items():
        digital = _enlarged(rgb, method)
        error = np.mean((digital.astype(np.float64) - optical) ** 2)
        psnr_db = 10.0 * np.log10(255.0**2 / max(float(error), 1e-5))
        panels.append((f"digital {MAGNIFICATION:g}x, {kernel}: {psnr_db:.1f} dB", digital))
    panels.append((f"optical {MAGNIFICATION:g}x", optical))
    return rgb_bytes(captioned_grid([(title, _scaled(panel, PANEL_WIDTH_PX)) for title, panel in panels], 2))


def _enlarged(rgb: np.ndarray, method: int) -> np.ndarray:
    """Enlarge the middle of a picture, (h, w, 3) uint8, to its full size by MAGNIFICATION."""
    # Pixel (u, v) of the result samples the same ray in the wide picture; pixel centres are at + 0.5.
    size = rgb.shape[1::-1]
    share = 1.0 / MAGNIFICATION
    matrix = np.column_stack([share * np.eye(2), (np.array(size) - 1) / 2.0 * (1.0 - share)])
    return cv2.warpAffine(rgb, matrix, size, flags=method | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE)


def _scaled(rgb: np.ndarray, width_px: int) -> np.ndarray:
    """Return a picture scaled to a width."""
    height_px = max(1, round(width_px * rgb.shape[0] / rgb.shape[1]))
    method = cv2.INTER_AREA if rgb.shape[1] > width_px else cv2.INTER_NEAREST
    return cv2.resize(rgb, (width_px, height_px), interpolation=method)
