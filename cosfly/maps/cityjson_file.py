"""Reading CityJSON: from the file to objects with a rule and with surfaces in the file's coordinates.

One document or a text sequence (CityJSONSeq: the document first, then one feature a line, with its own vertices).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import AliasPath, BaseModel, Field, FiniteFloat

from cosfly.formats.columns import numbers
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import over_limit, read_unpacked
from cosfly.runtime.json_io import parse_document, parse_json, validated

log = logging.getLogger(__name__)

CITY_MB = 16_384  # on disk and unpacked; as values of Python it takes ten times that
MOST_VERTICES = 100_000  # of a surface, its holes included
VERSIONS = ("1.1", "2.0")
RECORD_SEPARATOR = b"\x1e"  # before each text of a sequence of RFC 7464
# Nesting of `boundaries` above the surfaces. Of a Solid's shells only the outer one counts.
NESTING = {"MultiSurface": 0, "CompositeSurface": 0, "Solid": 1, "MultiSolid": 2, "CompositeSolid": 2}
Form = Literal["solid", "wall", "surface", "green"]
Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Surface = list[np.ndarray]  # rings of (n, 3) m: the outline, then the holes


class ObjectRule(NamedTuple):
    """Kind and form of objects of a CityJSON type; with an attribute, only of those with a matching value."""

    type: str
    kind: str
    form: Form
    attribute: str = ""
    value: str = "*"

    def covers(self, item: _Object) -> bool:
        """Return whether the rule is for an object. Extension types (a leading +) count as their base name."""
        given = str((item.attributes or {}).get(self.attribute, ""))
        return fnmatchcase(item.type.removeprefix("+"), self.type) and fnmatchcase(given, self.value)


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
    # The edge of a quay is flush with the street.
    ObjectRule("GenericCityObject", "Walls", "surface", "bgt_type", "kademuur"),
    ObjectRule("*GenericCityObject", "Walls", "wall", "bgt_type", "muur"),
    ObjectRule("*GenericCityObject", "Static", "wall"),
    ObjectRule("CityFurniture", "Static", "solid"),
    ObjectRule("OtherConstruction", "Static", "solid"),
)


class CityObject(NamedTuple):
    """One object.

    surfaces: of the plainest geometry with a height, which boxes are made of; detailed: of the most detailed one of a
    solid, which is drawn.
    """

    object_id: str
    rule: ObjectRule
    surfaces: list[Surface]
    detailed: list[Surface]

    def corners(self) -> np.ndarray:
        """Return all vertices, (n, 3) m."""
        return np.concatenate([ring for surface in self.surfaces for ring in surface])

    def moved(self, move: Callable[[np.ndarray], np.ndarray]) -> CityObject:
        """Return the object with each ring of vertices moved."""
        surfaces, detailed = ([[move(r) for r in rings] for rings in each] for each in (self.surfaces, self.detailed))
        return self._replace(surfaces=surfaces, detailed=detailed)


class CityModel(NamedTuple):
    """The objects that a rule covers, and how many objects were dropped, by reason."""

    objects: list[CityObject]
    dropped: dict[str, int]
    num_objects: int
    version: str


class _Geometry(BaseModel):
    type: str
    lod: Any = 0
    boundaries: list[Any] = []
    template: int = -1
    transformationMatrix: list[FiniteFloat] = Field([], max_length=16)

    @property
    def level(self) -> float:
        try:
            return float(self.lod)
        except (TypeError, ValueError):
            return 0.0


class _Templates(BaseModel):
    templates: list[_Geometry] = []
    vertices: list[Any] = Field([], alias="vertices-templates")


class _Object(BaseModel):
    type: str
    attributes: dict[str, Any] | None = None
    geometry: list[_Geometry] = []
    children: list[str] | None = None


class _Part(BaseModel):
    """City objects and the vertices that their indices refer to: a document, or one feature of a sequence."""

    objects: dict[str, _Object] = Field(alias="CityObjects")
    vertices: list[Any]


class _Document(_Part):
    scale: Vector = Field(validation_alias=AliasPath("transform", "scale"))
    translate: Vector = Field(validation_alias=AliasPath("transform", "translate"))
    templates: _Templates = Field(_Templates(), alias="geometry-templates")


class _Vertices(NamedTuple):
    """Vertices of a part, the templates of the document and their vertices, (n, 3) m."""

    own: np.ndarray
    templates: list[_Geometry]
    of_templates: np.ndarray


def read_model(path: Path) -> CityModel:
    """Read a CityJSON file or text sequence, plain or gzipped; coordinates stay the file's."""
    version, head, features = _read_parts(path)
    of_templates = _vectors(head.templates.vertices, f"{path}: geometry-templates.vertices-templates")
    objects, known, num_objects = dict[str, CityObject](), set[str](), 0
    dropped = dict.fromkeys(("unmapped_type", "group", "no_geometry", "outline_of_parts", "repeated_id"), 0)
    for where, part in [(str(path), head), *features] if head.objects else features:
        own = _vectors(part.vertices, f"{where}: vertices") * head.scale + head.translate
        vertices = _Vertices(own, head.templates.templates, of_templates)
        num_objects += len(part.objects)
        for object_id, value in part.objects.items():
            found = _city_object(object_id, value, part, vertices, f"{where}: CityObjects.{object_id}")
            if object_id in known or isinstance(found, str):
                dropped["repeated_id" if object_id in known else str(found)] += 1
            else:
                objects[object_id] = found
            known.add(object_id)
    dropped = {reason: count for reason, count in dropped.items() if count}
    if not objects:
        got = ", ".join(f"{count} {reason}" for reason, count in dropped.items()) or "no objects"
        raise InputError("the model has no usable object", where=f"{path}: CityObjects", got=got)
    return CityModel(list(objects.values()), dropped, num_objects, version)


