"""Reading CityJSON: from the file to objects with a rule and with surfaces in world coordinates. No geometry is judged
here.

Versions 0.8 to 2.0, one document or a text sequence (CityJSONSeq: the document first, then one feature a line). What
differs between them: until 1.0 `transform` may be missing (vertices are metres then) and `lod` is a number; `parent`
became `parents` in 0.9, `members` of a group `children` in 1.1; in a sequence every feature has its own vertices.
Sources: cityjson.org, the specifications and their change logs.
"""

from __future__ import annotations

import logging
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeGuard

import numpy as np

from cosfly.formats.columns import numbers
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import over_limit, read_unpacked
from cosfly.runtime.json_io import MISSING, parse_document, parse_json

log = logging.getLogger(__name__)

CITY_MB = 16_384  # as it stands there and unpacked; as values of Python it takes ten times that
VERSIONS = ("0.8", "0.9", "1.0", "1.1", "2.0")
PLAIN_VERTICES = VERSIONS[:3]  # may go without `transform`
RECORD_SEPARATOR = b"\x1e"  # stands before each text of a sequence as RFC 7464 has it
# Nesting of `boundaries` above the surfaces. Of a Solid's shells only the outer one counts.
NESTING = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
Form = Literal["solid", "wall", "surface", "green"]


class ObjectRule(NamedTuple):
    """What objects of a CityJSON type are; with an attribute, only those whose value matches."""

    type: str
    kind: str
    form: Form
    attribute: str = ""
    value: str = "*"


# The first rule that matches decides. Attribute values are those of the Dutch register BGT, as 3dfier writes them.
RULES = (
    ObjectRule("Building*", "Buildings", "solid"),
    ObjectRule("Bridge*", "Bridge", "surface"),
    ObjectRule("Tunnel*", "Other", "surface"),
    ObjectRule("Road", "Sidewalks", "surface", "function", "voet*"),
    ObjectRule("Road", "Roads", "surface"),
    ObjectRule("TransportSquare", "Sidewalks", "surface"),
    ObjectRule("Railway", "RailTrack", "surface"),
    ObjectRule("Water*", "Water", "surface"),
    ObjectRule("LandUse", "Ground", "surface", "bgt_fysiekvoorkomen", "*verharding"),
    ObjectRule("LandUse", "Terrain", "surface"),
    ObjectRule("PlantCover", "Terrain", "green"),
    ObjectRule("SolitaryVegetationObject", "Vegetation", "solid"),
    ObjectRule("TINRelief", "Terrain", "surface"),
    ObjectRule(
        "GenericCityObject", "Walls", "surface", "bgt_type", "kademuur"
    ),  # a quay's edge is flush with the street
    ObjectRule("*GenericCityObject", "Walls", "wall", "bgt_type", "muur"),
    ObjectRule("*GenericCityObject", "Static", "wall"),
    ObjectRule("CityFurniture", "Static", "solid"),
    ObjectRule("OtherConstruction", "Static", "solid"),
)


class CityObject(NamedTuple):
    """One object: its surfaces as rings of world vertices; ring 0 of a surface is its outline, others are holes.

    surfaces: of the plainest geometry with a height, which boxes are made of; detailed: of the most detailed one of a
    solid, which is drawn.
    """

    object_id: str
    rule: ObjectRule
    surfaces: list[list[np.ndarray]]
    detailed: list[list[np.ndarray]]

    def corners(self) -> np.ndarray:
        """All vertices, (n, 3) m."""
        return np.concatenate([ring for surface in self.surfaces for ring in surface])


class CityModel(NamedTuple):
    """What a file holds: the objects that a rule takes, and what was left out, by reason."""

    objects: list[CityObject]
    dropped: dict[str, int]
    num_objects: int
    version: str


class _Part(NamedTuple):
    """City objects and the vertices that their indices count in: a document, or one feature of a sequence."""

    objects: dict[str, Any]
    vertices: np.ndarray
    where: str


