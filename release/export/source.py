"""The source of an export: a release, read a row group at a time."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosfly.formats.frames import FrameFile
from cosfly.formats.places import Place
from cosfly.runtime.arrays import parse_array
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import inside
from cosfly.runtime.png import png_size
from cosfly.runtime.tables import open_table
from release.columns import PICTURES, PLACE, SPLIT_NAMES, SplitName, schema
from release.reading import check_columns, row_lists
from release.record import RECORD, ReleaseRecord, read_record, release_folder, shard_paths

PLANNED = [*PLACE, "frame_index", "time_s", "decision", "goal_en", "width_px", "height_px"]  # what plans need of a row
# What one part of a path may be that rows name: no separator, nothing hidden, no ".."
PART = re.compile(r"\w[\w.-]{0,200}", re.ASCII)
BYTES_PER_PIXEL = 6  # of the three pictures of a frame, a typical value

Row = dict[str, Any]


class Span(NamedTuple):
    """Rows [start, stop) of row group `group` of a shard, all of one track."""

    shard: Path
    group: int
    start: int
    stop: int


@dataclass
class SourceTrack:
    """One track. It holds what plans need of its frames, and where its rows are.

    decisions: Of the captions, "" for a frame without. goal: In English, "" without one.
    """

    place: Place
    split: SplitName
    spans: list[Span] = field(default_factory=list)
    frame_index: list[int] = field(default_factory=list)
    time_s: list[float] = field(default_factory=list)
    decisions: list[str] = field(default_factory=list)
    goal: str = ""
    size_px: tuple[int, int] = (0, 0)

    @property
    def name(self) -> str:
        return "/".join((self.place.run, self.place.town, self.place.trajectory, self.place.variant))

    @property
    def frame_bytes(self) -> int:
        """Approximate size of the pictures of a frame."""
        return self.size_px[0] * self.size_px[1] * BYTES_PER_PIXEL

    def __len__(self) -> int:
        return len(self.frame_index)

    def add(self, rows: Iterable[Row]) -> None:
        """Note the next frames, given their PLANNED columns."""
        for row in rows:
            size_px = (row["width_px"], row["height_px"])
            if self.frame_index and size_px != self.size_px:
                raise InputError("the pictures of the track differ in size", where=self.name)
            if self.frame_index and (row["frame_index"] <= self.frame_index[-1] or row["time_s"] <= self.time_s[-1]):
                raise InputError("the indices and times of the frames do not increase", where=self.name)
            self.frame_index.append(row["frame_index"])
            self.time_s.append(row["time_s"])
            self.decisions.append(row["decision"] or "")
            self.goal, self.size_px = row["goal_en"] or "", size_px

    def rows(self, columns: Sequence[str], start: int = 0, stop: int | None = None) -> Iterator[Row]:
        """Yield rows [start, stop) in order, with the columns, which may be pictures; one row group is in memory."""
        stop, first = len(self) if stop is None else stop, 0
        for span in self.spans:
            size = span.stop - span.start
            low, high = max(start - first, 0), min(stop - first, size)
            if low < high:
                part = span.group, span.start + low, span.start + high
                (rows,) = row_lists(span.shard, columns, part=part)
                yield from rows
            first += size

    def runs(self) -> list[tuple[int, int]]:
        """Return [start, stop) of the rows whose frames follow each other without a gap."""
        edges = [0, *(np.flatnonzero(np.diff(self.frame_index) != 1) + 1).tolist(), len(self)]
        return list(itertools.pairwise(edges))

    def picture(self, row: Mapping[str, Any], file: FrameFile) -> bytes:
        """Return the bytes of a picture of a row."""
        value, where = row[PICTURES[file].name], f"{row['sample_id']}: {PICTURES[file].name}"
        data = value if file == "depth" else value and value["bytes"]
        if not data:
            raise InputError("the frame has no picture", where=where, got="no data")
        if file == "depth":
            height, width = parse_array(data, where, dtype=np.float32, ndim=2, what="depth image", copy=False).shape
        elif (size := png_size(data)) is None:
            raise InputError("the frame has no picture", where=where, got="data that are not a PNG")
        else:
            width, height = size
        if (width, height) != self.size_px:
            got, expected = f"{width} x {height} px", "{} x {} px".format(*self.size_px)
            raise InputError("the picture has another size than its track", where=where, got=got, expected=expected)
        return data


@dataclass(frozen=True)
class ExportSource:
    """The release that is exported. modalities: The pictures that the export will hold."""

    folder: Path
    record: ReleaseRecord
    modalities: tuple[FrameFile, ...]
    tracks: list[SourceTrack]


def open_release(folder: Path, consecutive: str = "") -> ExportSource:
    """Open a release, or that of a run, and find the rows of its tracks, splits in their order; reads no picture.

    Args:
        consecutive: What needs consecutive frames, if something does.

    Raises:
        InputError: If the folder has no release, if the release is incomplete or lacks consecutive frames that are
            needed.
    """
    folder = release_folder(folder)
    record = read_record(folder / RECORD)
    if consecutive:
        record.require_whole_tracks(consecutive, folder)
    names = shard_paths([shard.split for shard in record.shards], record.content_digest)
    wrong = [
        shard.path for shard, (name, _) in zip(record.shards, names, strict=True)
        if shard.path != name or not (path := inside(folder, name)).is_file() or path.stat().st_size != shard.bytes
    ]  # fmt: skip
    if wrong:
        raise InputError(
            "the release is incomplete", where=folder, got=f"missing, or of another name or size: {'; '.join(wrong)}",
            expected="the shards in release.json", fix="run cosfly release verify for details",
        )  # fmt: skip
    tracks: dict[Place, SourceTrack] = {}
    for shard in sorted(record.shards, key=lambda shard: (SPLIT_NAMES.index(shard.split), shard.path)):
        path = folder / shard.path
        with open_table(path, tree=folder) as table:
            if table.metadata.num_rows != shard.rows:
                got, expected = f"{table.metadata.num_rows} rows", f"{shard.rows} rows, as in release.json"
                raise InputError("the shard has the wrong number of rows", where=path, got=got, expected=expected)
            check_columns(table.schema_arrow.empty_table(), schema(record.settings.modalities).names, path)
        for group, rows in enumerate(row_lists(path, PLANNED)):
            stop = 0
            for parts, of_track in itertools.groupby(rows, itemgetter(*PLACE)):
                if not all(map(PART.fullmatch, parts)):
                    got = shown(list(parts), 200)
                    raise InputError("the names of the track are not folder names", where=path, got=got)
                own, start = list(of_track), stop
                stop = start + len(own)
                track = tracks.setdefault(Place(*parts), SourceTrack(Place(*parts), shard.split))
                if track.split != shard.split:
                    got = f"{track.split} and {shard.split}"
                    raise InputError("the track is in two splits", where=track.name, got=got)
                track.spans.append(Span(path, group, start, stop))
                track.add(own)
    return ExportSource(folder, record, tuple(record.settings.modalities), list(tracks.values()))
