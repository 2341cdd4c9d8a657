"""Collect rows with their pictures into row groups, and lay out the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq

from cosfly.formats.frames import FILE_NAMES, FrameFile, as_depth_npy, frame_path
from cosfly.formats.playback import Track
from release import columns
from release.columns import PICTURES, Placement

# Values between two looks at the size of a page: with more a page takes a whole row group, twice in memory.
VALUES_A_BATCH = 4
MOST_ROWS = 1000  # of a row group: of small pictures it would hold more rows than memory should


class Rows:
    """Rows on their way into row groups of a size that viewers load one at a time."""

    def __init__(self, writer: pq.ParquetWriter, row_group_bytes: int) -> None:
        self._writer, self._most_bytes = writer, row_group_bytes
        self._rows: list[dict[str, Any]] = []
        self._num_bytes = 0

    def add(self, row: dict[str, Any], pictures: dict[FrameFile, bytes], track: Track, i: int) -> None:
        """Add a frame and its pictures."""
        for file, data in pictures.items():
            if file == "depth":
                data = as_depth_npy(data, frame_path(track.frame_folder(i), FILE_NAMES["depth"]))
                row[PICTURES[file].name] = data
            else:
                row[PICTURES[file].name] = {"bytes": data, "path": f"{row['sample_id']}_{FILE_NAMES[file]}"}
            self._num_bytes += len(data)
        self._rows.append(row)
        if self._num_bytes >= self._most_bytes or len(self._rows) >= MOST_ROWS:
            self.flush()

    def flush(self) -> None:
        if self._rows:
            table = pa.Table.from_pylist(self._rows, schema=self._writer.schema)
            self._writer.write_table(table, row_group_size=table.num_rows)
            self._rows, self._num_bytes = [], 0


def open_writer(sink: str | IO[bytes], schema: pa.Schema) -> pq.ParquetWriter:
    """Open a parquet file whose bytes depend on the rows alone.

    PNG files do not compress, so they are stored as they are; everything else is zstd. Statistics of pictures would
    only repeat their first bytes. The page index lets the hub's viewer read one row without its row group.
    """
    leaves: list[str] = []  # parquet's paths of the primitive columns
    for member in schema:
        inner = [child.name for child in member.type] if pa.types.is_struct(member.type) else []
        inner = ["list.element"] if pa.types.is_list(member.type) else inner
        leaves += [f"{member.name}.{name}" for name in inner] or [member.name]
    compression = {name: "none" if name.endswith(".bytes") else "zstd" for name in leaves}
    small = [name for name in leaves if name != PICTURES["depth"].name and not name.endswith(".bytes")]
    repeated = [name for name in small if name in schema.names and schema.field(name).type == pa.string()]
    return pq.ParquetWriter(
        sink,
        schema,
        compression=compression,
        use_dictionary=repeated,
        write_statistics=small,
        version="2.6",
        write_page_index=True,
        write_batch_size=VALUES_A_BATCH,
    )


@contextmanager
def points_writer(sink: IO[bytes]) -> Iterator[Callable[[Track, Placement], None]]:
    """Open a table of points; yield the function that adds all points of a track, a row group each."""
    schema = columns.points_schema()
    with pq.ParquetWriter(sink, schema, compression="zstd", version="2.6", write_page_index=True) as writer:

        def add(track: Track, placement: Placement) -> None:
            rows = [columns.point_row(track, i, placement) for i in range(len(track))]
            writer.write_table(pa.Table.from_pylist(rows, schema=schema))

        yield add
