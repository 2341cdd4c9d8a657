"""GeoJSON: features with their properties and the rings of their geometry. Coordinates are not converted."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import read_json

GEOMETRIES = ("Point", "Polygon", "MultiPolygon")
LARGEST = 1e9  # absolute value of a coordinate
MOST_NAME = 40  # characters of a name in messages


class Feature(NamedTuple):
    """One feature.

    where: Names it in messages: its number, counted from 1, with its id or name.
    properties: Its properties; empty if there are none.
    parts: Its polygons. Each is a list of rings (n, 2), the outer one first. A point is a ring of one position.
    problem: What is wrong with its geometry; `parts` is empty then.
    """

    where: str
    properties: dict[str, Any]
    parts: list[list[np.ndarray]]
    problem: str = ""


def is_geojson(value: Any) -> bool:
    """Return whether the type of a JSON document is one of GeoJSON's that this module reads."""
    return isinstance(value, dict) and value.get("type") in ("FeatureCollection", "Feature", *GEOMETRIES)


def read_features(path: Path, *, what: str = "GeoJSON") -> list[Feature]:
    """Read a FeatureCollection, a Feature or a bare geometry.

    Each feature stores its own problem, so that the caller can report all of them at once.
    """
    return features_of(read_json(path, what=what), path)


def features_of(value: Any, path: Path) -> list[Feature]:
    """Return the features of a document; `path` is for messages. Raises InputError if it is not GeoJSON."""
    if not is_geojson(value):
        expected = "FeatureCollection, Feature, Polygon or MultiPolygon"
        raise InputError("this file is not GeoJSON", where=f"{path}: type", expected=expected)
    items = value.get("features") if value["type"] == "FeatureCollection" else [value]
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise InputError(
            "the file has no list of features", where=f"{path}: features", expected="a list of Feature objects"
        )
    return [_feature(item, number) for number, item in enumerate(items, 1)]


def _feature(item: dict[str, Any], number: int) -> Feature:
    """Return the feature of an object, which is a Feature or a bare geometry; `number` counts from 1."""
    properties = item.get("properties")
    if not isinstance(properties, dict):
        properties = {}
    where = f"feature {number}"
    names = (properties.get("name"), item.get("id"), properties.get("id"))
    if name := next((str(value)[:MOST_NAME] for value in names if value not in (None, "")), None):
        where += f" ({name})"
    geometry = item.get("geometry") if item.get("type") == "Feature" else item
    if not isinstance(geometry, dict):
        geometry = {}
    kind = geometry.get("type")
    if kind not in GEOMETRIES:
        problem = f"the geometry {str(kind)[:MOST_NAME]} is not supported; expected one of {', '.join(GEOMETRIES)}"
        return Feature(where, properties, [], problem)
    parts = _parts(kind, geometry.get("coordinates"))
    if parts is not None:
        return Feature(where, properties, parts)
    expected = "one point [x, y]" if kind == "Point" else "at least four points [x, y], the last equal to the first"
    return Feature(where, properties, [], f"the coordinates of the {kind} are invalid; expected {expected}")


def _parts(kind: str, coordinates: Any) -> list[list[np.ndarray]] | None:
    """Return the polygons of a geometry as in `Feature.parts`; None if its coordinates are invalid."""
    polygons: Any = {"Point": [[[coordinates]]], "Polygon": [coordinates], "MultiPolygon": coordinates}[kind]
    is_point = kind == "Point"
    try:
        parts = [
            [np.array([position[:2] for position in ring], dtype=np.float64) for ring in polygon]
            for polygon in polygons
        ]
        is_valid = all(parts) and all(_is_ring(ring, is_point) for rings in parts for ring in rings)
    except (TypeError, ValueError, OverflowError):
        return None
    return parts if is_valid else None


def _is_ring(ring: np.ndarray, is_point: bool) -> bool:
    """Return whether a ring has finite [x, y] and, unless it is a point, is closed."""
    is_closed = is_point or (len(ring) > 3 and (ring[0] == ring[-1]).all())
    return bool(ring.shape == (len(ring), 2) and is_closed and (np.abs(ring) <= LARGEST).all())  # NaN fails
