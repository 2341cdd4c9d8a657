"""`cosfly view`: one self-contained page of a release, a run or a playback tree, for a browser without a network. The
frames of a run become rows of a release's columns first. The data are JSON with the names that `viewer.js` reads; the
script writes every foreign text as text, never as markup, and the page's policy lets no other script run."""

from __future__ import annotations

import base64
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.captions import Caption, Coc
from cosfly.formats.frames import FrameFile, depth_values, frame_path
from cosfly.formats.inspection import read_settled
from cosfly.formats.kinds import GROUND_KINDS, KIND_NAMES
from cosfly.formats.places import place_of
from cosfly.formats.playback import Track, read_track
from cosfly.formats.tracks import find_tracks
from cosfly.llm.answer_text import sentences_of
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.escaping import for_terminal
from cosfly.runtime.io import write_bytes
from cosfly.runtime.png import colours_of
from cosfly.viz.frame_views import (
    VIEW_FILES,
    View,
    depth_colors,
    page_pictures,
    read_view,
    segmentation_colors,
    spread,
)  # fmt: skip
from cosfly.viz.page import page, scripts
from cosfly.viz.topview import footprint
from release.columns import (
    BOX,
    CAPTION,
    FIELDS,
    FRAME,
    LANGUAGES,
    PICTURES,
    PLACE,
    POINT,
    SHORT_NAMES,
    TARGET_PICTURE,
    VALUES,
    Column,
    Placement,
    caption_values,
    scalar_row,
)  # fmt: skip
from release.export.source import (
    ExportSource,
    Line,
    SourceTrack,
    Tree,
    captions_of,
    find_trees,
    open_release,
    read_caption,
)
from release.reading import bounded
from release.record import RECORD

Place = tuple[str, str, str, str]  # PLACE
Views = Mapping[View, Callable[[], np.ndarray]]
Item = TypeVar("Item")

PATH_POINTS = 240
MOST_BOXES, MARGIN_M = 2_500, 30.0  # of one map
VIEW_OF: dict[FrameFile, View] = {"rgb": "rgb", "depth": "depth", "instance": "segmentation"}
TEXTS = {"C": "critical_components", "R": "reasoning_trace"}  # by the letter of a sentence's name
SCANNED = [
    *PLACE, "sample_id", "track", "split", "frame_index", "time_s", "width_px", "height_px", "fov_deg", "pose",
    "target", "visibility", "has_caption", "verdict", "decision",
]  # fmt: skip


def run(
    folder: Path, out: Path, captions: Path | None = None, *, picture_px: int = 320, most_tracks: int = 100,
    most_frames: int = 16,
) -> Path:  # fmt: skip
    """Read a release (or the folder around it), a run or a playback tree; write one page and return its path.

    Args:
        captions: `captions.jsonl` of a playback tree; a run has its own.
        picture_px: Width of a colour picture; the others have half of it.
        most_tracks: Of more, whole trajectories are shown, evenly spread.
        most_frames: Of a track, among them one of each verdict and decision.
    """
    record = next((path for path in (folder / RECORD, folder / "dataset" / RECORD) if path.exists()), None)
    if record is None:
        title, kind, trees = folder.absolute().name, "run", find_trees(folder, captions)
        parts, notes = _run_parts(trees, most_tracks)
    else:
        source, kind, trees = open_release(record.parent), "release", []
        title = source.facts.source
        parts, notes = _release_parts(source, most_tracks)
    flights = []
    with progress_bar("viewer: tracks", len(parts)) as advance:
        for read_part in parts:
            if (part := read_part(notes)) is not None:
                flights.append(_flight(part, most_frames, picture_px))
            advance(1)
    data = {"title": title, "kind": kind, "notes": notes, "maps": _maps(trees, flights), "flights": flights}
    script, style = scripts("tools.js", "canvas.js", "viewer.js"), scripts("viewer.css")
    values = {"title": data["title"], "notes": data["notes"], "data": _printable(data)}
    write_bytes(out, page("cosfly/viz/templates/viewer.html", style=style, script=script, **values).encode())
    return out


def _printable(value: Any) -> Any:
    """Return a value whose texts are cut and free of control characters; pictures, which are ours, stay."""
    if isinstance(value, str):
        return for_terminal(value)
    if isinstance(value, list | tuple):
        return [_printable(one) for one in value]
    if isinstance(value, dict):
        return {
            _printable(key): one if key in ("pictures", TARGET_PICTURE) else _printable(one)
            for key, one in value.items()
        }
    return value


