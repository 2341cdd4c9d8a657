"""The release that an export is made of: its flights, where their rows stand, and the rows themselves, read a row group
at a time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cosfly.formats.frames import FrameFile
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import inside, sha256_file
from cosfly.runtime.png import png_size
from cosfly.runtime.tables import arrow_errors, open_table, read_row_group, row_groups
from release.columns import PICTURES, PLACE, REQUIRED, SPLIT_NAMES, SplitName, flight_spans, schema
from release.record import ReleaseRecord, read_record, release_folder

# Names of columns below come from `release/columns.py`; those of shards from `release build`.
SHARD_NAME = re.compile(r"data/(train|validation|test)-[0-9a-f]{12}-\d{5}-of-\d{5}\.parquet")
LIGHT = [*PLACE, "frame_index", "time_s", "sample_id", "decision", "goal_en"]
# What one part of a path may be that rows name: no separator, nothing hidden, no ".."
DEPTH_CODING = "{}: float32, metres, lossless"
PART = re.compile(r"\w[\w.-]{0,200}", re.ASCII)

Place = tuple[str, str, str, str]  # run, town, trajectory, variant


@dataclass(frozen=True)
class Span:
    """Rows [start, stop) of row group `group` of a shard, all of one flight."""

    shard: str
    group: int
    start: int
    stop: int


@dataclass
class ReleasedRows:
    """One flight of a release, n frames. frames (n,) int32, rising; time_s (n,) float64; decisions: of the captions, ""
    where none; goal: in English, "" where none.

    num_bytes: of its rows, unpacked.
    """

    run: str
    town: str
    trajectory: str
    variant: str
    split: SplitName
    spans: list[Span] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)
    times: list[np.ndarray] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    goal: str = ""
    num_bytes: int = 0

    @property
    def name(self) -> str:
        return "/".join((self.run, self.town, self.trajectory, self.variant))

    @property
    def frame_index(self) -> np.ndarray:
        return np.concatenate(self.frames)

    @property
    def time_s(self) -> np.ndarray:
        return np.concatenate(self.times)

    def __len__(self) -> int:
        return sum(map(len, self.frames))


@dataclass(frozen=True)
class Release:
    """A release folder and its record. record_sha256: of `release.json`."""

    folder: Path
    record: ReleaseRecord
    record_sha256: str

    @property
    def modalities(self) -> list[FrameFile]:
        return self.record.settings.modalities


def open_release(folder: Path) -> Release:
    """Open a release folder, or that inside a release stage's or a run's.

    Raises:
        InputError: it is none, or its record names files that no release has; lists them all.
    """
    folder = release_folder(folder)
    record = read_record(folder / "release.json")
    wrong = []
    for shard in record.shards:
        if not SHARD_NAME.fullmatch(shard.path):
            wrong.append(f"{shard.path!r} is not the name of a shard")
        elif not (path := inside(folder, shard.path)).is_file():
            wrong.append(f"{shard.path} is missing")
        elif (size := path.stat().st_size) != shard.bytes:
            wrong.append(f"{shard.path} has {size} bytes instead of {shard.bytes}")
    if wrong:
        raise InputError(
            "the release is incomplete", where=folder, got="; ".join(wrong), fix="run cosfly release verify for details"
        )
    return Release(folder, record, sha256_file(folder / "release.json", tree=folder))


def split_of(shard: str) -> SplitName:
    """Return the split that a shard's name says: train, validation or test."""
    match = SHARD_NAME.fullmatch(shard)
    assert match is not None, shard
    return cast(SplitName, match[1])


def scan(release: Release) -> list[ReleasedRows]:
    """Find the flights of a release and where their rows stand, splits in their order; reads no picture."""
    flights: dict[Place, ReleasedRows] = {}
    shards = sorted(
        (shard.path for shard in release.record.shards), key=lambda path: (SPLIT_NAMES.index(split_of(path)), path)
    )
    wanted = schema(release.modalities)
    for shard in shards:
        path = inside(release.folder, shard)
        with open_table(path, tree=release.folder) as table:
            found = {member.name: member.type for member in table.schema_arrow}
            names = table.schema_arrow.names
            if differing := [m.name for m in wanted if found.get(m.name) != m.type or names.count(m.name) != 1]:
                raise InputError(
                    "the columns of the shard are not those of this version", where=path,
                    got=f"columns that are missing, repeated or of another type: {', '.join(differing)}",
                    fix="build the release again with this version of cosfly",
                )  # fmt: skip
            for k in range(table.num_row_groups):
                _scan_group(flights, shard, k, read_row_group(path, table, k, LIGHT), _unpacked_bytes(table, k))
    for flight in flights.values():
        _check(flight, release.folder)
    return list(flights.values())