def _read_parts(path: Path) -> tuple[str, _Document, list[tuple[str, _Part]]]:
    """Return the version, the document, and the features of a sequence with their places in the file."""
    data = read_unpacked(path, what="city model", most_mb=CITY_MB)
    lines = data.replace(RECORD_SEPARATOR, b"").splitlines()
    texts = [(str(path), data)]
    if len(lines) > 1 and b'"CityJSONFeature"' in data and _is_json(lines[0]):
        texts = [(f"{path}: line {k + 1}", line) for k, line in enumerate(lines) if line.strip()]
    version, parts = "", list[tuple[str, Any]]()
    for where, text in texts:
        value = parse_document(text, where)
        found = value.get("type") if isinstance(value, dict) else type(value).__name__
        expected = "CityJSONFeature" if parts else "CityJSON"
        if found != expected:
            fix = None if parts else "put the CityJSON object with version and transform on the first line"
            what = "the object is not of the expected type"
            raise InputError(what, where=f"{where}: type", got=repr(found)[:80], expected=repr(expected), fix=fix)
        if not parts:
            version = ".".join(str(value.get("version")).split(".")[:2])  # 1.1.3 is 1.1
            if version not in VERSIONS:
                what, got = "the version of CityJSON is not supported", repr(value.get("version"))[:80]
                fix = "convert the file, for instance with `cjio OLD upgrade save NEW`"
                raise InputError(what, where=f"{where}: version", got=got, expected=" or ".join(VERSIONS), fix=fix)
        parts.append((where, validated(_Part if parts else _Document, value, where)))
    return version, parts[0][1], parts[1:]


def _is_json(line: bytes) -> bool:
    """Return whether a line is JSON by itself: the first one of a document over several lines is not."""
    try:
        parse_json(line)
    except ValueError:
        return False
    return True


def _vectors(values: list[Any], where: str) -> np.ndarray:
    """Return lists of three numbers as (n, 3)."""
    vectors = numbers(values, None, 3) if values else np.empty((0, 3))
    if vectors is None:
        raise InputError("the vertices are malformed", where=where, expected="lists of three finite numbers")
    return vectors


