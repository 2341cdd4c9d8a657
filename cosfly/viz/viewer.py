"""`cosfly view`: one self-contained page of a run or a playback tree, for a browser without a network.

The data are JSON with the names that `viewer.js` reads; the script writes every foreign text as text, never as markup,
and the page's policy lets no other script run.
"""

import base64
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
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


class Tree(NamedTuple):
    """A playback tree and the files that were made from it; None for a file that does not exist."""

    run: str  # name of the run, empty for a tree without one
    data: Path
    captions: Path | None = None
    inspect: Path | None = None
    boxes: Path | None = None

    def place(self, track: Any) -> Place:
        """Return the place of a track, a caption or another record with a town, a trajectory and a variant."""
        return Place(self.run, town_folder(track.town), track.trajectory, track.variant)


class CaptionOutcome(NamedTuple):
    """What a caption says of its frame."""

    status: str
    verdict: str | None
    decision: str | None


@dataclass
class TrackEntry:
    """A track to show; its captions stay in their file."""

    path: Path
    captions: Path | None
    result: str | None = None  # of the inspection
    outcomes: dict[int, CaptionOutcome] = field(default_factory=dict)  # by frame
    spans: dict[int, tuple[int, int]] = field(default_factory=dict)  # by frame: first byte and size of the caption

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
        picture_px: Width of a colour picture; the other pictures have half of it.
        most_tracks: Greatest number of tracks; of more, whole trajectories are chosen, evenly spread.
        most_frames: Greatest number of frames of a track, among them one of each verdict and decision.
    """
    trees = _find_trees(folder, captions)
    all_tracks = {
        tree.place(place_of(path)): TrackEntry(path, tree.captions) for tree in trees for path in find_tracks(tree.data)
    }
    tracks = {place: all_tracks[place] for place in _choose_tracks(list(all_tracks), most_tracks)}
    notes = list[str]()
    if len(tracks) < len(all_tracks):
        notes.append(f"{len(tracks):,} of {len(all_tracks):,} tracks are shown")
    for tree in trees:
        _add_records(tracks, tree)
    flights = []
    with progress_bar("viewer: tracks", len(tracks)) as advance:
        for place, entry in tracks.items():
            try:
                track = read_track(entry.path)
            except InputError as error:
                notes.append(f"not shown: {place.trajectory}/{place.variant}: {error.what}")
            else:
                flights.append(_flight(place, track, entry, most_frames, picture_px))
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
        return [_printable(item) for item in value]
    if isinstance(value, dict):
        return {
            _printable(key): item if key in ("pictures", TARGET_PICTURE) else _printable(item)
            for key, item in value.items()
        }
    return value


# --- tracks and captions of a run -------------------------------------------------------------------------------------


def _find_trees(folder: Path, captions: Path | None) -> list[Tree]:
    """Return the trees of a folder: those of a run, of the towns of a run, or the folder itself as a playback tree."""
    run_folders = [folder]
    if not (folder / "render").is_dir():
        run_folders = sorted(path.parent for path in folder.glob("*/render") if path.is_dir())
    trees = []
    for run_folder in run_folders:
        trees.append(
            Tree(
                run=folder_name(run_folder.absolute().name),
                data=run_folder / "render",
                captions=captions or _existing(run_folder / "caption/captions.jsonl"),
                inspect=_existing(run_folder / "inspect/inspect.json"),
                boxes=_existing(run_folder / "simplify/step2_simplified.json"),
            )
        )
    return trees or [Tree("", folder, captions)]


def _existing(path: Path) -> Path | None:
    return path if path.exists() else None


def _add_records(tracks: dict[Place, TrackEntry], tree: Tree) -> None:
    """Add the captions and the results of the inspection of a tree to its tracks."""
    if tree.captions is not None:
        for span, caption in caption_spans(tree.captions):
            if (track := tracks.get(tree.place(caption))) is not None:
                decision = caption.en.flight_decision if caption.en else None
                track.outcomes[caption.frame_index] = CaptionOutcome(caption.status, caption.verdict, decision)
                track.spans[caption.frame_index] = span
    if tree.inspect is not None:
        for inspected in read_settled(tree.inspect).flights:
            if (track := tracks.get(tree.place(inspected))) is not None:
                track.result = inspected.result


def _choose_tracks(places: list[Place], most: int) -> list[Place]:
    """Return the tracks of whole trajectories, evenly spread: as many as fit, and one trajectory at least."""
    tracks_of: dict[tuple[str, str, str], list[Place]] = defaultdict(list)  # by run, town and trajectory
    for place in places:
        tracks_of[place.run, place.town, place.trajectory].append(place)
    trajectories = list(tracks_of.values())
    chosen = places
    for num_trajectories in range(len(trajectories), 0, -1):
        chosen = [place for k in spread(len(trajectories), num_trajectories) for place in trajectories[k]]
        if len(chosen) <= most:
            break
    return chosen


def choose_frames(num_frames: int, outcomes: Mapping[int, CaptionOutcome], most: int) -> list[int]:
    """Choose at most `most` frames of a track, ascending.

    Half of them are the first frames of each outcome. The rest are evenly spread over the frames with captions, and
    then over those without.
    """
    first_of: dict[CaptionOutcome, int] = {}
    for frame in sorted(outcomes.keys() & range(num_frames)):
        first_of.setdefault(outcomes[frame], frame)
    chosen = set(list(first_of.values())[: max(1, most // 2)])
    for has_caption in (True, False):
        rest = [i for i in range(num_frames) if i not in chosen and (i in outcomes) == has_caption]
        chosen |= {rest[k] for k in spread(len(rest), most - len(chosen))}
    return sorted(chosen)


# --- the page's data --------------------------------------------------------------------------------------------------


def _flight(place: Place, track: Track, entry: TrackEntry, most_frames: int, picture_px: int) -> dict[str, Any]:
    """Return a track with some of its frames."""
    names = [name for name in (place.run, track.town, track.trajectory, track.variant) if name]
    chosen = choose_frames(len(track), entry.outcomes, most_frames)
    return {
        "name": "/".join(names),
        "group": "/".join(names[:-1]),  # both tracks of a trajectory
        "map": f"{place.run}/{track.town}",
        "town": track.town,
        "track": "clean" if track.is_original else "perturbed",
        "result": entry.result,
        "fovs_deg": [round(fov_deg, 1) for fov_deg in track.fovs_deg],
        "num_frames": len(track),
        "num_captions": len(entry.outcomes),
        "drone_path": _path(track.positions_m[:, :2]),
        "target_path": _path(track.targets_m[:, :2]),
        "frames": [_frame(track, i, entry.caption(i), picture_px) for i in chosen],
    }


def _path(points_m: np.ndarray) -> list[list[float]]:
    """Return at most PATH_POINTS of the known points, (n, 2) m."""
    known = points_m[~np.isnan(points_m).any(axis=1)]
    return known[spread(len(known), PATH_POINTS)].astype(np.float64).round(1).tolist()


def _frame(track: Track, i: int, caption: Caption | None, picture_px: int) -> dict[str, Any]:
    """Return a frame. Its `box` is that of the target: xmin, ymin, xmax, ymax as shares of the picture."""
    folder = track.frame_folder(i)
    camera = track.camera_at(i)
    target_picture = track.target_picture(i)
    target_data = None if target_picture is None else target_picture["bytes"]
    views = {view: partial(read_view, folder, view) for view in VIEWS if frame_path(folder, VIEW_FILES[view]).exists()}
    box = (track.target.bbox[i] / np.tile([max(1, camera.width_px), max(1, camera.height_px)], 2)).round(4)
    has_target = not np.isnan(track.targets_m[i]).any()
    visibility = float(track.target.visibility[i])
    return {
        "index": i,
        "time_s": round(float(track.time_s[i]), 3),
        "drone": [round(float(value), 2) for value in (*track.positions_m[i], track.rotations_deg[i, 1])],
        "target": track.targets_m[i].round(2).tolist() if has_target else None,
        "visibility": None if np.isnan(visibility) else round(visibility, 3),
        "is_perturbed": bool(track.perturbation.is_perturbed[i]),
        "events": track.events(i),
        "facts": dict(_facts(track, i)),
        "fov_deg": round(camera.fov_deg, 1),
        "box": box.tolist() if np.isfinite(box).all() else None,
        "pictures": page_pictures(views, picture_px),
        TARGET_PICTURE: base64.b64encode(target_data).decode() if isinstance(target_data, bytes) else None,
        "caption": None if caption is None else _caption(caption),
    }


def _facts(track: Track, i: int) -> Iterator[tuple[str, str]]:
    """Return title and text of each known fact of a frame."""
    goal = track.goal
    num_others = np.nan if track.bystanders is None else track.bystanders[i, 0]
    facts = {
        "style": track.styles[i],
        "planner": track.planner,
        "pace": track.pace,
        "goal in words": None if goal is None else goal.en,
        "goal in Chinese": None if goal is None else goal.zh,
        "weather": track.weather["weather"],
        "time of day": track.weather["time_of_day"],
        "other people in view": None if np.isnan(num_others) else int(num_others),
    }
    return ((name, str(value)) for name, value in facts.items() if value is not None)


def _caption(caption: Caption) -> dict[str, Any]:
    written = {language: coc for language, coc in (("en", caption.en), ("zh", caption.zh)) if coc is not None}
    decision = next((coc.flight_decision for coc in written.values()), None)
    counts = list((caption.checks.values or {}).values())
    repair_text = None
    if (repair := caption.repair) is not None:
        repair_text = f"{repair.rung or repair.outcome}, first {repair.first_decision} ({repair.first_verdict})"
    facts = {
        "decision": decision, "label": caption.label, "label from": caption.label_from, "repair": repair_text,
        "kind of teacher": caption.teacher.kind, "teacher model": caption.teacher.model,
        "written as": caption.writing, "window": ", ".join(map(str, caption.window)),
    }  # fmt: skip
    return {
        "decision": decision,
        "verdict": caption.verdict,
        "repair": repair_text,
        "facts": {name: str(value) for name, value in facts.items() if value is not None},
        "texts": {language: {name: getattr(coc, name) for name in FIELDS[:2]} for language, coc in written.items()},
        "values": {name: sum(getattr(count, name) for count in counts) for name in ValueCounts.model_fields},
        "problems": caption.checks.contradictions or [],
        "dropped": caption.drop_reason if caption.status == "dropped" else None,
    }


def _maps(trees: list[Tree], tracks: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the boxes around the tracks of each town, where the run has a map."""
    points_of: dict[str, list] = defaultdict(list)  # by name of the map, which is run/town
    for track in tracks:
        points_of[track["map"]] += [*track["drone_path"], *track["target_path"]]
    boxes_of = {tree.run: tree.boxes for tree in trees if tree.boxes is not None}
    paths = {name: boxes_of.get(name.partition("/")[0]) for name in points_of}
    return {name: _boxes_near(read_boxes(path), points_of[name]) for name, path in paths.items() if path is not None}


def _boxes_near(box_map: BoxMap, points_m: Sequence[Sequence[float]]) -> list[dict[str, Any]]:
    """Return the footprints of the largest boxes of a map around some points, in painting order: lower ones first."""
    if not points_m:
        return []
    low, high = np.min(points_m, axis=0) - MARGIN_M, np.max(points_m, axis=0) + MARGIN_M
    rows = np.flatnonzero(((box_map.maxs[:, :2] >= low) & (box_map.mins[:, :2] <= high)).all(axis=1))
    areas = box_map.half_extents[rows, 0] * box_map.half_extents[rows, 1]
    rows = rows[np.argsort(-areas, kind="stable")[:MOST_BOXES]]
    is_ground = np.isin(box_map.kinds[rows], list(GROUND_KINDS))
    tops = box_map.centers[rows, 2] + box_map.half_extents[rows, 2]
    rows = rows[np.lexsort((tops, ~is_ground))]
    return [
        {"kind": KIND_NAMES[int(box_map.kinds[row])], "corners": footprint(box_map, row).round(1).tolist()}
        for row in rows.tolist()
    ]
