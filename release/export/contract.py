"""What a format of `cosfly release export` is: a module with three functions, and a row in FORMATS.

    plan(release, flights, cfg) -> list[Unit]              the work, cut so that units can be done in any order by several processes
    write(release, unit, folder, cfg) -> Written           one unit: its files, each whole or absent, below `folder`
    finish(release, units, written, folder, cfg) -> Facts  what speaks of all units: indices, statistics; called once, in order of units

The bytes of a unit depend on the release, the unit and the settings alone.
"""

from __future__ import annotations

import hashlib
import importlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal, Protocol, cast

from pydantic import BaseModel, Field

from cosfly.work.config import Config
from cosfly.work.store import atomic_file
from release.export.source import Release, ReleasedRows, Span

FormatName = Literal["tree", "webdataset", "lerobot"]
FORMATS: dict[FormatName, str] = {
    "tree": "release.export.tree",
    "webdataset": "release.export.webdataset",
    "lerobot": "release.export.lerobot",
}


class ExportConfig(Config):
    """What is made of a release."""

    format: FormatName = Field(description="tree, webdataset, or lerobot (v3.0)")
    shard_mb: int = Field(
        500,
        ge=1,
        description="size that a file of many frames should not pass by more than a row group or a flight, MB",
    )


@dataclass(frozen=True)
class Unit:
    """One piece of work. name: unique; frames: how many it has; spans or flights: its rows; extra: the format's own."""

    name: str
    frames: int
    spans: tuple[Span, ...] = ()
    flights: tuple[ReleasedRows, ...] = ()
    extra: Any = None


class Written(BaseModel):
    """What a unit left: its files (relative name -> sha256) and what the format wants to know of it afterwards."""

    files: dict[str, str]
    bytes: int
    facts: dict[str, Any] = {}


class Facts(BaseModel):
    """What a format says of itself in `export.json`, and the files that `finish` wrote (relative name -> sha256)."""

    version: str
    codings: dict[str, str] = {}  # of each modality: how it is stored
    notes: list[str] = []  # what a reader must know: conventions, and what the format cannot carry
    how_to_open: str  # lines of Python
    coordinates: dict[str, str] = {}  # where the format has other axes than the release
    files: dict[str, str] = {}


class Format(Protocol):
    def plan(self, release: Release, flights: list[ReleasedRows], cfg: ExportConfig) -> list[Unit]: ...

    def write(self, release: Release, unit: Unit, folder: Path, cfg: ExportConfig) -> Written: ...

    def finish(
        self, release: Release, units: Sequence[Unit], written: Sequence[Written], folder: Path, cfg: ExportConfig
    ) -> Facts: ...


def format_of(name: FormatName) -> Format:
    """Give the module of a format, loaded when it is asked for."""
    return cast(Format, importlib.import_module(FORMATS[name]))


class HashedFile(io.RawIOBase):
    """Counts and digests what is written through it; closing it leaves the file below open."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file, self.digest, self.num_bytes = file, hashlib.sha256(), 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self.digest.update(data)
        self.num_bytes += len(data)
        self.file.write(data)
        return len(data)


class Files:
    """The files of a unit: each appears whole, and is on record with its digest."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.digests, self.num_bytes = folder, dict[str, str](), 0

    def put(self, name: str, data: bytes, *, listed: bool = True) -> str:
        """Write one file; give its sha256. listed: whether it stands in the record of the export."""
        with atomic_file(self.folder / name) as file:
            file.write(data)
        return self.note(name, hashlib.sha256(data).hexdigest(), len(data), listed=listed)

    def note(self, name: str, digest: str, num_bytes: int, *, listed: bool = True) -> str:
        if listed:
            self.digests[name] = digest
        self.num_bytes += num_bytes
        return digest

    def written(self, **facts: Any) -> Written:
        return Written(files=self.digests, bytes=self.num_bytes, facts=facts)
