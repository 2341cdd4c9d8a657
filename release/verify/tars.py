"""The rows and pictures of an exported WebDataset, read again from its tar shards: every column of a release stands in their JSON.

Headers are walked through one by one: what `release export` writes are regular files, and long names before them. Anything else, or a
size that leads out of the archive, is refused before it is followed.
"""

from __future__ import annotations

import itertools
import tarfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cosfly.errors import InputError
from cosfly.products.frames import FrameFile
from cosfly.reading.documents import parse_document
from cosfly.reading.files import open_file
from release.columns import PLACE, SCALAR_NAMES
from release.export.webdataset import ENDINGS
from release.record import DepthCodingName
from release.verify.findings import Findings
from release.verify.rows import Row
from release.verify.sources import Entry, Pictures, with_ids

BLOCK = 512
MOST_NAME_BYTES, MOST_ROW_BYTES = 4096, 1_000_000
FILE_OF: dict[str, FrameFile] = {ending: file for file, ending in ENDINGS.items()} | {"depth.png": "depth"}


@dataclass(frozen=True)
class Place:
    """Where a file of a frame lies in its tar. header: where what is said of it begins."""

    header: int
    offset: int
    size: int


Frame = tuple[str, list[tuple[str, Place]]]  # its key; of each of its files the ending and the place


@dataclass(frozen=True)
class Tars:
    """Tar shards of a folder. A part of a flight is (shard, where its first frame's headers begin, where its last frame ends)."""

    folder: Path
    files: tuple[FrameFile, ...]

    def rows(self, entry: Entry) -> list[Row]:
        return [self.row(shard, own["json"]) for shard, own in self._frames_of(entry)]

    def pictures(self, entry: Entry) -> Iterator[Pictures]:
        for shard, own in self._frames_of(entry):
            places = {FILE_OF[ending]: place for ending, place in own.items() if ending in FILE_OF}
            yield {file: self._read(shard, places[file]) if file in places else None for file in self.files}

    def _frames_of(self, entry: Entry) -> Iterator[tuple[str, dict[str, Place]]]:
        for shard, begin, end in entry.parts:
            for _, members in frames_in(self.folder, shard, begin, end):
                own = dict(members)
                if "json" in own:
                    yield shard, own

    def row(self, shard: str, place: Place) -> Row:
        """Read the row of a frame.

        Raises:
            InputError: it is none.
        """
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


def found_tars(
    folder: Path, shards: list[str], files: tuple[FrameFile, ...], coding: DepthCodingName, findings: Findings
) -> tuple[Tars, list[Entry]]:
    """Find the flights of tar shards, and see that each frame is whole, under its own key and in the shard of its split.

    Args:
        files, coding: the pictures that every frame has, and how its depth is coded.
    Returns:
        the shards and their flights.
    Raises:
        InputError: a shard or a row cannot be read.
    """
    tars = Tars(folder, files)
    wanted = {"json"} | {"depth.png" if file == "depth" and coding == "millimetre_png" else ENDINGS[file] for file in files}  # fmt: skip
    last: list[tuple[str, int, int]] | None = None  # of the frame before
    parts, counts = defaultdict[str, list[tuple[str, int, int]]](list), Counter[str]()
    shown: dict[str, str] = {}  # nothing says whether it was a part that was exported
    for shard in shards:
        for key, members in frames_in(folder, shard):
            endings = [ending for ending, _ in members]
            for ending in set(endings) - wanted | {ending for ending in endings if endings.count(ending) > 1}:
                findings.error("unexpected", f"{shard}: {key}.{ending}", "a file, or twice", "each file of a frame once")  # fmt: skip
            if absent := wanted - set(endings):
                findings.error("missing", f"{shard}: {key}", f"no {', '.join(sorted(absent))}", f"all of {', '.join(sorted(wanted))}")  # fmt: skip
            if "json" not in endings:
                continue
            row = tars.row(shard, dict(members)["json"])
            if str(row["sample_id"]).replace(".", "_") != key:
                findings.error("sample_id", f"{shard}: {key}", row["sample_id"], "the key of its files")
            if row["split"] != shard.partition("-")[0]:
                findings.error("leak", f"{shard}: {key}", f"a row of {row['split']}", "the shard's split")
            name = "/".join(str(row[name]) for name in PLACE)
            own = parts[name]
            shown.setdefault(name, str(row["sample_id"]))
            begin, end = members[0][1].header, members[-1][1].offset + members[-1][1].size
            if own is last and own[-1][0] == shard:  # the flight goes on
                own[-1] = (shard, own[-1][1], end)
            else:
                own.append((shard, begin, end))
            last = own
            counts[name] += 1
    entries = [
        Entry(name, tuple(own), counts[name]) for name, own in parts.items() if name.count("/") == len(PLACE) - 1
    ]
    return tars, with_ids(entries, shown)


def frames_in(folder: Path, shard: str, begin: int = 0, end: int | None = None) -> Iterator[Frame]:
    """Yield the frames of a tar, or of bytes [begin, end) of it: the files of one stand together.

    Raises:
        InputError: as `_members`.
    """
    named = ((*name.partition(".")[::2], place) for name, place in _members(folder, shard, begin, end))
    for key, members in itertools.groupby(named, key=lambda one: one[0]):
        yield key, [(ending, place) for _, ending, place in members]


def _members(folder: Path, shard: str, begin: int, end: int | None) -> Iterator[tuple[str, Place]]:
    """Yield name and place of the files of a tar whose headers stand in bytes [begin, end).

    Raises:
        InputError: it is none, ends too soon, or holds something else.
    """
    with open_file(folder / shard, what="shard", tree=folder) as file:
        size = file.seek(0, 2)
        at, first, long_name = begin, begin, ""
        while at + BLOCK <= size:
            if end is not None and at >= end:
                return
            file.seek(at)
            block = file.read(BLOCK)
            if not any(block):
                return
            try:
                header = tarfile.TarInfo.frombuf(block, "utf-8", "strict")
            except (tarfile.HeaderError, UnicodeError) as error:
                raise InputError("not a tar", where=shard, got=f"{error} at byte {at:,}", expected="a header") from None
            content = at + BLOCK
            if not 0 <= header.size <= size - content:
                raise InputError("a tar that is cut short", where=shard, got=f"a file of {header.size:,} bytes at byte {at:,}", expected=f"{size - content:,} at most")  # fmt: skip
            if header.type == tarfile.GNUTYPE_LONGNAME and header.size <= MOST_NAME_BYTES:
                long_name = file.read(header.size).rstrip(b"\0").decode(errors="replace")
            elif header.type in (tarfile.REGTYPE, tarfile.AREGTYPE):
                yield long_name or header.name, Place(first, content, header.size)
                first, long_name = content + -(-header.size // BLOCK) * BLOCK, ""
            else:
                raise InputError("a tar with what is no file", where=shard, got=f"{header.name}: type {header.type!r}", expected="regular files")  # fmt: skip
            at = content + -(-header.size // BLOCK) * BLOCK
    raise InputError(
        "a tar that is cut short", where=shard, got=f"{size:,} bytes without an end", expected="two empty blocks"
    )
