"""GeoJSON: features with their properties and the rings of their geometry. Coordinates stay as they stand there."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosfly.errors import InputError
from cosfly.reading.documents import read_json

GEOMETRIES = ("Point", "Polygon", "MultiPolygon")
LARGEST = 1e9  # of a coordinate


class Feature(NamedTuple):
    """One feature.

    Attributes:
        where: which one, for messages.
        parts: polygons of rings, the outer one first, (n, 2); a point is a ring of one.
    """

    where: str
    properties: dict[str, Any]
    parts: list[list[np.ndarray]]


def is_geojson(value: Any) -> bool:
    """Tell whether a JSON document says that it is GeoJSON."""
    return isinstance(value, dict) and value.get("type") in ("FeatureCollection", "Feature", *GEOMETRIES)


def read_features(path: Path, *, what: str = "GeoJSON") -> list[Feature]:
    """Read a FeatureCollection, a Feature or a bare geometry.

    Raises:
        InputError: names the feature; a geometry of another kind, or coordinates that are no finite places.
    """
    return features_of(read_json(path, what=what), path)


def features_of(value: Any, path: Path) -> list[Feature]:
    """Give the features of a document; `path` is for messages."""
    if not is_geojson(value):
        raise InputError(
            "not GeoJSON", where=f"{path}: type", expected="FeatureCollection, Feature, Polygon or MultiPolygon"
        )
    items = value.get("features") if value["type"] == "FeatureCollection" else [value]
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise InputError("no list of features", where=f"{path}: features", expected="a list of Feature")
    return [_feature(item, number, path) for number, item in enumerate(items)]


def _feature(item: dict[str, Any], number: int, path: Path) -> Feature:
    geometry = item.get("geometry") if item.get("type") == "Feature" else item
    kind, places = (geometry.get("type"), geometry.get("coordinates")) if isinstance(geometry, dict) else (None, None)
    where = f"feature {number}"
    if kind not in GEOMETRIES:
        raise InputError(
            "not a geometry that has a place here",
            where=f"{path}: {where}",
            got=str(kind)[:40],
            expected=", ".join(GEOMETRIES),
        )
    nested: Any = {"Point": [[[places]]], "Polygon": [places], "MultiPolygon": places}[kind]
    least = 1 if kind == "Point" else 4
    try:
        parts = [[np.array([place[:2] for place in ring], dtype=np.float64) for ring in part] for part in nested]
        is_good = all(parts) and all(
            ring.shape == (len(ring), 2) and len(ring) >= least for part in parts for ring in part
        )
        is_good = is_good and all((np.abs(ring) <= LARGEST).all() for part in parts for ring in part)  # NaN is not
    except (TypeError, ValueError, OverflowError):
        is_good = False
    if not is_good:
        raise InputError(
            "its coordinates are not rings of places",
            where=f"{path}: {where}",
            expected="at least four finite [x, y], the last the first again",
        )
    properties = item.get("properties")
    return Feature(where, properties if isinstance(properties, dict) else {}, parts)
