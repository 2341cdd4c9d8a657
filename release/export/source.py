"""The source of an export: a release, a run directory or a playback tree, all read as the rows of a release.

A release is read a row group at a time. Frames of a run become rows through `release/columns.py`, as `release build`
makes them; they are of no split but train, and each carries its accepted caption.
"""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

import cosfly
from cosfly.formats.boxes import UNKNOWN_LICENCE
from cosfly.formats.captions import Caption, caption_lines
from cosfly.formats.frames import FILE_NAMES, FrameFile, as_depth_npy, frame_path, tree_of
from cosfly.formats.inspection import read_settled
from cosfly.formats.places import Place, flight_ids, folder_name, place_of, sample_id, town_folder
from cosfly.formats.playback import Track, read_track
from cosfly.formats.town import read_town_map
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import inside, open_file, read_bytes, sha256_file
from cosfly.runtime.png import png_size
from cosfly.runtime.run_dir import fingerprint
from cosfly.runtime.tables import arrow_errors, open_table, read_row_group, row_groups
from release.columns import (
    CONTRACT,
    PICTURES,
    PLACE,
    REQUIRED,
    SCALARS,
    SPLIT_NAMES,
    Column,
    Placement,
    SplitName,
    caption_values,
    flight_spans,
    schema,
)
from release.record import ReleasedMap, ReleaseRecord, read_record, release_folder

# Names of columns below come from `release/columns.py`; those of shards from `release build`.
SHARD_NAME = re.compile(r"data/(train|validation|test)-[0-9a-f]{12}-\d{5}-of-\d{5}\.parquet")
LIGHT = [*PLACE, "frame_index", "time_s", "sample_id", "decision", "goal_en", "width_px", "height_px"]
# What one part of a path may be that rows name: no separator, nothing hidden, no ".."
PART = re.compile(r"\w[\w.-]{0,200}", re.ASCII)
COLUMNS: dict[str, Column] = {column.name: column for column in SCALARS}
BYTES_PER_PIXEL = 6  # of the three pictures of a frame, a typical value
FILE_OF: dict[str, FrameFile] = {column.name: file for file, column in PICTURES.items()}

Row = dict[str, Any]


@dataclass
class SourceTrack:
    """One track, n frames.

    frame_index (n,) int32 and time_s (n,) float64 increase. decisions: Of the captions, "" for a frame without.
    goal: In English, "" without one. num_bytes: Of its rows, unpacked. read: Yields the rows [start, stop) with the
    given columns; pictures are among the columns.
    """

    place: Place
    split: SplitName = "train"
    frame_index: np.ndarray = field(default_factory=lambda: np.empty(0, np.int32))
    time_s: np.ndarray = field(default_factory=lambda: np.empty(0))
    decisions: list[str] = field(default_factory=list)
    goal: str = ""
    size_px: tuple[int, int] = (0, 0)
    num_bytes: int = 0
    read: Callable[[Sequence[str], int, int], Iterator[Row]] = field(default=lambda columns, start, stop: iter(()))

    @property
    def name(self) -> str:
        return "/".join((self.place.run, self.place.town, self.place.trajectory, self.place.variant))

    def __len__(self) -> int:
        return len(self.frame_index)

    def rows(self, columns: Sequence[str], start: int = 0, stop: int | None = None) -> Iterator[Row]:
        """Yield rows [start, stop) in order, with the columns; one row group is in memory."""
        return self.read(columns, start, len(self) if stop is None else stop)

    def runs(self) -> list[tuple[int, int]]:
        """Return [start, stop) of the rows whose frames follow each other without a gap."""
        edges = [0, *(np.flatnonzero(np.diff(self.frame_index) != 1) + 1).tolist(), len(self)]
        return list(itertools.pairwise(edges))


@dataclass(frozen=True)
class ExportSource:
    """What is exported. digest: Of its content. inputs: The files that a stage records as its inputs."""

    folder: Path
    name: str
    made_by: str
    digest: str
    inputs: dict[str, Path]
    licence: str
    credits: str
    maps: list[ReleasedMap]
    coordinates: dict[str, Any]
    prompts: dict[str, dict[str, str]]
    modalities: tuple[FrameFile, ...]
    tracks: list[SourceTrack]


