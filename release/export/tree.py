"""The playback tree again, as the public CosFly-Track layout has it: `Town*/trajectory_*/{ORI,aug_*}/`, for loaders of
that layout and for cosfly.

Pictures are the released bytes, depth is `depth.npy`, axes are CARLA's. Fields have the public forms: `dataset_format`
v7, an integer `scenario_id`, flags for perturbations; the offsets are in `perturbation.offsets`. Frames count from 0,
and `source.released_frames` has their indices in the release. Several runs become a tree each, in a folder of its
name.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
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
from cosfly.formats.playback import DATASET_FORMAT, LEGIBILITY, TARGET_FILE, Track, write_track
from cosfly.formats.segments import FOLLOW, Segment
from cosfly.formats.town import TOWN_FILE, TOWN_FORMAT, TownMap
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes, sha256_file, write_bytes, write_checksums
from cosfly.runtime.json_io import write_model
from cosfly.runtime.worker import advance
from release.columns import COMPANY_COLUMNS, PICTURES, SCALAR_NAMES, TARGET_PICTURE, matrices_of
from release.export.source import ExportSource, Row, SourceTrack
from release.export.stage import Done, ExportConfig, ExportUnit, FormatFacts, track_units
from release.flight_rows import FlightRows

VERSION = "drone_nav_traj_v7 7.0.0"


def plan(source: ExportSource, cfg: ExportConfig) -> list[ExportUnit]:
    """Return one unit per track; its `extra` is its folder in the tree, and the number of its trajectory."""
    wrong = [
        f"{track.name}: the name of the {kind} does not begin with {begin}"
        for track in source.tracks
        for kind, begin in (("town", TOWN), ("trajectory", "trajectory_"))
        if not getattr(track.place, kind).startswith(begin)
    ]
    if wrong:
        what = "the source cannot be written as a playback tree"
        raise InputError(what, where=source.folder, got="; ".join(wrong[:20]))
    has_runs = len({track.place.run for track in source.tracks}) > 1
    numbers: dict[tuple[str, str, str], int] = {}
    units = []
    for unit in track_units(source):
        place = unit.track.place
        number = numbers.setdefault((place.run, place.town, place.trajectory), len(numbers))
        folder = Path(place.run if has_runs else "", place.town, place.trajectory, place.variant)
        units.append(replace(unit, extra=(folder.as_posix(), number)))
    return units


def write(source: ExportSource, unit: ExportUnit, folder: Path, cfg: ExportConfig) -> dict[str, Any]:
    """Write one track: its pictures, then trajectory.json, then the checksums of all."""
    track, (place, number) = unit.track, unit.extra
    out, digests, scalars = folder / place, dict[str, str](), list[Row]()

    def put(name: str, data: bytes) -> None:
        write_bytes(out / name, data)
        digests[name] = sha256_bytes(data)

    for i, row in enumerate(track.rows([*SCALAR_NAMES, *(PICTURES[file].name for file in source.modalities)])):
        for file in source.modalities:
            put(f"{frame_name(i)}/{FILE_NAMES[file]}", track.picture(row, file))
        if row[TARGET_PICTURE] is not None:
            put(TARGET_FILE, row[TARGET_PICTURE]["bytes"])
        scalars.append({column: row[column] for column in SCALAR_NAMES})
        advance()
    write_track(out, track_of_rows(scalars, track, number), with_flags=True)
    digests["trajectory.json"] = sha256_file(out / "trajectory.json")
    write_checksums(out, digests)
    has_gaps = bool((np.diff(track.frame_index) != 1).any() or track.frame_index[0] != 0)
    return {"is_original": scalars[0]["track"] == "clean", "has_gaps": has_gaps}


def finish(source: ExportSource, done: Done, folder: Path, cfg: ExportConfig) -> FormatFacts:
    """Write each town's `map.json`, and count the tracks of which strict readers will miss something."""
    towns = {(unit.extra[0].rpartition("/trajectory_")[0], unit.track.place.town) for unit, _ in done}
    maps = {entry.town: entry for entry in source.record.maps}
    for place, town in sorted(towns):
        shown = maps.get(town)
        about = TownMap(name=shown.name, licence=shown.licence, credits=shown.credits) if shown else None
        about = about or TownMap(name=town, licence=UNKNOWN_LICENCE, credits="")
        write_model(folder / place / TOWN_FILE, about, TOWN_FORMAT)
    return FormatFacts(
        format_version=VERSION,
        codings={file: f"{FILE_NAMES[file]}, the released bytes" for file in source.modalities},
        coordinates=COORDINATES,
        notes=list(_notes(done)),
        how_to_open="from cosfly.formats.tracks import find_tracks\n"
        "from cosfly.formats.playback import read_track\n"
        "tracks = [read_track(folder, strict=False) for folder in find_tracks(Path('.'))]",
    )


