"""Parquet files of bounded size, read row group by row group; damage becomes an InputError."""

import bisect
import contextlib
import io
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cosfly.runtime.errors import InputError
from cosfly.runtime.io import FILE_MB, MB, SMALL_UNPACKED_MB, UNPACK_FACTOR, open_file, over_limit

MOST_FOOTER_BYTES = 100 * MB  # of the strings and lists of a footer; ours have some 10 kB
WORTH_THREADS_BYTES = 8 * MB  # of a row group; for smaller ones a single thread is faster and needs less memory
LEAST_ROW_BYTES = 1_000  # of a row as Python values; a million equal rows take only a few kB in the file
ITEM_BYTES = 40  # of an item of a list as a Python value; a list of a hundred million equal items takes 600 bytes
GROUPS_HELD = 4  # row groups that reading single rows keeps in memory
SMALLER_GROUPS = "write the file again with smaller row groups (row_group_size in pyarrow)"


@contextlib.contextmanager
def arrow_errors(path: Path | str) -> Iterator[None]:
    """Convert what pyarrow raises on a damaged file into an InputError."""
    try:
        yield
    except (pa.ArrowException, OSError, ValueError) as error:  # which one depends on the damaged byte
        fix = "copy or download the file again"
        raise InputError("the parquet file is damaged", where=path, got=str(error), fix=fix) from None


class _Table(pq.ParquetFile):
    """A parquet file."""

    def __init__(self, file: io.IOBase) -> None:
        limits = {"thrift_string_size_limit": MOST_FOOTER_BYTES, "thrift_container_size_limit": MOST_FOOTER_BYTES}
        super().__init__(file, **limits)
        texts = []
        for j in range(len(self.schema)):
            leaf = self.schema.column(j)
            if leaf.logical_type.type == "STRING" or self._has_dictionary(j):
                texts.append(leaf.path)
        # The same file, read with texts as dictionaries and indices.
        self.packed = pq.ParquetFile(file, metadata=self.metadata, read_dictionary=texts, **limits)

    def _has_dictionary(self, j: int) -> bool:
        """Return whether a column stores bytes by a dictionary; pictures are stored without, which is faster."""
        chunks = (self.metadata.row_group(k).column(j) for k in range(self.num_row_groups))
        return any(chunk.physical_type == "BYTE_ARRAY" and chunk.has_dictionary_page for chunk in chunks)


@contextlib.contextmanager
def open_table(path: Path, *, tree: Path | None = None) -> Iterator[_Table]:
    """Open a parquet file for its schema and metadata; InputError where it is damaged."""
    with open_file(path, what="parquet file", tree=tree) as file:
        with arrow_errors(path):
            table = _Table(file)
        with table:
            yield table


def row_groups(path: Path, columns: list[str] | None = None, *, tree: Path | None = None) -> Iterator[pa.Table]:
    """Yield the row groups of a parquet file one at a time; InputError over the limit."""
    with open_table(path, tree=tree) as table:
        for k in range(table.num_row_groups):
            yield read_row_group(path, table, k, columns)


def read_row_group(path: Path | str, table: _Table, k: int, columns: list[str] | None) -> pa.Table:
    """Read one row group of an open table; texts are unpacked once their total size is known."""
    _check_size(path, table, k)
    metadata = table.metadata.row_group(k)
    use_threads = metadata.total_byte_size > WORTH_THREADS_BYTES
    with arrow_errors(path):
        group = table.packed.read_row_group(k, columns=columns, use_threads=use_threads)
        size = sum(_text_bytes(chunk) for column in group.columns for chunk in column.chunks)
    stored = sum(metadata.column(j).total_compressed_size for j in range(metadata.num_columns))
    if size > max(SMALL_UNPACKED_MB * MB, UNPACK_FACTOR * stored):
        got = f"{stored:,} stored bytes, which decompress to {size:,} bytes of text"
        raise over_limit(f"{path}: row group {k}", got, f"{UNPACK_FACTOR} times the stored bytes", SMALLER_GROUPS)
    with arrow_errors(path):
        fields = [field.with_type(_unpacked_type(field.type)) for field in group.schema]
        return group.cast(pa.schema(fields, group.schema.metadata))


