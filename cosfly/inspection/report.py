"""`report.html` of the inspection: one self-contained page without scripts for the reviewer.

It shows pictures of each track, curves over time, and the drone trajectory on the map.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat

from cosfly.formats.boxes import BoxMap
from cosfly.formats.inspection import RESULTS, Inspection, TrackInspection
from cosfly.formats.issues import Issue, sort_key
from cosfly.formats.playback import STATES, Track, read_track
from cosfly.geometry.trajectory_metrics import CLEARANCE_CAP_M
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_text
from cosfly.viz.coverage_page import coverage_html
from cosfly.viz.frame_views import small_jpeg, thumbnail
from cosfly.viz.page import fragment, page
from cosfly.viz.topview import INK, PAPER, TopView, draw_dot, draw_line, draw_map, draw_text

STYLE = "\n" + read_text(Path(__file__).with_name("report.css"))
MB = 1_000_000

# column title, metric, format
COLUMNS = (
    ("frames", "num_frames", "{:.0f}"), ("m", "length_m", "{:.1f}"), ("a m/s²", "accel_rms_mps2", "{:.2f}"),
    ("j m/s³", "jerk_rms_mps3", "{:.2f}"), ("S", "smoothness", "{:.3f}"), ("clear m", "clearance_min_m", "{:.2f}"),
    ("five-ray", "five_ray_mean", "{:.3f}"), ("rendered", "rendered_visibility_mean", "{:.3f}"),
    ("visible", "visible_share", "{:.0%}"), ("legible", "legible_share", "{:.0%}"), ("IoU", "track_quality", "{:.2f}"),
)  # fmt: skip
PLOT_WIDTH, PLOT_HEIGHT = 250.0, 62.0
OPENING_PICTURES = 4
CURVE_POINTS = 160
# Curve -> title, unit, least range of the axis.
PLOTS: dict[str, tuple[str, str, tuple[float | None, float | None]]] = {
    "altitude_m": ("height over the target", "m", (0.0, None)),
    "distance_m": ("distance to the target", "m", (0.0, None)),
    "visibility": ("visibility in the frame", "", (0.0, 1.0)),
    "clearance_m": (f"clearance, up to {CLEARANCE_CAP_M:g} m", "m", (0.0, None)),
    "speed_mps": ("speed", "m/s", (0.0, None)),
}
OF_FRAME = re.compile(r"(?:frame_|points\[|frame )(\d+)")  # the frame's index in `where` of an issue
BETWEEN_FRAMES = ("temporal_jump", "frozen_frame", "teleport")
PLAN_PX = 300
MARGIN_M = 12.0
# RGB
DRONE = (35, 100, 220)
TARGET = (235, 120, 20)
OTHER_TRACK = (150, 80, 190)
JPEG = Annotated[str, Field(pattern=r"^[A-Za-z0-9+/=]*$")]


# --- tracks -----------------------------------------------------------------------------------------------------------


class TrackView(BaseModel):
    """The pictures and curves of one track; JPEGs are in base64."""

    time_s: list[FiniteFloat] = []
    curves: dict[str, list[FiniteFloat | None]] = {}  # by their names in PLOTS; None is a gap
    pictures: list[JPEG | None] = Field([None, None, None], min_length=3, max_length=3)  # None: the file is unreadable
    plan: JPEG | None = None  # the map from above
    frames: list[int] = []  # of the pictures: those of issues first, then the first, the middle and the last


def draw_track(
    track: Track, heights_m: np.ndarray, clearance_m: np.ndarray | None, box_map: BoxMap | None,
    width_px: int, issues: Sequence[Issue] = (),
) -> TrackView:  # fmt: skip
    """Return the view of a track.

    Args:
        heights_m: (n,) of the drone over the target. clearance_m: (n,) to obstacles; None without a map.
        width_px: Width of the pictures. issues: Their frames are shown first.
    """
    rows = np.unique(np.linspace(0, len(track) - 1, CURVE_POINTS).round().astype(int))
    speeds_mps = np.full(len(track), np.nan)
    speeds_mps[1:] = np.linalg.norm(np.diff(track.positions_m, axis=0), axis=1) / np.diff(track.time_s)
    curves = {
        "altitude_m": heights_m,
        "distance_m": np.linalg.norm(track.positions_m - track.targets_m, axis=1),
        "visibility": track.target.visibility,
        "clearance_m": clearance_m,
        "speed_mps": speeds_mps,
    }
    default_frames = [0, len(track) // 2, len(track) - 1]
    frames = sorted((frames_of_issues(issues, len(track)) + default_frames)[: len(default_frames)])
    return TrackView(
        time_s=[round(float(at_s), 2) for at_s in track.time_s[rows]],
        curves={name: _numbers(values[rows]) for name, values in curves.items() if values is not None},
        pictures=[thumbnail(track.frame_folder(i), width_px) for i in frames],
        plan=draw_plan(track, box_map, _other_tracks(track)),
        frames=frames,
    )


def _other_tracks(track: Track) -> list[Track]:
    """Read the other tracks of a trajectory, skipping unreadable ones."""
    assert track.folder is not None
    tracks = list[Track]()
    for folder in sorted(path.parent for path in track.folder.parent.glob("[!.]*/trajectory.json")):
        if folder != track.folder:
            with contextlib.suppress(InputError):
                tracks.append(read_track(folder, strict=False))
    return tracks


def frames_of_issues(issues: Sequence[Issue], num_frames: int) -> list[int]:
    """Return the frames of issues, the worst first. An issue between two frames has both."""
    frames: dict[int, None] = {}
    for issue in sorted(issues, key=sort_key):
        match = OF_FRAME.search(issue.where) if issue.severity != "note" else None
        if match is not None and (i := int(match[1])) < num_frames:
            frames.update(dict.fromkeys([max(i - 1, 0), i] if issue.code in BETWEEN_FRAMES else [i]))
    return list(frames)


def _numbers(values: np.ndarray) -> list[float | None]:
    return [round(float(value), 3) if np.isfinite(value) else None for value in values]


def draw_plan(track: Track, box_map: BoxMap | None, others: Sequence[Track] = ()) -> str:
    """Draw the trajectories of drone and target on the map from above; return a JPEG in base64.

    Args:
        others: The other tracks of the trajectory, drawn as thin lines.
    """
    person_m = track.targets_m[~np.isnan(track.targets_m).any(axis=1)]
    others_m = [other.positions_m for other in others]
    view = TopView.around(np.concatenate([track.positions_m, person_m, *others_m]), PLAN_PX, MARGIN_M)
    picture = np.full((*view.size_px[::-1], 3), PAPER, dtype=np.uint8)
    if box_map is not None:
        width_m, height_m = np.array(view.size_px) / view.pixels_per_m
        low = np.array([view.west_m, view.north_m - height_m])
        high = np.array([view.west_m + width_m, view.north_m])
        is_near = ((box_map.maxs[:, :2] >= low) & (box_map.mins[:, :2] <= high)).all(axis=1)
        picture = draw_map(box_map.select(np.flatnonzero(is_near)), view)
    for points_m, color in ((person_m, TARGET), (track.positions_m, DRONE)):
        if len(points_m):
            places = view.pixels(points_m)
            draw_line(picture, places, color, 2, halo=4)
            draw_dot(picture, places[0], 5, color)
            draw_dot(picture, places[-1], 5, color, 2)
    for points_m in others_m:
        draw_line(picture, view.pixels(points_m), OTHER_TRACK)
    _draw_scale(picture, view)
    return small_jpeg(picture, picture.shape[1])


def _draw_scale(picture: np.ndarray, view: TopView) -> None:
    """Draw a scale bar of a round number of metres, at most a third of the width."""
    third_m = picture.shape[1] / 3.0 / view.pixels_per_m
    power = 10.0 ** np.floor(np.log10(third_m))
    metres = power * max(k for k in (1.0, 2.0, 5.0) if k * power <= third_m)
    y = picture.shape[0] - 8.0
    draw_line(picture, np.array([[8.0, y], [8.0 + metres * view.pixels_per_m, y]]), INK, 2, halo=5)
    draw_text(picture, f"{metres:g} m", 8.0, y - 6.0, 0.4, halo=(255.0, 255.0, 255.0))


# --- the page ---------------------------------------------------------------------------------------------------------


def report_html(name: str, inspection: Inspection, views: Mapping[str, TrackView], page_mb: float) -> str:
    """Return the page, with the tracks that need a decision first.

    Args:
        name: Name of the run.
        views: By track folder. Pages larger than `page_mb` leave out the pictures of the last tracks.
    """
    tracks = inspection.flights
    coverage = inspection.coverage
    accepted = [track for track in tracks if track.result == "accepted"] or tracks
    accepted = [track for track in sorted(accepted, key=lambda track: track.track) if track.folder in views]
    counts = {
        state: sum(int(track.metrics.get(f"frames_{state.replace(' ', '_')}") or 0) for track in tracks)
        for state in STATES
    }
    total = sum(counts.values())
    cards = list[str]()
    size = 0
    num_without_pictures = 0
    for track in sorted(tracks, key=lambda track: (-RESULTS.index(track.result), track.folder)):
        card = _card(track, views.get(track.folder))
        if track.folder in views and size + len(card) > page_mb * MB:
            card = _card(track, None)
            num_without_pictures += 1
        size += len(card)
        cards.append(card)
    return page(
        "cosfly/inspection/report.html", title=name, style=STYLE, inspection=inspection, results=RESULTS,
        columns=COLUMNS, cards=cards, num_without_pictures=num_without_pictures, page_mb=page_mb,
        pictures=[picture for track in accepted if (picture := views[track.folder].pictures[1])][:OPENING_PICTURES],
        states=[(name, counts[name], f"{counts[name] / max(total, 1):.1%}", f"{STATES[name]:.0%}") for name in STATES],
        num_perturbable=total, coverage=coverage_html(coverage) if coverage is not None and coverage.frames else None,
    )  # fmt: skip


def _card(track: TrackInspection, view: TrackView | None) -> str:
    issues = [issue for issue in track.issues if issue.severity != "note"]
    plots = [] if view is None else [plot for name in PLOTS if (plot := _plot(name, view)) is not None]
    return fragment(
        "cosfly/inspection/card.html", track=track, columns=COLUMNS, issues=issues, view=view, plots=plots,
        asked=frames_of_issues(track.issues, int(track.metrics.get("num_frames") or 0)),
    )  # fmt: skip


def _plot(name: str, view: TrackView) -> dict[str, Any] | None:
    """Return a curve over time and its range, with gaps for unknown values; None if all are unknown."""
    title, unit, span = PLOTS[name]
    values = view.curves.get(name, [])
    time_s = view.time_s
    finite = [value for value in values if value is not None]
    if not finite:
        return None
    edges = [*finite, *(edge for edge in span if edge is not None)]
    low, high = min(edges), max(edges)
    scale = (PLOT_HEIGHT - 4.0) / ((high - low) or 1.0)
    step = PLOT_WIDTH / ((time_s[-1] - time_s[0]) or 1.0)
    points = [
        (before, f"{(at_s - time_s[0]) * step:.1f} {PLOT_HEIGHT - 2.0 - (value - low) * scale:.1f}")
        for before, at_s, value in zip([None, *values], time_s, values, strict=False) if value is not None
    ]  # fmt: skip
    return {
        "title": title,
        "path": "".join(f"{'M' if before is None else 'L'}{point}" for before, point in points),
        "found": f"{min(finite):.2f} to {max(finite):.2f}{unit and f' {unit}'}, mean {float(np.mean(finite)):.2f}",
        "axes": f"{low:.4g} to {high:.4g}; {time_s[0]:g} s to {time_s[-1]:g} s",
    }
