"""`cosfly release export`: a release in another format.

Reads a release, a row group at a time; writes `<format>/` with the format's files, README.md (what it was made of, how
things are stored) and checksums.sha256, whole or not at all. A format is a module with a
function, and a line in EXPORTS:

    write(source, folder, cfg, advance) -> FormatFacts      advance(n): n frames are written
"""

from __future__ import annotations

import importlib
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import yaml
from pydantic import Field

import cosfly
from cosfly.formats.frames import FILE_NAMES, FrameFile
from cosfly.formats.places import Place
from cosfly.runtime.arrays import parse_array
from cosfly.runtime.config import Config
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.io import CHECKSUMS, atomic_folder, inside, sha256_file, write_bytes, write_checksums
from cosfly.runtime.png import png_size
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.runtime.tables import open_table
from cosfly.viz.page import markdown
from release.columns import LANGUAGES, PICTURES, PLACE, SPLIT_NAMES, SplitName, schema
from release.reading import Row, check_columns, row_lists
from release.record import RECORD, ReleaseRecord, read_record, release_folder, shard_paths
from release.rules import group_by_size

FormatName = Literal["tree", "lerobot", "webdataset", "coco", "chat", "sharegpt"]
README = "README.md"
MB = 1024 * 1024
PLANNED = [*PLACE, "frame_index", "time_s", "decision", "goal_en", "width_px", "height_px"]  # what plans need of a row
# What one part of a path may be that rows name: no separator, nothing hidden, no ".."
PART = re.compile(r"\w[\w.-]{0,200}", re.ASCII)
BYTES_PER_PIXEL = 6  # of the three pictures of a frame, a typical value


class Export(NamedTuple):
    """One format. module: Its writer. pictures: It cannot do without these. carries: It can hold these; `default` of
    them are written unless the settings choose others."""

    module: str
    pictures: tuple[FrameFile, ...] = ()
    carries: tuple[FrameFile, ...] = tuple(FILE_NAMES)
    default: tuple[FrameFile, ...] = tuple(FILE_NAMES)
    needs_consecutive: bool = False  # chat: but for samples of the last frame alone


EXPORTS: dict[FormatName, Export] = {
    "tree": Export("release.export.tree", pictures=("rgb",)),
    "lerobot": Export("release.export.lerobot", default=("rgb",), needs_consecutive=True),
    "webdataset": Export("release.export.webdataset"),
    "coco": Export("release.export.coco", ("rgb", "instance"), ("rgb",), ("rgb",)),
    "chat": Export("release.export.chat", ("rgb",), ("rgb",), ("rgb",), needs_consecutive=True),
    "sharegpt": Export("release.export.chat", ("rgb",), ("rgb",), ("rgb",), needs_consecutive=True),
}


class ExportConfig(Config):
    """What is written."""

    format: FormatName = Field(description=f"one of {', '.join(EXPORTS)}")
    modalities: tuple[FrameFile, ...] = Field((), description="pictures: rgb, depth, instance; empty: the usual ones")
    shard_mb: int = Field(500, ge=1, description="approximate size of a file of many frames, MB")
    video: bool = Field(False, description="LeRobot: store colour and instance pictures as mp4, with loss")
    languages: tuple[Literal["en", "zh"], ...] = Field(
        LANGUAGES, min_length=1, description="chat: languages of samples"
    )
    frames: Literal["all", "last"] = Field("all", description="chat: pictures of the whole window or its last frame")


# --- the source -------------------------------------------------------------------------------------------------------


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


class Piece(NamedTuple):
    """Rows [start, stop) of a track."""

    track: SourceTrack
    start: int
    stop: int

    @property
    def frames(self) -> int:
        return self.stop - self.start


@dataclass(frozen=True)
class FormatFacts:
    """What a format states about itself.

    codings: How each thing is stored. notes: Conventions, and what the format cannot carry. how_to_open: Lines of
    Python. coordinates: If the format has other axes than the release. split_files: Split -> pattern of its files,
    where `datasets` opens the folder.
    """

    format_version: str
    codings: dict[str, str]
    notes: list[str]
    how_to_open: str
    coordinates: dict[str, str] = field(default_factory=dict)
    split_files: dict[str, str] = field(default_factory=dict)