def _text_bytes(values: pa.Array) -> int:
    """Return the number of bytes of packed texts after unpacking, also inside lists and structs."""
    if pa.types.is_dictionary(values.type):
        lengths = pc.binary_length(values.dictionary).cast(pa.int64())
        return pc.sum(lengths.take(values.indices)).as_py() or 0
    if pa.types.is_struct(values.type):
        return sum(map(_text_bytes, values.flatten()))
    return _text_bytes(values.flatten()) if pa.types.is_list(values.type) else 0


def _unpacked_type(kind: pa.DataType) -> pa.DataType:
    """Return the type with its texts unpacked."""
    if pa.types.is_struct(kind):
        return pa.struct([field.with_type(_unpacked_type(field.type)) for field in kind])
    if pa.types.is_list(kind):
        return pa.list_(kind.value_field.with_type(_unpacked_type(kind.value_type)))
    return kind.value_type if pa.types.is_dictionary(kind) else kind


def row_batches(path: Path | str, table: _Table, k: int, columns: list[str], num_rows: int) -> Iterator[pa.RecordBatch]:
    """Yield one row group of an open table in batches, which reuse the same memory."""
    _check_size(path, table, k)
    with arrow_errors(path):
        yield from table.iter_batches(num_rows, row_groups=[k], columns=columns, use_threads=False)


def _check_size(path: Path | str, table: _Table, k: int) -> None:
    metadata = table.metadata.row_group(k)
    size = max(metadata.total_byte_size, metadata.num_rows * LEAST_ROW_BYTES)
    if size > FILE_MB * MB:
        raise over_limit(f"{path}: row group {k}", f"{size / MB:,.0f} MB", f"{FILE_MB:,} MB", SMALLER_GROUPS)
    chunks = [metadata.column(j) for j in range(metadata.num_columns)]
    num_items = sum(chunk.num_values - metadata.num_rows for chunk in chunks)  # a list of n items counts n - 1
    stored = sum(chunk.total_compressed_size for chunk in chunks)
    most = max(SMALL_UNPACKED_MB * MB, UNPACK_FACTOR * stored) / ITEM_BYTES
    if num_items > most:
        raise over_limit(f"{path}: row group {k}", f"lists of {num_items:,} items", f"{most:,.0f}", SMALLER_GROUPS)


def rows_of(path: Path, columns: list[str] | None = None, *, tree: Path | None = None) -> Iterator[dict[str, Any]]:
    """Yield the rows of a parquet file."""
    for group in row_groups(path, columns, tree=tree):
        with arrow_errors(path):  # for text that is not UTF-8
            yield from group.to_pylist()


class TableRows(Sequence[dict[str, Any]]):
    """The rows of a parquet file by index. Each process opens the file once and keeps a few row groups in memory."""

    def __init__(self, path: Path, columns: list[str]) -> None:
        self._path = path
        self._columns = columns
        self._stack = contextlib.ExitStack()  # keeps the file open
        self._process = -1  # the process that has opened it
        self._lock = threading.Lock()
        self._starts: list[int] = []  # index of the first row of each group, then the number of rows
        self._group: Callable[[int], pa.Table]  # set by `_open`

    def __reduce__(self) -> tuple:
        return type(self), (self._path, self._columns)

    def _open(self) -> None:
        if self._process != os.getpid():  # a fork shares the position in the open file with its parent
            table = self._stack.enter_context(open_table(self._path))
            if missing := sorted(set(self._columns) - set(table.schema_arrow.names)):
                noun = "column" if len(missing) == 1 else "columns"
                raise InputError(f"the table does not have the {noun} {', '.join(missing)[:200]}", where=self._path)
            counts = (table.metadata.row_group(k).num_rows for k in range(table.num_row_groups))
            self._starts = list(accumulate(counts, initial=0))
            self._group = lru_cache(GROUPS_HELD)(lambda k: read_row_group(self._path, table, k, self._columns))
            self._process = os.getpid()
            self._lock = threading.Lock()

    def __len__(self) -> int:
        self._open()
        return self._starts[-1]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return rows_of(self._path, self._columns)

    def __getitem__(self, index: int) -> dict[str, Any]:  # type: ignore[override]  # one row at a time
        if not 0 <= index < len(self):
            raise IndexError(f"row {index} does not exist: the table has {len(self)} rows")
        k = bisect.bisect_right(self._starts, index) - 1
        with self._lock:
            group = self._group(k)
        with arrow_errors(self._path):
            return group.slice(index - self._starts[k], 1).to_pylist()[0]