def open_source(folder: Path, *, consecutive: str = "") -> ExportSource:
    """Open a release, the folder around it, a run directory or a playback tree.

    consecutive: What needs consecutive frames, if something does: of a run directory it gets the playback tree, which
    has all frames, instead of the release.

    Raises:
        InputError: If the folder is none of them, if the release is incomplete (lists all that is wrong), or if it
            lacks consecutive frames that are needed.
    """
    dataset = release_folder(folder)
    if (dataset / "release.json").is_file() and not (consecutive and (folder / "render").is_dir()):
        if consecutive:
            read_record(dataset / "release.json").require_whole_tracks(consecutive, dataset)
        return open_release(dataset)
    trees = find_trees(folder)
    if not any(tree.data.is_dir() and any(tree.data.glob("*/*/*/trajectory.json")) for tree in trees):
        raise InputError(
            "the folder has nothing to export", where=folder, expected="a release, a run directory or a playback tree",
            fix="correct the path, or build a release with cosfly release build",
        )  # fmt: skip
    return open_trees(folder, trees)


# --- a release --------------------------------------------------------------------------------------------------------


class Span(NamedTuple):
    """Rows [start, stop) of row group `group` of a shard, all of one track."""

    shard: str
    group: int
    start: int
    stop: int


def open_release(folder: Path) -> ExportSource:
    """Open the folder of a release and find the rows of its tracks, splits in their order; reads no picture."""
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
    sha256_file(folder / "release.json", tree=folder)  # refuses a link
    return ExportSource(
        folder, record.name, record.made_by, record.content_digest, {"release": folder / "release.json"},
        record.licence, record.credits, record.maps, record.coordinates, record.prompts,
        tuple(record.settings.modalities), _released_tracks(folder, record),
    )  # fmt: skip


def _released_tracks(folder: Path, record: ReleaseRecord) -> list[SourceTrack]:
    tracks: dict[Place, SourceTrack] = {}
    spans: dict[Place, list[Span]] = defaultdict(list)
    wanted = schema(record.settings.modalities)
    for shard in sorted(
        (one.path for one in record.shards), key=lambda path: (SPLIT_NAMES.index(split_of(path)), path)
    ):
        path = inside(folder, shard)
        with open_table(path, tree=folder) as table:
            found = {member.name: member.type for member in table.schema_arrow}
            names = table.schema_arrow.names
            if differing := [m.name for m in wanted if found.get(m.name) != m.type or names.count(m.name) != 1]:
                raise InputError(
                    "the columns of the shard are not those of this version", where=path,
                    got=f"columns that are missing, repeated or of another type: {', '.join(differing)}",
                    fix="build the release again with this version of cosfly",
                )  # fmt: skip
            for k in range(table.num_row_groups):
                size = table.metadata.row_group(k).total_byte_size
                _scan_group(tracks, spans, shard, k, read_row_group(path, table, k, LIGHT), size)
    for place, track in tracks.items():
        if not (np.diff(track.frame_index) > 0).all() or not (np.diff(track.time_s) > 0).all():
            raise InputError("the indices and times of the frames do not increase", where=f"{folder}: {track.name}")
        track.read = partial(_released_rows, folder, spans[place])
    return list(tracks.values())


def split_of(shard: str) -> SplitName:
    """Return the split that a shard's name says: train, validation or test."""
    match = SHARD_NAME.fullmatch(shard)
    assert match is not None, shard
    return cast(SplitName, match[1])