@dataclass(frozen=True)
class _Part:
    """One track.

    about: Facts for the page. places_m: (n, 4) x, y of drone and target, NaN where unknown. kinds: Of the frames with a
    caption. read: Yields the rows of frames, in order, with their pictures and caption.
    """

    place: tuple[str, ...]  # PLACE
    about: dict[str, Any]
    places_m: np.ndarray
    fovs_deg: tuple[float, float]
    frames: Sequence[int]
    kinds: dict[int, Hashable]
    read: Callable[[list[int]], Iterator[tuple[Mapping[str, Any], Views, dict[str, Any] | None]]]


# Each reads its track when it is called; one that cannot be read is None, and is noted.
Parts = list[Callable[[list[str]], _Part | None]]


# --- a release --------------------------------------------------------------------------------------------------------


def _release_parts(source: ExportSource, most_tracks: int) -> tuple[Parts, list[str]]:
    groups = [track.name.rpartition("/")[0] for track in source.tracks]
    chosen, notes = _choose_tracks(source.tracks, groups, most_tracks)
    notes.append("a release has no map: the tracks are drawn without one")
    return [partial(_released_part, track, source.modalities) for track in chosen], notes


def _released_part(track: SourceTrack, modalities: Sequence[FrameFile], notes: list[str]) -> _Part:
    places_m, fovs_deg, kinds = [], set[float](), dict[int, Hashable]()
    for row in track.rows(SCANNED):
        target = row["target"] or dict.fromkeys(POINT, 0.0)
        for value in (row["time_s"], *row["pose"].values(), *target.values(), row["visibility"] or 0.0):
            bounded(value)
        target_m = [np.nan if row["target"] is None else target[axis] for axis in POINT[:2]]
        places_m.append([row["pose"][axis] for axis in POINT[:2]] + target_m)
        fovs_deg.add(bounded(row["fov_deg"]))
        if row["has_caption"]:
            kinds[row["frame_index"]] = row["verdict"], row["decision"]
    about = {"town": row["town"], "track": row["track"], "split": row["split"]}
    fov_range = min(fovs_deg), max(fovs_deg)
    read = partial(_released_frames, track, modalities)
    return _Part(tuple(track.name.split("/")), about, np.array(places_m), fov_range, track.frame_index, kinds, read)


def _released_frames(
    track: SourceTrack, modalities: Sequence[FrameFile], frames: list[int]
) -> Iterator[tuple[Mapping[str, Any], Views, dict[str, Any] | None]]:
    numbers = np.flatnonzero(np.isin(track.frame_index, frames)).tolist()
    for row in track.pick([*SHORT_NAMES, *(PICTURES[file].name for file in modalities)], numbers):
        views = {VIEW_OF[file]: partial(_picture, track, row, file) for file in modalities}
        yield row, views, _caption(row) if row["has_caption"] else None


def _picture(track: SourceTrack, row: Mapping[str, Any], file: FrameFile) -> np.ndarray:
    """Return a picture of a row as colours, (h, w, 3) uint8 RGB."""
    data, where = track.picture(row, file), f"{row['sample_id']}: {PICTURES[file].name}"
    if file == "depth":
        return depth_colors(depth_values(data, Path(where)))
    rgb = colours_of(data, where)
    if file == "rgb":
        return rgb
    # Red is the kind, green the low byte of the id, blue the high one.
    return segmentation_colors(rgb[..., 0], rgb[..., 1].astype(np.uint16) | rgb[..., 2].astype(np.uint16) << 8)


# --- a run or a playback tree -----------------------------------------------------------------------------------------


def _run_parts(trees: list[Tree], most_tracks: int) -> tuple[Parts, list[str]]:
    found = {tree.place(place_of(path)): path for tree in trees for path in find_tracks(tree.data)}
    chosen, notes = _choose_tracks(list(found), [place[:-1] for place in found], most_tracks)
    kinds: dict[Place, dict[int, Hashable]] = {place: {} for place in chosen}
    lines: dict[Place, dict[int, Line]] = {place: {} for place in chosen}
    for place, caption, line in (one for tree in trees for one in captions_of(tree)):
        if place in kinds:
            decision = caption.en.flight_decision if caption.en else None
            kinds[place][caption.frame_index] = caption.status, caption.verdict, decision
            lines[place][caption.frame_index] = line
    inspected = ((tree, read_settled(tree.inspect)) for tree in trees if tree.inspect is not None)
    results = {tree.place(track): track.result for tree, inspection in inspected for track in inspection.flights}
    parts = [partial(_tree_part, one[0], found[one], kinds[one], lines[one], results.get(one)) for one in chosen]
    return list(parts), notes


