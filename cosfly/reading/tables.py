"""Parquet files: opened as any other file, and what pyarrow says of damage becomes an InputError."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from cosfly.errors import InputError
from cosfly.reading.files import open_file
from cosfly.reading.limits import MB, limits, over_limit

MOST_FOOTER_BYTES = 100 * MB  # what the footer's strings and lists may take; ours have some 10 kB

LEAST_ROW_BYTES = 1_000  # of a row in memory, as values of Python: packed, a million equal ones are a few kB


@contextlib.contextmanager
def arrow_errors(path: Path) -> Iterator[None]:
    """Turn what pyarrow raises on a damaged file into an InputError; only its calls stand in it."""
    try:
        yield
    except (pa.ArrowException, OSError, ValueError) as error:  # damage shows as what depends on the byte
        raise InputError("not a whole parquet file", where=path, got=str(error)) from None


@contextlib.contextmanager
def open_table(path: Path, *, tree: Path | None = None) -> Iterator[pq.ParquetFile]:
    """Open a parquet file for its schema and metadata.

    Raises:
        InputError: as `open_file`; or it is no whole parquet file.
    """
    with open_file(path, what="parquet file", tree=tree) as file:
        with arrow_errors(path):
            table = pq.ParquetFile(
                file,
                thrift_string_size_limit=MOST_FOOTER_BYTES,
                thrift_container_size_limit=MOST_FOOTER_BYTES,
            )
        with table:
            yield table


def num_rows(path: Path) -> int:
    """Give the number of rows; raises as `open_table`."""
    with open_table(path) as table:
        return table.metadata.num_rows


def row_groups(
    path: Path, columns: list[str] | None = None, *, tree: Path | None = None, wanted: Collection[int] | None = None
) -> Iterator[pa.Table]:
    """Yield the row groups of a parquet file, of these numbers or all, in memory one at a time; raises as `open_table`, and for one over the limit."""
    with open_table(path, tree=tree) as table:
        for k in range(table.num_row_groups):
            if wanted is not None and k not in wanted:
                continue
            about = table.metadata.row_group(k)
            size = max(about.total_byte_size, about.num_rows * LEAST_ROW_BYTES)
            if size > limits().file_mb * MB:
                raise over_limit("file_mb", f"{path}: row group {k}", f"{size / MB:,.0f} MB", " MB")
            with arrow_errors(path):
                group = table.read_row_group(k, columns=columns)
            yield group


def rows_of(path: Path, columns: list[str] | None = None, *, tree: Path | None = None) -> Iterator[dict[str, Any]]:
    """Yield the rows of a parquet file; raises as `row_groups`."""
    for group in row_groups(path, columns, tree=tree):
        with arrow_errors(path):  # text that is no UTF-8 shows here
            rows = group.to_pylist()
        yield from rows