def _scan_group(
    tracks: dict[Place, SourceTrack], spans: dict[Place, list[Span]], shard: str, k: int, group: pa.Table, size: int
) -> None:
    """Note the tracks of one row group, which may hold several."""
    with arrow_errors(shard):
        rows = {name: group.column(name).to_pylist() for name in LIGHT if name not in PLACE}
        found = flight_spans(group)
    for parts, start, stop in found:
        if not all(
            isinstance(one, str) and (PART.fullmatch(one) or (one == "" and n == 0)) for n, one in enumerate(parts)
        ):
            where = f"{shard}: {rows['sample_id'][start]}"
            raise InputError("the names of the track are not folder names", where=where, got=shown(list(parts), 200))
        place = Place(*parts)
        track = tracks.setdefault(place, SourceTrack(place, split_of(shard)))
        if track.split != split_of(shard):
            raise InputError("the track is in two splits", where=track.name, got=f"{track.split} and {split_of(shard)}")
        frames, times = rows["frame_index"][start:stop], rows["time_s"][start:stop]
        if None in times or None in frames:
            raise InputError("a frame has no index or no time", where=f"{shard}: {track.name}")
        spans[place].append(Span(shard, k, start, stop))
        track.frame_index = np.append(track.frame_index, np.array(frames, np.int32))
        track.time_s = np.append(track.time_s, times)
        track.decisions += [decision or "" for decision in rows["decision"][start:stop]]
        track.goal = rows["goal_en"][start] or ""
        track.size_px = rows["width_px"][start] or 0, rows["height_px"][start] or 0
        track.num_bytes += size * (stop - start) // len(group)


def _released_rows(folder: Path, spans: list[Span], columns: Sequence[str], start: int, stop: int) -> Iterator[Row]:
    at = 0
    for span in spans:
        begin, end = max(at, start), min(at + span.stop - span.start, stop)
        if begin < end:
            path = inside(folder, span.shard)
            (group,) = row_groups(path, list(columns), tree=folder, wanted=[span.group])
            _check_values(group, f"{path}: row group {span.group}")
            with arrow_errors(path):
                rows = group.slice(span.start + begin - at, end - begin).to_pylist()
            yield from rows
        at += span.stop - span.start


def _check_values(group: pa.Table, where: str) -> None:
    """Check that required values are there, and that numbers are finite."""
    for member in group.schema:
        column = group.column(member.name)
        if member.name in REQUIRED and column.null_count:
            raise InputError("a required value is missing in a row", where=f"{where}: {member.name}", got="null")
        parts = column.combine_chunks().flatten() if pa.types.is_struct(member.type) else [column]
        for part in parts:
            if pa.types.is_floating(part.type) and pc.all(pc.is_finite(part)).as_py() is False:
                raise InputError("a number is not finite", where=f"{where}: {member.name}")


def picture(row: Row, file: FrameFile) -> bytes:
    """Return the bytes of a picture of a row."""
    value = row[PICTURES[file].name]
    data = value if file == "depth" else value and value["bytes"]
    if not data or (file != "depth" and png_size(data) is None):
        where = f"{row['sample_id']}: {PICTURES[file].name}"
        raise InputError("the frame has no picture", where=where, got="data that are not a PNG" if data else "no data")
    return data


# --- a run or a playback tree -----------------------------------------------------------------------------------------


class Tree(NamedTuple):
    """A playback tree and what was made of it; None for what does not exist. run: Its name among several."""

    run: str
    data: Path
    captions: Path | None = None
    inspect: Path | None = None
    boxes: Path | None = None

    def place(self, one: Any) -> tuple[str, str, str, str]:
        """Return the place of a track (PLACE) from anything that names its town, trajectory and variant."""
        return self.run, town_folder(one.town), one.trajectory, one.variant


def find_trees(folder: Path, captions: Path | None = None) -> list[Tree]:
    """Return what a folder is: a run, a run of several towns, or a playback tree."""
    towns = sorted(path.parent for path in folder.glob("*/render") if path.is_dir())
    runs = [folder] if (folder / "render").is_dir() else towns
    trees = []
    for place in runs:
        names = ("caption/captions.jsonl", "inspect/inspect.json", "simplify/step2_simplified.json")
        own_captions, *others = (place / name if (place / name).exists() else None for name in names)
        trees.append(Tree(folder_name(place.absolute().name), place / "render", captions or own_captions, *others))
    return trees or [Tree("", folder, captions)]


