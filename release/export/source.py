"""The source of an export: a release, a run directory or a playback tree, all read as the rows of a release.

A release is read a row group at a time. Frames of a run become rows through `release/columns.py`, as `release build`
makes them; they are of no split but train, and each carries its accepted caption.
"""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

import cosfly
from cosfly.formats.boxes import UNKNOWN_LICENCE
from cosfly.formats.captions import Caption, caption_lines
from cosfly.formats.frames import FILE_NAMES, FrameFile, as_depth_npy, frame_path, tree_of
from cosfly.formats.inspection import read_settled
from cosfly.formats.places import Place, flight_ids, folder_name, place_of, sample_id, town_folder
from cosfly.formats.playback import read_track
from cosfly.formats.town import read_town_map
from cosfly.formats.tracks import find_tracks
from cosfly.runtime.arrays import parse_array
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import inside, open_file, read_bytes, sha256_bytes, sha256_file
from cosfly.runtime.png import png_size
from cosfly.runtime.run_dir import fingerprint
from cosfly.runtime.tables import open_table
from release.columns import (
    CONTRACT,
    PICTURES,
    PLACE,
    SCALARS,
    SPLIT_NAMES,
    Column,
    Placement,
    SplitName,
    caption_values,
    schema,
)
from release.reading import check_columns, check_rows, row_lists
from release.record import ReleasedMap, Strict, read_record, release_folder

PLANNED = [*PLACE, "frame_index", "time_s", "decision", "goal_en", "width_px", "height_px"]  # what plans need of a row
# What one part of a path may be that rows name: no separator, nothing hidden, no ".."
PART = re.compile(r"\w[\w.-]{0,200}", re.ASCII)
COLUMNS: dict[str, Column] = {column.name: column for column in SCALARS}
FILE_OF: dict[str, FrameFile] = {column.name: file for file, column in PICTURES.items()}
BYTES_PER_PIXEL = 6  # of the three pictures of a frame, a typical value

Row = dict[str, Any]
Reader = Callable[[Sequence[str], Sequence[int]], Iterator[Row]]


@dataclass
class SourceTrack:
    """One track. It holds what plans need of its frames; `read` yields rows with the given columns, by number.

    decisions: Of the captions, "" for a frame without. goal: In English, "" without one.
    """

    place: Place
    split: SplitName
    read: Reader
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
        return self.read(columns, range(start, len(self) if stop is None else stop))

    def pick(self, columns: Sequence[str], numbers: Sequence[int]) -> Iterator[Row]:
        """Yield the rows with these numbers, which increase."""
        return self.read(columns, numbers)

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


class SourceFacts(Strict):
    """What `export.json` says of the source. digest: Of its content. prompts: As in `release.json`."""

    source: str
    source_made_by: str
    digest: str
    licence: str
    credits: str
    maps: list[ReleasedMap]
    coordinates: dict[str, Any]
    prompts: dict[str, dict[str, str]] = Field(default_factory=dict)


@dataclass(frozen=True)
class ExportSource:
    """What is exported. inputs: The files that a stage records as its inputs."""

    folder: Path
    facts: SourceFacts
    inputs: dict[str, Path]
    modalities: tuple[FrameFile, ...]
    tracks: list[SourceTrack]


def open_source(folder: Path, *, prefer_tree: bool = False, consecutive: str = "") -> ExportSource:
    """Open a release, the folder around it, a run directory or a playback tree.

    Args:
        prefer_tree: Open the playback tree of a run directory, which has all frames, instead of its release.
        consecutive: What needs consecutive frames, if something does.

    Raises:
        InputError: If the folder is none of them, if the release is incomplete (lists all that is wrong), or if it
            lacks consecutive frames that are needed.
    """
    dataset, is_run = release_folder(folder), any(any(folder.glob(name)) for name in ("render", "*/render"))
    if (dataset / "release.json").is_file() and not (prefer_tree and is_run):
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

    shard: Path
    group: int
    start: int
    stop: int


def open_release(folder: Path) -> ExportSource:
    """Open the folder of a release and find the rows of its tracks, splits in their order; reads no picture."""
    record = read_record(folder / "release.json")
    shards = sorted(record.shards, key=lambda shard: (SPLIT_NAMES.index(shard.split), shard.path))
    wrong = []
    for shard in shards:
        if not re.fullmatch(rf"data/{shard.split}-[0-9a-f]{{12}}-\d{{5}}-of-\d{{5}}\.parquet", shard.path):
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
    tracks: dict[Place, SourceTrack] = {}
    spans: dict[Place, list[Span]] = defaultdict(list)
    for shard in shards:
        path = inside(folder, shard.path)
        check_rows(path, shard.rows)
        with open_table(path, tree=folder) as table:
            check_columns(table.schema_arrow.empty_table(), schema(record.settings.modalities).names, path)
        for group, rows in enumerate(row_lists(path, PLANNED)):
            stop = 0
            for parts, of_track in itertools.groupby(rows, itemgetter(*PLACE)):
                place, own, start = _place_of_row(parts, path), list(of_track), stop
                stop = start + len(own)
                spans[place].append(Span(path, group, start, stop))
                if place not in tracks:
                    tracks[place] = SourceTrack(place, shard.split, partial(_released_rows, spans[place]))
                track = tracks[place]
                if track.split != shard.split:
                    got = f"{track.split} and {shard.split}"
                    raise InputError("the track is in two splits", where=track.name, got=got)
                track.add(own)
    facts = SourceFacts(
        source=record.name, source_made_by=record.made_by, digest=record.content_digest, licence=record.licence,
        credits=record.credits, maps=record.maps, coordinates=record.coordinates, prompts=record.prompts,
    )  # fmt: skip
    inputs = {"release": folder / "release.json"}
    return ExportSource(folder, facts, inputs, tuple(record.settings.modalities), list(tracks.values()))


