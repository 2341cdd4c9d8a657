"""`cosfly release export`: a release in another format.

Reads a release (`release/export/source.py`); writes `<format>/` with the format's files, `export.json` (what it was
made of, how things are stored), README.md and checksums.sha256, whole or not at all. A format is a module with a
function, and a line in EXPORTS:

    write(source, folder, cfg, advance) -> FormatFacts      advance(n): n frames are written
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import yaml
from pydantic import Field

import cosfly
from cosfly.formats.frames import FILE_NAMES, FrameFile
from cosfly.runtime.config import Config
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import CHECKSUMS, atomic_folder, sha256_file, write_bytes, write_checksums
from cosfly.runtime.json_io import FileFormat, write_model
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.viz.page import markdown
from release.columns import LANGUAGES, SPLIT_NAMES, SplitName
from release.export.source import ExportSource, SourceTrack, open_release
from release.record import RECORD as RELEASE
from release.record import ReleasedMap, Strict
from release.rules import group_by_size

FormatName = Literal["tree", "lerobot", "webdataset", "coco", "chat", "sharegpt"]
EXPORT_FORMAT = FileFormat("cosfly.export", "2.0", "record of an export")
RECORD, README = "export.json", "README.md"
OWN = (RECORD, README, CHECKSUMS)  # files that this module writes
MB = 1024 * 1024


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


class Piece(NamedTuple):
    """Rows [start, stop) of a track."""

    track: SourceTrack
    start: int
    stop: int

    @property
    def frames(self) -> int:
        return self.stop - self.start


class FormatFacts(Strict):
    """What a format states about itself.

    codings: How each thing is stored. notes: Conventions, and what the format cannot carry. how_to_open: Lines of
    Python. coordinates: If the format has other axes than the release. split_files: Split -> pattern of its files,
    where `datasets` opens the folder.
    """

    format_version: str
    codings: dict[str, str]
    notes: list[str]
    how_to_open: str
    coordinates: dict[str, str] = Field({}, exclude=True)
    split_files: dict[str, str] = Field({}, exclude=True)


def shards(pieces: Sequence[Piece], shard_mb: int) -> Iterator[tuple[SplitName, str, list[Piece]]]:
    """Yield groups of pieces of each split of about `shard_mb`, each with its split and name, `train-00000`."""
    for split in SPLIT_NAMES:
        own = [piece for piece in pieces if piece.track.split == split]
        sizes = [piece.frames * piece.track.frame_bytes for piece in own]
        for number, group in enumerate(group_by_size(sizes, shard_mb * MB)):
            yield split, f"{split}-{number:05d}", [own[k] for k in group]


# --- the record -------------------------------------------------------------------------------------------------------


class ExportRecord(Strict):
    """`export.json`: what was exported, and what its format states about itself. digest: Of the release's content.
    prompts: As in `release.json`."""

    source: str
    source_made_by: str
    digest: str
    licence: str
    credits: str
    maps: list[ReleasedMap]
    coordinates: dict[str, Any]
    prompts: dict[str, dict[str, str]] = Field(default_factory=dict)
    format: str
    format_version: str
    made_by: str
    codings: dict[str, str]
    notes: list[str]
    how_to_open: str
    frames: int
    bytes: int


def _write_records(source: ExportSource, frames: int, facts: FormatFacts, folder: Path, cfg: ExportConfig) -> None:
    """Write `export.json`, README.md and the checksums."""
    own = {folder / name for name in OWN}
    paths = [path for path in folder.rglob("*") if path.is_file() and path not in own]
    with_list = {path.parent for path in paths if path.name == CHECKSUMS}  # such as the tracks of a tree
    listed = [path for path in paths if path.name == CHECKSUMS or with_list.isdisjoint(path.parents)]
    with ThreadPoolExecutor() as pool:
        digests = dict(zip(listed, pool.map(sha256_file, listed), strict=True))
    of = source.record
    record = ExportRecord(
        source=of.name, source_made_by=of.made_by, digest=of.content_digest, licence=of.licence, credits=of.credits,
        maps=of.maps, coordinates=facts.coordinates or of.coordinates, prompts=of.prompts, format=cfg.format,
        made_by=f"cosfly {cosfly.__version__}", frames=frames, bytes=sum(path.stat().st_size for path in paths),
        **facts.model_dump(),
    )  # fmt: skip
    write_model(folder / RECORD, record, EXPORT_FORMAT)
    digests[folder / RECORD] = sha256_file(folder / RECORD)
    write_bytes(folder / README, render_readme(record, facts.split_files).encode())
    write_checksums(folder, {path.relative_to(folder).as_posix(): digest for path, digest in digests.items()})


def render_readme(record: ExportRecord, split_files: dict[str, str]) -> str:
    """Return README.md: front matter as the hub reads it, and `export.json` in words."""
    tags = ["cosfly", "LeRobot" if record.format == "lerobot" else record.format]  # the hub knows LeRobot by this tag
    front: dict[str, Any] = {"license": record.licence, "pretty_name": record.source, "tags": tags}
    if split_files:
        files = [{"split": split, "path": path} for split, path in split_files.items()]
        front["configs"] = [{"config_name": "default", "data_files": files}]
    front_matter = yaml.safe_dump(front, sort_keys=True, allow_unicode=True).rstrip()
    return markdown("release/export/readme.md", record=record, front_matter=front_matter).rstrip() + "\n"


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


def run(cfg: ExportConfig, folder: Path, out: Path, *, resume: Resume = "if-same") -> Path:
    """Read a release, also of a run; write it in the format of the settings and return its folder."""
    is_of_windows = EXPORTS[cfg.format].needs_consecutive and (cfg.frames == "all" or cfg.format == "lerobot")
    source = check_needs(open_release(folder, f"the {cfg.format} export" if is_of_windows else ""), cfg)
    stage = StageFolder.open(
        out, "export", config=cfg, inputs={"release": source.folder / RELEASE}, seed=0, resume=resume
    )
    product, num_frames = out / cfg.format, sum(map(len, source.tracks))
    if stage.is_complete:
        return product
    format = importlib.import_module(EXPORTS[cfg.format].module)
    with atomic_folder(product) as parts, progress_bar("export: frames", num_frames) as advance:
        facts = format.write(source, parts, cfg, advance)
        _write_records(source, num_frames, facts, parts, cfg)
    stage.finish([product / name for name in OWN], Tally(input=num_frames, kept=num_frames))
    return product
