"""GeoJSON: features with their properties and the rings of their geometry. Coordinates stay as they stand there."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import read_json

GEOMETRIES = ("Point", "Polygon", "MultiPolygon")
LARGEST = 1e9  # of a coordinate


class Feature(NamedTuple):
    """One feature. where: which one, for messages: counted from 1, with its id or name. parts: polygons of rings, the
    outer one first, (n, 2); a point is a ring of one. wrong: what is wrong with its geometry; it has no parts then."""

    where: str
    properties: dict[str, Any]
    parts: list[list[np.ndarray]]
    wrong: str = ""


def is_geojson(value: Any) -> bool:
    """Return whether a JSON document says that it is GeoJSON."""
    return isinstance(value, dict) and value.get("type") in ("FeatureCollection", "Feature", *GEOMETRIES)


def read_features(path: Path, *, what: str = "GeoJSON") -> list[Feature]:
    """Read a FeatureCollection, a Feature or a bare geometry. What is wrong with a feature is stored in it, so that all
    is reported at once."""
    return features_of(read_json(path, what=what), path)


def features_of(value: Any, path: Path) -> list[Feature]:
    """Return the features of a document; `path` is for messages. Raises InputError where it is no GeoJSON."""
    if not is_geojson(value):
        expected = "FeatureCollection, Feature, Polygon or MultiPolygon"
        raise InputError("not GeoJSON", where=f"{path}: type", expected=expected)
    items = value.get("features") if value["type"] == "FeatureCollection" else [value]
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise InputError("no list of features", where=f"{path}: features", expected="a list of Feature")
    return [_feature(item, number) for number, item in enumerate(items, 1)]


def _feature(item: dict[str, Any], number: int) -> Feature:
    geometry = item.get("geometry") if item.get("type") == "Feature" else item
    given = item.get("properties")
    properties: dict[str, Any] = given if isinstance(given, dict) else {}
    names = (properties.get("name"), item.get("id"), properties.get("id"))
    name = next((str(value)[:40] for value in names if value not in (None, "")), None)
    where = f"feature {number}" + ("" if name is None else f" ({name})")
    kind, places = (geometry.get("type"), geometry.get("coordinates")) if isinstance(geometry, dict) else (None, None)
    if kind not in GEOMETRIES:
        wrong = f"a geometry that has no place here, {str(kind)[:40]}; there are {', '.join(GEOMETRIES)}"
        return Feature(where, properties, [], wrong)
    nested: Any = {"Point": [[[places]]], "Polygon": [places], "MultiPolygon": places}[kind]
    try:
        parts = [[np.array([place[:2] for place in ring], dtype=np.float64) for ring in part] for part in nested]
        is_good = all(parts) and all(_is_ring(ring, kind == "Point") for part in parts for ring in part)
    except (TypeError, ValueError, OverflowError):
        is_good = False
    if is_good:
        return Feature(where, properties, parts)
    needs = "one finite [x, y]" if kind == "Point" else "at least four finite [x, y], the last the first again"
    return Feature(where, properties, [], f"its coordinates are not places: {needs}")


def _is_ring(ring: np.ndarray, is_point: bool) -> bool:
    is_closed = is_point or (len(ring) > 3 and (ring[0] == ring[-1]).all())
    return bool(ring.shape == (len(ring), 2) and is_closed and (np.abs(ring) <= LARGEST).all())  # NaN is not
