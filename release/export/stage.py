"""`cosfly release export`: a release in another format.

Reads a release, a row group at a time; writes `<format>/` with the format's files, README.md (what it was made of, how
things are stored) and checksums.sha256, whole or not at all. A format is a module with a
function, and a line in EXPORTS:

    write(source, folder, cfg, advance) -> FormatFacts      advance(n): n frames are written
"""

from __future__ import annotations

import importlib
import itertools
import math
import re
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
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
from cosfly.runtime.io import CHECKSUMS, atomic_folder, sha256_file, write_bytes, write_checksums
from cosfly.runtime.png import png_size
from cosfly.runtime.run_dir import StageFolder, Tally
from cosfly.viz.page import markdown
from release.columns import LANGUAGES, PICTURES, PLACE, SPLIT_NAMES, SplitName
from release.reading import Pictures, Row, TrackRows, read_pictures, read_tracks
from release.record import RECORD, ReleaseRecord, read_record, release_folder
from release.verify.findings import Findings
from release.verify.verify import check_footers, check_names

FormatName = Literal["tree", "lerobot", "webdataset", "coco", "chat", "sharegpt"]
README = "README.md"
MB = 1024 * 1024
# What one part of a path may be that rows name: no separator, nothing hidden, no ".."
PART = re.compile(r"\w[\w.-]{0,200}", re.ASCII)
BYTES_PER_PIXEL = 6  # of the three pictures of a frame, a typical value


class Export(NamedTuple):
    """One format."""

    module: str  # its writer
    needs: tuple[FrameFile, ...] = ()  # pictures that the writer reads
    carries: tuple[FrameFile, ...] = tuple(FILE_NAMES)  # pictures that the format can hold
    default: tuple[FrameFile, ...] = tuple(FILE_NAMES)  # those that are written unless the settings choose others