def _city_object(object_id: str, value: _Object, part: _Part, vertices: _Vertices, where: str) -> CityObject | str:
    """Return an object, or the reason why it is dropped."""
    if value.type == "CityObjectGroup":  # its members are objects themselves
        return "group"
    rule = next((rule for rule in RULES if rule.covers(value)), None)
    if rule is None:
        log.warning("%s: no rule for the type %s; dropped", object_id, value.type)
        return "unmapped_type"
    placed = [_placed(g, vertices, f"{where}.geometry[{k}]") for k, g in enumerate(value.geometry)]
    usable = [(geometry.level, number) for number, (geometry, _) in enumerate(placed) if geometry.type in NESTING]
    if not usable:
        return "no_geometry"
    level, plainest = min(usable, key=lambda pair: (pair[0] < 1, pair[0]))
    _, finest = max(usable, key=lambda pair: pair[0])
    surfaces = _surfaces(*placed[plainest], f"{where}.geometry[{plainest}].boundaries")
    if not surfaces:
        return "no_geometry"
    is_solid = rule.form == "solid"
    if level < 1 and is_solid and any(child in part.objects for child in value.children or []):
        return "outline_of_parts"  # its parts have the walls; the outline would hide their courtyards
    detailed = surfaces if is_solid else []
    if is_solid and finest != plainest:
        detailed = _surfaces(*placed[finest], f"{where}.geometry[{finest}].boundaries")
    return CityObject(object_id, rule, surfaces, detailed)


def _placed(geometry: _Geometry, vertices: _Vertices, where: str) -> tuple[_Geometry, np.ndarray]:
    """Return a geometry and its vertices; of an instance its template, moved to its place."""
    if geometry.type != "GeometryInstance":
        return geometry, vertices.own
    anchor = geometry.boundaries[0] if len(geometry.boundaries) == 1 else None
    if not 0 <= geometry.template < len(vertices.templates):
        got, expected = str(geometry.template)[:40], f"below {len(vertices.templates)}"
        raise InputError("the template does not exist", where=f"{where}.template", got=got, expected=expected)
    if type(anchor) is not int or not 0 <= anchor < len(vertices.own):
        got, expected = repr(geometry.boundaries)[:40], "one vertex index"
        raise InputError("the instance has no place", where=f"{where}.boundaries", got=got, expected=expected)
    if len(geometry.transformationMatrix) != 16:
        what, where = "the instance has no matrix", f"{where}.transformationMatrix"
        raise InputError(what, where=where, expected="16 finite numbers, row by row")
    matrix = np.array(geometry.transformationMatrix).reshape(4, 4)
    corners = vertices.of_templates @ matrix[:3, :3].T + matrix[:3, 3] + vertices.own[anchor]
    return vertices.templates[geometry.template], corners


def _surfaces(geometry: _Geometry, corners: np.ndarray, where: str) -> list[Surface]:
    """Return the surfaces of one geometry; of a solid those of its outer shell."""
    lists, nesting = geometry.boundaries, NESTING[geometry.type]
    solids = lists if nesting == 2 else [lists] if nesting == 1 else [[lists]]
    found = [one for solid in solids for shell in _list(solid, where)[:1] for one in _list(shell, where)]
    return [_rings(surface, corners, f"{where} surface {k}") for k, surface in enumerate(found)]


def _list(value: Any, where: str) -> list:
    if not isinstance(value, list):
        what = "the boundaries are not nested as the geometry's type requires"
        raise InputError(what, where=where, got=repr(value)[:40], expected="a list")
    return value


def _rings(surface: Any, vertices: np.ndarray, where: str) -> Surface:
    rings = Surface()
    for ring in _list(surface, where):
        if not isinstance(ring, list) or len(ring) < 3 or not all(type(index) is int for index in ring):
            expected = "at least three vertex indices"
            raise InputError("the ring is malformed", where=where, got=repr(ring)[:60], expected=expected)
        if min(ring) < 0 or max(ring) >= len(vertices):
            got, expected = str(min(ring) if min(ring) < 0 else max(ring)), f"0 to {len(vertices) - 1}"
            raise InputError("the vertex does not exist", where=where, got=got[:60], expected=expected)
        rings.append(vertices[ring])
    if not rings or not all(np.isfinite(ring).all() for ring in rings):
        raise InputError("the surface has no finite vertices", where=where, expected="a list of rings")
    if (num := sum(map(len, rings))) > MOST_VERTICES:
        raise over_limit(where, f"a surface of {num:,} vertices", f"{MOST_VERTICES:,}", "simplify it")
    return rings
