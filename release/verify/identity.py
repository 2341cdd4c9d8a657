"""Is each row who it says it is, and is every value one that its column can hold? Relations inside a row that need no geometry."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from cosfly.products.actions import action_tokens
from cosfly.products.playback import EVENTS, ORIGINAL
from release.columns import REQUIRED, SCALARS
from release.verify.findings import Findings
from release.verify.rows import FlightRows

CONSTANT = [column.name for column in SCALARS if column.constant]
ZOOMED = ("fov_deg", "intrinsics")  # but of a camera that zooms; geometry.py looks at each row's
CLOSED = {column.name: column.words for column in SCALARS if column.words}
RANGES = {column.name: column.ranges for column in SCALARS if column.ranges}
LARGEST = 1e6  # of a coordinate, m: farther than any town reaches
# What became of a perturbation, in the words of docs/files.md.
EVENT_WORDS = re.compile(
    r"none|applied|fallback: (?:drone clearance|person in an obstacle|target out of view|target hidden)"
)
_TRAJECTORY = re.compile(r"[\w.-]+")


def check_identity(flight: FlightRows, findings: Findings) -> None:
    """Check ids, names, constants, closed sets, ranges and nulls of a flight's rows."""
    _check_names(flight, findings)
    _check_constants(flight, findings)
    closed = {name: action_tokens() if words == "actions" else words for name, words in CLOSED.items()}
    for i, row in enumerate(flight.rows):
        for name in REQUIRED:
            if name in row and row[name] is None:
                findings.error("null", flight.where(i, name), "null", "a value in every row")
        for name, allowed in closed.items():
            value = row.get(name)
            if value is not None and value not in allowed:
                findings.error(
                    "closed_set",
                    flight.where(i, name),
                    repr(value),
                    f"one of {len(allowed)} words: {', '.join(allowed[:4])} ...",
                )
        for name, value in row.items():
            if isinstance(value, float | dict):
                _check_numbers(flight, i, name, value, findings)
        words = row.get("perturbation") or {}
        for event in EVENTS:
            if words.get(event) is not None and not EVENT_WORDS.fullmatch(words[event]):
                findings.error("closed_set", flight.where(i, f"perturbation.{event}"), repr(words[event]), "none, applied, or fallback and why")  # fmt: skip


def _check_names(flight: FlightRows, findings: Findings) -> None:
    first = flight.rows[0]
    is_original = first.get("variant") == ORIGINAL
    if flight.name != "/".join(str(first.get(n)) for n in ("run", "town", "trajectory", "variant")):
        findings.error("flight", flight.name, "rows of another flight", "rows of this one")
    for name in ("town", "trajectory", "variant", "run"):
        value = first.get(name)
        if isinstance(value, str) and value and (not _TRAJECTORY.fullmatch(value) or value in (".", "..")):
            findings.error("name", flight.where(0, name), repr(value), "a plain name, which leads nowhere")
    track = first.get("track")
    is_named = is_original or re.fullmatch(r"aug_\d+", str(first.get("variant")))
    if is_named and track in ("clean", "perturbed") and (track == "clean") != is_original:
        findings.error("track", flight.where(0, "track"), f"{track}, variant {first.get('variant')}", f"clean exactly where the variant is {ORIGINAL}")  # fmt: skip
    for i, row in enumerate(flight.rows):
        given, index = row.get("sample_id"), row.get("frame_index")
        own = f"{row.get('trajectory')}_{row.get('variant')}_frame_{index:05d}" if isinstance(index, int) else ""
        expected = own if flight.given_id is None else f"{flight.given_id}_frame_{index or 0:05d}"
        fits = given == expected if flight.given_id is not None else str(given).endswith(own)
        if "sample_id" in row and not fits:
            findings.error("sample_id", flight.where(i, "sample_id"), repr(given), f"{expected}, of its own columns")
    index = flight.index
    if (np.diff(index) <= 0).any() or index[0] < 0:
        k = int(np.argmax(np.diff(index) <= 0)) + 1 if len(index) > 1 else 0
        findings.error(
            "frame_index", flight.where(k), f"{index[k]} after {index[k - 1]}", "indices that grow, from 0 on"
        )
    if flight.num_frames is not None and index[-1] >= flight.num_frames:
        findings.error("frame_index", flight.where(len(index) - 1), index[-1], f"less than {flight.num_frames}, the frames of the flight")  # fmt: skip


def _check_constants(flight: FlightRows, findings: Findings) -> None:
    for name in CONSTANT:
        if flight.zooms and name in ZOOMED:
            continue
        column = flight.column(name)
        for i, value in enumerate(column):
            if value != column[0]:
                findings.error("constant", flight.where(i, name), value, f"{column[0]}, as in the flight's first row")
                break


def _check_numbers(flight: FlightRows, i: int, name: str, value: Any, findings: Findings) -> None:
    """Check that numbers are finite, of a sane size, and within their range; a group is whole or null."""
    if isinstance(value, dict) and name in ("perturbation", "image", "instance"):
        return
    ranges = RANGES.get(name, {})
    for member, number in value.items() if isinstance(value, dict) else (("", value),):
        low, high = ranges.get(member, (-LARGEST * 10, LARGEST * 10))
        if isinstance(number, str | bool) or (number is not None and low <= number <= high):
            continue
        place = flight.where(i, f"{name}.{member}".rstrip("."))
        if number is None:
            findings.error("null", place, "null", "a number: the group is there")
        elif not math.isfinite(number):
            findings.error("not_finite", place, number, "a finite number")
        elif abs(number) > LARGEST * 10:
            findings.error("range", place, number, f"at most {LARGEST * 10:g}")
        else:
            findings.error("range", place, number, f"{low:g} to {high:g}")
