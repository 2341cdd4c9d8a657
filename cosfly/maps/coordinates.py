"""Units and origin of a file's coordinates: the one place where every reader makes them metres near the origin.

A reader declares the unit, never guesses it. `offset_m` of a map's header leads from the map's coordinates back to the
file's, or, for longitude and latitude, to metres around the file's middle.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from cosfly.runtime.errors import InputError

log = logging.getLogger(__name__)

Unit = Literal["m", "degrees"]

WIDEST_M = 20_000.0  # of a map
WIDEST_DEG = 2.0  # of a map in longitude and latitude: beyond this a plane that touches the Earth is no map of it
EARTH_M, EARTH_E2 = 6_378_137.0, 0.00669437999014  # WGS 84: equatorial radius, squared eccentricity


def to_metres(unit: Unit, places: np.ndarray, where: str | Path) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that turns a file's coordinates into metres east and north.

    Args:
        unit: m leaves coordinates as they are; degrees projects them on the plane that touches the Earth in the middle.
        places: (n, 2), all coordinates of the file. where: for the message.
    """
    low, high = places.min(axis=0), places.max(axis=0)
    size = float((high - low).max())
    may_be_degrees = size <= WIDEST_DEG and (np.abs(places) <= [180.0, 90.0]).all()
    if (unit == "degrees" and not may_be_degrees) or (unit == "m" and may_be_degrees and size > 0):
        other, expected = ("degrees", "wider than 2 m") if unit == "m" else ("m", "longitude and latitude of one town")
        got, fix = f"{low.tolist()} to {high.tolist()}", f"--set maps.boxes.units={other}, if that is their unit"
        raise InputError(f"the coordinates are not in {unit}", where=where, got=got, expected=expected, fix=fix)
    if unit == "m":
        return lambda ring: ring
    middle = (low + high) / 2
    log.info("longitude and latitude: metres east and north of %.6f, %.6f", *middle)
    latitude = math.radians(middle[1])
    bent = 1 - EARTH_E2 * math.sin(latitude) ** 2
    east_m, north_m = EARTH_M / math.sqrt(bent) * math.cos(latitude), EARTH_M * (1 - EARTH_E2) / bent**1.5  # a radian
    return lambda ring: np.radians(ring - middle) * [east_m, north_m]


def origin_m(low: np.ndarray, high: np.ndarray, where: str | Path, ground_z_m: float = 0.0) -> np.ndarray:
    """Return the place that becomes a map's origin, (3,) m: the middle of its bounds, at the height of its ground."""
    if not (high - low <= WIDEST_M).all():
        got = " x ".join(f"{size:.6g}" for size in high - low) + " m"
        fix = "cut a part out, or remove stray vertices"
        raise InputError("the map is too wide or too high", where=where, got=got, expected="at most 20 km", fix=fix)
    return np.array([*np.round((low + high)[:2] / 2), round(float(ground_z_m), 3)])


def offset_header(origin: np.ndarray) -> dict[str, float]:
    """Return the `offset_m` of a map's header."""
    return {axis: float(value) for axis, value in zip("xyz", origin, strict=True)}
