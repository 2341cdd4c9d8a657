"""`cosfly view MAP`: a self-contained page of a map in 3D with pedestrian and drone trajectories and frames.

Arrays are embedded as base64; the page's script draws them (`space.js`, WebGL 2) and plays them back.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.frames import read_rgb
from cosfly.formats.kinds import GROUND_KINDS, KIND_NAMES, KINDS, LAYERS
from cosfly.formats.pedestrian_paths import read_paths
from cosfly.formats.places import town_folder
from cosfly.formats.playback import Track
from cosfly.formats.playback_file import read_track
from cosfly.formats.traces import DroneTrace, read_traces
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import rotation_matrices
from cosfly.geometry.grid import occupancy
from cosfly.runtime.escaping import for_terminal
from cosfly.runtime.io import write_bytes
from cosfly.viz.frame_views import page_pictures, spread
from cosfly.viz.page import page, scripts
from cosfly.viz.topview import COLORS, OTHER_COLOR

# 1 is opaque.
OPACITIES = {"Buildings": 0.5, "Vegetation": 0.35, "Walls": 0.6, "Bridge": 0.6}
LAYER_M = 0.02  # between coplanar surfaces
MOST_MATRIX_CELLS = 64_000_000
MOST_PATHS = 100
MOST_PICTURES = 1200  # on a page, evenly spread over the frames; about 20 KB each


@dataclass
class PageTrack:
    """A drone trajectory of a planner or a tree.

    Columns of `rows`: time s; drone x, y, z m; pitch, yaw degrees; target x, y, z m (NaN if unknown); visibility.
    """

    path: str  # id of its pedestrian trajectory
    kind: str  # text of the legend
    rows: np.ndarray  # (n, 10)
    figures: dict[str, float] = field(default_factory=dict)
    drawn: Track | None = None
    pictures: dict[int, str] = field(default_factory=dict)


def run(
    map_: Path, out: Path, *, paths: Path | None = None, traces: Sequence[Path] = (), data: Path | None = None,
    picture_px: int = 320,
) -> Path:  # fmt: skip
    """Read a map, pedestrian trajectories, drone trajectories of planners and a playback tree; write one page."""
    box_map = read_boxes(map_)
    notes = list[str]()
    pedestrians = [] if paths is None else read_paths(paths)
    tracks = [_of_trace(trace) for path in traces for trace in read_traces(path)]
    all_drawn = [] if data is None else [read_track(folder) for folder in find_tracks(data)]
    town_drawn = [drawn for drawn in all_drawn if town_folder(drawn.town) == town_folder(box_map.name)] or all_drawn
    if len(town_drawn) < len(all_drawn):
        notes.append(f"{len(all_drawn) - len(town_drawn):,} tracks of other towns are not shown")
    tracks += [_of_drawn(drawn) for drawn in town_drawn]
    all_paths = list(dict.fromkeys([path.path_id for path in pedestrians] + [track.path for track in tracks]))
    path_ids = all_paths[:MOST_PATHS]
    if len(all_paths) > MOST_PATHS:
        notes.append(f"{MOST_PATHS:,} of {len(all_paths):,} paths are shown")
    tracks = [track for track in tracks if track.path in path_ids]
    notes += _add_pictures(tracks, picture_px)
    content = {
        **_boxes(box_map),
        "matrix": _matrix(box_map),
        "paths": [{"name": for_terminal(name)} for name in path_ids],
        "walks": [
            {"path": path_ids.index(path.path_id), "rows": _packed(np.column_stack([path.time_s, path.positions_m]))}
            for path in pedestrians
            if path.path_id in path_ids
        ],
        "tracks": [
            {
                "path": path_ids.index(track.path), "kind": for_terminal(track.kind), "rows": _packed(track.rows),
                "figures": track.figures, "pictures": track.pictures,
            }
            for track in tracks
        ],
    }  # fmt: skip
    script = scripts("tools.js", "canvas.js", "space.js", "scene.js")
    style = scripts("scene.css")
    values: dict[str, Any] = {"title": box_map.name, "notes": notes, "data": content}
    write_bytes(out, page("cosfly/viz/templates/scene.html", style=style, script=script, **values).encode())
    return out


def _page_track(path: str, kind: str, track: DroneTrace | Track, visibility: np.ndarray, **more: Any) -> PageTrack:
    rows = [track.time_s, track.positions_m, track.rotations_deg[:, :2], track.targets_m, visibility]
    return PageTrack(path, kind, np.column_stack(rows), **more)


def _of_trace(trace: DroneTrace) -> PageTrack:
    figures = {name: value for name, value in trace.metrics.items() if isinstance(value, int | float)}
    return _page_track(trace.path_id, trace.planner, trace, trace.visibility, figures=figures)


def _of_drawn(drawn: Track) -> PageTrack:
    path = str(drawn.source.get("scenario_id") or drawn.trajectory)
    kind = "clean" if drawn.is_original else "perturbed"
    return _page_track(path, f"{kind} frames", drawn, drawn.target.visibility, drawn=drawn)


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()


def _boxes(box_map: BoxMap) -> dict[str, Any]:
    """Return the boxes of the page: centre and three half axes of each, (n, 12) float32, by kind, surfaces first."""
    lift_m = np.array([LAYERS.get(KIND_NAMES[kind], 0) * LAYER_M for kind in range(len(KINDS))])
    is_ground = box_map.is_any_of(GROUND_KINDS)
    # In random order within a kind: a slow machine draws only the first boxes while the view moves.
    order = np.lexsort((np.random.default_rng(0).permutation(len(box_map)), box_map.kinds, ~is_ground))
    axes = rotation_matrices(np.radians(box_map.rotations_deg)) * box_map.half_extents[:, None, :]
    centers = box_map.centers.copy()
    centers[is_ground, 2] += lift_m[box_map.kinds[is_ground]]
    rows = np.hstack([centers, axes.transpose(0, 2, 1).reshape(-1, 9)])[order]
    kinds, firsts, counts = np.unique(box_map.kinds[order], return_index=True, return_counts=True)
    names = [KIND_NAMES[kind] for kind in kinds.tolist()]
    low, high = box_map.bounds()
    return {
        "boxes": _packed(rows),
        "kinds": [
            {
                "name": names[k], "first": int(firsts[k]), "count": int(counts[k]),
                "color": COLORS.get(names[k], OTHER_COLOR), "opacity": OPACITIES.get(names[k], 1.0),
            }
            for k in np.argsort(firsts).tolist()
        ],
        "bounds": [low.tolist(), high.tolist()],
    }  # fmt: skip


def _matrix(box_map: BoxMap) -> dict[str, Any] | None:
    """Return the planning matrix, north up; None if it is too large for a page."""
    grid = occupancy(box_map)
    if grid.occupied.size > MOST_MATRIX_CELLS:
        return None
    cells = np.where(grid.occupied[::-1], np.uint8(128), np.uint8(255))
    done, png = cv2.imencode(".png", cells)
    assert done, "OpenCV encodes any 8-bit picture"
    east = grid.x_min_m + grid.size[0] * grid.resolution_m
    north = grid.y_min_m + grid.size[1] * grid.resolution_m
    return {"png": base64.b64encode(png.tobytes()).decode(), "bounds": [grid.x_min_m, grid.y_min_m, east, north]}


def _add_pictures(tracks: Sequence[PageTrack], picture_px: int) -> list[str]:
    """Add pictures to the tracks of a tree; return a note if some frames have none."""
    frames = [(track, track.drawn, i) for track in tracks if track.drawn is not None for i in range(len(track.drawn))]
    for k in spread(len(frames), MOST_PICTURES):
        track, drawn, i = frames[k]
        if picture := page_pictures({"rgb": partial(read_rgb, drawn.frame_folder(i))}, picture_px):
            track.pictures[i] = picture["rgb"]
    num_pictures = sum(len(track.pictures) for track in tracks)
    return [f"{num_pictures:,} of {len(frames):,} frames have pictures"] if num_pictures < len(frames) else []
