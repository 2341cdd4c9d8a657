"""`cosfly view`: one self-contained page of a run or a playback tree, for a browser without a network.

The data are JSON with the names that `viewer.js` reads; the script writes every foreign text as text, never as markup,
and the page's policy lets no other script run.
"""

import base64
from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.captions import FIELDS, Caption, ValueCounts, caption_spans
from cosfly.formats.frames import frame_path
from cosfly.formats.inspection import read_settled
from cosfly.formats.kinds import GROUND_KINDS, KIND_NAMES
from cosfly.formats.places import Place, folder_name, place_of, town_folder
from cosfly.formats.playback import Track
from cosfly.formats.playback_file import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.escaping import for_terminal
from cosfly.runtime.io import read_bytes, write_bytes
from cosfly.viz.frame_views import VIEW_FILES, View, page_pictures, read_view, spread
from cosfly.viz.page import page, scripts
from cosfly.viz.topview import footprint

PATH_POINTS = 240
MOST_BOXES, MARGIN_M = 2_500, 30.0  # of one map
TARGET_PICTURE = "target_picture"
VIEWS: tuple[View, ...] = ("rgb", "depth", "segmentation")
Group = tuple[str, str, str]  # run, town, trajectory


class Tree(NamedTuple):
    """A playback tree and what was made of it; None for what does not exist. run: Its name among several."""

    run: str
    data: Path
    captions: Path | None = None
    inspect: Path | None = None
    boxes: Path | None = None

    def place(self, one: Any) -> Place:
        """Return the place of a track from anything that names its town, trajectory and variant."""
        return Place(self.run, town_folder(one.town), one.trajectory, one.variant)


@dataclass
class _Shown:
    """A track on the page. kinds: What the caption of a frame says. spans: Where it is stored: first byte and size."""

    path: Path
    captions: Path | None
    result: str | None = None
    kinds: dict[int, Hashable] = field(default_factory=dict)
    spans: dict[int, tuple[int, int]] = field(default_factory=dict)

    def caption(self, frame: int) -> Caption | None:
        """Read the caption of a frame again; None where it has none."""
        if self.captions is None or frame not in self.spans:
            return None
        return Caption.model_validate_json(read_bytes(self.captions, span=self.spans[frame], what="captions"))


def run(
    folder: Path, out: Path, captions: Path | None = None, *, picture_px: int = 320, most_tracks: int = 100,
    most_frames: int = 16,
) -> Path:  # fmt: skip
    """Read a run or a playback tree; write one page and return its path.

    Args:
        captions: `captions.jsonl` of a playback tree; a run has its own.
        picture_px: Width of a colour picture; the others have half of it.
        most_tracks: Of more, whole trajectories are shown, evenly spread.
        most_frames: Of a track, among them one of each verdict and decision.
    """
    trees = _find_trees(folder, captions)
    tracks, notes = _find_tracks(trees, most_tracks)
    flights = []
    with progress_bar("viewer: tracks", len(tracks)) as advance:
        for place, shown in tracks.items():
            try:
                track = read_track(shown.path)
            except InputError as error:
                notes.append(f"not shown: {place.trajectory}/{place.variant}: {error.what}")
            else:
                flights.append(_flight(place, track, shown, most_frames, picture_px))
            advance(1)
    title = folder.absolute().name
    data = {"title": title, "notes": notes, "maps": _maps(trees, flights), "flights": flights}
    script, style = scripts("tools.js", "canvas.js", "viewer.js"), scripts("viewer.css")
    values = {"title": title, "notes": notes, "data": _printable(data)}
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


# --- tracks and captions of a run -------------------------------------------------------------------------------------


def _find_trees(folder: Path, captions: Path | None) -> list[Tree]:
    """Return what a folder is: a run, a run of several towns, or a playback tree."""
    towns = sorted(path.parent for path in folder.glob("*/render") if path.is_dir())
    trees = []
    for place in [folder] if (folder / "render").is_dir() else towns:
        names = ("caption/captions.jsonl", "inspect/inspect.json", "simplify/step2_simplified.json")
        own_captions, *others = (place / name if (place / name).exists() else None for name in names)
        trees.append(Tree(folder_name(place.absolute().name), place / "render", captions or own_captions, *others))
    return trees or [Tree("", folder, captions)]


def _find_tracks(trees: list[Tree], most: int) -> tuple[dict[Place, _Shown], list[str]]:
    """Return the tracks to show with their captions and results, and a note if there are others."""
    found = {tree.place(place_of(path)): (path, tree.captions) for tree in trees for path in find_tracks(tree.data)}
    tracks = {place: _Shown(*found[place]) for place in _choose_tracks(list(found), most)}
    for tree in trees:
        for span, caption in caption_spans(tree.captions) if tree.captions else ():
            if (shown := tracks.get(tree.place(caption))) is not None:
                decision = caption.en.flight_decision if caption.en else None
                shown.kinds[caption.frame_index] = caption.status, caption.verdict, decision
                shown.spans[caption.frame_index] = span
        for inspected in read_settled(tree.inspect).flights if tree.inspect else ():
            if (shown := tracks.get(tree.place(inspected))) is not None:
                shown.result = inspected.result
    return tracks, [f"{len(tracks):,} of {len(found):,} tracks are shown"] if len(tracks) < len(found) else []


