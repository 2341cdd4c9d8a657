"""Reading CityJSON: from the file to objects with a rule and with surfaces in world coordinates. No geometry is judged here."""

from __future__ import annotations

import gzip
import logging
import zlib
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from cosfly.errors import InputError
from cosfly.store import parse_json

log = logging.getLogger(__name__)

VERSIONS = ("1.1", "2.0")
# Nesting of `boundaries` above the surfaces. Of a Solid's shells only the outer one counts.
NESTING = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
Form = Literal["solid", "wall", "surface", "green"]


class Rule(NamedTuple):
    """What objects of a CityJSON type are; with an attribute, only those whose value matches."""

    type: str
    kind: str
    form: Form
    attribute: str = ""
    value: str = "*"


# The first rule that matches decides. Attribute values are those of the Dutch register BGT, as 3dfier writes them.
RULES = (
    Rule("Building*", "Buildings", "solid"),
    Rule("Bridge*", "Bridge", "surface"),
    Rule("Tunnel*", "Other", "surface"),
    Rule("Road", "Sidewalks", "surface", "function", "voet*"),
    Rule("Road", "Roads", "surface"),
    Rule("TransportSquare", "Sidewalks", "surface"),
    Rule("Railway", "RailTrack", "surface"),
    Rule("Water*", "Water", "surface"),
    Rule("LandUse", "Ground", "surface", "bgt_fysiekvoorkomen", "*verharding"),
    Rule("LandUse", "Terrain", "surface"),
    Rule("PlantCover", "Terrain", "green"),
    Rule("SolitaryVegetationObject", "Vegetation", "solid"),
    Rule("TINRelief", "Terrain", "surface"),
    Rule("GenericCityObject", "Walls", "surface", "bgt_type", "kademuur"),  # a quay's edge is flush with the street
    Rule("*GenericCityObject", "Walls", "wall", "bgt_type", "muur"),
    Rule("*GenericCityObject", "Static", "wall"),
    Rule("CityFurniture", "Static", "solid"),
    Rule("OtherConstruction", "Static", "solid"),
)


class CityObject(NamedTuple):
    """One object: its surfaces as rings of world vertices; ring 0 of a surface is its outline, others are holes."""

    object_id: str
    rule: Rule
    surfaces: list[list[np.ndarray]]

    def corners(self) -> np.ndarray:
        """All vertices, (n, 3) m."""
        return np.concatenate([ring for surface in self.surfaces for ring in surface])


class CityModel(NamedTuple):
    """What a file holds: the objects that a rule takes, and what was left out, by reason."""

    objects: list[CityObject]
    dropped: dict[str, int]
    num_objects: int
    version: str


def read_model(path: Path) -> CityModel:
    """Read a CityJSON file; coordinates stay the source's.

    Raises:
        InputError: names the object and the field.
    """
    model = _read_json(path)
    vertices = _vertices(model, path)
    objects, dropped = [], {"unmapped_type": 0, "no_geometry": 0}
    for object_id, value in model["CityObjects"].items():
        where = f"{path}: CityObjects.{object_id}"
        if not isinstance(value, dict) or not isinstance(value.get("type"), str):
            got, expected = type(value).__name__, "an object with a type"
            raise InputError("not a city object", where=f"{where}.type", got=got, expected=expected)
        attributes = value.get("attributes")
        rule = rule_of(value["type"], attributes if isinstance(attributes, dict) else {})
        if rule is None:
            dropped["unmapped_type"] += 1
            log.warning("%s: no rule for the type %s; left out", object_id, value["type"])
            continue
        surfaces = _surfaces(value.get("geometry", []), vertices, f"{where}.geometry")
        if not surfaces:
            dropped["no_geometry"] += 1
            continue
        objects.append(CityObject(object_id, rule, surfaces))
    if not objects:
        raise InputError("no object can be used", where=f"{path}: CityObjects", got=str(dropped))
    dropped = {reason: count for reason, count in dropped.items() if count}
    return CityModel(objects, dropped, len(model["CityObjects"]), model["version"])


def rule_of(object_type: str, attributes: dict) -> Rule | None:
    """Find what an object is. Extension types (a leading +) count as their base name."""
    for rule in RULES:
        if fnmatchcase(object_type.removeprefix("+"), rule.type) and (
            not rule.attribute or fnmatchcase(str(attributes.get(rule.attribute, "")), rule.value)
        ):
            return rule
    return None


