"""`cosfly view MAP`: one self-contained page of a map in 3D with walks, flights and frames, which needs no network.

Bulk data goes in as binary arrays in base64; the page's script draws them (`space.js`, WebGL 2) and plays them back.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.kinds import GROUND_KINDS, KIND_NAMES, KINDS, LAYERS
from cosfly.formats.pedestrian_paths import read_paths
from cosfly.formats.places import town_folder
from cosfly.formats.playback import Track, read_track
from cosfly.formats.traces import DroneTrace, read_traces
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import rotation_matrices
from cosfly.geometry.grid import occupancy
from cosfly.runtime.errors import InputError
from cosfly.runtime.escaping import for_terminal
from cosfly.runtime.io import write_bytes
from cosfly.viz.frame_views import thumbnail
from cosfly.viz.page import page, scripts
from cosfly.viz.topview import COLORS, OTHER_COLOR

MB = 1024 * 1024
# How much of a kind one sees through: 1 is opaque.
OPACITIES = {"Buildings": 0.5, "Vegetation": 0.35, "Walls": 0.6, "Bridge": 0.6}
LAYER_M = 0.02  # between surfaces that lie in one plane
MOST_MATRIX_CELLS = 64_000_000
JPEG_QUALITY = 70


@dataclass
class PageTrack:
    """One flight: of a planner, or of a tree. path: which walk it follows; kind: whose it is, as its legend says.

    rows: (n, 10) s, drone x, y, z, m, pitch, yaw, degrees, target x, y, z, m (NaN: nobody knows), visibility.
    """

    path: str
    kind: str
    rows: np.ndarray
    figures: dict[str, float] = field(default_factory=dict)
    flight: Track | None = None
    pictures: dict[int, str] = field(default_factory=dict)


def run(
    map_: Path,
    out: Path,
    *,
    paths: Path | None = None,
    traces: Sequence[Path] = (),
    data: Path | None = None,
    most_paths: int = 100,
    picture_px: int = 320,
    max_mb: float = 24.0,
) -> Path:
    """Reads a map, walks, flights of one planner or several and a playback tree; writes one page and gives its path.

    Args:
        most_paths: of more walks, the first. picture_px: width of frames. max_mb: of the page; frames are left out,
            evenly, to stay below it.
    Raises:
        InputError: a file cannot be read, or the page is too large without any frame.
    """
    box_map, notes = read_boxes(map_), list[str]()
    walks = [] if paths is None else read_paths(paths)
    tracks = [_of_trace(trace) for path in traces for trace in read_traces(path)]
    flights = [] if data is None else [read_track(place, strict=False) for place in find_tracks(data)]
    own = [flight for flight in flights if town_folder(flight.town) == town_folder(box_map.name)] or flights
    if len(own) < len(flights):
        notes.append(f"{len(flights) - len(own):,} flights are of other towns")
    tracks += [_of_flight(flight) for flight in own]
    names = list(dict.fromkeys([walk.path_id for walk in walks] + [track.path for track in tracks]))
    if len(names) > most_paths:
        notes.append(f"{most_paths:,} of {len(names):,} paths are shown")
    known = names[:most_paths]
    tracks = [track for track in tracks if track.path in known]
    content: dict[str, Any] = {
        **_boxes(box_map),
        "matrix": _matrix(box_map),
        "paths": [{"name": for_terminal(name)} for name in known],
        "walks": [
            {"path": known.index(walk.path_id), "rows": _packed(np.column_stack([walk.time_s, walk.positions_m]))}
            for walk in walks
            if walk.path_id in known
        ],
    }
    left = (
        max_mb * MB - sum(len(str(part)) for part in content.values()) - sum(60 * track.rows.size for track in tracks)
    )
    if left < 0:
        fix = "raise --max-mb, or take a simplified map and fewer paths"
        raise InputError("the page is too large", where=map_, expected=f"at most {max_mb:g} MB", fix=fix)
    notes += _add_pictures(tracks, left, picture_px)
    content["tracks"] = [
        {
            "path": known.index(track.path), "kind": for_terminal(track.kind), "rows": _packed(track.rows),
            "figures": track.figures, "pictures": track.pictures,
        }
        for track in tracks
    ]  # fmt: skip
    write_bytes(out, page_html(box_map.name, notes, content).encode())
    return out


def page_html(name: str, notes: Sequence[str], content: dict[str, Any]) -> str:
    """Return the page's text."""
    script = scripts("tools.js", "canvas.js", "space.js", "scene.js")
    style, template = scripts("scene.css"), "cosfly/viz/templates/scene.html"
    return page(template, title=name, style=style, script=script, notes=notes, data=content)


