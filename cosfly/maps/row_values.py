"""What one row of somebody's boxes says: its type, its numbers, its sizes and heights, in whichever way they are told."""

from __future__ import annotations

import math
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from cosfly.products.columns import LARGEST
from cosfly.products.kinds import GROUND_KINDS, KINDS

TYPES = [kind for kind in KINDS if kind != "NONE"]
SLAB_M = 0.3  # thickness of a surface whose outline has no height: its top is the ground


class WrongRow(Exception):
    """What is wrong with one row, in words."""


def wrong_in(values: Mapping[str, Any], types: Mapping[str, str]) -> str:
    """Say what is wrong with the type and the numbers of a row; "" where nothing is."""
    try:
        read_values(values, types)
    except WrongRow as error:
        return str(error)
    return ""


def read_values(values: Mapping[str, Any], types: Mapping[str, str]) -> tuple[str, dict[str, float]]:
    """Give the type and the numbers of a row, by field, in the file's units.

    Args:
        values: by field, as the file has them. types: names of the file -> types of cosfly.
    Raises:
        WrongRow: says all that is wrong with them.
    """
    wrong, kind, numbers = list[str](), "", dict[str, float]()
    try:
        kind = _kind(values, types)
    except WrongRow as error:
        wrong.append(str(error))
    for name, value in values.items():
        if name not in ("type", "id", "name"):
            try:
                numbers[name] = _number(name, value)
            except WrongRow as error:
                wrong.append(str(error))
    if wrong:
        raise WrongRow(", ".join(wrong))
    return kind, numbers


def _kind(values: Mapping[str, Any], types: Mapping[str, str]) -> str:
    name = str(values.get("type", ""))
    kind = types.get(name, name)
    if kind not in TYPES:
        alike = {known.lower(): known for known in [*KINDS, *types]}
        close = get_close_matches(name.lower(), alike, n=1)
        raise WrongRow(
            f"unknown type {name[:40]!r}" + (f" (did you mean {alike[close[0]]!r}?)" if close else "")
            if name
            else "no type"
        )
    return kind


def _number(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not abs(number) <= LARGEST:
        point = "; write a decimal point, no comma" if "," in str(value) else ""
        raise WrongRow(f"{name} is not a finite number: {str(value)[:40]!r}{point}")
    return number


def size_of(metres: Mapping[str, float], name: str) -> float:
    """Give a full size, m, which may be told as its half; raises WrongRow."""
    half = metres.get(f"half_{name}")
    if (name in metres) == (half is not None):
        raise WrongRow(f"{name} twice, whole and half" if half is not None else f"neither {name} nor half_{name}")
    size = metres[name] if half is None else 2 * half
    if not size > 0:
        raise WrongRow(f"{name} is not more than 0: {size:g} m")
    return size


def span_of(metres: Mapping[str, float], kind: str, ground_m: float) -> tuple[float, float]:
    """Give the lowest and highest point, m: of low and high, of the middle and a height, or of a height over the ground; raises WrongRow."""
    has_height = "height" in metres or "half_height" in metres
    if "high" in metres:
        if has_height or "z" in metres:
            raise WrongRow("its heights are told twice: high beside height or z")
        low, high = metres.get("low", ground_m), metres["high"]
    elif not has_height and KINDS[kind] in GROUND_KINDS:
        top = metres.get("z", metres.get("low", ground_m))
        low, high = top - SLAB_M, top
    else:
        height = size_of(metres, "height")
        if "z" in metres and "low" in metres:
            raise WrongRow("its heights are told twice: low beside z")
        low = metres["z"] - height / 2 if "z" in metres else metres.get("low", ground_m)
        high = low + height
    if not high > low:
        raise WrongRow(f"its top, {high:g} m, is not above its foot, {low:g} m")
    return low, high