def _tree_part(
    run: str, path: Path, kinds: dict[int, Hashable], lines: Mapping[int, Line], result: str | None, notes: list[str]
) -> _Part | None:
    try:
        track = read_track(path, strict=False)
    except InputError as error:
        notes.append(f"not shown: {path.parent.name}/{path.name}: {error.what}")
        return None
    kind = "clean" if track.is_original else "perturbed"
    about = {"town": track.town, "track": kind, "split": None, "result": result}
    places_m = np.hstack([track.positions_m[:, :2], track.targets_m[:, :2]])
    names = run, track.town, track.trajectory, track.variant
    read = partial(_tree_frames, track, lines)
    return _Part(names, about, places_m, track.fovs_deg, range(len(track)), kinds, read)


def _tree_frames(
    track: Track, lines: Mapping[int, Line], frames: list[int]
) -> Iterator[tuple[Mapping[str, Any], Views, dict[str, Any] | None]]:
    for index in frames:
        folder, caption = track.frame_folder(index), read_caption(lines[index]) if index in lines else None
        values = None if caption is None else caption_values(caption)
        row = scalar_row(track, index, values, Placement(walk="", split="train"))
        files = (view for view in VIEW_OF.values() if frame_path(folder, VIEW_FILES[view]).exists())
        views: Views = {view: partial(read_view, folder, view) for view in files}
        yield row, views, None if caption is None else _caption(row, caption)


