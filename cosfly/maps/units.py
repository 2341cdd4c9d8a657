"""The unit and coordinate system of a map file, for all readers: what a file declares is used, or refused by name.

Without a library of coordinate systems: those of metres that map makers use are listed, WGS 84 and its like are
degrees, and any other needs the setting `units`.
"""

import logging
import math
import re
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from cosfly.runtime.errors import InputError, shown

log = logging.getLogger(__name__)

Units = Literal["auto", "m", "degrees", "ft", "us-ft"]
METRES = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}
# EPSG codes with east and north in metres at (nearly) true scale; first and last of each range.
METRIC = (
    (2056, 2056), (2154, 2154), (2180, 2180), (2193, 2193), (2326, 2326), (3006, 3018), (3034, 3035), (3067, 3067),
    (3414, 3414), (3812, 3812), (3826, 3826), (3879, 3879), (3942, 3950), (5179, 5188), (5514, 5514), (5554, 5556),
    (6328, 6348), (6669, 6687), (7405, 7405), (7415, 7415), (7846, 7859), (21781, 21781), (25828, 25838),
    (26901, 26923), (27700, 27700), (28348, 28358), (28991, 28992), (31254, 31259), (31287, 31287), (31370, 31370),
    (31466, 31469), (32601, 32660), (32701, 32760),
)  # fmt: skip
DEGREES = {4258, 4269, 4283, 4326, 4490, 4612, 4979, 6668, 7844}  # longitude and latitude that agree within metres
# The middle outline of a file is shorter than the first in degrees and longer than the second in metres.
LARGEST_DEG, SMALLEST_M = 0.02, 0.3
EARTH_M, EARTH_E2 = 6_378_137.0, 0.00669437999014  # WGS 84: equatorial radius, squared eccentricity
_LENGTH = re.compile(
    r"(?P<number>[-+]?\d*\.?\d+(?:[eE][-+]?\d+)?|[-+]?\d+\.)\s*(?P<unit>m|metres?|meters?|cm|ft|feet|foot|')?"
    r"(?:\s*(?P<inches>\d+\.?\d*)\s*(?:\"|in))?"
)


def declared_units(declared: Any, where: str) -> Units | None:
    """Return the units of a declared coordinate system, `crs` of GeoJSON or `referenceSystem` of CityJSON.

    None if nothing is declared; InputError names a system that is neither of metres nor of degrees.
    """
    text = ", ".join(_texts(declared))
    if not text:
        return None
    if re.search(r"CRS:?84|^wgs ?84$", text, re.IGNORECASE):
        return "degrees"
    # "urn:ogc:def:crs:EPSG::28992", ".../EPSG/0/7415" or "28992"; of a compound system the horizontal one.
    match = re.search(r"epsg\D*(?:[\d.]+[:/])?(\d{4,6})\b|^(\d{4,6})$", text, re.IGNORECASE)
    code = int(match[1] or match[2]) if match else 0
    if code in DEGREES:
        return "degrees"
    if any(first <= code <= last for first, last in METRIC):
        return "m"
    raise refused(text, where)


def refused(declared: str, where: str) -> InputError:
    """Return the error of a coordinate system that a reader cannot use."""
    return InputError(
        "the declared coordinate system is not supported",
        where=where,
        got=declared[:80],
        expected="a metric system such as UTM (EPSG:326NN); for GeoJSON also EPSG:4326",
        fix="convert the file (ogr2ogr -t_srs EPSG:4326 for GeoJSON, cjio reproject for CityJSON), or set "
        "maps.boxes.units or maps.cityjson.units to the unit of the coordinates: m, ft or us-ft",
    )


def _texts(declared: Any) -> list[str]:
    """Return the texts and codes in a declaration, whatever its form."""
    if isinstance(declared, dict):  # {"type": "name", "properties": {"name": ...}} of GeoJSON
        declared = [value for value in declared.values() if value not in ("name", "link")]
    if isinstance(declared, list):
        return [text for part in declared for text in _texts(part)]
    if declared is None:
        return []
    return [str(declared) if isinstance(declared, str | int) else shown(declared)]


def seen_units(places: np.ndarray, sizes: np.ndarray) -> Units | None:
    """Return what coordinates look like, m or degrees; None if they may be both.

    places: (n, 2).
    sizes: (k,), the length of each outline, or the distance of a point to the nearest other one.
    """
    middle = float(np.median(sizes[sizes > 0])) if (sizes > 0).any() else math.inf
    if (np.abs(np.median(places, axis=0)) > [180.0, 90.0]).any() or middle > SMALLEST_M:
        return "m"
    return "degrees" if middle < LARGEST_DEG else None


def to_metres(units: Units, places: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that converts coordinates, (n, 2), to metres east and north.

    Degrees are projected on the plane that touches the Earth at the median of all coordinates of the file, `places`.
    """
    if units != "degrees":
        return lambda ring: ring * METRES[units]
    first = places[0, 0]
    around = np.column_stack([_near(places[:, 0], first), places[:, 1]])
    middle = np.median(around, axis=0)
    log.info("longitude and latitude are converted to metres east and north of %.6f, %.6f", *middle)
    latitude = math.radians(middle[1])
    curvature = 1 - EARTH_E2 * math.sin(latitude) ** 2
    east_m = EARTH_M / math.sqrt(curvature) * math.cos(latitude)  # metres in a radian of longitude
    north_m = EARTH_M * (1 - EARTH_E2) / curvature**1.5  # metres in a radian of latitude

    def projected(ring: np.ndarray) -> np.ndarray:
        shifted = np.column_stack([_near(ring[:, 0], middle[0]), ring[:, 1]]) - middle
        return np.radians(shifted) * [east_m, north_m]

    return projected


def _near(longitudes: np.ndarray, middle: float) -> np.ndarray:
    """Return longitudes within 180 degrees of another one, for a map across the date line."""
    return (longitudes - middle + 180.0) % 360.0 - 180.0 + middle


def length_m(value: Any) -> float:
    """Return a length in metres of a number or a text with a unit (`12`, `12 m`, `40'`, `39'4"`, `40 ft`), else NaN."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return math.nan
    match = _LENGTH.fullmatch(str(value).strip())
    is_feet = match is not None and match["unit"] in ("'", "ft", "feet", "foot")
    if match is None or (match["inches"] and not is_feet):
        return math.nan
    unit_m = 0.01 if match["unit"] == "cm" else METRES["ft"] if is_feet else 1.0
    return float(match["number"]) * unit_m + float(match["inches"] or 0.0) * 0.0254