def _unpacked_bytes(table: Any, k: int) -> int:
    return table.metadata.row_group(k).total_byte_size


def _scan_group(flights: dict[Place, ReleasedRows], shard: str, k: int, group: Any, num_bytes: int) -> None:
    """Note the flights of one row group, which may hold several."""
    with arrow_errors(shard):
        rows = {name: group.column(name).to_pylist() for name in LIGHT if name not in PLACE}
        spans = flight_spans(group)
    for place, start, stop in spans:
        if not all(
            isinstance(part, str) and (PART.fullmatch(part) or (part == "" and n == 0)) for n, part in enumerate(place)
        ):
            raise InputError(
                "the names of the track are not folder names",
                where=f"{shard}: {rows['sample_id'][start]}",
                got=shown(list(place), 200),
            )
        flight = flights.setdefault(place, ReleasedRows(*place, split_of(shard)))
        if flight.split != split_of(shard):
            raise InputError(
                "the track is in two splits", where=flight.name, got=f"{flight.split} and {split_of(shard)}"
            )
        times = rows["time_s"][start:stop]
        if None in times or None in rows["frame_index"][start:stop]:
            raise InputError("a frame has no index or no time", where=f"{shard}: {flight.name}")
        flight.spans.append(Span(shard, k, start, stop))
        flight.frames.append(np.array(rows["frame_index"][start:stop], dtype=np.int32))
        flight.times.append(np.array(times, dtype=np.float64))
        flight.decisions += [decision or "" for decision in rows["decision"][start:stop]]
        flight.goal = rows["goal_en"][start] or ""
        flight.num_bytes += num_bytes * (stop - start) // len(group)


def _check(flight: ReleasedRows, where: Path) -> None:
    frames, time_s = flight.frame_index, flight.time_s
    if not (np.diff(frames) > 0).all() or not (np.diff(time_s) > 0).all():
        raise InputError("the indices and times of the frames do not increase", where=f"{where}: {flight.name}")


def read_span(release: Release, span: Span, columns: list[str] | None = None) -> list[dict[str, Any]]:
    """Read the rows of a span, pictures included; in memory they are one row group."""
    path = inside(release.folder, span.shard)
    (group,) = row_groups(path, columns, tree=release.folder, wanted=[span.group])
    _check_values(group, f"{path}: row group {span.group}")
    with arrow_errors(path):
        return group.slice(span.start, span.stop - span.start).to_pylist()


def _check_values(group: pa.Table, where: str) -> None:
    """See that what every row must have is there, and that numbers are finite."""
    for member in group.schema:
        column = group.column(member.name)
        if member.name in REQUIRED and column.null_count:
            raise InputError("a required value is missing in a row", where=f"{where}: {member.name}", got="null")
        parts = column.combine_chunks().flatten() if pa.types.is_struct(member.type) else [column]
        for part in parts:
            if pa.types.is_floating(part.type) and pc.all(pc.is_finite(part)).as_py() is False:
                raise InputError("a number is not finite", where=f"{where}: {member.name}")


def rows_of_flight(
    release: Release, flight: ReleasedRows, columns: list[str] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a flight in order."""
    for span in flight.spans:
        yield from read_span(release, span, columns)


def picture(row: dict[str, Any], file: FrameFile) -> bytes:
    """Return the bytes of a picture of a row."""
    value = row[PICTURES[file].name]
    data = value if file == "depth" else value and value["bytes"]
    if not data or (file != "depth" and png_size(data) is None):
        raise InputError(
            "the frame has no picture",
            where=f"{row['sample_id']}: {PICTURES[file].name}",
            got="no data" if not data else "data that are not a PNG",
        )
    return data
