"""Columns of numbers in JSON products."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cosfly.geometry.axes import step_s
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import MISSING, FileFormat, check_schema, read_json, write_json

Item = TypeVar("Item")

LARGEST = 1e18  # no length or time is larger in any unit, and no square or sum of such numbers overflows


def is_number(value: Any) -> bool:
    """Return whether a JSON value is a number no larger than a length or a time can be; true and false are none."""
    return type(value) in (int, float) and abs(value) <= LARGEST


def rounded(vector: np.ndarray, digits: int = 6) -> list[float]:
    """Return a vector, (n,) m, rounded for a file."""
    return [round(float(v), digits) + 0.0 for v in vector]  # + 0.0 turns -0.0 into 0.0


def records(value: dict, name: str, path: Path | str) -> list[dict]:
    """Read a list of objects, the first level of a product; raises InputError for anything else."""
    records = value.get(name)
    if not isinstance(records, list) or not all(isinstance(r, dict) for r in records):
        raise InputError("not a list of objects", where=f"{path}: {name}")
    return records


def read_items(path: Path, form: FileFormat, name: str, parse: Callable[[dict, str], Item]) -> list[Item]:
    """Read the items of a product, as `parse` makes them of a record and its place."""
    value = check_schema(read_json(path, what=form.what), form, path)
    return [parse(record, f"{path}: {name}[{i}]") for i, record in enumerate(records(value, name, path))]


def write_items(path: Path, form: FileFormat, name: str, items: list[Any], header: dict[str, Any]) -> None:
    """Write what `read_items` reads; `header` holds the map's name, the seed and what else a stage wants on record."""
    write_json(path, {**form.header, **header, name: [item.as_json() for item in items]}, indent=None)


def step_field(items: list[Any]) -> dict[str, float | None]:
    """Return the time step of a product's items."""
    return {"dt_s": round(step_s(items[0].time_s), 6) if items else None}


def text_id(record: dict, where: str) -> str:
    """Read the `id` of a record; raises InputError where it is missing or no text."""
    if record.get("id") is None:
        raise InputError(MISSING, where=f"{where}.id", expected="text")
    if not isinstance(record["id"], str):
        raise InputError("not an id", where=f"{where}.id", got=repr(record.get("id")), expected="text")
    return record["id"]


def numbers(value: Any, *shape: int | None) -> np.ndarray | None:
    """Return lists of numbers, one in another, as float64 of a shape, in which None is any length; None where they are
    something else, or a number is not finite or too large."""
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    fits = found.ndim == len(shape) and all(wanted in (None, n) for wanted, n in zip(shape, found.shape, strict=True))
    return found if fits and (np.abs(found) <= LARGEST).all() else None  # NaN is not


def column(record: dict, name: str, where: str, length: int | None = None) -> np.ndarray:
    """Read a list of finite numbers, (n,) float64, n = `length` where it is given; else InputError."""
    wanted = "a list of finite numbers" if length is None else f"{length} finite numbers"
    if name not in record:
        raise InputError(MISSING, where=f"{where}.{name}", expected=wanted)
    column = numbers(record[name], length)
    if column is None or len(column) == 0:
        raise InputError("not a column", where=f"{where}.{name}", got=repr(record[name])[:60], expected=wanted)
    return column


def matrix(record: dict, name: str, width: int, where: str) -> np.ndarray:
    """Read a list of vectors of finite numbers, (n, width) float64; raises InputError for anything else."""
    wanted = f"a list of {width} finite numbers each"
    if record.get(name) is None:
        raise InputError(MISSING, where=f"{where}.{name}", expected=wanted)
    matrix = numbers(record[name], None, width)
    if matrix is None:
        raise InputError("not a list of vectors", where=f"{where}.{name}", got=repr(record[name])[:60], expected=wanted)
    return matrix
