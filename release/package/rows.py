"""Rows on their way into a shard: pictures in memory that is used again, from where parquet takes them, and how the
file is laid out."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import mmap
import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel

from cosfly.products.frames import FILE_NAMES, FrameFile, depth_bytes, depth_values, frame_path, is_packed
from cosfly.products.places import sample_id
from cosfly.products.playback import Flight
from cosfly.reading.files import read_into
from release import columns
from release.columns import PICTURES

BLOCK = 4 * 1024 * 1024  # bytes that are handed to the disk at once
NUM_BLOCKS = 3  # one is filled, one is written, one waits
DIRECT = getattr(os, "O_DIRECT", 0)  # Linux


class HashedFile:
    """What parquet writes to: blocks are filled here, and a thread hashes them and writes them to an open, empty file.

    Where the file system can, the blocks go past the page cache: a copy into it costs the processor more than the
    digest does, and nobody reads a shard soon. A block stands at a page's begin and is whole pages long, as that way of
    writing asks for, so the last one is padded and the file then cut to its length.
    """

    closed = False  # whoever opened the file closes it

    def __init__(self, file: IO[bytes]) -> None:
        self._number, self._sha256, self._size = file.fileno(), hashlib.sha256(), 0
        self._is_direct = _set_direct(self._number, True)
        self._blocks = deque(mmap.mmap(-1, BLOCK) for _ in range(NUM_BLOCKS))
        self._filled = 0  # of the first block
        self._on_the_way: deque[Future[None]] = deque()
        self._thread = ThreadPoolExecutor(1)

    def __enter__(self) -> HashedFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown(cancel_futures=True)

    def write(self, data: bytes) -> int:
        """Take bytes; raises OSError, also for those of an earlier call."""
        view = memoryview(data)
        while view:
            part = view[: BLOCK - self._filled]
            self._blocks[0][self._filled : self._filled + len(part)] = part
            self._filled += len(part)
            view = view[len(part) :]
            if self._filled == BLOCK:
                self._hand_over()
        self._size += len(data)
        return len(data)

    def finish(self) -> tuple[int, str]:
        """Write what is left; gives the number of bytes and their sha256. Raises OSError."""
        self._hand_over()
        while self._on_the_way:
            self._on_the_way.popleft().result()
        os.ftruncate(self._number, self._size)
        _set_direct(self._number, False)
        return self._size, self._sha256.hexdigest()

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        """Nothing: the file's owner flushes it before it gets its name."""

    def close(self) -> None:
        """Nothing, as `flush`."""

    def _hand_over(self) -> None:
        self._on_the_way.append(self._thread.submit(self._store, self._blocks[0], self._filled))
        self._blocks.rotate(-1)
        self._filled = 0
        if len(self._on_the_way) == NUM_BLOCKS:  # the block that comes next is still on its way
            self._on_the_way.popleft().result()

    def _store(self, block: mmap.mmap, size: int) -> None:
        view = memoryview(block)
        self._sha256.update(view[:size])
        rest = view[: -(-size // mmap.PAGESIZE) * mmap.PAGESIZE]
        while rest:
            try:
                rest = rest[os.write(self._number, rest) :]
            except OSError as error:
                if error.errno != errno.EINVAL or not self._is_direct:
                    raise
                self._is_direct = _set_direct(self._number, False)  # it asks for more than whole pages


def _set_direct(number: int, wanted: bool) -> bool:
    """Have a file written past the page cache, or not; tells whether it now is."""
    if not DIRECT:
        return False
    flags = fcntl.fcntl(number, fcntl.F_GETFL)
    try:
        fcntl.fcntl(number, fcntl.F_SETFL, flags | DIRECT if wanted else flags & ~DIRECT)
    except OSError:  # the file system has no such way
        return False
    return wanted


# Values between two looks at the size of a page: with more a page takes a whole row group, twice in memory.
VALUES_A_BATCH = 4
MOST_ROWS = 1000  # of a row group: of small pictures it would hold more rows than memory should


class ShardPlan(BaseModel):
    """How rows are chosen and cut."""

    num_frames: int | None
    window_frames: int
    uniform_stride: bool
    files: tuple[FrameFile, ...]
    row_group_bytes: int


class _Column:
    """The files of one picture column of a row group, one after the other in memory that every row group uses again."""

    def __init__(self, num_bytes: int) -> None:
        # The last file goes beyond; pages that nobody writes to take no memory.
        self._memory = np.empty(2 * num_bytes, np.uint8)
        self.ends = [0]  # of the files that are kept, from byte 0 on
        self._last = 0  # end of the one that was read last

    def read(self, path: Path, tree: Path | None) -> memoryview:
        """Read a file behind those that are kept; gives its bytes, which the next one replaces."""
        size = read_into(path, self._room, what="frame's file", fix="render it again", tree=tree)
        return self._set(size)

    def replace(self, data: bytes) -> None:
        """Put other bytes in the place of the file that was read last."""
        self._room(len(data))[:] = data
        self._set(len(data))

    def keep(self) -> int:
        """Keep the file that was read last; gives its size."""
        self.ends.append(self._last)
        return self.ends[-1] - self.ends[-2]

    def last(self) -> memoryview:
        return self._memory.data[self.ends[-1] : self._last]

    def clear(self) -> None:
        self.ends, self._last = [0], 0

    def array(self) -> pa.Array:
        """Give the files as binary values; nothing is copied."""
        offsets = pa.py_buffer(np.array(self.ends, np.int32))
        return pa.Array.from_buffers(pa.binary(), len(self.ends) - 1, [None, offsets, pa.py_buffer(self._memory)])

    def _room(self, size: int) -> memoryview:
        begin = self.ends[-1]
        if begin + size > len(self._memory):
            grown = np.empty(2 * (begin + size), np.uint8)
            grown[:begin] = self._memory[:begin]
            self._memory = grown
        return self._memory.data[begin : begin + size]

    def _set(self, size: int) -> memoryview:
        self._last = self.ends[-1] + size
        return self.last()


class Rows:
    """Rows on their way into row groups of a size that viewers load one at a time."""

    def __init__(self, writer: pq.ParquetWriter, plan: ShardPlan) -> None:
        self._writer, self._plan = writer, plan
        self.pictures = {file: _Column(plan.row_group_bytes) for file in PICTURES if file in plan.files}
        self._scalars: list[dict[str, Any]] = []
        self._paths: list[str] = []
        self._num_bytes = 0

    def add(self, scalars: dict[str, Any], flight: Flight, i: int, *, keep: bool) -> None:
        """Add a frame whose pictures were read. keep: False where nothing will be written any more."""
        depth = self.pictures.get("depth")
        if depth is not None and is_packed(depth.last()):
            where = frame_path(flight.frame_folder(i), FILE_NAMES["depth"])
            depth.replace(depth_bytes(depth_values(depth.last(), where)))
        if not keep:
            return
        self._scalars.append(scalars)
        self._paths.append(sample_id(flight.flight_id, i))
        self._num_bytes += sum(column.keep() for column in self.pictures.values())
        if self._num_bytes >= self._plan.row_group_bytes or len(self._scalars) >= MOST_ROWS:
            self.flush()

    def flush(self) -> None:
        if not self._scalars:
            return
        schema = columns.schema(self._plan.files)
        arrays = [
            self._array(file, column, schema.field(PICTURES[file].name).type) for file, column in self.pictures.items()
        ]
        scalars = pa.Table.from_pylist(
            self._scalars, schema=pa.schema([schema.field(name) for name in columns.SCALAR_NAMES])
        )
        table = pa.Table.from_arrays([*arrays, *scalars.columns], schema=schema)
        self._writer.write_table(table, row_group_size=table.num_rows)
        for column in self.pictures.values():
            column.clear()
        self._scalars, self._paths, self._num_bytes = [], [], 0

    def _array(self, file: FrameFile, column: _Column, kind: pa.DataType) -> pa.Array:
        if not pa.types.is_struct(kind):
            return column.array()
        paths = pa.array([f"{stem}_{FILE_NAMES[file]}" for stem in self._paths], pa.string())
        return pa.StructArray.from_arrays([column.array(), paths], fields=list(kind))


def open_writer(sink: str | pa.NativeFile, schema: pa.Schema) -> pq.ParquetWriter:
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
