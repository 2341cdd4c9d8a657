"""Read a release: its rows, checked for what every reader relies on, and its tracks with frames and points, in order.

Memory holds a row group and the points of one shard, however large the release is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from cosfly.runtime.errors import InputError
from cosfly.runtime.tables import arrow_errors, row_groups
from release.columns import PICTURES, PLACE, POINT_NAMES, REQUIRED, SCALAR_NAMES, flight_name, points_schema, schema
from release.flight_rows import FlightRows
from release.record import POINTS_FOLDER, Shard

LARGEST = 1e9  # of a value: beyond any town, track and picture


def bounded(value: float) -> float:
    """Return a value that a track can have; raise InputError if it is no finite number, or beyond LARGEST."""
    if not -LARGEST < value < LARGEST:  # NaN is not
        expected = f"a number from {-LARGEST:g} to {LARGEST:g}"
        raise InputError("a number of a track is out of range", where="data", got=str(value), expected=expected)
    return value


def row_lists(
    shard: Path, columns: Sequence[str], *, strict: bool = True, part: tuple[int, int, int] | None = None
) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of a parquet file of a release, a row group at a time.

    Args:
        strict: Raise InputError if a column is not that of a release, a value that must be there is null, or a number
            is not finite. part: Number of a row group, and its first row and the one after its last that are wanted,
            of a file whose columns are known to be those of a release.
    """
    for group in row_groups(shard, list(columns), tree=shard.parents[1], wanted=part and part[:1]):
        if part is not None:
            group = group.slice(part[1], part[2] - part[1])
        elif strict:
            check_columns(group, columns, shard)
        if strict:
            _check_values(group, shard)
        with arrow_errors(shard):  # text that is no UTF-8 shows here
            rows = group.to_pylist()
        del group
        yield rows
        del rows


def _check_values(group: pa.Table, shard: Path) -> None:
    for member in group.schema:
        column = group.column(member.name)
        wanted = 0 if member.name in REQUIRED else column.null_count
        is_struct = pa.types.is_struct(member.type)
        parts = [pc.struct_field(column, i) for i in range(member.type.num_fields)] if is_struct else []
        is_plain = all(pa.types.is_floating(part.type) for part in parts)  # words may be missing
        if any(part.null_count > wanted for part in (column, *(parts if is_plain else ()))):
            where, expected = f"{shard}: {member.name}", "a value in every row"
            raise InputError("a required value is missing in a row", where=where, got="null", expected=expected)
        for part in parts or [column]:
            if pa.types.is_floating(part.type) and pc.all(pc.is_finite(part)).as_py() is False:
                raise InputError("a number is not finite", where=f"{shard}: {member.name}")


def check_columns(group: pa.Table, columns: Iterable[str], shard: Path) -> None:
    """Check that columns of a row group are those of a release."""
    wanted = points_schema() if shard.parent.name == POINTS_FOLDER else schema(tuple(PICTURES))
    for name in columns:
        found = group.schema.field(name).type if group.schema.get_field_index(name) >= 0 else None
        if found != wanted.field(name).type:
            what, where = "the columns of the shard are not those of a release", f"{shard}: {name}"
            got = "no column of this name" if found is None else str(found)
            raise InputError(what, where=where, got=got, expected=str(wanted.field(name).type))


def read_tracks(
    folder: Path, shard: Shard, columns: Sequence[str] = SCALAR_NAMES, *, strict: bool = True
) -> Iterator[tuple[FlightRows, FlightRows]]:
    """Yield the tracks of a shard in order: the rows of the released frames, and those of all points.

    Args:
        columns: Of the frames, besides PLACE; never pictures. strict: As in `row_lists`.
    Raises:
        InputError: Frames and points are not of the same tracks in the same order.
    """
    names = [*PLACE, *(name for name in columns if name not in PLACE)]
    both = [
        groupby(chain.from_iterable(row_lists(folder / file.path, wanted, strict=strict)), itemgetter(*PLACE))
        for file, wanted in ((shard, names), (shard.points, POINT_NAMES))
    ]
    points = both[1]
    for place, frames in both[0]:
        own, of_points = next(points, (None, ()))
        if own != place:
            got = "no track" if own is None else flight_name(own)
            what = "the points of a shard are not those of its tracks"
            raise InputError(what, where=folder / shard.points.path, got=got, expected=flight_name(place))
        name = flight_name(place)
        yield FlightRows(name, list(frames)), FlightRows(name, list(of_points))
    if (more := next(points, None)) is not None:
        what = "the points of a shard are not those of its tracks"
        raise InputError(what, where=folder / shard.points.path, got=flight_name(more[0]), expected="no further track")