class _Templates(NamedTuple):
    """Geometries that many objects share, and their own vertices, (n, 3) m."""

    geometries: list
    vertices: np.ndarray


def read_model(path: Path, most_vertices: int) -> CityModel:
    """Read a CityJSON file or text sequence, plain or gzipped; coordinates stay the source's. A surface has at most so
    many vertices, its holes included.

    Raises:
        InputError: names the object and the field.
    """
    head, features = _read_json(path)
    templates = _templates(head, path)
    parts = _parts(head, features, path)
    objects: dict[str, CityObject] = {}
    dropped = {"unmapped_type": 0, "group": 0, "no_geometry": 0, "outline_of_parts": 0, "repeated_id": 0}
    known: set[str] = set()
    for part in parts:
        for object_id, value in part.objects.items():
            found = _city_object(object_id, value, part, templates)
            reason = "repeated_id" if object_id in known else found if isinstance(found, str) else None
            known.add(object_id)
            if reason:
                dropped[reason] += 1
            elif isinstance(found, CityObject):
                _check_vertices(found, most_vertices, part.where)
                objects[object_id] = found
    if not objects:
        raise InputError("no object can be used", where=f"{path}: CityObjects", got=str(dropped))
    dropped = {reason: count for reason, count in dropped.items() if count}
    num_objects = sum(len(part.objects) for part in parts)
    return CityModel(list(objects.values()), dropped, num_objects, head["version"])


def _check_vertices(item: CityObject, most: int, where: str) -> None:
    largest = max(sum(map(len, surface)) for surface in (*item.surfaces, *item.detailed))
    if largest > most:
        fix = "simplify it, or raise maps.cityjson.polygon_vertices if you trust the file"
        where, got = f"{where}: CityObjects.{item.object_id}", f"a surface of {largest:,} vertices"
        raise over_limit(where, got, f"{most:,}", fix)


def _city_object(object_id: str, value: Any, part: _Part, templates: _Templates) -> CityObject | str:
    """Return an object, or the reason why it is left out."""
    where = f"{part.where}: CityObjects.{object_id}"
    if not isinstance(value, dict) or not isinstance(value.get("type"), str):
        got, expected = type(value).__name__, "an object with a type"
        raise InputError("not a city object", where=f"{where}.type", got=got, expected=expected)
    if value["type"] == "CityObjectGroup":  # its members stand in the file themselves
        return "group"
    attributes = value.get("attributes")
    rule = rule_of(value["type"], attributes if isinstance(attributes, dict) else {})
    if rule is None:
        log.warning("%s: no rule for the type %s; left out", object_id, value["type"])
        return "unmapped_type"
    surfaces, detailed, level = _surfaces(value.get("geometry", []), part.vertices, templates, f"{where}.geometry")
    if not surfaces:
        return "no_geometry"
    if level < 1 and rule.form == "solid" and _has_parts(value, part):
        return (
            "outline_of_parts"  # a building whose parts stand in the file with a height; it would hide their courtyards
        )
    return CityObject(object_id, rule, surfaces, detailed if rule.form == "solid" else [])


def _has_parts(value: dict, part: _Part) -> bool:
    """Return whether an object's parts stand in the file; one that names absent ones has nothing but its own
    geometry."""
    children = value.get("children")
    names = children if isinstance(children, list) else []
    return any(isinstance(name, str) and name in part.objects for name in names)


def rule_of(object_type: str, attributes: dict) -> ObjectRule | None:
    """Find what an object is. Extension types (a leading +) count as their base name."""
    for rule in RULES:
        if fnmatchcase(object_type.removeprefix("+"), rule.type) and (
            not rule.attribute or fnmatchcase(str(attributes.get(rule.attribute, "")), rule.value)
        ):
            return rule
    return None