def _choose_tracks(places: list[Place], most: int) -> list[Place]:
    """Return the tracks of whole trajectories, evenly spread: as many as fit, and one trajectory at least."""
    groups: dict[Group, list[Place]] = defaultdict(list)
    for place in places:
        groups[place.run, place.town, place.trajectory].append(place)
    trajectories = list(groups.values())
    chosen = places
    for count in range(len(trajectories), 0, -1):
        chosen = [place for k in spread(len(trajectories), count) for place in trajectories[k]]
        if len(chosen) <= most:
            break
    return chosen


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


# --- the page's data --------------------------------------------------------------------------------------------------


def _flight(place: Place, track: Track, shown: _Shown, most_frames: int, picture_px: int) -> dict[str, Any]:
    """Return a track with some of its frames."""
    names = [name for name in (place.run, track.town, track.trajectory, track.variant) if name]
    chosen = choose_frames(range(len(track)), shown.kinds, most_frames)
    return {
        "name": "/".join(names),
        "group": "/".join(names[:-1]),  # both tracks of a trajectory
        "map": f"{place.run}/{track.town}",
        "town": track.town,
        "track": "clean" if track.is_original else "perturbed",
        "result": shown.result,
        "fovs_deg": [round(fov_deg, 1) for fov_deg in track.fovs_deg],
        "num_frames": len(track),
        "num_captions": len(shown.kinds),
        "drone_path": _path(track.positions_m[:, :2]),
        "target_path": _path(track.targets_m[:, :2]),
        "frames": [_frame(track, i, shown.caption(i), picture_px) for i in chosen],
    }


def _path(points_m: np.ndarray) -> list[list[float]]:
    known = points_m[~np.isnan(points_m).any(axis=1)]
    return known[spread(len(known), PATH_POINTS)].astype(np.float64).round(1).tolist()


def _frame(track: Track, i: int, caption: Caption | None, picture_px: int) -> dict[str, Any]:
    """Return a frame. box: Of the target, xmin, ymin, xmax, ymax as shares of the picture."""
    folder, camera, picture = track.frame_folder(i), track.camera_at(i), track.target_picture(i)
    data = picture and picture["bytes"]
    views = {view: partial(read_view, folder, view) for view in VIEWS if frame_path(folder, VIEW_FILES[view]).exists()}
    box = (track.target.bbox[i] / np.tile([max(1, camera.width_px), max(1, camera.height_px)], 2)).round(4)
    has_target, seen = not np.isnan(track.targets_m[i]).any(), float(track.target.visibility[i])
    return {
        "index": i,
        "time_s": round(float(track.time_s[i]), 3),
        "drone": [round(float(value), 2) for value in (*track.positions_m[i], track.rotations_deg[i, 1])],
        "target": track.targets_m[i].round(2).tolist() if has_target else None,
        "visibility": None if np.isnan(seen) else round(seen, 3),
        "is_perturbed": bool(track.perturbation.is_perturbed[i]),
        "events": track.events(i),
        "facts": dict(_facts(track, i)),
        "fov_deg": round(camera.fov_deg, 1),
        "box": box.tolist() if np.isfinite(box).all() else None,
        "pictures": page_pictures(views, picture_px),
        TARGET_PICTURE: base64.b64encode(data).decode() if isinstance(data, bytes) else None,
        "caption": None if caption is None else _caption(caption),
    }


def _facts(track: Track, i: int) -> Iterator[tuple[str, str]]:
    goal, others = track.goal, None if track.bystanders is None else track.bystanders[i, 0]
    facts = {
        "style": track.styles[i], "planner": track.planner, "pace": track.pace,
        "goal in words": goal and goal.en, "goal in Chinese": goal and goal.zh, "weather": track.weather["weather"],
        "time of day": track.weather["time_of_day"],
        "other people in view": None if others is None or np.isnan(others) else int(others),
    }  # fmt: skip
    return ((name, str(value)) for name, value in facts.items() if value is not None)


def _caption(caption: Caption) -> dict[str, Any]:
    texts = {
        language: {name: getattr(coc, name) for name in FIELDS[:2]}
        for language, coc in (("en", caption.en), ("zh", caption.zh)) if coc is not None
    }  # fmt: skip
    counts, repair = (caption.checks.values or {}).values(), caption.repair
    decision = next((coc.flight_decision for coc in (caption.en, caption.zh) if coc is not None), None)
    first = repair and f"{repair.rung or repair.outcome}, first {repair.first_decision} ({repair.first_verdict})"
    facts = {
        "decision": decision, "label": caption.label, "label from": caption.label_from, "repair": first,
        "kind of teacher": caption.teacher.kind, "teacher model": caption.teacher.model,
        "written as": caption.writing, "window": ", ".join(map(str, caption.window)),
    }  # fmt: skip
    return {
        "decision": decision,
        "verdict": caption.verdict,
        "repair": first,
        "facts": {name: str(value) for name, value in facts.items() if value is not None},
        "texts": texts,
        "values": {name: sum(getattr(one, name) for one in counts) for name in ValueCounts.model_fields},
        "problems": caption.checks.contradictions or [],
        "dropped": caption.drop_reason if caption.status == "dropped" else None,
    }


def _maps(trees: list[Tree], tracks: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the boxes around the tracks of each town, where the run has a map."""
    near: dict[str, list] = defaultdict(list)
    for track in tracks:
        near[track["map"]] += [*track["drone_path"], *track["target_path"]]
    maps = {tree.run: tree.boxes for tree in trees if tree.boxes is not None}
    of_runs = {name: maps.get(name.partition("/")[0]) for name in near}
    return {name: _boxes_of(read_boxes(path), near[name]) for name, path in of_runs.items() if path is not None}


def _boxes_of(box_map: BoxMap, near: Sequence[Sequence[float]]) -> list[dict[str, Any]]:
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
