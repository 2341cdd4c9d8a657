"""The playback tree (CosFly-Track v7) of a release: what other people's loaders of that layout, and `cosfly caption`,
read.

    Town*/trajectory_*/{ORI, aug_001}/trajectory.json
    Town*/trajectory_*/{ORI, aug_001}/frames_playback/frame_00000/{rgb.png, depth.npy, instance.png}

Pictures are the released bytes; every number of `trajectory.json` is the release's, its axes the tree's
(products/playback.py). Frames are counted from 0, as the layout asks; which frame of the flight each was says
`source.released_frames`. A release of several runs becomes a tree a run, in a folder of its name.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
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
from cosfly.formats.playback import LEGIBILITY, TARGET_FILE, Track, write_track
from cosfly.formats.segments import FOLLOW, Segment
from cosfly.formats.town import TOWN_FILE, TOWN_FORMAT, TownMap
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import CHECKSUMS, checksum_lines, sha256_file
from cosfly.runtime.json_io import write_model
from cosfly.runtime.worker import advance
from release.columns import COMPANY_COLUMNS, PICTURES, SCALAR_NAMES, TARGET_PICTURE, matrices_of
from release.export.contract import ExportConfig, ExportUnit, Files, FormatFacts, UnitFiles
from release.export.source import DEPTH_CODING, Release, ReleasedRows, picture, read_span
from release.flight_rows import FlightRows

VERSION = "drone_nav_traj_v7 7.0.0"
Row = dict[str, Any]


def plan(release: Release, flights: list[ReleasedRows], cfg: ExportConfig) -> list[ExportUnit]:
    """Return a unit is one flight."""
    wrong = [] if "rgb" in release.modalities else ["the release has no colour pictures"]
    wrong += [
        f"{flight.name}: the name of the town does not begin with {TOWN}"
        for flight in flights
        if not flight.town.startswith(TOWN)
    ]
    wrong += [
        f"{flight.name}: the name of the trajectory does not begin with trajectory_"
        for flight in flights
        if not flight.trajectory.startswith("trajectory_")
    ]
    if wrong:
        raise InputError(
            "the release cannot be written as a playback tree", where=release.folder, got="; ".join(wrong[:20])
        )
    has_runs = len({flight.run for flight in flights}) > 1
    numbers: dict[tuple[str, str, str], int] = {}
    units = []
    for flight in flights:
        number = numbers.setdefault((flight.run, flight.town, flight.trajectory), len(numbers))
        folder = tree_folder(flight, has_runs)
        units.append(ExportUnit(flight.name, len(flight), flights=(flight,), extra=(folder.as_posix(), number)))
    return units


def tree_folder(flight: ReleasedRows, has_runs: bool) -> Path:
    """Return the folder of a flight, relative to the tree; has_runs: the release is of several runs."""
    return Path(flight.run if has_runs else "", flight.town, flight.trajectory, flight.variant)


def write(release: Release, unit: ExportUnit, folder: Path, cfg: ExportConfig) -> UnitFiles:
    """Write one flight: its pictures, then trajectory.json, then the checksums of all."""
    (rows,), (place, number) = unit.flights, unit.extra
    files, digests, scalars = Files(folder), dict[str, str](), list[Row]()
    for i, row in enumerate(_rows(release, rows)):
        for file in release.modalities:
            name = f"{frame_name(i)}/{FILE_NAMES[file]}"
            data = picture(row, file)
            digests[name] = files.put(f"{place}/{name}", data, listed=False)
        if row[TARGET_PICTURE] is not None:
            digests[TARGET_FILE] = files.put(f"{place}/{TARGET_FILE}", row[TARGET_PICTURE]["bytes"], listed=False)
        scalars.append({column: row[column] for column in SCALAR_NAMES})
        advance()
    (folder / place).mkdir(parents=True, exist_ok=True)
    write_track(folder / place, flight_of_rows(scalars, rows, number))
    digests["trajectory.json"] = sha256_file(folder / place / "trajectory.json")
    files.put(f"{place}/{CHECKSUMS}", checksum_lines(digests).encode())
    has_gaps = bool((np.diff(rows.frame_index) != 1).any() or rows.frame_index[0] != 0)
    return files.written(is_original=scalars[0]["track"] == "clean", has_gaps=has_gaps)


def _rows(release: Release, flight: ReleasedRows) -> Iterator[Row]:
    for span in flight.spans:
        yield from read_span(release, span, [*SCALAR_NAMES, *(PICTURES[file].name for file in release.modalities)])


def finish(
    release: Release, units: Sequence[ExportUnit], written: Sequence[UnitFiles], folder: Path, cfg: ExportConfig
) -> FormatFacts:
    """Write each town's `map.json`, and say which flights the strictest readers will miss something of."""
    towns = {(unit.extra[0].rpartition("/trajectory_")[0], unit.flights[0].town) for unit in units}
    maps = {entry.town: entry for entry in release.record.maps}
    files = {}
    for place, town in sorted(towns):
        shown = maps.get(town)
        about = TownMap(name=shown.name, licence=shown.licence, credits=shown.credits) if shown else None
        about = about or TownMap(name=town, licence=UNKNOWN_LICENCE, credits="")
        write_model(folder / place / TOWN_FILE, about, TOWN_FORMAT)
        files[f"{place}/{TOWN_FILE}"] = sha256_file(folder / place / TOWN_FILE)
    return FormatFacts(
        version=VERSION,
        codings={
            file: DEPTH_CODING.format(FILE_NAMES[file])
            if file == "depth"
            else f"{FILE_NAMES[file]}, the released bytes"
            for file in release.modalities
        },
        coordinates=COORDINATES,
        notes=list(_notes(units, written)),
        how_to_open="from cosfly.formats.tracks import find_flights\n"
        "from cosfly.formats.playback import read_flight\n"
        "flights = [read_flight(folder, strict=False) for folder in find_flights(Path('.'))]",
        files=files,
    )


