"""What a shard says of its rows beside them: the least and greatest value of each column, the names of pictures, who wrote the file.

Programs go by these without a look at the rows: a filter skips what the statistics exclude, a viewer shows the name.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from cosfly.products.frames import FILE_NAMES
from cosfly.reading.tables import arrow_errors, open_table, read_row_group
from release.columns import PICTURES, SCALAR_NAMES
from release.record import ReleaseRecord
from release.verify.findings import Findings


def check_shards(folder: Path, record: ReleaseRecord, findings: Findings) -> None:
    """Check the footers and names of all shards against their rows.

    Raises:
        InputError: a shard cannot be read.
    """
    named = {PICTURES[file].name: FILE_NAMES[file] for file in record.settings.modalities if file != "depth"}
    wanted = [*SCALAR_NAMES, *(f"{column}.path" for column in named)]
    writers = set()
    for shard in record.shards:
        path = folder / shard.path
        with open_table(path, tree=folder) as table:
            writers.add(table.metadata.created_by)
            for k in range(table.num_row_groups):
                rows = read_row_group(path, table, k, wanted)
                with arrow_errors(path):
                    _check_statistics(f"{shard.path}: row group {k}", table.metadata.row_group(k), rows, findings)
                    _check_names(rows, named, findings)
    told = record.provenance.versions.get("pyarrow")
    if record.part_of is None and told and writers and not any(f"version {told}" in (one or "") for one in writers):
        # A build that was broken off may have gone on with another version.
        findings.warn("provenance", "release.json: provenance.versions.pyarrow", told, f"that of the shards, {', '.join(map(str, sorted(writers, key=str)))}")  # fmt: skip


def _check_statistics(where: str, about: Any, rows: pa.Table, findings: Findings) -> None:
    """All values lie between the footer's least and greatest: rows beyond them would be skipped. Wider bounds cost time alone."""
    for j in range(about.num_columns):
        chunk = about.column(j)
        told = chunk.statistics if chunk.is_stats_set else None
        if told is None or not told.has_min_max or chunk.path_in_schema.split(".")[0] not in rows.column_names:
            continue
        for values in _leaf(rows, chunk.path_in_schema):
            found = pc.min_max(values).as_py()
            if found["min"] is not None and not told.min <= found["min"] <= found["max"] <= told.max:
                got, expected = (f"{low!r} to {high!r}" for low, high in ((told.min, told.max), (found["min"], found["max"])))  # fmt: skip
                findings.error("statistics", f"{where}: {chunk.path_in_schema}", f"{got} in the footer", f"{expected}, of the rows")  # fmt: skip


def _leaf(rows: pa.Table, path: str) -> Iterator[pa.Array]:
    """Yield the values of a primitive column by parquet's name of it: `decision`, `pose.x_m`, `caption_window.list.element`."""
    first, *members = path.split(".")
    values = rows.column(first)
    if members[:1] == ["list"]:
        yield pc.list_flatten(values)
    elif len(members) < 2:
        yield pc.struct_field(values, members) if members else values


def _check_names(rows: pa.Table, named: dict[str, str], findings: Findings) -> None:
    """A picture is called by its row's id."""
    ids = rows.column("sample_id").to_pylist()
    for column, file in named.items():
        for own, found in zip(ids, pc.struct_field(rows.column(column), ["path"]).to_pylist(), strict=True):
            if found != f"{own}_{file}":
                findings.error("name", f"{own}: {column}.path", repr(found), f"{own}_{file}")
