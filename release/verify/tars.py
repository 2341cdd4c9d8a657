"""The rows and pictures of an exported WebDataset, read again from its tar shards: every column of a release stands in their JSON.

Headers are walked through one by one: what `release export` writes are regular files, and long names before them. Anything else, or a
size that leads out of the archive, is refused before it is followed.
"""

from __future__ import annotations

import tarfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosfly.errors import InputError
from cosfly.products.frames import INVALID_DEPTH_M, FrameFile
from cosfly.reading.documents import parse_document
from cosfly.reading.files import open_file
from release.columns import PLACE, SCALAR_NAMES
from release.export.webdataset import ENDINGS
from release.record import DepthCoding
from release.verify.findings import Findings
from release.verify.rows import Row
from release.verify.sources import Entry, Pictures, with_ids

BLOCK = 512
MOST_NAME_BYTES, MOST_ROW_BYTES = 4096, 1_000_000
FILE_OF: dict[str, FrameFile] = {ending: file for file, ending in ENDINGS.items()} | {"depth.png": "depth"}
CODED = DepthCoding(
    coding="millimetre_png", unit="millimetre", sky=65535.0, invalid=INVALID_DEPTH_M, min_m=None, max_m=None, max_error_m=0.0
)  # fmt: skip


@dataclass(frozen=True)
class Place:
    """Where a file of a frame lies in its tar."""

    offset: int
    size: int


@dataclass(frozen=True)
class Tars:
    """Tar shards of a folder. A part of a flight is one frame: (shard, where its JSON is, where its pictures are)."""

    folder: Path
    files: tuple[FrameFile, ...]

    def rows(self, entry: Entry) -> list[Row]:
        return [self._row(shard, place) for shard, place, _ in entry.parts]

    def pictures(self, entry: Entry) -> Iterator[Pictures]:
        for shard, _, places in entry.parts:
            yield {file: self._read(shard, places[file]) if file in places else None for file in self.files}

    def _row(self, shard: str, place: Place) -> Row:
        where = f"{shard} at byte {place.offset}"
        if place.size > MOST_ROW_BYTES:
            raise InputError("not a row", where=where, got=f"{place.size:,} bytes", expected="the columns of a frame")
        value = parse_document(self._read(shard, place), where, what="row")
        if not isinstance(value, dict) or value.keys() != set(SCALAR_NAMES):
            odd = sorted(set(value) ^ set(SCALAR_NAMES))[:3] if isinstance(value, dict) else [type(value).__name__]
            raise InputError("not a row", where=where, got=", ".join(odd), expected="the columns of a release")
        return value

    def _read(self, shard: str, place: Place) -> bytes:
        with open_file(self.folder / shard, what="shard", tree=self.folder) as file:
            file.seek(place.offset)
            return file.read(place.size)


def found_tars(folder: Path, shards: list[str], findings: Findings) -> tuple[Tars, list[Entry], DepthCoding | None]:
    """Find the flights of tar shards, and see that each frame is whole, under its own key and in the shard of its split.

    Returns:
        the shards, their flights, and how depth is coded where it is not float32.
    Raises:
        InputError: a shard or a row cannot be read.
    """
    frames: dict[tuple[str, str], dict[str, Place]] = defaultdict(dict)
    for shard in shards:
        for name, place in _members(folder, shard):
            key, _, ending = name.partition(".")
            own = frames[shard, key]
            if ending in own or (ending != "json" and ending not in FILE_OF):
                findings.error("unexpected", f"{shard}: {name}", "twice" if ending in own else "a file", "each file of a frame once")  # fmt: skip
            own[ending] = place
    kinds = {ending for own in frames.values() for ending in own if ending in FILE_OF}
    tars = Tars(folder, tuple(file for file in ENDINGS if any(FILE_OF[kind] == file for kind in kinds)))
    parts: dict[str, list[Any]] = defaultdict(list)
    for (shard, key), own in frames.items():
        if own.keys() != kinds | {"json"}:
            findings.error("missing", f"{shard}: {key}", ", ".join(sorted(own)), f"all of json, {', '.join(sorted(kinds))}")  # fmt: skip
            if "json" not in own:
                continue
        row = tars._row(shard, own["json"])
        if str(row["sample_id"]).replace(".", "_") != key:
            findings.error("sample_id", f"{shard}: {key}", row["sample_id"], "the key of its files")
        if row["split"] != shard.partition("-")[0]:
            findings.error("leak", f"{shard}: {key}", f"a row of {row['split']}", "the shard's split")
        pictures = {FILE_OF[ending]: place for ending, place in own.items() if ending in FILE_OF}
        parts["/".join(str(row[name]) for name in PLACE)].append((shard, own["json"], pictures))
    entries = [Entry(name, tuple(own), len(own)) for name, own in parts.items() if name.count("/") == len(PLACE) - 1]
    return tars, with_ids(entries), CODED if "depth.png" in kinds else None


def _members(folder: Path, shard: str) -> Iterator[tuple[str, Place]]:
    """Yield name and place of the files of a tar.

    Raises:
        InputError: it is none, ends too soon, or holds something else.
    """
    with open_file(folder / shard, what="shard", tree=folder) as file:
        size = file.seek(0, 2)
        at, long_name = 0, ""
        while at + BLOCK <= size:
            file.seek(at)
            block = file.read(BLOCK)
            if not any(block):
                return
            try:
                header = tarfile.TarInfo.frombuf(block, "utf-8", "strict")
            except (tarfile.HeaderError, UnicodeError) as error:
                raise InputError("not a tar", where=shard, got=f"{error} at byte {at:,}", expected="a header") from None
            begin = at + BLOCK
            if not 0 <= header.size <= size - begin:
                raise InputError("a tar that is cut short", where=shard, got=f"a file of {header.size:,} bytes at byte {at:,}", expected=f"{size - begin:,} at most")  # fmt: skip
            if header.type == tarfile.GNUTYPE_LONGNAME and header.size <= MOST_NAME_BYTES:
                long_name = file.read(header.size).rstrip(b"\0").decode(errors="replace")
            elif header.type in (tarfile.REGTYPE, tarfile.AREGTYPE):
                yield long_name or header.name, Place(begin, header.size)
                long_name = ""
            else:
                raise InputError("a tar with what is no file", where=shard, got=f"{header.name}: type {header.type!r}", expected="regular files")  # fmt: skip
            at = begin + -(-header.size // BLOCK) * BLOCK
    raise InputError(
        "a tar that is cut short", where=shard, got=f"{size:,} bytes without an end", expected="two empty blocks"
    )
