"""Is each row who it says it is, and is every value one that its column can hold? Relations inside a row that need no
geometry."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from cosfly.products.actions import ActionSet
from cosfly.products.playback import EVENTS, ORIGINAL
from release.columns import REQUIRED, SCALARS, TARGET_PICTURE
from release.flight_rows import FlightRows
from release.verify.findings import Findings

CONSTANT = [column.name for column in SCALARS if column.constant]
ZOOMED = ("fov_deg", "intrinsics")  # but of a camera that zooms; geometry.py looks at each row's
CLOSED = {column.name: column.words for column in SCALARS if column.words}
RANGES = {column.name: column.ranges for column in SCALARS if column.ranges}
LARGEST = 1e7  # of any number: farther than any town reaches, m
# What became of a perturbation, in the words of docs/files.md.
EVENT_WORDS = re.compile(
    r"none|applied|fallback: (?:drone clearance|person in an obstacle|target out of view|target hidden)"
)
_PLAIN_NAME = re.compile(r"[\w.-]+")


def check_identity(flight: FlightRows, actions: ActionSet, findings: Findings) -> None:
    """Check ids, names, constants, closed sets, ranges and nulls of a flight's rows."""
    _check_names(flight, findings)
    for name in CONSTANT:
        column = flight.column(name)
        differs = [value != column[0] and not (flight.zooms and name in ZOOMED) for value in column]
        if any(differs):
            i = differs.index(True)
            findings.error("constant", flight.where(i, name), column[i], f"{column[0]}, as in the flight's first row")
    closed = {name: actions.tokens if words == "actions" else words for name, words in CLOSED.items()}
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
        words = row.get("perturbation") or {}
        for event in EVENTS:
            if words.get(event) is not None and not EVENT_WORDS.fullmatch(words[event]):
                place = flight.where(i, f"perturbation.{event}")
                findings.error("closed_set", place, repr(words[event]), "none, applied, or fallback and why")


def _check_names(flight: FlightRows, findings: Findings) -> None:
    first, index, variant = flight.rows[0], flight.index, flight.rows[0].get("variant")
    if flight.name != "/".join(str(first.get(n)) for n in ("run", "town", "trajectory", "variant")):
        findings.error("flight", flight.name, "rows of another flight", "rows of this one")
    for name in ("town", "trajectory", "variant", "run"):
        value = first.get(name)
        if isinstance(value, str) and value and (not _PLAIN_NAME.fullmatch(value) or value in (".", "..")):
            findings.error("name", flight.where(0, name), repr(value), "a plain name, which leads nowhere")
    track, is_named = first.get("track"), variant == ORIGINAL or re.fullmatch(r"aug_\d+", str(variant))
    if is_named and track in ("clean", "perturbed") and (track == "clean") != (variant == ORIGINAL):
        expected = f"clean exactly where the variant is {ORIGINAL}"
        findings.error("track", flight.where(0, "track"), f"{track}, variant {variant}", expected)
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
    if flight.num_frames is not None and index[-1] >= flight.num_frames:
        expected = f"less than {flight.num_frames}, the frames of the flight"
        findings.error("frame_index", flight.where(len(index) - 1), index[-1], expected)


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