def _place_of_row(parts: tuple[Any, ...], shard: Path) -> Place:
    """Check that the names of a track are folder names; only that of the run may be empty."""
    if not all(PART.fullmatch(part) or (number == 0 and part == "") for number, part in enumerate(parts)):
        raise InputError("the names of the track are not folder names", where=shard, got=shown(list(parts), 200))
    return Place(*parts)


def _released_rows(spans: list[Span], columns: Sequence[str], numbers: Sequence[int]) -> Iterator[Row]:
    first = 0
    for span in spans:
        size = span.stop - span.start
        wanted = [number - first for number in numbers if first <= number < first + size]
        if wanted:
            part = span.group, span.start + wanted[0], span.start + wanted[-1] + 1
            (rows,) = row_lists(span.shard, columns, part=part)
            yield from (rows[number - wanted[0]] for number in wanted)
        first += size


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
    found: dict[Place, tuple[Path, dict[int, Line]]] = {}
    inputs: dict[str, Path] = {}
    for number, tree in enumerate(trees):
        roles = {"data": tree.data, "captions": tree.captions, "inspect": tree.inspect}
        inputs |= {f"{number}.{role}": path for role, path in roles.items() if path is not None}
        paths = {Place(*tree.place(place_of(path))): path for path in find_tracks(tree.data)}
        captions = _accepted_captions(tree, paths)
        if tree.inspect is not None:
            results = {Place(*tree.place(one)): one.result for one in read_settled(tree.inspect).flights}
            paths = {place: path for place, path in paths.items() if results.get(place) == "accepted"}
        found |= {place: (path, captions[place]) for place, path in paths.items()}
    if not found:
        raise InputError("the inspection accepted no track", where=folder, fix="see inspect/report.html")
    ids = flight_ids(list(found))
    maps = {path.parents[1]: read_town_map(path.parents[1]) for path, _ in found.values()}
    licences, credits = {one.licence for one in maps.values()}, {one.credits: None for one in maps.values()}
    first = read_track(next(iter(found.values()))[0], strict=False).frame_folder(0)
    tracks = []
    for place, (path, lines) in found.items():
        track = SourceTrack(place, "train", partial(_tree_rows, place, path, ids[place], lines))
        track.add(track.rows(PLANNED, 0, len(read_track(path, strict=False))))
        tracks.append(track)
    facts = SourceFacts(
        source=folder.absolute().name, source_made_by=f"cosfly {cosfly.__version__}", digest=_digest_of(trees),
        licence=licences.pop() if len(licences) == 1 else UNKNOWN_LICENCE, credits=" ".join(credits).strip(),
        maps=[ReleasedMap(town=town.name, **one.model_dump()) for town, one in maps.items()], coordinates=CONTRACT,
    )  # fmt: skip
    modalities = tuple(file for file, name in FILE_NAMES.items() if frame_path(first, name).is_file())
    return ExportSource(folder, facts, inputs, modalities, tracks)


def _digest_of(trees: list[Tree]) -> str:
    digests = [fingerprint(tree.data) for tree in trees]
    return digests[0] if len(digests) == 1 else sha256_bytes("\n".join(digests).encode())


Line = tuple[Path, int]  # the file of a caption, and the byte at which its line begins


def captions_of(tree: Tree) -> Iterator[tuple[tuple[str, str, str, str], Caption, Line]]:
    """Yield the captions of a tree, each with the place of its track (PLACE) and its line."""
    begin = 0
    for line, caption in caption_lines(tree.captions) if tree.captions else ():
        assert tree.captions is not None
        yield tree.place(caption), caption, (tree.captions, begin)
        begin += len(line.encode())


def read_caption(line: Line) -> Caption:
    """Read a caption again."""
    path, begin = line
    with open_file(path) as file:
        file.seek(begin)
        return Caption.model_validate_json(file.readline())


def _accepted_captions(tree: Tree, tracks: Iterable[Place]) -> dict[Place, dict[int, Line]]:
    """Return the lines of the accepted captions of each track of a tree, by frame."""
    found: dict[Place, dict[int, Line]] = {place: {} for place in tracks}
    for names, caption, line in captions_of(tree):
        if (place := Place(*names)) not in found:
            raise InputError(
                "the captions are of another playback tree", where=tree.captions, got=caption.sample_id,
                expected=f"captions of tracks in {tree.data}", fix="run cosfly caption on this tree",
            )  # fmt: skip
        if caption.status == "accepted":
            found[place][caption.frame_index] = line
    return found


def _tree_rows(
    place: Place, path: Path, track_id: str, lines: dict[int, Line], columns: Sequence[str], numbers: Sequence[int]
) -> Iterator[Row]:
    track = replace(read_track(path, strict=False), run=place.run, town=place.town, given_id=track_id)
    placement = Placement(walk="/".join((place.run, place.town, place.trajectory)), split="train")
    for i in numbers:
        values = caption_values(read_caption(lines[i])) if i in lines else None
        row = {name: COLUMNS[name].cell(track, i, values, placement) for name in columns if name in COLUMNS}
        for file in (FILE_OF[name] for name in columns if name in FILE_OF):
            picture = frame_path(track.frame_folder(i), FILE_NAMES[file])
            data = read_bytes(picture, what="picture", tree=tree_of(track.frame_folder(i)))
            name = f"{sample_id(track.flight_id, i)}_{FILE_NAMES[file]}"
            row[PICTURES[file].name] = as_depth_npy(data, picture) if file == "depth" else {"bytes": data, "path": name}
        yield row