def _notes(units: Sequence[ExportUnit], written: Sequence[UnitFiles]) -> Iterator[str]:
    yield (
        "Frames are counted from 0 as the layout asks; source.released_frames of trajectory.json says which frame of "
        "the flight each was. The layout has no captions: they stand in the release. meta.json and the order of "
        "missions are not in it."
    )
    gaps = sum(one.facts["has_gaps"] for one in written)
    if gaps:
        parts = f"{gaps} of {len(units)} flights are parts of a flight"
        yield f"{parts}: steps between their frames are uneven, which strict readers of time refuse."
    tracks = defaultdict(set)
    for unit, one in zip(units, written, strict=True):
        tracks[unit.extra[0].rpartition("/")[0]].add(one.facts["is_original"])
    alone = sum(len(found) < 2 for found in tracks.values())
    if alone:
        yield f"{alone} of {len(tracks)} trajectories have one track alone; some public loaders ask for both."


# --- trajectory.json --------------------------------------------------------------------------------------------------


def flight_of_rows(rows: list[Row], placed: ReleasedRows, number: int) -> Track:
    """Return the flight that released rows are of; `number` is its trajectory's among those of the release."""
    sizes = {(r["width_px"], r["height_px"]) for r in rows}
    if len(sizes) != 1:
        raise InputError("the pictures of the track differ in size", where=placed.name, got=f"{len(sizes)} sizes")
    found = FlightRows(placed.name, rows)
    return replace(
        found.flight,
        intrinsics=None if (found.intrinsics == found.intrinsics[0]).all() else matrices_of(found.intrinsics),
        segments=_segments([row["style"] for row in rows]),
        source={
            "path_index": number,
            "scenario_id": f"{placed.run}/{placed.town}/{placed.trajectory}".lstrip("/"),
            "scenario_name": placed.town,
            "released_frames": placed.frame_index.tolist(),
            **pace_field(rows[0]["pace"]),
        },
        goal=_goal(found, placed),
        raw={"points": [_point(row) for row in rows]} | _weather(rows[0]),
    )


def _goal(rows: FlightRows, placed: ReleasedRows) -> Goal | None:
    """Return the goal where its frame is released, under the number that this has in the tree."""
    at = np.flatnonzero(placed.frame_index == (rows.goal.frame if rows.goal else -1))
    return replace(rows.goal, frame=int(at[0])) if rows.goal and len(at) else None


def _point(row: Row) -> dict[str, Any]:
    """What a point says of its perturbation beside the offsets: what became of it, or that there was one whose offsets
    nobody knows; and of its target whether it can be made out.
    """
    told = {name: text for name, text in (row["perturbation"] or {}).items() if text is not None}
    if row["is_perturbed"] and row["drone_offset"] is None:
        told |= {"drone_position": True, "drone_rotation": True}
    target = {name: value for name in LEGIBILITY if (value := row[f"target_{name}"]) is not None}
    others = dict(zip(BYSTANDER_COLUMNS, (row[name] for name in COMPANY_COLUMNS), strict=True))
    point = {"perturbation": told, "target": target, "others": others if others["in_view"] is not None else {}}
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
