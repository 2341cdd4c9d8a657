"""`cosfly release export`: a release, a run or a playback tree in another format.

Reads a source (`release/export/source.py`); writes `<format>/` with the format's files, `export.json` (what it was made
of, how things are stored), README.md and checksums.sha256. A format is a module with three functions and a line in
EXPORTS:

    plan(source, cfg) -> list[ExportUnit]                       cuts the work into units that can be done in any order
    write(source, unit, folder, cfg) -> UnitFiles               writes the files of one unit, through `Files`
    finish(source, units, written, folder, cfg) -> FormatFacts  writes what concerns all units; called once

The bytes of a unit depend on source, unit and settings alone.
"""

from __future__ import annotations

import importlib
import os
import shutil
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import yaml
from pydantic import BaseModel, Field

import cosfly
from cosfly.formats.frames import FILE_NAMES, FrameFile
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.escaping import for_markdown
from cosfly.runtime.io import (
    CHECKSUMS,
    atomic_file,
    inside,
    open_file,
    sha256_bytes,
    sha256_file,
    storage_errors,
    write_bytes,
    write_checksums,
)
from cosfly.runtime.json_io import FileFormat, dump_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Resume, StageFolder, result_of
from cosfly.runtime.worker import Item, Outcome, Work
from release.columns import LANGUAGES, SPLIT_NAMES, SplitName
from release.export.source import ExportSource, SourceTrack, open_source
from release.record import ReleasedMap, Strict

FormatName = Literal["tree", "lerobot", "webdataset", "coco", "chat", "sharegpt"]
EXPORT_FORMAT = FileFormat("cosfly.export", "2.0", "record of an export")
MB = 1024 * 1024


class Export(NamedTuple):
    """One format. module: Its writer. pictures: It cannot do without these. carries: It can hold these; `default` of
    them are written unless the settings choose others."""

    module: str
    pictures: tuple[FrameFile, ...] = ()
    carries: tuple[FrameFile, ...] = tuple(FILE_NAMES)
    default: tuple[FrameFile, ...] = tuple(FILE_NAMES)
    needs_consecutive: bool = False
    needs_one_size: bool = False


