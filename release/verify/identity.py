"""Check rows against their schema: ids, constants, closed sets, ranges and nulls."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cosfly.products.actions import TOKENS
from release.columns import REQUIRED, SCALARS, TARGET_PICTURE
from release.flight_rows import FlightRows
from release.verify.findings import Findings

CONSTANT = [column.name for column in SCALARS if column.constant]
ZOOMED = ("fov_deg", "intrinsics")  # but of a camera that zooms; geometry.py looks at each row's
CLOSED = {column.name: column.words for column in SCALARS if column.words}
RANGES = {column.name: column.ranges for column in SCALARS if column.ranges}
LARGEST = 1e7  # of any number: farther than any town reaches, m


def check_identity(flight: FlightRows, findings: Findings) -> None:
    """Check ids, names, constants, closed sets, ranges and nulls of a flight's rows."""
    _check_names(flight, findings)
    for name in CONSTANT:
        column = flight.column(name)
        differs = [value != column[0] and not (flight.zooms and name in ZOOMED) for value in column]
        if any(differs):
            i = differs.index(True)
            findings.error("constant", flight.where(i, name), column[i], f"{column[0]}, as in the flight's first row")
    closed = {name: TOKENS if words == "actions" else words for name, words in CLOSED.items()}
    for i, row in enumerate(flight.rows):
        for name in (name for name in REQUIRED if name in row and row[name] is None):
            findings.error("null", flight.where(i, name), "null", "a value in every row")
        for name, allowed in closed.items():
            value = row.get(name)
            if value is not None and value not in allowed:
                expected = f"one of {len(allowed)} words: {', '.join(allowed[:4])} ..."
                findings.error("closed_set", flight.where(i, name), repr(value), expected)
        for name, value in row.items():
            if isinstance(value, float | dict):
                _check_numbers(flight, i, name, value, findings)


def _check_names(flight: FlightRows, findings: Findings) -> None:
    first, index = flight.rows[0], flight.index
    if flight.name != "/".join(str(first.get(n)) for n in ("run", "town", "trajectory", "variant")):
        findings.error("flight", flight.name, "rows of another flight", "rows of this one")
    for i, row in enumerate(flight.rows):
        given, number = row.get("sample_id"), row.get("frame_index") or 0
        own = f"{row.get('trajectory')}_{row.get('variant')}_frame_{number:05d}"
        expected = own if flight.given_id is None else f"{flight.given_id}_frame_{number:05d}"
        fits = str(given).endswith(own) if flight.given_id is None else given == expected
        if "sample_id" in row and not fits:
            findings.error("sample_id", flight.where(i, "sample_id"), repr(given), f"{expected}, of its own columns")
    if (backwards := np.diff(index, prepend=-1) <= 0).any():
        k = int(np.argmax(backwards))
        findings.error("frame_index", flight.where(k), f"{index[max(k - 1, 0) :][:2]}", "indices that grow, from 0 on")
    if (flight.time_s[1:] <= flight.time_s[:-1]).any():
        findings.error("time", flight.where(0, "time_s"), "times that do not grow", "times that grow with the frames")


def _check_numbers(flight: FlightRows, i: int, name: str, value: Any, findings: Findings) -> None:
    """Check that numbers are finite, of a sane size, and within their range; a group is whole or null."""
    if isinstance(value, dict) and name in ("perturbation", "image", "instance", TARGET_PICTURE):
        return
    ranges = RANGES.get(name, {})
    for member, number in value.items() if isinstance(value, dict) else (("", value),):
        low, high = ranges.get(member, (-LARGEST, LARGEST))
        if isinstance(number, str | bool) or (number is not None and low <= number <= high):
            continue
        place = flight.where(i, f"{name}.{member}".rstrip("."))
        if number is None:
            findings.error("null", place, "null", "a number: the group is there")
        elif not math.isfinite(number):
            findings.error("not_finite", place, number, "a finite number")
        else:
            findings.error("range", place, number, f"{low:g} to {high:g}")
