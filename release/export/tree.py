"""The playback tree again, as the public CosFly-Track layout has it: `Town*/trajectory_*/{ORI,aug_*}/`, for loaders of
that layout and for cosfly.

Pictures are the released bytes, depth is `depth.npy`, axes are CARLA's. Fields have the public forms: `dataset_format`
v7, an integer `scenario_id`, flags for perturbations; the offsets are in `perturbation.offsets`. Frames count from 0,
and `source.released_frames` has their indices in the release. Several runs become a tree each, in a folder of its
name.
"""

from collections import Counter
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.formats.boxes import UNKNOWN_LICENCE
from cosfly.formats.frames import BYSTANDER_COLUMNS, COORDINATES, FILE_NAMES, frame_name
from cosfly.formats.pedestrian_paths import pace_field
from cosfly.formats.people import Goal
from cosfly.formats.places import TOWN
from cosfly.formats.playback import DATASET_FORMAT, LEGIBILITY, TARGET_FILE, Track
from cosfly.formats.playback_file import write_track
from cosfly.formats.segments import FOLLOW, Segment
from cosfly.formats.town import TOWN_FILE, TOWN_FORMAT, TownMap
from cosfly.runtime.console import Advance
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes, sha256_file, write_bytes, write_checksums
from cosfly.runtime.json_io import write_model
from release.columns import COMPANY_COLUMNS, TARGET_PICTURE, matrices_of
from release.export.stage import ExportConfig, ExportSource, FormatFacts, SourceTrack
from release.reading import Row, TrackRows


def write(source: ExportSource, folder: Path, cfg: ExportConfig, advance: Advance) -> FormatFacts:
    """Write each track, and each town's `map.json`; count the tracks of which strict readers will miss something."""
    has_several_runs = len({track.flight.partition("/")[0] for track in source.record.flights}) > 1
    maps = {released_map.town: released_map for released_map in source.record.maps}
    numbers = dict[tuple[str, str, str], int]()  # run, town, trajectory -> number of the trajectory in the export
    num_tracks = Counter[int]()  # of each trajectory
    num_gaps = 0
    for track in source.tracks():
        run, town, trajectory = track.place.run, track.place.town, track.place.trajectory
        if not town.startswith(TOWN) or not trajectory.startswith("trajectory_"):
            what, expected = "a playback tree cannot contain a track of this name", f"{TOWN}*/trajectory_*"
            raise InputError(what, where=source.folder, got=track.name, expected=expected, fix="export another format")
        number = numbers.setdefault((run, town, trajectory), len(numbers))
        num_tracks[number] += 1
        num_gaps += bool((np.diff(track.frame_index) != 1).any() or track.frame_index[0] != 0)
        town_folder = folder / (run if has_several_runs else "") / town
        _write_track(track, number, town_folder / trajectory / track.place.variant, advance)
        town_map = TownMap(name=town, licence=UNKNOWN_LICENCE, credits="")
        if released_map := maps.get(town):
            town_map = TownMap(**released_map.model_dump(include={"name", "licence", "credits"}))
        write_model(town_folder / TOWN_FILE, town_map, TOWN_FORMAT)
    values = {
        "num_gaps": num_gaps, "num_tracks": num_tracks.total(), "num_trajectories": len(numbers),
        "num_alone": sum(count < 2 for count in num_tracks.values()),
    }  # fmt: skip
    return FormatFacts(values, COORDINATES)


def _write_track(track: SourceTrack, number: int, out: Path, advance: Advance) -> None:
    """Write the pictures of a track, then trajectory.json, then the checksums of all."""
    digests = dict[str, str]()

    def put(name: str, data: bytes) -> None:
        write_bytes(out / name, data)
        digests[name] = sha256_bytes(data)

    for i, (row, pictures) in enumerate(track.frames()):
        for file, data in pictures.items():
            put(f"{frame_name(i)}/{FILE_NAMES[file]}", data)
        if row[TARGET_PICTURE] is not None:
            put(TARGET_FILE, row[TARGET_PICTURE]["bytes"])
        advance(1)
    write_track(out, track_of_rows(track, number), with_flags=True)
    digests["trajectory.json"] = sha256_file(out / "trajectory.json")
    write_checksums(out, digests)


# --- trajectory.json --------------------------------------------------------------------------------------------------


def track_of_rows(exported: SourceTrack, number: int) -> Track:
    """Return the track of released rows; `number` is that of its trajectory in the export."""
    rows, place = TrackRows(exported.name, exported.rows), exported.place
    first = exported.rows[0]
    source = {
        "path_index": number, "scenario_id": number,
        "scenario_name": f"{place.run}/{place.town}/{place.trajectory}".lstrip("/"),
        "algorithm": first["planner"] or "unknown", "released_frames": exported.frame_index,
        **pace_field(first["pace"]),
    }  # fmt: skip
    points = [_point(row) for row in exported.rows]
    return replace(
        rows.track, source=source, goal=_goal(rows.goal, exported.frame_index),
        intrinsics=None if (rows.intrinsics == rows.intrinsics[0]).all() else matrices_of(rows.intrinsics),
        segments=_segments([row["style"] for row in exported.rows]),
        raw={"dataset_format": "v7", "made_by": DATASET_FORMAT, "points": points, **_weather(first)},
    )  # fmt: skip


def _goal(goal: Goal | None, frame_index: list[int]) -> Goal | None:
    """Return the goal if its frame is released, with the number of that frame in the tree."""
    if goal is None or goal.frame not in frame_index:
        return None
    return replace(goal, frame=frame_index.index(goal.frame))


def _point(row: Row) -> dict[str, Any]:
    """Return what a point has in addition to the arrays: the outcome of its perturbation, or flags if the offsets are
    unknown; whether its target is legible; the other people."""
    outcome = {name: text for name, text in (row["perturbation"] or {}).items() if text is not None}
    if row["is_perturbed"] and row["drone_offset"] is None:
        outcome |= {"drone_position": True, "drone_rotation": True}
    target = {name: row[f"target_{name}"] for name in LEGIBILITY if row[f"target_{name}"] is not None}
    others = {}
    if row["others_in_view"] is not None:
        others = dict(zip(BYSTANDER_COLUMNS, (row[name] for name in COMPANY_COLUMNS), strict=True))
    point = {"perturbation": outcome, "target": target, "others": others}
    return {name: value for name, value in point.items() if value}


def _weather(row: Row) -> dict[str, Any]:
    """Return the field of the weather: with its parameters, or else its names, or nothing if they are null."""
    if row["weather_params"] is not None and row["weather_mode"] is not None:
        names = {"weather_name": row["weather"], "tod_name": row["time_of_day"]}
        return {"weather": {"mode": row["weather_mode"], **names, "params": row["weather_params"]}}
    names = {name: row[name] for name in ("weather", "time_of_day") if row[name] is not None}
    return {"weather": names} if names else {}


def _segments(styles: list[str]) -> tuple[Segment, ...]:
    """Return the parts of a track by style; none if it follows from end to end."""
    if set(styles) == {FOLLOW}:
        return ()
    parts, begin = [], 0
    for style, group in groupby(styles):
        end = begin + len(list(group))
        parts.append(Segment(style, begin, end))
        begin = end
    return tuple(parts)