def open_trees(folder: Path, trees: list[Tree]) -> ExportSource:
    """Open playback trees: the tracks that their inspection accepted, or all of a tree without one."""
    found: dict[Place, Path] = {}
    captions: dict[Place, dict[int, tuple[Path, int]]] = defaultdict(dict)
    inputs: dict[str, Path] = {}
    for number, tree in enumerate(trees):
        roles = {"data": tree.data, "captions": tree.captions, "inspect": tree.inspect}
        inputs |= {f"{number}.{role}": path for role, path in roles.items() if path is not None}
        paths = {Place(*tree.place(place_of(path))): path for path in find_tracks(tree.data)}
        if tree.inspect is not None:
            results = {Place(*tree.place(one)): one.result for one in read_settled(tree.inspect).flights}
            paths = {place: path for place, path in paths.items() if results.get(place) == "accepted"}
        found |= paths
        begin = 0
        for line, caption in caption_lines(tree.captions) if tree.captions else ():
            if tree.captions and caption.status == "accepted":
                captions[Place(*tree.place(caption))][caption.frame_index] = tree.captions, begin
            begin += len(line.encode())
    if not found:
        raise InputError("the inspection accepted no track", where=folder, fix="see inspect/report.html")
    ids = flight_ids(list(found))
    maps = {path.parents[1]: read_town_map(path.parents[1]) for path in found.values()}
    licences, credits = {one.licence for one in maps.values()}, {one.credits: None for one in maps.values()}
    first = read_track(next(iter(found.values())), strict=False).frame_folder(0)
    return ExportSource(
        folder, folder.absolute().name, f"cosfly {cosfly.__version__}", fingerprint(trees[0].data), inputs,
        licences.pop() if len(licences) == 1 else UNKNOWN_LICENCE, " ".join(credits).strip(),
        [ReleasedMap(town=town.name, **one.model_dump()) for town, one in maps.items()], CONTRACT, {},
        tuple(file for file, name in FILE_NAMES.items() if frame_path(first, name).is_file()),
        [_tree_track(place, path, ids[place], captions[place]) for place, path in found.items()],
    )  # fmt: skip


Captions = dict[int, tuple[Path, int]]  # frame -> its captions.jsonl, and the byte at which its line begins


def _tree_track(place: Place, path: Path, track_id: str, captions: Captions) -> SourceTrack:
    track = read_track(path, strict=False)
    decisions = [
        str(row["decision"] or "") for row in _tree_rows(place, path, track_id, captions, ["decision"], 0, len(track))
    ]
    size = (track.camera.width_px, track.camera.height_px)
    return SourceTrack(
        place, "train", np.arange(len(track), dtype=np.int32), track.time_s, decisions,
        track.goal.en if track.goal else "", size, len(track) * size[0] * size[1] * BYTES_PER_PIXEL,
        partial(_tree_rows, place, path, track_id, captions),
    )  # fmt: skip


def _tree_rows(
    place: Place, path: Path, track_id: str, captions: Captions, columns: Sequence[str], start: int, stop: int
) -> Iterator[Row]:
    track = replace(read_track(path, strict=False), run=place.run, town=place.town, given_id=track_id)
    placement = Placement(walk="/".join((place.run, place.town, place.trajectory)), split="train")
    for i in range(start, stop):
        caption = _caption_at(*captions[i]) if i in captions else None
        values = None if caption is None else caption_values(caption)
        row = {name: COLUMNS[name].cell(track, i, values, placement) for name in columns if name in COLUMNS}
        yield row | {name: _tree_picture(track, i, FILE_OF[name]) for name in columns if name in FILE_OF}


def _caption_at(path: Path, begin: int) -> Caption:
    with open_file(path) as file:
        file.seek(begin)
        return Caption.model_validate_json(file.readline())


def _tree_picture(track: Track, i: int, file: FrameFile) -> Any:
    path = frame_path(track.frame_folder(i), FILE_NAMES[file])
    data = read_bytes(path, what="picture", tree=tree_of(track.frame_folder(i)))
    if file == "depth":
        return as_depth_npy(data, path)
    return {"bytes": data, "path": f"{sample_id(track.flight_id, i)}_{FILE_NAMES[file]}"}