EXPORTS: dict[FormatName, Export] = {
    "tree": Export("release.export.tree", needs=("rgb",)),
    "lerobot": Export("release.export.lerobot", default=("rgb",)),
    "webdataset": Export("release.export.webdataset"),
    "coco": Export("release.export.coco", needs=("rgb", "instance"), carries=("rgb",), default=("rgb",)),
    "chat": Export("release.export.chat", needs=("rgb",), carries=("rgb",), default=("rgb",)),
    "sharegpt": Export("release.export.chat", needs=("rgb",), carries=("rgb",), default=("rgb",)),
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

    @property
    def needs_consecutive(self) -> bool:
        """Whether the format shows frames in their sequence, so that a release without gaps is needed."""
        return self.format == "lerobot" or (self.format in ("chat", "sharegpt") and self.frames == "all")


# --- the source -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SourceTrack:
    """One track, or some of its rows."""

    place: Place
    split: SplitName
    rows: list[Row]  # without pictures
    pictures: Iterator[Pictures]  # of each row, in order; they are read once

    @property
    def name(self) -> str:
        return "/".join((self.place.run, self.place.town, self.place.trajectory, self.place.variant))

    @property
    def size_px(self) -> tuple[int, int]:
        return self.rows[0]["width_px"], self.rows[0]["height_px"]

    @property
    def frame_index(self) -> list[int]:
        return [row["frame_index"] for row in self.rows]

    def __len__(self) -> int:
        return len(self.rows)

    def cut(self, edges: Sequence[int]) -> Iterator[SourceTrack]:
        """Yield the rows between edges, which begin with 0; the pictures of each part are read before the next."""
        for start, stop in itertools.pairwise(edges):
            yield replace(self, rows=self.rows[start:stop], pictures=itertools.islice(self.pictures, stop - start))

    def frames(self) -> Iterator[tuple[Row, dict[FrameFile, bytes]]]:
        """Yield each row with its pictures, which have the size of the track."""
        for row, pictures in zip(self.rows, self.pictures, strict=False):
            yield row, {file: self._checked(row, file, data) for file, data in pictures.items()}

    def _checked(self, row: Row, file: FrameFile, data: bytes | memoryview | None) -> bytes:
        """Return a picture; InputError if it is missing, damaged, or of another size than the track."""
        where = f"{row['sample_id']}: {PICTURES[file].name}"
        if not data:
            raise InputError("the frame has no picture", where=where, got="no data")
        data = bytes(data)
        if file == "depth":
            depth = parse_array(data, where, dtype=np.float32, ndim=2, what="depth image", copy=False)
            size_px: tuple[int, ...] | None = depth.shape[::-1]
        else:
            size_px = png_size(data)
        if size_px is None:
            raise InputError("the picture of the frame is not a PNG file", where=where)
        if size_px != self.size_px:
            got, expected = "{} x {} px".format(*size_px), "{} x {} px".format(*self.size_px)
            raise InputError("the picture has another size than the track", where=where, got=got, expected=expected)
        return data


@dataclass(frozen=True)
class ExportSource:
    """The release that is exported."""

    folder: Path
    record: ReleaseRecord
    modalities: tuple[FrameFile, ...]  # pictures that the export will hold
    files: tuple[FrameFile, ...]  # pictures that are read for it

    def tracks(self) -> Iterator[SourceTrack]:
        """Yield the tracks, splits in their order. The pictures of a track are read before the next track.

        Raises:
            InputError: The shards are not those of a release.
        """
        known = set[Place]()
        for shard in sorted(self.record.shards, key=lambda shard: (SPLIT_NAMES.index(shard.split), shard.path)):
            pictures = read_pictures(self.folder, shard, self.files)
            for frames, _ in read_tracks(self.folder, shard):
                parts = [frames.rows[0][name] for name in PLACE]
                place = Place(*parts)
                if not all(map(PART.fullmatch, parts)) or place in known:
                    what = "the names of a track are not valid folder names, or the track occurs twice"
                    raise InputError(what, where=self.folder / shard.path, got=shown(parts, 200))
                known.add(place)
                _check_frames(frames)
                pictures_of_track = itertools.islice(pictures, len(frames))
                yield SourceTrack(place, shard.split, list(frames.rows), pictures_of_track)
                deque(pictures_of_track, maxlen=0)  # skip those that the writer has not read


def _check_frames(frames: TrackRows) -> None:
    """Check what writers rely on: ids that can be file names, one size of pictures, and increasing times."""
    ids = frames.column("sample_id")
    if not all(map(PART.fullmatch, ids)) or len({*ids}) < len(ids):
        what = "the sample_id of a frame is repeated or is not a valid file name"
        raise InputError(what, where=frames.name, got=shown(ids, 200))
    if len({*frames.column("width_px")}) > 1 or len({*frames.column("height_px")}) > 1:
        raise InputError("the pictures of the track differ in size", where=frames.name)
    if (np.diff(frames.index) <= 0).any() or (np.diff(frames.time_s) <= 0).any():
        raise InputError("the indices and times of the frames do not increase", where=frames.name)


def key_of(sample_id: str) -> str:
    """Return a sample_id without dots: where it begins the name of a file, readers end it at its first dot."""
    return sample_id.replace(".", "_")


def open_release(folder: Path, consecutive: str = "") -> ExportSource:
    """Open a release, or that of a run; InputError if there is none or it is incomplete. `consecutive` names, for the
    message, what needs consecutive frames; then InputError if the release has skipped some."""
    folder = release_folder(folder)
    record = read_record(folder / RECORD)
    if consecutive:
        record.require_whole_tracks(consecutive, folder)
    findings = Findings()
    usable = check_names(folder, record, findings)
    if not (check_footers(folder, record, usable, findings) and record.shards):
        raise InputError(
            "the release is incomplete", where=folder, got="; ".join(map(str, findings.issues)) or "no shards",
            expected="the shards in release.json", fix="run cosfly release verify for details",
        )  # fmt: skip
    modalities = tuple(record.settings.modalities)
    return ExportSource(folder, record, modalities, modalities)


@dataclass(frozen=True)
class FormatFacts:
    """What README.md says of an export."""

    values: dict[str, Any] = field(default_factory=dict)  # for the format's section of `readme.md`
    coordinates: dict[str, str] = field(default_factory=dict)  # if the format has other axes than the release
    split_files: dict[str, str] = field(default_factory=dict)  # split -> pattern of its files, if `datasets` opens them


class _ShardNames:
    """Names the shard of each piece; all pieces are passed once, in order."""

    def __init__(self, shard_mb: int) -> None:
        self.shard_bytes = shard_mb * MB
        self.split = ""
        self.number = 0
        self.filled_bytes = 0

    def next_name(self, piece: SourceTrack) -> str:
        """Return the name of the shard that the next piece belongs to, such as `train-00000`."""
        if piece.split != self.split:
            self.split, self.number, self.filled_bytes = piece.split, 0, 0
        elif self.filled_bytes >= self.shard_bytes:
            self.number, self.filled_bytes = self.number + 1, 0
        self.filled_bytes += len(piece) * math.prod(piece.size_px) * BYTES_PER_PIXEL
        return f"{self.split}-{self.number:05d}"


def shards(pieces: Iterable[SourceTrack], shard_mb: int) -> Iterator[tuple[str, Iterator[SourceTrack]]]:
    """Group pieces of each split into files of about `shard_mb`; yield names and pieces, to be read in order."""
    return itertools.groupby(pieces, _ShardNames(shard_mb).next_name)


# --- the stage --------------------------------------------------------------------------------------------------------


def check_needs(source: ExportSource, cfg: ExportConfig) -> ExportSource:
    """Return the source with the pictures that the format will hold; InputError if it lacks some that are needed."""
    export = EXPORTS[cfg.format]
    chosen = cfg.modalities or tuple(file for file in export.default if file in source.modalities)
    for needed in (*export.needs, *chosen):
        if needed not in source.modalities:
            got, fix = f"a release with {', '.join(source.modalities)}", f"build a release with {needed} pictures"
            raise InputError(f"the {cfg.format} export needs {needed} pictures", where=source.folder, got=got, fix=fix)
    if unused := set(chosen) - set(export.carries):
        what = f"the {cfg.format} export cannot contain {' or '.join(sorted(unused))} pictures"
        raise InputError(what, where="--modalities", expected=f"some of {', '.join(export.carries)}")
    return replace(source, modalities=chosen, files=tuple(dict.fromkeys((*chosen, *export.needs))))


def _write_readme(source: ExportSource, facts: FormatFacts, folder: Path, cfg: ExportConfig) -> None:
    """Write README.md: front matter as the hub reads it, what was exported, and how the format stores it."""
    tags = ["cosfly", "LeRobot" if cfg.format == "lerobot" else cfg.format]  # the hub knows LeRobot by this tag
    front: dict[str, Any] = {"license": source.record.licence, "pretty_name": source.record.name, "tags": tags}
    if facts.split_files:
        files = [{"split": split, "path": path} for split, path in facts.split_files.items()]
        front["configs"] = [{"config_name": "default", "data_files": files}]
    text = markdown(
        "release/export/readme.md", front_matter=yaml.safe_dump(front, sort_keys=True, allow_unicode=True).rstrip(),
        release=source.record, cfg=cfg, format=cfg.format, num_frames=source.record.numbers.frames,
        made_by=f"cosfly {cosfly.__version__}", coordinates=facts.coordinates or source.record.coordinates,
        pictures=", ".join(FILE_NAMES[file] for file in source.modalities), **facts.values,
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


def run(cfg: ExportConfig, folder: Path, out: Path) -> Path:
    """Read a release, also of a run; write it in the format of the settings and return its folder."""
    source = check_needs(open_release(folder, f"the {cfg.format} export" if cfg.needs_consecutive else ""), cfg)
    stage = StageFolder.open(out, "export", config=cfg, inputs={"release": source.folder / RECORD}, seed=0)
    product, num_frames = out / cfg.format, source.record.numbers.frames
    if stage.is_complete:
        return product
    writer = importlib.import_module(EXPORTS[cfg.format].module)
    with atomic_folder(product) as parts, progress_bar("export: frames", num_frames) as advance:
        facts = writer.write(source, parts, cfg, advance)
        _write_readme(source, facts, parts, cfg)
        _write_checksums(parts)
    stage.finish([product / README, product / CHECKSUMS], Tally(input=num_frames, kept=num_frames))
    return product
