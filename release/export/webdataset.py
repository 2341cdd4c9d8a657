"""WebDataset: tar shards in which the files of a frame stand together under one key.

    train-00000.tar     trajectory_1_ORI_frame_00000.depth.npy, .instance.png, .json, .rgb.png, then the next frame

A shard is a run of row groups of the release, so its size is bounded by the setting and one row group; its bytes depend
on the rows alone (no times, no owners). The JSON holds every column but the pictures.
"""

from __future__ import annotations

import tarfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

from cosfly.formats.frames import FrameFile
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_file
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.worker import advance
from release.columns import PICTURES, SPLIT_NAMES, TARGET_PICTURE
from release.export.contract import ExportConfig, ExportUnit, Files, FormatFacts, UnitFiles
from release.export.source import DEPTH_CODING, PART, Release, ReleasedRows, Span, picture, read_span

MB = 1024 * 1024
VERSION = "tar, keys sorted"
ENDINGS: dict[FrameFile, str] = {"rgb": "rgb.png", "depth": "depth.npy", "instance": "instance.png"}
PICTURE_COLUMNS = {column.name for column in PICTURES.values()}


def plan(release: Release, flights: list[ReleasedRows], cfg: ExportConfig) -> list[ExportUnit]:
    """Cut each split into shards of about `shard_mb`; a unit is one shard."""
    units = []
    for split in SPLIT_NAMES:
        groups: list[list[Span]] = []
        filled = 0.0
        for flight in (flight for flight in flights if flight.split == split):
            bytes_per_frame = flight.num_bytes / len(flight)
            for span in flight.spans:
                if not groups or filled >= cfg.shard_mb * MB:
                    groups.append([])
                    filled = 0.0
                groups[-1].append(span)
                filled += bytes_per_frame * (span.stop - span.start)
        for number, spans in enumerate(groups):
            frames = sum(span.stop - span.start for span in spans)
            units.append(ExportUnit(f"{split}-{number:05d}", frames, spans=tuple(spans), extra=split))
    return units


def write(release: Release, unit: ExportUnit, folder: Path, cfg: ExportConfig) -> UnitFiles:
    """Write one shard."""
    files = Files(folder)
    name, keys = f"{unit.name}.tar", set[str]()
    with (
        atomic_file(folder / name) as file,
        tarfile.open(fileobj=file, mode="w|", format=tarfile.GNU_FORMAT) as tar,
    ):
        for span in unit.spans:
            for row in read_span(release, span):
                key = row["sample_id"].replace(".", "_")  # a key ends at its first dot
                if key in keys or not PART.fullmatch(key):
                    raise InputError(
                        "the sample_id of a frame is repeated or is not a file name", where=unit.name, got=key
                    )
                keys.add(key)
                for ending, data in members(row, release):
                    tar.addfile(_header(f"{key}.{ending}", len(data)), BytesIO(data))
                advance()
    files.note(name)
    return files.written()


def members(row: dict[str, Any], release: Release) -> list[tuple[str, bytes]]:
    """Return the files of one frame, by their endings in order."""
    scalars = {name: value for name, value in row.items() if name not in PICTURE_COLUMNS}
    pictures = {ENDINGS[file]: picture(row, file) for file in release.modalities}
    if (target := scalars.pop(TARGET_PICTURE)) is not None:
        pictures["target.png"] = target["bytes"]
    return sorted({"json": (dump_json(scalars) + "\n").encode(), **pictures}.items())


def _header(name: str, size: int) -> tarfile.TarInfo:
    header = tarfile.TarInfo(name)
    header.size, header.mode = size, 0o644
    return header  # times, owners: zero


def finish(
    release: Release, units: Sequence[ExportUnit], written: Sequence[UnitFiles], folder: Path, cfg: ExportConfig
) -> FormatFacts:
    """Return how the shards are opened."""
    codings = {file: f"{ENDINGS[file]}, the released bytes" for file in release.modalities}
    if "depth" in codings:
        codings["depth"] = DEPTH_CODING.format(codings["depth"])
    first = units[0].extra
    last = sum(unit.extra == first for unit in units) - 1
    shards = f"{first}-{{00000..{last:05d}}}.tar" if last else f"{first}-00000.tar"
    splits = ", ".join(
        f"{split}: {sum(u.extra == split for u in units)} shards"
        for split in SPLIT_NAMES
        if any(u.extra == split for u in units)
    )
    return FormatFacts(
        version=VERSION,
        codings={**codings, "json": "every other column of the release, one object"},
        notes=[f"Splits: {splits}. A key is the sample_id, dots replaced by _."],
        how_to_open=f'import webdataset\nrows = webdataset.WebDataset("{shards}", shardshuffle=False).decode("rgb8")',
    )