def _read_json(path: Path) -> tuple[dict, list[tuple[str, dict]]]:
    """Return the document, and the features of a sequence with their places in the file."""
    data = read_unpacked(path, what="city model", most_mb=CITY_MB)
    lines = data.replace(RECORD_SEPARATOR, b"").splitlines()
    is_sequence = len(lines) > 1 and b'"CityJSONFeature"' in data and _is_whole(lines[0])
    texts = [(f"{path}: line {k + 1}", line) for k, line in enumerate(lines) if line.strip()] if is_sequence else []
    head, *features = [
        (where, parse_document(text, where, what="city model")) for where, text in texts or [(str(path), data)]
    ]
    model = _document(head[1], path)
    for where, feature in features:
        if not isinstance(feature, dict) or feature.get("type") != "CityJSONFeature":
            got = repr(feature.get("type")) if isinstance(feature, dict) else type(feature).__name__
            raise InputError("not a feature", where=f"{where}: type", got=got, expected="'CityJSONFeature'")
    if not features and not model["CityObjects"]:
        raise InputError("no city objects", where=f"{path}: CityObjects", expected="an object that is not empty")
    return model, features


def _is_whole(line: bytes) -> bool:
    """Return whether a line is JSON by itself: a document over several lines is not."""
    try:
        parse_json(line)
    except ValueError:
        return False
    return True


def _document(model: Any, path: Path) -> dict:
    """Check what the document says of itself; a version with a patch number (1.0.1) counts as the version."""
    kind = model.get("type") if isinstance(model, dict) else None
    if not isinstance(model, dict) or kind != "CityJSON":
        is_headless = kind == "CityJSONFeature"
        fix = "put the CityJSON object with version and transform on the first line" if is_headless else None
        got = repr(kind) if isinstance(model, dict) else type(model).__name__
        raise InputError("not a CityJSON file", where=f"{path}: type", got=got, expected="'CityJSON'", fix=fix)
    version = ".".join(str(model.get("version")).split(".")[:2])
    if version not in VERSIONS:
        raise InputError(
            "unknown version", where=f"{path}: version", got=repr(model.get("version")), expected=" or ".join(VERSIONS),
            fix="convert it, for instance with cjio upgrade",
        )  # fmt: skip
    if not isinstance(model.get("CityObjects"), dict):
        raise InputError("no city objects", where=f"{path}: CityObjects", expected="an object")
    return model | {"version": version}


def _parts(head: dict, features: list[tuple[str, dict]], path: Path) -> list[_Part]:
    """Return the document's own objects, where it has any, and those of each feature; all share the document's
    transform."""
    transform = _transform(head, path)
    parts = []
    for where, value in [(str(path), head)] * bool(head["CityObjects"]) + features:
        if not isinstance(value.get("CityObjects"), dict):
            raise InputError("no city objects", where=f"{where}: CityObjects", expected="an object")
        vertices = _vectors(value.get("vertices"), f"{where}: vertices")
        parts.append(_Part(value["CityObjects"], vertices * transform[0] + transform[1], where))
    return parts


def _transform(model: dict, path: Path) -> np.ndarray:
    """Scale and translation of the vertices, (2, 3)."""
    transform = model.get("transform")
    if transform is None and model["version"] in PLAIN_VERTICES:
        return np.array([[1.0] * 3, [0.0] * 3])
    parts = []
    for name in ("scale", "translate"):
        if not isinstance(transform, dict) or transform.get(name) is None:
            raise InputError(MISSING, where=f"{path}: transform.{name}", expected="three finite numbers")
        part = numbers(transform[name], 3)
        if part is None:
            raise InputError("not a vector", where=f"{path}: transform.{name}", expected="three finite numbers")
        parts.append(part)
    return np.array(parts)


def _vectors(values: Any, where: str) -> np.ndarray:
    """Lists of three numbers as (n, 3)."""
    vectors = np.empty((0, 3)) if values == [] else numbers(values, None, 3)
    if vectors is None:
        raise InputError("not a list of vertices", where=where, expected="lists of three finite numbers")
    return vectors