def shards(pieces: Sequence[Piece], shard_mb: int) -> Iterator[tuple[SplitName, str, list[Piece]]]:
    """Yield groups of pieces of each split of about `shard_mb`, each with its split and name, `train-00000`."""
    for split in SPLIT_NAMES:
        own = [piece for piece in pieces if piece.track.split == split]
        sizes = [piece.frames * piece.track.frame_bytes for piece in own]
        for number, group in enumerate(group_by_size(sizes, shard_mb * MB)):
            yield split, f"{split}-{number:05d}", [own[k] for k in group]


# --- the stage --------------------------------------------------------------------------------------------------------


def check_needs(source: ExportSource, cfg: ExportConfig) -> ExportSource:
    """Return the source with the pictures that the format will hold; raise InputError if it lacks what the format
    needs."""
    export = EXPORTS[cfg.format]
    chosen = cfg.modalities or tuple(file for file in export.default if file in source.modalities)
    for needed in (*export.pictures, *chosen):
        if needed not in source.modalities:
            got = f"pictures: {', '.join(source.modalities)}"
            raise InputError(f"the {cfg.format} export needs {needed} pictures", where=source.folder, got=got)
    if unused := set(chosen) - set(export.carries):
        what = f"the {cfg.format} export holds no {' and no '.join(sorted(unused))} pictures"
        raise InputError(what, where="--modalities", expected=", ".join(export.carries))
    return replace(source, modalities=chosen)


def _write_readme(source: ExportSource, facts: FormatFacts, folder: Path, cfg: ExportConfig) -> None:
    """Write README.md: front matter as the hub reads it, what was exported, and what the format states about itself."""
    tags = ["cosfly", "LeRobot" if cfg.format == "lerobot" else cfg.format]  # the hub knows LeRobot by this tag
    front: dict[str, Any] = {"license": source.record.licence, "pretty_name": source.record.name, "tags": tags}
    if facts.split_files:
        files = [{"split": split, "path": path} for split, path in facts.split_files.items()]
        front["configs"] = [{"config_name": "default", "data_files": files}]
    text = markdown(
        "release/export/readme.md", front_matter=yaml.safe_dump(front, sort_keys=True, allow_unicode=True).rstrip(),
        release=source.record, facts=facts, format=cfg.format, num_frames=sum(map(len, source.tracks)),
        made_by=f"cosfly {cosfly.__version__}", coordinates=facts.coordinates or source.record.coordinates,
    )  # fmt: skip
    write_bytes(folder / README, (text.rstrip() + "\n").encode())


def _write_checksums(folder: Path) -> None:
    """Write the checksums of all files but those that have a list of their own, such as the tracks of a tree."""
    paths = [path for path in folder.rglob("*") if path.is_file()]
    with_list = {path.parent for path in paths if path.name == CHECKSUMS}
    listed = [path for path in paths if path.name == CHECKSUMS or with_list.isdisjoint(path.parents)]
    with ThreadPoolExecutor() as pool:
        digests = zip(listed, pool.map(sha256_file, listed), strict=True)
        write_checksums(folder, {path.relative_to(folder).as_posix(): digest for path, digest in digests})


def run(cfg: ExportConfig, folder: Path, out: Path, *, resume: Resume = "if-same") -> Path:
    """Read a release, also of a run; write it in the format of the settings and return its folder."""
    is_of_windows = EXPORTS[cfg.format].needs_consecutive and (cfg.frames == "all" or cfg.format == "lerobot")
    source = check_needs(open_release(folder, f"the {cfg.format} export" if is_of_windows else ""), cfg)
    stage = StageFolder.open(
        out, "export", config=cfg, inputs={"release": source.folder / RECORD}, seed=0, resume=resume
    )
    product, num_frames = out / cfg.format, sum(map(len, source.tracks))
    if stage.is_complete:
        return product
    format = importlib.import_module(EXPORTS[cfg.format].module)
    with atomic_folder(product) as parts, progress_bar("export: frames", num_frames) as advance:
        facts = format.write(source, parts, cfg, advance)
        _write_readme(source, facts, parts, cfg)
        _write_checksums(parts)
    stage.finish([product / README, product / CHECKSUMS], Tally(input=num_frames, kept=num_frames))
    return product