def _maps(trees: list[Tree], tracks: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the boxes around the tracks of each town, where the run has a map."""
    near: dict[str, list] = defaultdict(list)
    for track in tracks:
        near[track["map"]] += [*track["drone_path"], *track["target_path"]]
    maps = {tree.run: tree.boxes for tree in trees if tree.boxes is not None}
    of_runs = {name: maps.get(name.partition("/")[0]) for name in near}
    return {name: boxes_of(read_boxes(path), near[name]) for name, path in of_runs.items() if path is not None}


# --- tracks, frames and captions on the page --------------------------------------------------------------------------


def _choose_tracks(tracks: Sequence[Item], groups: Sequence[Hashable], most: int) -> tuple[list[Item], list]:
    """Choose whole groups (the tracks of a trajectory), spread evenly, as many as fit, and one at least; return their
    tracks, and a note if there are others."""
    by_group: dict[Hashable, list[Item]] = defaultdict(list)
    for track, group in zip(tracks, groups, strict=True):
        by_group[group].append(track)
    named, chosen = list(by_group.values()), list(tracks)
    for count in range(len(named), 0, -1):
        chosen = [track for k in spread(len(named), count) for track in named[k]]
        if len(chosen) <= most:
            break
    is_all = len(chosen) == len(tracks)
    return chosen, [] if is_all else [f"{len(chosen):,} of {len(tracks):,} tracks are shown"]


def choose_frames(frames: Sequence[int], kinds: Mapping[int, Hashable], most: int) -> list[int]:
    """Choose frames of a track, in order: the first of each kind until half of them, then evenly of those with
    captions, then of the others.

    Args:
        frames: All, ascending. kinds: What the caption of a frame says, such as (verdict, decision).
    """
    firsts: dict[Hashable, int] = {}
    for frame in frames:
        if frame in kinds:
            firsts.setdefault(kinds[frame], frame)
    chosen = set(list(firsts.values())[: max(1, most // 2)])
    for wanted in (kinds, set(frames) - set(kinds)):
        others = [frame for frame in frames if frame not in chosen and frame in wanted]
        chosen |= {others[k] for k in spread(len(others), most - len(chosen))}
    return sorted(chosen)


def _flight(part: _Part, most_frames: int, picture_px: int) -> dict[str, Any]:
    """Return a track with some of its frames."""
    chosen = choose_frames(part.frames, part.kinds, most_frames)
    return {
        "name": "/".join(filter(None, part.place)),
        "group": "/".join(filter(None, part.place[:-1])),  # both tracks of a trajectory
        "map": "/".join(part.place[:2]),
        "result": None,
        "fovs_deg": [round(fov_deg, 1) for fov_deg in part.fovs_deg],
        "num_frames": len(part.places_m),
        "num_captions": len(part.kinds),
        "drone_path": _path(part.places_m[:, :2]),
        "target_path": _path(part.places_m[:, 2:]),
        "frames": [_frame(row, page_pictures(views, picture_px), caption) for row, views, caption in part.read(chosen)],
        **part.about,
    }


def _path(points_m: np.ndarray) -> list[list[float]]:
    known = points_m[~np.isnan(points_m).any(axis=1)]
    return known[spread(len(known), PATH_POINTS)].astype(np.float64).round(1).tolist()


def _frame(row: Mapping[str, Any], pictures: dict[View, str], caption: dict[str, Any] | None) -> dict[str, Any]:
    """Return a frame. box: of the target, xmin, ymin, xmax, ymax as shares of the picture."""
    pose, target, seen, picture = row["pose"], row["target"], row["visibility"], row[TARGET_PICTURE]
    box_px = np.array([(row["target_bbox"] or {}).get(name) for name in BOX], np.float64)
    box = (box_px / np.maximum(1, (row["width_px"], row["height_px"]) * 2)).round(4)
    return {
        "index": row["frame_index"],
        "time_s": round(row["time_s"], 3),
        "drone": [round(float(pose[name]), 2) for name in (*POINT, "yaw_deg")],
        "target": None if target is None else [round(target[name], 2) for name in POINT],
        "visibility": None if seen is None else round(seen, 3),
        "is_perturbed": bool(row["is_perturbed"]),
        "events": row["perturbation"] or None,
        "facts": _facts(FRAME, row),
        "fov_deg": round(row["fov_deg"], 1),
        "box": box.tolist() if np.isfinite(box).all() else None,
        "pictures": pictures,
        TARGET_PICTURE: base64.b64encode(picture["bytes"]).decode() if picture else None,
        "caption": caption,
    }


def _facts(columns: Sequence[Column], row: Mapping[str, Any]) -> dict[str, str]:
    values = {column.title: row[column.name] for column in columns if column.shown}
    return {
        title: ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        for title, value in values.items()
        if value is not None
    }


def _caption(row: Mapping[str, Any], caption: Caption | None = None) -> dict[str, Any]:
    """Return a caption of its columns, and of the caption of a run, which says more than a release."""
    texts = {}
    for language in LANGUAGES:
        coc = Coc(**{name: row[f"caption_{language}_{name}"] or "" for name in FIELDS})
        texts[language] = [{"field": TEXTS[name[0]], "text": text} for name, text in sentences_of(coc)]
    shown = {name: row[name] for name in ("decision", "label", "verdict")} | {"repair": row["repair_strategy"]}
    values = {name: sum(row[f"{name}_{language}"] or 0 for language in LANGUAGES) for name in VALUES}
    shown |= {"facts": _facts(CAPTION, row), "texts": texts, "values": values, "problems": [], "dropped": None}
    if caption is not None and caption.repair is not None:
        repair, first = caption.repair, f"first {caption.repair.first_decision} ({caption.repair.first_verdict})"
        shown["repair"] = shown["facts"]["repair"] = f"{repair.rung or repair.outcome}, {first}"
    if caption is not None:
        shown["problems"] = caption.checks.contradictions or []
        shown["dropped"] = caption.drop_reason if caption.status == "dropped" else None
    return shown


def boxes_of(box_map: BoxMap, near: Sequence[Sequence[float]]) -> list[dict[str, Any]]:
    """Return the footprints of the largest boxes of a map around some places, those below others first."""
    if not near:
        return []
    low, high = np.min(near, axis=0) - MARGIN_M, np.max(near, axis=0) + MARGIN_M
    rows = np.flatnonzero(((box_map.maxs[:, :2] >= low) & (box_map.mins[:, :2] <= high)).all(axis=1))
    areas = box_map.half_extents[rows, 0] * box_map.half_extents[rows, 1]
    rows = rows[np.argsort(-areas, kind="stable")[:MOST_BOXES]]
    is_ground = np.isin(box_map.kinds[rows], list(GROUND_KINDS))
    tops = box_map.centers[rows, 2] + box_map.half_extents[rows, 2]
    rows = rows[np.lexsort((tops, ~is_ground))]
    kinds = (KIND_NAMES[kind] for kind in box_map.kinds[rows].tolist())
    corners = (footprint(box_map, row).round(1).tolist() for row in rows.tolist())
    return [{"kind": kind, "corners": four} for kind, four in zip(kinds, corners, strict=True)]