def _notes(done: Done) -> Iterator[str]:
    yield (
        "Frames count from 0 as the layout asks; source.released_frames of trajectory.json has the index of each in "
        "its track. The layout has no captions: they are in the release. meta.json and missions are not in it."
    )
    if gaps := sum(facts["has_gaps"] for _, facts in done):
        yield (
            f"{gaps} of {len(done)} tracks are parts of a track: the steps between their frames are uneven, which "
            "readers with a strict clock refuse."
        )
    tracks = defaultdict(set)
    for unit, facts in done:
        tracks[unit.extra[0].rpartition("/")[0]].add(facts["is_original"])
    if alone := sum(len(found) < 2 for found in tracks.values()):
        yield f"{alone} of {len(tracks)} trajectories have one track only; some public loaders ask for both."


# --- trajectory.json --------------------------------------------------------------------------------------------------


def track_of_rows(rows: list[Row], placed: SourceTrack, number: int) -> Track:
    """Return the track of released rows; `number` is that of its trajectory in the export."""
    found = FlightRows(placed.name, rows)
    return replace(
        found.flight,
        intrinsics=None if (found.intrinsics == found.intrinsics[0]).all() else matrices_of(found.intrinsics),
        segments=_segments([row["style"] for row in rows]),
        source={
            "path_index": number,
            "scenario_id": number,
            "scenario_name": f"{placed.place.run}/{placed.place.town}/{placed.place.trajectory}".lstrip("/"),
            "algorithm": rows[0]["planner"] or "unknown",
            "released_frames": placed.frame_index,
            **pace_field(rows[0]["pace"]),
        },
        goal=_goal(found, placed),
        raw={"dataset_format": "v7", "made_by": DATASET_FORMAT, "points": [*map(_point, rows)], **_weather(rows[0])},
    )


def _goal(rows: FlightRows, placed: SourceTrack) -> Goal | None:
    """Return the goal if its frame is released, with the number of that frame in the tree."""
    at = np.flatnonzero(np.equal(placed.frame_index, rows.goal.frame if rows.goal else -1))
    return replace(rows.goal, frame=int(at[0])) if rows.goal and len(at) else None


def _point(row: Row) -> dict[str, Any]:
    """Return what a point has in addition to the arrays: the outcome of its perturbation, or flags if the offsets are
    unknown; whether its target is legible; the other people."""
    outcome = {name: text for name, text in (row["perturbation"] or {}).items() if text is not None}
    if row["is_perturbed"] and row["drone_offset"] is None:
        outcome |= {"drone_position": True, "drone_rotation": True}
    target = {name: value for name in LEGIBILITY if (value := row[f"target_{name}"]) is not None}
    others = dict(zip(BYSTANDER_COLUMNS, (row[name] for name in COMPANY_COLUMNS), strict=True))
    point = {"perturbation": outcome, "target": target, "others": others if others["in_view"] is not None else {}}
    return {name: one for name, one in point.items() if one}


def _weather(row: Row) -> dict[str, Any]:
    if row["weather_params"] is not None and row["weather_mode"] is not None:
        names = {"weather_name": row["weather"], "tod_name": row["time_of_day"]}
        return {"weather": {"mode": row["weather_mode"], **names, "params": row["weather_params"]}}
    told = {name: row[name] for name in ("weather", "time_of_day") if row[name] is not None}
    return {"weather": told} if told else {}


def _segments(styles: list[str]) -> tuple[Segment, ...]:
    """Return the parts of a flight by style; none where it follows from end to end."""
    if set(styles) == {FOLLOW}:
        return ()
    parts, begin = [], 0
    for style, group in groupby(styles):
        end = begin + len(list(group))
        parts.append(Segment(style, begin, end))
        begin = end
    return tuple(parts)