def _templates(model: dict, path: Path) -> _Templates:
    value = model.get("geometry-templates")
    if value is None:
        return _Templates([], np.empty((0, 3)))
    where = f"{path}: geometry-templates"
    if not isinstance(value, dict) or not isinstance(value.get("templates"), list):
        raise InputError("no list of templates", where=f"{where}.templates", expected="a list of geometries")
    return _Templates(value["templates"], _vectors(value.get("vertices-templates"), f"{where}.vertices-templates"))


def _surfaces(
    geometries: Any, vertices: np.ndarray, templates: _Templates, where: str
) -> tuple[list[list[np.ndarray]], list[list[np.ndarray]], float]:
    """Return the surfaces of the plainest geometry with a height, those of the most detailed one, the former's
    level."""
    if not isinstance(geometries, list) or not all(isinstance(g, dict) for g in geometries):
        raise InputError("not a list of geometries", where=where, got=type(geometries).__name__)
    placed = [_placed(g, vertices, templates, f"{where}[{k}]") for k, g in enumerate(geometries)]
    usable = [(_level(g), number) for number, (g, _) in enumerate(placed) if str(g.get("type")) in NESTING]
    if not usable:
        return [], [], 0.0
    level, number = min(usable, key=lambda pair: (pair[0] < 1, pair[0]))
    _, finest = max(usable, key=lambda pair: pair[0])
    plain = _surfaces_of(*placed[number], f"{where}[{number}].boundaries")
    return plain, plain if finest == number else _surfaces_of(*placed[finest], f"{where}[{finest}].boundaries"), level


def _surfaces_of(geometry: dict, corners: np.ndarray, where: str) -> list[list[np.ndarray]]:
    """Return the surfaces of one geometry; of a solid those of its outer shell."""
    lists, nesting = geometry.get("boundaries"), NESTING[geometry["type"]]
    solids = lists if nesting == 2 else [lists] if nesting == 1 else [[lists]]
    found: list = []
    for solid in _list(solids, where):
        for shell in _list(solid, where)[:1]:  # the outer shell
            found += _list(shell, where)
    return [_rings(surface, corners, f"{where} surface {k}") for k, surface in enumerate(found)]


def _placed(geometry: dict, vertices: np.ndarray, templates: _Templates, where: str) -> tuple[dict, np.ndarray]:
    """Return a geometry and the vertices that it counts in; an instance gives its template, moved to its place."""
    if geometry.get("type") != "GeometryInstance":
        return geometry, vertices
    number, anchor = geometry.get("template"), geometry.get("boundaries")
    if not _is_index(number, len(templates.geometries)):
        raise InputError(
            "no such template",
            where=f"{where}.template",
            got=repr(number)[:40],
            expected=f"below {len(templates.geometries)}",
        )
    if not (isinstance(anchor, list) and len(anchor) == 1 and _is_index(anchor[0], len(vertices))):
        raise InputError(
            "no place for a template", where=f"{where}.boundaries", got=repr(anchor)[:40], expected="one vertex index"
        )
    try:
        matrix = np.array(geometry.get("transformationMatrix"), dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        matrix = np.full((4, 4), np.nan)
    if not np.isfinite(matrix).all():
        expected = "16 finite numbers, row by row"
        raise InputError("not a matrix", where=f"{where}.transformationMatrix", expected=expected)
    template = templates.geometries[number]
    if not isinstance(template, dict):
        raise InputError("not a geometry", where=f"{where}.template", got=type(template).__name__, expected="an object")
    return template, templates.vertices @ matrix[:3, :3].T + matrix[:3, 3] + vertices[anchor[0]]


def _is_index(value: Any, count: int) -> TypeGuard[int]:
    return type(value) is int and 0 <= value < count


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
