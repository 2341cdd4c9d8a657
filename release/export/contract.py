"""What a format of `cosfly release export` is: a module with three functions, and a row in FORMATS.

    plan(release, flights, cfg) -> list[ExportUnit]              the work, cut so that units can be done in any order by
    several processes write(release, unit, folder, cfg) -> UnitFiles           one unit: its files, each whole or
    absent, below `folder` finish(release, units, written, folder, cfg) -> FormatFacts  what speaks of all units:
    indices, statistics; called once, in order of units

The bytes of a unit depend on the release, the unit and the settings alone.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, cast

from pydantic import BaseModel, Field

from cosfly.runtime.config import Config
from cosfly.runtime.io import atomic_file, sha256_bytes, sha256_file
from release.export.source import Release, ReleasedRows, Span

FormatName = Literal["tree", "webdataset", "lerobot"]
FORMATS: dict[FormatName, str] = {
    "tree": "release.export.tree",
    "webdataset": "release.export.webdataset",
    "lerobot": "release.export.lerobot",
}


class ExportConfig(Config):
    """What is made of a release."""

    format: FormatName = Field(description="format: tree, webdataset or lerobot (v3.0)")
    shard_mb: int = Field(
        500,
        ge=1,
        description="approximate size of a file of many frames, MB; exceeded by at most a row group or a track",
    )


@dataclass(frozen=True)
class ExportUnit:
    """One piece of work. name: unique; frames: how many it has; spans or flights: its rows; extra: the format's own."""

    name: str
    frames: int
    spans: tuple[Span, ...] = ()
    flights: tuple[ReleasedRows, ...] = ()
    extra: Any = None


class UnitFiles(BaseModel):
    """What a unit left: its files (relative name -> sha256) and what the format wants to know of it afterwards."""

    files: dict[str, str]
    bytes: int
    facts: dict[str, Any] = {}


class FormatFacts(BaseModel):
    """What a format says of itself in `export.json`, and the files that `finish` wrote (relative name -> sha256)."""

    version: str
    codings: dict[str, str] = {}  # of each modality: how it is stored
    notes: list[str] = []  # what a reader must know: conventions, and what the format cannot carry
    how_to_open: str  # lines of Python
    coordinates: dict[str, str] = {}  # where the format has other axes than the release
    files: dict[str, str] = {}


class Format(Protocol):
    def plan(self, release: Release, flights: list[ReleasedRows], cfg: ExportConfig) -> list[ExportUnit]: ...

    def write(self, release: Release, unit: ExportUnit, folder: Path, cfg: ExportConfig) -> UnitFiles: ...

    def finish(
        self,
        release: Release,
        units: Sequence[ExportUnit],
        written: Sequence[UnitFiles],
        folder: Path,
        cfg: ExportConfig,
    ) -> FormatFacts: ...


def format_of(name: FormatName) -> Format:
    """Return the module of a format, loaded when it is asked for."""
    return cast(Format, importlib.import_module(FORMATS[name]))


class Files:
    """The files of a unit: each appears whole, and is on record with its digest."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.digests, self.num_bytes = folder, dict[str, str](), 0

    def put(self, name: str, data: bytes, *, listed: bool = True) -> str:
        """Write one file; give its sha256. listed: whether it stands in the record of the export."""
        with atomic_file(self.folder / name) as file:
            file.write(data)
        return self._note(name, sha256_bytes(data), len(data), listed)

    def note(self, name: str) -> None:
        """Put a file that stands there on record."""
        path = self.folder / name
        self._note(name, sha256_file(path), path.stat().st_size, True)

    def _note(self, name: str, digest: str, num_bytes: int, listed: bool) -> str:
        if listed:
            self.digests[name] = digest
        self.num_bytes += num_bytes
        return digest

    def written(self, **facts: Any) -> UnitFiles:
        return UnitFiles(files=self.digests, bytes=self.num_bytes, facts=facts)