EXPORTS: dict[FormatName, Export] = {
    "tree": Export("release.export.tree", pictures=("rgb",)),
    "lerobot": Export("release.export.lerobot", default=("rgb",), needs_consecutive=True, needs_one_size=True),
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


@dataclass(frozen=True)
class ExportUnit:
    """A piece of work. name: Unique. split: Of all its rows. extra: What the format has decided about it."""

    name: str
    split: SplitName
    pieces: tuple[Piece, ...]
    extra: Any = None

    @property
    def frames(self) -> int:
        return sum(piece.frames for piece in self.pieces)


class UnitFiles(BaseModel):
    """The files of a unit (relative name -> sha256), and what the format needs to know of it afterwards."""

    files: dict[str, str]
    bytes: int
    facts: dict[str, Any] = {}


class FormatFacts(BaseModel):
    """What a format states about itself in `export.json`, and the files that `finish` wrote (name -> sha256)."""

    version: str
    codings: dict[str, str] = {}  # how each thing is stored
    notes: list[str] = []  # conventions, and what the format cannot carry
    how_to_open: str  # lines of Python
    coordinates: dict[str, str] = {}  # if the format has other axes than the release
    files: dict[str, str] = {}
    split_files: dict[str, str] = {}  # split -> its files, as a pattern, where `datasets` opens the folder


class Files:
    """The files of a unit: each appears whole, and is recorded with its digest."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.digests, self.num_bytes = folder, dict[str, str](), 0

    def put(self, name: str, data: bytes, *, listed: bool = True) -> str:
        """Write one file and return its sha256. listed: Whether the record of the export names it."""
        write_bytes(self.folder / name, data)
        return self._note(name, sha256_bytes(data), len(data), listed)

    def note(self, name: str) -> None:
        """Record a file that is already written."""
        path = self.folder / name
        self._note(name, sha256_file(path), path.stat().st_size, True)

    def _note(self, name: str, digest: str, num_bytes: int, listed: bool) -> str:
        if listed:
            self.digests[name] = digest
        self.num_bytes += num_bytes
        return digest

    def written(self, **facts: Any) -> UnitFiles:
        return UnitFiles(files=self.digests, bytes=self.num_bytes, facts=facts)


def track_units(source: ExportSource) -> list[ExportUnit]:
    """Return one unit per track."""
    return [ExportUnit(track.name, track.split, (Piece(track, 0, len(track)),)) for track in source.tracks]


def shards(source: ExportSource, pieces: Iterable[Piece], shard_mb: int) -> list[ExportUnit]:
    """Group pieces of each split into units of about `shard_mb`, and name them `train-00000`."""
    groups: list[tuple[SplitName, list[Piece]]] = []
    filled = 0.0
    for piece in sorted(pieces, key=lambda piece: SPLIT_NAMES.index(piece.track.split)):
        if not groups or groups[-1][0] != piece.track.split or filled >= shard_mb * MB:
            groups.append((piece.track.split, []))
            filled = 0.0
        groups[-1][1].append(piece)
        filled += piece.track.num_bytes * piece.frames / len(piece.track)
    numbers = dict.fromkeys(SPLIT_NAMES, 0)
    units = []
    for split, members in groups:
        units.append(ExportUnit(f"{split}-{numbers[split]:05d}", split, tuple(members)))
        numbers[split] += 1
    return units


def scratch_of(folder: Path) -> Path:
    """Return the folder for parts of a unit that `finish` joins; it is removed after the export."""
    return folder.with_name("scratch")


def join_parts(paths: Sequence[Path], out: Path, begin: bytes = b"", between: bytes = b"", end: bytes = b"") -> None:
    """Write the lines of several files as one, with other bytes around and between them."""
    with atomic_file(out) as file, ExitStack() as stack:
        lines = (line for path in paths for line in stack.enter_context(open_file(path)))
        file.write(begin)
        for number, line in enumerate(lines):
            file.write((between if number else b"") + (line.rstrip(b"\n") if between else line))
        file.write(end)


# --- the record -------------------------------------------------------------------------------------------------------


class ExportRecord(Strict):
    """`export.json`. source, digest: Name and content of what was exported, and the version that made it. prompts: The
    questions, as the release's record has them."""

    format: str
    format_version: str
    made_by: str
    source: str
    source_made_by: str
    digest: str
    licence: str
    credits: str
    maps: list[ReleasedMap]
    coordinates: dict[str, Any]
    prompts: dict[str, dict[str, str]] = Field(default_factory=dict)
    codings: dict[str, str]
    notes: list[str]
    how_to_open: str
    frames: int
    bytes: int


def render_readme(record: ExportRecord, split_files: dict[str, str]) -> str:
    """Return README.md: front matter as the hub reads it, and `export.json` in words."""
    tags = ["cosfly", "LeRobot" if record.format == "lerobot" else record.format]  # the hub knows LeRobot by this tag
    front: dict[str, Any] = {"license": record.licence, "pretty_name": record.source, "tags": tags}
    if split_files:
        files = [{"split": split, "path": path} for split, path in split_files.items()]
        front["configs"] = [{"config_name": "default", "data_files": files}]
    maps = [
        f"- {for_markdown(m.town)}: {for_markdown(m.name)}, {for_markdown(m.licence)}. {for_markdown(m.credits)}"
        for m in record.maps
    ]
    lines = [
        "---", yaml.safe_dump(front, sort_keys=True, allow_unicode=True).rstrip(), "---", "",
        f"# {for_markdown(record.source)}: {record.format} {record.format_version}", "",
        f"{record.frames:,} frames of {for_markdown(record.source)} (content {record.digest}), exported by "
        f"{for_markdown(record.made_by)}. `export.json` has these facts for programs; `checksums.sha256` lists the "
        "files.", "",
        "```python", record.how_to_open, "```", "",
        "## How data are stored", "",
        *(f"- {name}: {for_markdown(text)}" for name, text in record.codings.items()), "",
        *(f"- {for_markdown(note)}" for note in record.notes), "",
        "## Axes", "",
        *(f"- {for_markdown(name)}: {for_markdown(str(text))}" for name, text in record.coordinates.items()), "",
        "## Licence and credits", "",
        f"Licence: {for_markdown(record.licence)}. {for_markdown(record.credits)}".rstrip(), "",
        *maps,
    ]  # fmt: skip
    return "\n".join(lines).rstrip() + "\n"


# --- the stage ------------------------------------------------------------------------------------------------------


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
    sizes = sorted({track.size_px for track in source.tracks})
    if export.needs_one_size and len(sizes) > 1:
        raise InputError(
            f"the {cfg.format} export needs pictures of one size", where=source.folder,
            got=", ".join(f"{width} x {height} px" for width, height in sizes), fix="build one release per size",
        )  # fmt: skip
    return replace(source, modalities=chosen)


def _write_records(
    source: ExportSource,
    units: list[ExportUnit],
    written: list[UnitFiles],
    facts: FormatFacts,
    parts: Path,
    cfg: ExportConfig,
) -> None:
    """Write `export.json`, README.md and the checksums."""
    record = ExportRecord(
        format=cfg.format, format_version=facts.version, made_by=f"cosfly {cosfly.__version__}",
        source=source.name, source_made_by=source.made_by, digest=source.digest,
        licence=source.licence, credits=source.credits, maps=source.maps,
        coordinates=facts.coordinates or source.coordinates, prompts=source.prompts, codings=facts.codings,
        notes=facts.notes, how_to_open=facts.how_to_open, frames=sum(unit.frames for unit in units),
        bytes=sum(one.bytes for one in written),
    )  # fmt: skip
    digests = {name: digest for one in written for name, digest in one.files.items()} | facts.files
    data = (dump_json({**EXPORT_FORMAT.header, **record.model_dump(mode="json")}, indent=1) + "\n").encode()
    write_bytes(parts / "export.json", data)
    write_bytes(parts / "README.md", render_readme(record, facts.split_files).encode())
    write_checksums(parts, digests | {"export.json": sha256_bytes(data)})


def make_worker(source: ExportSource, parts: Path, cfg: ExportConfig) -> Work:
    """Return the function that writes one unit."""
    format = importlib.import_module(EXPORTS[cfg.format].module)

    def work(item: Item) -> Outcome:
        return Outcome(format.write(source, item.payload, parts, cfg).model_dump())

    return work


def run(
    cfg: ExportConfig, folder: Path, out: Path, *, workers: int = 0, watch: Watch = Watch(), resume: Resume = "if-same"
) -> Path:
    """Read a release, a run or a playback tree; write it in the format of the settings and return its folder."""
    consecutive = f"the {cfg.format} export" if EXPORTS[cfg.format].needs_consecutive else ""
    source = open_source(folder, consecutive=consecutive)
    chosen = check_needs(source, cfg)
    stage = StageFolder.open(out, "export", config=cfg, inputs=source.inputs, seed=0, resume=resume)
    product, parts = out / cfg.format, out / "parts"
    if stage.is_complete:
        return product
    if product.is_dir() and not parts.exists():  # a kill came between the last rename and the manifest
        with storage_errors(parts):
            os.replace(product, parts)
    format = importlib.import_module(EXPORTS[cfg.format].module)
    units = format.plan(chosen, cfg)
    items = [Item(unit.name, unit, unit.frames) for unit in units]
    arguments = (replace(chosen, tracks=[]), parts, cfg)
    finished = run_items(stage, items, make_worker, arguments, workers=workers, watch=watch, label="export: frames")
    if finished.tally.failed:  # nothing half is published
        raise InputError(
            "parts of the source could not be exported", where=out / "failures.jsonl", got=str(finished.tally),
            fix="fix what this file lists (see cosfly release verify) and run the same command again, which repeats "
            "only these parts",
        )  # fmt: skip
    written = [result_of(kept, UnitFiles) for kept in finished.kept]
    missing = [name for one in written for name in one.files if not inside(parts, name).is_file()]
    if missing:
        raise VerifyError(
            "finished files are missing", where=parts, got=", ".join(missing[:5]),
            fix=f"remove {out} and run the same command again",
        )  # fmt: skip
    facts = format.finish(chosen, units, written, parts, cfg)
    _write_records(chosen, units, written, facts, parts, cfg)
    with storage_errors(product):
        os.replace(parts, product)
    stage.finish([product / name for name in ("export.json", "README.md", CHECKSUMS)], finished.tally)
    shutil.rmtree(scratch_of(parts), ignore_errors=True)
    return product