def _of_trace(trace: DroneTrace) -> PageTrack:
    rows = np.column_stack(
        [trace.time_s, trace.positions_m, trace.rotations_deg[:, :2], trace.targets_m, trace.visibility]
    )
    figures = {name: value for name, value in trace.metrics.items() if isinstance(value, int | float)}
    return PageTrack(trace.path_id, trace.planner, rows, figures)


def _of_flight(flight: Track) -> PageTrack:
    rows = np.column_stack(
        [flight.time_s, flight.positions_m, flight.rotations_deg[:, :2], flight.targets_m, flight.target.visibility]
    )
    kind = "clean frames" if flight.is_original else "perturbed frames"
    return PageTrack(str(flight.source.get("scenario_id") or flight.trajectory), kind, rows, {}, flight)


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()


def _boxes(box_map: BoxMap) -> dict[str, Any]:
    """Return boxes as the page draws them: the middle of each and its three half axes, (n, 12) float32, kind by kind,
    surfaces first."""
    lift_m = np.array([LAYERS.get(KIND_NAMES[kind], 0) * LAYER_M for kind in range(len(KINDS))])
    is_ground = box_map.is_any_of(GROUND_KINDS)
    # Within a kind in no order, so that the first of them are a fair sample: what a slow machine draws in motion.
    order = np.lexsort((np.random.default_rng(0).permutation(len(box_map)), box_map.kinds, ~is_ground))
    axes = rotation_matrices(np.radians(box_map.rotations_deg)) * box_map.half_extents[:, None, :]
    centers = box_map.centers.copy()
    centers[is_ground, 2] += lift_m[box_map.kinds[is_ground]]
    rows = np.hstack([centers, axes.transpose(0, 2, 1).reshape(-1, 9)])[order]
    kinds, firsts, counts = np.unique(box_map.kinds[order], return_index=True, return_counts=True)
    low, high = box_map.bounds()
    return {
        "boxes": _packed(rows),
        "kinds": [
            {
                "name": (name := KIND_NAMES[int(kinds[k])]), "first": int(firsts[k]), "count": int(counts[k]),
                "color": COLORS.get(name, OTHER_COLOR), "opacity": OPACITIES.get(name, 1.0),
            }
            for k in np.argsort(firsts)
        ],
        "bounds": [low.tolist(), high.tolist()],
    }  # fmt: skip


def _matrix(box_map: BoxMap) -> dict[str, Any] | None:
    """Return the planning matrix, north up; None where it is too large for a page."""
    grid = occupancy(box_map)
    if grid.occupied.size > MOST_MATRIX_CELLS:
        return None
    cells = np.where(grid.occupied[::-1], np.uint8(128), np.uint8(255))
    done, png = cv2.imencode(".png", cells)
    assert done, "OpenCV encodes any 8-bit picture"
    east, north = grid.x_min_m + grid.size[0] * grid.resolution_m, grid.y_min_m + grid.size[1] * grid.resolution_m
    return {"png": base64.b64encode(png.tobytes()).decode(), "bounds": [grid.x_min_m, grid.y_min_m, east, north]}


def _add_pictures(tracks: Sequence[PageTrack], left: float, picture_px: int) -> list[str]:
    """Add frames to tracks of a tree, every so many of each flight as there is room for; says what is left out."""
    flights = [(track, track.flight) for track in tracks if track.flight is not None]
    num_frames = sum(len(flight) for _, flight in flights)
    first = next((one for _, flight in flights for one in [_picture(flight, 0, picture_px)] if one), None)
    if first is None:
        return []
    every = max(1, int(np.ceil(1.3 * len(first) * num_frames / max(left, 1.0))))
    num_shown = 0
    for track, flight in flights:
        for index in range(0, len(flight), every):
            picture = _picture(flight, index, picture_px)
            if picture is not None and len(picture) < left:
                track.pictures[index], left, num_shown = picture, left - len(picture), num_shown + 1
    return [] if num_shown == num_frames else [f"{num_shown:,} of {num_frames:,} frames have their picture here"]


def _picture(flight: Track, index: int, width_px: int) -> str | None:
    return thumbnail(flight.frame_folder(index), width_px, JPEG_QUALITY)
