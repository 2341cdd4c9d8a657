"""WebDataset: tar shards in which the files of a frame follow each other under one key, for `webdataset` and for
`load_dataset("webdataset")` of `datasets`.

    train-00000.tar     trajectory_1_ORI_frame_00000.depth.npy, .instance.png, .json, ..., then the next frame

All frames have the same files of the same types, because `datasets` takes the types from the first frames. `json` has
the texts, flags and numbers that no frame lacks; a missing text is empty. A number or a list that a frame may lack is a
float64 array of its own: NaN, or an array without elements. The bytes depend on the rows alone.
"""

import tarfile
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np

from cosfly.formats.frames import FILE_NAMES
from cosfly.runtime.console import Advance
from cosfly.runtime.io import atomic_file
from cosfly.runtime.json_io import dump_json
from release.columns import SCALARS, TARGET_PICTURE, Column
from release.export.stage import ExportConfig, ExportSource, FormatFacts, SourceTrack, key_of, shards
from release.reading import Row

TEXTS = ("string", "texts", "events")
MOST_FRAMES = 100  # of a piece, the smallest part of a shard


def write(source: ExportSource, folder: Path, cfg: ExportConfig, advance: Advance) -> FormatFacts:
    """Cut each split into shards of about `shard_mb`, and write them."""
    pieces = (part for track in source.tracks() for part in track.cut([*range(0, len(track), MOST_FRAMES), len(track)]))
    counts = Counter[str]()  # split -> shards
    for name, pieces_of_shard in shards(pieces, cfg.shard_mb):
        _write_shard(folder / f"{name}.tar", pieces_of_shard, advance)
        counts[name.rpartition("-")[0]] += 1
    first = next(iter(counts))
    last = counts[first] - 1
    names = f"{first}-{{00000..{last:05d}}}.tar" if last else f"{first}-00000.tar"
    values = {"num_shards": counts, "first_split": first, "first_shards": names}
    return FormatFacts(values, split_files={split: f"{split}-*.tar" for split in counts})


def _write_shard(path: Path, pieces: Iterator[SourceTrack], advance: Advance) -> None:
    with atomic_file(path) as file, tarfile.open(fileobj=file, mode="w|", format=tarfile.GNU_FORMAT) as tar:
        for row, pictures in (frame for piece in pieces for frame in piece.frames()):
            files: dict[str, bytes] = {FILE_NAMES[file]: data for file, data in pictures.items()}
            for ending, data in sorted((files | dict(members(row))).items()):
                header = tarfile.TarInfo(f"{key_of(row['sample_id'])}.{ending}")  # without times and owners
                header.size, header.mode = len(data), 0o644
                tar.addfile(header, BytesIO(data))
            advance(1)


def members(row: Row) -> Iterator[tuple[str, bytes]]:
    """Yield the files of one frame by their endings, but for its pictures."""
    in_json = {}
    for column in SCALARS:
        if column.name == TARGET_PICTURE:
            continue
        value = row[column.name]
        if column.type in TEXTS:
            in_json[column.name] = _text(value)
        elif (column.required and not column.of_caption) or column.name == "has_caption":
            in_json[column.name] = value
        else:
            buffer = BytesIO()
            np.save(buffer, _numbers(column, value))
            yield f"{column.name}.npy", buffer.getvalue()
    yield "json", (dump_json(in_json) + "\n").encode()


def _text(value: object) -> str:
    """Return a text, the texts of a list, or those of a struct by their names; "" for none."""
    if isinstance(value, dict):
        value = [f"{name} {text}" for name, text in value.items() if text]
    return ", ".join(value) if isinstance(value, list) else str(value or "")


def _numbers(column: Column, value: object) -> np.ndarray:
    if isinstance(column.type, tuple):
        members = value if isinstance(value, dict) else {}
        return np.array([members.get(name) for name in column.type], np.float64)
    if column.type in ("numbers", "indices"):
        return np.array(value or [], np.float64)
    return np.array([value], np.float64)
