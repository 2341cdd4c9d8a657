"""A forger's kit."""

import json
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from caption.stage.released import read_released
from cosfly.formats.frames import depth_bytes
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_file
from cosfly.runtime.json_io import read_json, write_json
from release import columns
from release.build.shards import open_writer, points_part
from release.build.stage import name_shards, write_records
from release.counting import count_release, numbers_of
from release.record import (
    ReleasedFlight,
    ReleaseRecord,
    Shard,
    StoredFile,
    digest_of,
    numbers_of_splits,
    read_record,
)
from release.verify.verify import verify

Row = dict[str, Any]
CONSTANT = [column.name for column in columns.POINTS if column.constant]


def forge(
    dataset: Path,
    out: Path,
    change: Callable[[list[Row]], None] = lambda rows: None,
    change_record: Callable[[dict[str, Any]], None] = lambda record: None,
) -> Path:
    """Copy a release, change all of its rows together, then its record, and make everything that counts or hashes them
    right again."""
    record = read_record(dataset / "release.json")
    shards = [pq.read_table(dataset / shard.path).to_pylist() for shard in record.shards]
    tables = [pq.read_table(dataset / shard.points.path).to_pylist() for shard in record.shards]
    of_row = _points_of(shards, tables)
    all_rows = [row for rows in shards for row in rows]
    change(all_rows)
    for row, point, track in of_row:  # the points of changed rows say the same
        for other in track:
            other.update({name: row[name] for name in CONSTANT})
        point.update({name: row[name] for name in point})
    parts = out.with_name("parts")
    for folder in (out, parts):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    written, schema = [], columns.schema(record.settings.modalities)
    for old, rows, points in zip(record.shards, shards, tables, strict=True):
        part = parts / f"{len(written)}.parquet"
        with open_writer(str(part), schema) as writer:
            for at in range(0, len(rows), 50):
                writer.write_table(pa.Table.from_pylist(rows[at : at + 50], schema=schema))
        pq.write_table(pa.Table.from_pylist(points, schema=columns.points_schema()), points_part(part))
        written.append((part, Shard(split=old.split, points=_stored(points_part(part)), **vars(_stored(part)))))
    entries = name_shards(written, out)
    flights = _flights(record, all_rows)
    with_caption = Counter(row["split"] for row in all_rows if row["has_caption"])
    captions = with_caption.total()
    history = record.history.model_copy(deep=True)
    history.captions.read += captions - history.captions.released
    history.captions.released = captions
    history.captions.frames_without = {"forged": len(all_rows) - captions}
    splits = record.splits.model_copy(update={"splits": numbers_of_splits(flights, with_caption)})
    update: dict[str, Any] = {"shards": entries, "content_digest": digest_of(entries), "flights": flights}
    record = record.model_copy(update=update | {"splits": splits, "history": history})
    with suppress(InputError):  # rows that cannot be counted keep the numbers of the honest ones
        computed = numbers_of(count_release(out, entries), record.settings.num_frames)
        record = record.model_copy(update={"numbers": computed})
    values = record.model_dump(mode="json")
    change_record(values)
    write_records(out, ReleaseRecord.model_validate_json(json.dumps(values)))
    return out


def _stored(path: Path) -> StoredFile:
    rows = pq.read_metadata(path).num_rows
    return StoredFile(path=str(path), rows=rows, bytes=path.stat().st_size, sha256=sha256_file(path))


def _points_of(shards: list[list[Row]], tables: list[list[Row]]) -> list[tuple[Row, Row, list[Row]]]:
    """Return each row with its point and all points of its track."""
    tracks: dict[tuple, list[Row]] = defaultdict(list)
    for point in (point for points in tables for point in points):
        tracks[tuple(point[name] for name in columns.PLACE)].append(point)
    of_rows = [(row, tracks[tuple(row[name] for name in columns.PLACE)]) for rows in shards for row in rows]
    return [(row, track[row["frame_index"]], track) for row, track in of_rows]


def rewrite(folder: Path, change: Callable[[list[Row]], object]) -> None:
    """Change rows of a shard, and of what tells of it only its size."""
    path = next((folder / "data").glob("*.parquet"))
    table = pq.read_table(path)
    rows = table.to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), path, row_group_size=12)
    record = read_json(folder / "release.json")
    next(shard for shard in record["shards"] if shard["path"].endswith(path.name))["bytes"] = path.stat().st_size
    write_json(folder / "release.json", record)


def errors_in(folder: Path, level: str = "pixels", **how: Any) -> dict[str, int]:
    report = verify(folder, level=level, reader=read_released, **how)
    return {kind.code: kind.count for kind in report.issues if kind.severity == "error"}


def _flights(record: ReleaseRecord, rows: list[Row]) -> list[ReleasedFlight]:
    known = {flight.flight: flight for flight in record.flights}
    frames: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        frames["/".join(row[name] for name in columns.PLACE)].append(row)
    return [
        ReleasedFlight(
            flight=name, frames=len(own), split=own[0]["split"], walk=own[0]["walk"], pair=own[0]["pair"],
            frames_available=known[name].frames_available if name in known else len(own),
        )
        for name, own in frames.items()
    ]  # fmt: skip


def depth_of(row: Row) -> np.ndarray:
    return np.load(BytesIO(row["depth"]))


def set_depth(row: Row, depth: np.ndarray) -> None:
    row["depth"] = depth_bytes(depth)
