"""Read rows and pictures of flights from the shards of a release or from a playback tree, in worker processes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import pyarrow as pa

from cosfly.formats.frames import FILE_NAMES, FrameFile, frame_path
from cosfly.formats.places import Place, flight_ids
from cosfly.formats.playback import Track, read_track
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes
from cosfly.runtime.tables import open_table, read_row_group, row_batches
from release.columns import PICTURES, PLACE, POINT_NAMES, SCALAR_NAMES, SCALARS, Placement, flight_name, flight_spans
from release.flight_rows import FlightRows, Row
from release.record import Shard

BATCH_ROWS = 2  # whose pictures are in memory at once
Pictures = dict[FrameFile, bytes | memoryview | None]


@dataclass(frozen=True)
class Entry:
    """A flight of a source. parts, points: where its rows and points are, in the source's own terms."""

    name: str
    parts: tuple[Any, ...]
    num_rows: int
    points: tuple[Any, ...] = ()
    given_id: str | None = None

    @property
    def place(self) -> Place:
        return Place(*self.name.split("/"))


def with_ids(entries: list[Entry]) -> list[Entry]:
    """Return the entries with what their sample ids must begin with; None where two flights have one name."""
    try:
        ids = flight_ids([entry.place for entry in entries])
    except (InputError, TypeError):
        return entries
    return [replace(entry, given_id=ids[entry.place]) for entry in entries]


# --- shards -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shards:
    """Parquet files of a release folder. A part is (shard, row group, first row, row behind the last)."""

    folder: Path
    files: tuple[FrameFile, ...]

    def entries(self, shards: list[Shard]) -> list[Entry]:
        """Find which rows are of which flight, in the order in which they stand.

        Raises:
            InputError: a shard cannot be read.
        """
        parts = self._parts([shard.path for shard in shards])
        points = self._parts([shard.points.path for shard in shards])
        entries = [
            Entry(name, tuple(own), sum(end - begin for *_, begin, end in own), tuple(points.get(name, ())))
            for name, own in parts.items()
            if name.count("/") == len(PLACE) - 1
        ]
        return with_ids(entries)

    def _parts(self, names: list[str]) -> dict[str, list[tuple[str, int, int, int]]]:
        parts: dict[str, list[tuple[str, int, int, int]]] = defaultdict(list)
        for name in names:
            path = self.folder / name
            with open_table(path, tree=self.folder) as table:
                for group in range(table.num_row_groups):
                    places = read_row_group(path, table, group, list(PLACE))
                    for place, begin, end in flight_spans(places):
                        parts[flight_name(place)].append((name, group, begin, end))
        return parts

    def rows(self, entry: Entry) -> list[Row]:
        return self._rows(entry.parts, SCALAR_NAMES)

    def points(self, entry: Entry) -> list[Row]:
        return self._rows(entry.points, POINT_NAMES)

    def _rows(self, parts: tuple[Any, ...], names: Sequence[str]) -> list[Row]:
        found: list[Row] = []
        for path, table, group, begin, end in self._groups(parts):
            own = read_row_group(path, table, group, list(names))
            try:
                found += own.slice(begin, end - begin).to_pylist()
            except ValueError as error:
                raise InputError("a column is not valid text", where=path, got=str(error)) from None
        return found

    def pictures(self, entry: Entry) -> Iterator[Pictures]:
        names = {file: PICTURES[file].name for file in self.files}
        for path, table, group, begin, end in self._groups(entry.parts):
            row = 0
            for batch in row_batches(path, table, group, list(names.values()), BATCH_ROWS):
                yield from pictures_of(batch, names)[max(begin - row, 0) : max(end - row, 0)]
                row += len(batch)
                if row >= end:
                    break

    def _groups(self, parts: tuple[Any, ...]) -> Iterator[tuple[Path, Any, int, int, int]]:
        """Yield where a flight's rows are: file, the same opened once, row group, first row, row behind the last."""
        for shard, own in groupby(parts, key=itemgetter(0)):
            path = self.folder / shard
            with open_table(path, tree=self.folder) as table:
                for _, group, begin, end in own:
                    yield path, table, group, begin, end


def pictures_of(batch: pa.RecordBatch, names: dict[FrameFile, str]) -> list[Pictures]:
    """Return the pictures of a batch's rows. names: of their columns."""
    values = {file: batch.column(name).to_pylist() for file, name in names.items()}
    return [
        {file: cells[i]["bytes"] if isinstance(cells[i], dict) else cells[i] for file, cells in values.items()}
        for i in range(len(batch))
    ]


# --- a playback tree --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TreeFlights:
    """A playback tree, ours or the public one. A part is the flight's folder, relative to the tree."""

    folder: Path
    files: tuple[FrameFile, ...]

    @classmethod
    def found(cls, folder: Path) -> tuple[TreeFlights, list[Entry]]:
        """Find the flights of a tree; of the kinds of pictures, those that any frame of it has.

        Raises:
            InputError: it is none.
        """
        folders = find_tracks(folder)
        frames = [frame for flight in folders for frame in sorted(flight.glob("frames_playback/*"))[:1]]
        files = (file for file, name in FILE_NAMES.items() if any(frame_path(frame, name).exists() for frame in frames))
        tree = cls(folder, tuple(files))
        entries = []
        for path in folders:
            *above, town, trajectory, variant = ("", "", "", *path.relative_to(folder).parts)
            name = "/".join(("_".join(filter(None, above)), town, trajectory, variant))
            entries.append(Entry(name, (path.relative_to(folder).as_posix(),), 0))
        return tree, with_ids(entries)

    def rows(self, entry: Entry) -> list[Row]:
        flight = replace(self._flight(entry), run=entry.place.run)
        nobody = Placement(walk="", split="train")  # who made the split and told the walks is not said in a tree
        rows = [{column.name: column.cell(flight, i, None, nobody) for column in SCALARS} for i in range(len(flight))]
        for i, row in enumerate(rows):
            row |= {"walk": None, "split": None}
            if entry.given_id:
                row["sample_id"] = f"{entry.given_id}_frame_{i:05d}"
        return rows

    def points(self, entry: Entry) -> list[Row]:
        return self.rows(entry)

    def pictures(self, entry: Entry) -> Iterator[Pictures]:
        flight = self._flight(entry)
        for i in range(len(flight)):
            paths = {file: frame_path(flight.frame_folder(i), FILE_NAMES[file]) for file in self.files}
            yield {
                file: read_bytes(path, what="file of the frame", tree=self.folder) if path.is_file() else None
                for file, path in paths.items()
            }

    def _flight(self, entry: Entry) -> Track:
        return read_track(self.folder / entry.parts[0], strict=False)


FlightSource = Shards | TreeFlights


def flight_rows(source: FlightSource, entry: Entry) -> FlightRows:
    return FlightRows(entry.name, source.rows(entry), entry.given_id)


def point_rows(source: FlightSource, entry: Entry) -> FlightRows:
    return FlightRows(entry.name, source.points(entry), entry.given_id)