def _read_json(path: Path) -> dict:
    try:
        data = path.read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
        model = parse_json(data)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise InputError("the gzip data is damaged", where=path, got=str(error)) from None
    except OSError as error:
        raise InputError("cannot read the city model", where=path, got=error.strerror, fix="check the path") from None
    except (ValueError, RecursionError) as error:
        raise InputError("the city model is not valid JSON", where=path, got=str(error)) from None
    if not isinstance(model, dict) or model.get("type") != "CityJSON":
        got = repr(model.get("type")) if isinstance(model, dict) else type(model).__name__
        raise InputError("not a CityJSON file", where=f"{path}: type", got=got, expected="'CityJSON'")
    if model.get("version") not in VERSIONS:
        raise InputError(
            "unknown version", where=f"{path}: version", got=repr(model.get("version")), expected=" or ".join(VERSIONS),
            fix="convert it, for instance with cjio upgrade",
        )  # fmt: skip
    if not isinstance(model.get("CityObjects"), dict) or not model["CityObjects"]:
        raise InputError("no city objects", where=f"{path}: CityObjects", expected="an object that is not empty")
    return model


def _vertices(model: dict, path: Path) -> np.ndarray:
    """Vertices in the source's coordinates, (n, 3) m."""
    transform = model.get("transform")
    parts = []
    for name in ("scale", "translate"):
        try:
            part = np.array(transform[name], dtype=np.float64) if isinstance(transform, dict) else np.empty(0)
        except (KeyError, TypeError, ValueError):
            part = np.empty(0)
        if part.shape != (3,):
            raise InputError("not a vector", where=f"{path}: transform.{name}", expected="three numbers")
        parts.append(part)
    try:
        vertices = np.array(model.get("vertices"), dtype=np.float64)
    except (TypeError, ValueError):
        vertices = np.empty(0)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError("not a list of vertices", where=f"{path}: vertices", expected="lists of three numbers")
    return vertices * parts[0] + parts[1]


def _surfaces(geometries: Any, vertices: np.ndarray, where: str) -> list[list[np.ndarray]]:
    """The surfaces of the geometry with the lowest level of detail from 1 up; boxes need no more."""
    if not isinstance(geometries, list) or not all(isinstance(g, dict) for g in geometries):
        raise InputError("not a list of geometries", where=where, got=type(geometries).__name__)
    usable = [(_level(g), number) for number, g in enumerate(geometries) if g.get("type") in NESTING]
    if not usable:
        return []
    _, number = min(usable, key=lambda pair: (pair[0] < 1, pair[0]))
    lists = geometries[number].get("boundaries")
    where = f"{where}[{number}].boundaries"
    nesting = NESTING[geometries[number]["type"]]
    solids = lists if nesting == 2 else [lists] if nesting == 1 else [[lists]]
    found: list = []
    for solid in _list(solids, where):
        for shell in _list(solid, where)[:1]:  # the outer shell
            found += _list(shell, where)
    return [_rings(surface, vertices, f"{where} surface {k}") for k, surface in enumerate(found)]


def _list(value: Any, where: str) -> list:
    if not isinstance(value, list):
        raise InputError("not nested as its type says", where=where, got=repr(value)[:40], expected="a list")
    return value


def _level(geometry: dict) -> float:
    try:
        return float(geometry.get("lod", 0))
    except (TypeError, ValueError):
        return 0.0


def _rings(surface: Any, vertices: np.ndarray, where: str) -> list[np.ndarray]:
    if not isinstance(surface, list) or not surface:
        raise InputError("not a surface", where=where, got=repr(surface)[:60], expected="a list of rings")
    rings = []
    for ring in surface:
        if not isinstance(ring, list) or len(ring) < 3 or not all(type(index) is int for index in ring):
            raise InputError("not a ring", where=where, got=repr(ring)[:60], expected="at least three vertex indices")
        index = np.array(ring)
        if index.min() < 0 or index.max() >= len(vertices):
            wrong = int(index.min() if index.min() < 0 else index.max())
            raise InputError("no such vertex", where=where, got=str(wrong), expected=f"0 to {len(vertices) - 1}")
        corners = vertices[index]
        if not np.isfinite(corners).all():
            raise InputError("a vertex is not finite", where=where, got=str(corners.tolist())[:80])
        rings.append(corners)
    return rings
