"""Columns of numbers in JSON products."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cosfly.geometry.axes import step_s
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.json_io import MISSING, FileFormat, check_schema, read_json, write_json

Item = TypeVar("Item")

XYZ, ANGLES = ("x", "y", "z"), ("pitch", "yaw", "roll")
POSE = XYZ + ANGLES
FARTHEST_M = 1e7  # of a place from the origin of its map: coordinates of a country, which no kernel was made beyond
LARGEST = 1e18  # no length or time is larger in any unit, and no square or sum of such numbers overflows


def is_number(value: Any) -> bool:
    """Return whether a JSON value is a number of at most LARGEST; true and false are not numbers."""
    return type(value) in (int, float) and abs(value) <= LARGEST


def rounded(vector: np.ndarray, digits: int = 6) -> list[float]:
    """Return a vector, (n,) m, rounded for a file."""
    return [round(float(v), digits) + 0.0 for v in vector]  # + 0.0 turns -0.0 into 0.0


def records(value: dict, name: str, where: Path | str) -> list[dict]:
    """Read a list of objects; raises InputError for anything else."""
    entries = value.get(name)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        what = "the field is missing or is not a list of objects"
        raise InputError(what, where=f"{where}: {name}", expected="a list of objects")
    return entries


def read_items(path: Path, form: FileFormat, name: str, parse: Callable[[dict, str], Item]) -> list[Item]:
    """Read the items of a product; `parse` converts a record and its place, for messages, to an item."""
    value = check_schema(read_json(path, what=form.what), form, path)
    return [parse(record, f"{path}: {name}[{i}]") for i, record in enumerate(records(value, name, path))]


def write_items(path: Path, form: FileFormat, name: str, items: list[Any], header: dict[str, Any]) -> None:
    """Write what `read_items` reads; `header` holds further fields, such as the name of the map and the seed."""
    write_json(path, {**form.header, **header, name: [item.as_json() for item in items]}, indent=None)


def step_field(items: list[Any]) -> dict[str, float | None]:
    """Return the time step of a product's items."""
    return {"dt_s": round(step_s(items[0].time_s), 6) if items else None}


def text_id(record: dict, where: str) -> str:
    """Read the `id` of a record; raises InputError if it is missing or not text."""
    value = record.get("id")
    if value is None:
        raise InputError(MISSING, where=f"{where}.id", expected="text")
    if not isinstance(value, str):
        raise InputError("the id is not text", where=f"{where}.id", got=shown(value), expected="text")
    return value


def numbers(value: Any, *shape: int | None) -> np.ndarray | None:
    """Return nested lists of numbers as float64 of a shape, in which None is any length.

    Return None for another shape or content, or if a number is not finite or exceeds LARGEST.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    if array.ndim != len(shape) or any(side not in (None, n) for side, n in zip(shape, array.shape, strict=True)):
        return None
    return array if (np.abs(array) <= LARGEST).all() else None  # NaN fails


def column(record: dict, name: str, where: str, *shape: int | None) -> np.ndarray:
    """Read numbers of a shape, in which None is any length but 0; raises InputError for anything else."""
    shape_text = str(tuple("n" if side is None else side for side in shape)).replace("'", "")
    expected = f"finite numbers of shape {shape_text}" + (" with n of at least 1" if None in shape else "")
    values = numbers(record.get(name), *shape)
    if values is None or len(values) == 0:
        what = "the field has a wrong shape, or a value that is not a finite number" if name in record else MISSING
        got = shown(record[name]) if name in record else None
        raise InputError(what, where=f"{where}.{name}", got=got, expected=expected)
    return values


def columns(record: dict, names: Iterable[str], where: str, length: int | None = None) -> np.ndarray:
    """Read columns of one length as one array, (n, number of names) float64."""
    arrays: list[np.ndarray] = []
    for name in names:
        arrays.append(column(record, name, where, len(arrays[0]) if arrays else length))
        if name in XYZ and not (np.abs(arrays[-1]) <= FARTHEST_M).all():
            got = f"{np.abs(arrays[-1]).max():g} m"
            expected = f"at most {FARTHEST_M:,.0f} m"
            raise InputError("a place is too far from the origin", where=f"{where}.{name}", got=got, expected=expected)
    return np.stack(arrays, axis=1)


def times(record: dict, where: str) -> np.ndarray:
    """Read `t`, the time stamps of a trajectory, (n,) s; raises InputError if they do not increase."""
    time_s = column(record, "t", where, None)
    if not (np.diff(time_s) > 0).all():
        k = int(np.argmin(np.diff(time_s)))
        got = f"{time_s[k]:g} s, then {time_s[k + 1]:g} s"
        raise InputError("the times do not increase", where=f"{where}.t", got=got, expected="increasing times")
    return time_s


def as_columns(values: np.ndarray, names: Iterable[str]) -> dict[str, list[float]]:
    """Return columns in the form that `columns` reads, to four decimals."""
    return {name: rounded(values[:, k], 4) for k, name in enumerate(names)}
