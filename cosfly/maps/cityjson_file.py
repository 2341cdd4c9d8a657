"""Reading CityJSON: from the file to objects with a rule and with surfaces in the file's coordinates.

One document or a text sequence (CityJSONSeq: the document first, then one feature a line, with its own vertices).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AliasPath, BaseModel, Field, FiniteFloat

from cosfly.formats.columns import numbers
from cosfly.maps.boxlist import WIDEST_M, SkippedEntries
from cosfly.maps.units import METRES, Units, declared_units, length_m, refused
from cosfly.runtime.config import read_yaml
from cosfly.runtime.errors import InputError, counts_text, json_type, shown
from cosfly.runtime.io import over_limit, read_unpacked
from cosfly.runtime.json_io import parse_document, validated

log = logging.getLogger(__name__)

CITY_MB = 16_384  # on disk and unpacked; as values of Python it takes ten times that
MOST_VERTICES = 100_000  # of a surface, its holes included
FLAT_M = 0.01  # an object whose heights differ by less is a footprint
STOREY_M = 3.0
HIGHEST_M = 2_000.0  # of a building
VERSIONS = ("1.1", "2.0")
RECORD_SEPARATOR = b"\x1e"  # before each text of a sequence of RFC 7464
VALIDATE = "check the file with `cjio FILE validate`"
# Rings are indices of vertices; of a solid's shells only the outer one counts.
_Ring = Annotated[list[Annotated[int, Field(strict=True, ge=0)]], Field(min_length=3)]
_Surface = Annotated[list[_Ring], Field(min_length=1)]
_Shells = list[list[_Surface]]
GEOMETRIES = ("MultiSurface", "CompositeSurface", "Solid", "MultiSolid", "CompositeSolid")
Form = Literal["solid", "wall", "surface", "green"]
Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Surface = list[np.ndarray]  # rings of (n, 3) m: the outline, then the holes


class ObjectRule(NamedTuple):
    """The kind and form of objects of a CityJSON type: a row of `cityjson_rules.yaml`."""

    type: str
    kind: str
    form: Form
    attribute: str = ""
    value: str = "*"

    def covers(self, item: _Object) -> bool:
        """Return whether the rule applies to an object. Extension types (a leading +) count as their base name."""
        value = str(item.attribute(self.attribute) or "")
        return fnmatchcase(item.type.removeprefix("+"), self.type) and fnmatchcase(value, self.value)


RULES = [ObjectRule(**fields) for fields in read_yaml(Path(__file__).with_name("cityjson_rules.yaml"))["rules"]]


class CityObject(NamedTuple):
    object_id: str
    rule: ObjectRule
    surfaces: list[Surface]  # of the coarsest geometry with a height; boxes are made of them
    detailed: list[Surface]  # of the most detailed geometry of a solid; the renderer draws them

    def corners(self) -> np.ndarray:
        """Return all vertices, (n, 3) m."""
        return np.concatenate([ring for surface in self.surfaces for ring in surface])

    def moved(self, move: Callable[[np.ndarray], np.ndarray]) -> CityObject:
        """Return the object with each ring of vertices moved."""

        def moved_surfaces(surfaces: list[Surface]) -> list[Surface]:
            return [[move(ring) for ring in surface] for surface in surfaces]

        return self._replace(surfaces=moved_surfaces(self.surfaces), detailed=moved_surfaces(self.detailed))


class CityModel(NamedTuple):
    """The content of a file."""

    objects: list[CityObject]  # that are used
    dropped: SkippedEntries  # the others
    num_objects: int  # of both
    version: str


class _Geometry(BaseModel):
    type: str
    lod: Any = 0
    boundaries: list[Any] = []

    @property
    def level(self) -> float:
        try:
            return float(self.lod)
        except (TypeError, ValueError):
            return 0.0


class _Object(BaseModel):
    type: str
    attributes: Any = None
    geometry: list[_Geometry] | None = None
    children: Any = None

    def attribute(self, *names: str) -> Any:
        """Return the first of these attributes that has a value."""
        values = self.attributes if isinstance(self.attributes, dict) else {}
        return next((values[name] for name in names if values.get(name) is not None), None)


class _Part(BaseModel):
    """City objects and the vertices that their indices refer to: a document, or one feature of a sequence."""

    objects: dict[str, Any] = Field(alias="CityObjects")
    vertices: list[Any]


class _Document(_Part):
    metadata: Any = None
    scale: Vector = Field(validation_alias=AliasPath("transform", "scale"))
    translate: Vector = Field(validation_alias=AliasPath("transform", "translate"))


class _Dropped(Exception):
    """The object is not used; the text is the reason."""


def read_model(path: Path, units: Units, most_skipped: float) -> CityModel:
    """Read a CityJSON file or text sequence, plain or gzipped; coordinates are in metres, in the file's axes.

    most_skipped: The largest share of objects that may be skipped because they are invalid.
    """
    version, document, features = _read_parts(path)
    unit_m = METRES[_units_of(document, path) if units == "auto" else units]
    objects = list[CityObject]()
    seen_ids = set[str]()
    num_objects = 0
    dropped = SkippedEntries()
    parts: list[tuple[str, _Part]] = [(str(path), document)] if document.objects else []
    for where, part in [*parts, *features]:
        with np.errstate(all="ignore"):  # each ring is checked for finite numbers
            vertices = _vectors(part.vertices, f"{where}: vertices") * document.scale + document.translate
            vertices *= unit_m
        num_objects += len(part.objects)
        for object_id, value in part.objects.items():
            place = f"{where}: CityObjects.{object_id}"
            if object_id in seen_ids:
                dropped.add("repeated_id")
                continue
            seen_ids.add(object_id)
            try:
                objects.append(_city_object(object_id, validated(_Object, value, place), part, vertices, place))
            except _Dropped as error:
                dropped.add(str(error))
            except InputError as error:
                dropped.add("invalid", str(error.where), str(error).removeprefix(f"{error.where}: "))
    middle = np.median([item.corners().mean(axis=0) for item in objects] or [np.zeros(3)], axis=0)
    near = []
    for item in objects:
        if (np.abs(item.corners() - middle) <= WIDEST_M).all():
            near.append(item)
        else:
            dropped.add("far_away", item.object_id, "it is more than 20 km from the middle of the map")
    dropped.check(path, num_objects, most_skipped, f"at most {most_skipped:.0%} invalid or far objects")
    if not near:
        counts = f"dropped objects: {counts_text(dropped.counts)}" if dropped.counts else "no objects"
        expected = "an object with a geometry and a supported type, such as Building"
        raise InputError("the file has no usable object", where=f"{path}: CityObjects", got=counts, expected=expected)
    return CityModel(near, dropped, num_objects, version)


def _units_of(document: _Document, path: Path) -> Units:
    """Return the units that a document declares, else metres; raise InputError for degrees."""
    declared = document.metadata.get("referenceSystem") if isinstance(document.metadata, dict) else None
    where = f"{path}: metadata.referenceSystem"
    units = declared_units(declared, where) or "m"
    if units == "degrees":
        raise refused(str(declared), where)
    return units


def _read_parts(path: Path) -> tuple[str, _Document, list[tuple[str, _Part]]]:
    """Return the version, the document, and the features of a sequence with their places in the file."""
    data = read_unpacked(path, what="city model", most_mb=CITY_MB)
    lines = data.replace(RECORD_SEPARATOR, b"").splitlines()
    texts = [(str(path), data)]
    if len(lines) > 1 and b'"CityJSONFeature"' in data and lines[0].rstrip().endswith(b"}"):  # not of one document
        texts = [(f"{path}: line {k + 1}", line) for k, line in enumerate(lines) if line.strip()]
    where, text = texts[0]
    value = _object_of_type("CityJSON", text, where)
    version = ".".join(str(value.get("version")).split(".")[:2])  # 1.1.3 is 1.1
    if version not in VERSIONS:
        raise InputError(
            "the version of CityJSON is not supported",
            where=f"{where}: version",
            got=shown(value.get("version")),
            expected=" or ".join(VERSIONS),
            fix="convert the file, for instance with `cjio OLD upgrade save NEW`",
        )
    document = validated(_Document, value, where)
    features: list[tuple[str, _Part]] = []
    for where, text in texts[1:]:
        features.append((where, validated(_Part, _object_of_type("CityJSONFeature", text, where), where)))
    return version, document, features


def _object_of_type(expected: str, text: bytes, where: str) -> dict[str, Any]:
    """Return the JSON object in a text; raise InputError if it is not of the expected type of CityJSON."""
    value = parse_document(text, where)
    object_type = shown(value.get("type")) if isinstance(value, dict) else json_type(value)
    if object_type != repr(expected):
        what = f"the JSON object is not a {expected} object"
        fix = "pass a CityJSON file, or a sequence of a CityJSON object and CityJSONFeature objects"
        raise InputError(what, where=f"{where}: type", got=object_type, expected=repr(expected), fix=fix)
    return value


def _vectors(values: list[Any], where: str) -> np.ndarray:
    """Return lists of three numbers as (n, 3)."""
    vectors = numbers(values, None, 3) if values else np.empty((0, 3))
    if vectors is None:
        raise InputError("a vertex is not a list of three finite numbers", where=where, fix=VALIDATE)
    return vectors


def _city_object(object_id: str, item: _Object, part: _Part, vertices: np.ndarray, where: str) -> CityObject:
    """Return an object; raise _Dropped if it is not used."""
    if item.type == "CityObjectGroup":  # its members are objects themselves
        raise _Dropped("group")
    rule = next((rule for rule in RULES if rule.covers(item)), None)
    if rule is None:
        log.warning("%s: dropped, because cosfly has no rule for the type %s", object_id, item.type)
        raise _Dropped("unmapped_type")
    geometries = item.geometry or []
    levels = {k: geometry.level for k, geometry in enumerate(geometries) if geometry.type in GEOMETRIES}
    if not levels:
        raise _Dropped("no_geometry")

    def surfaces_of(k: int) -> list[Surface]:
        return _surfaces(geometries[k], vertices, f"{where}.geometry[{k}].boundaries")

    coarsest = min(levels, key=lambda k: (levels[k] < 1, levels[k]))  # level 0 has no height
    finest = max(levels, key=levels.__getitem__)
    surfaces = surfaces_of(coarsest)
    if not surfaces:
        raise _Dropped("no_geometry")
    if rule.form != "solid":
        return CityObject(object_id, rule, surfaces, [])
    children = item.children if isinstance(item.children, list) else []
    if levels[coarsest] < 1 and any(isinstance(child, str) and child in part.objects for child in children):
        raise _Dropped("outline_of_parts")  # its parts have the walls; the outline would hide their courtyards
    heights = np.concatenate([ring[:, 2] for surface in surfaces for ring in surface])
    height_m = _height_of(item, is_needed=rule.kind == "Buildings") if np.ptp(heights) < FLAT_M else 0.0
    if height_m:
        solid = _raised(surfaces, height_m)
        return CityObject(object_id, rule, solid, solid)
    return CityObject(object_id, rule, surfaces, surfaces if finest == coarsest else surfaces_of(finest))


def _height_of(item: _Object, *, is_needed: bool) -> float:
    """Return the declared height of a footprint, m; 0 if there is none, or _Dropped if it is needed."""
    value = item.attribute("measuredHeight", "height")
    height_m = length_m(value.get("value") if isinstance(value, dict) else value)
    if math.isnan(height_m):
        height_m = length_m(item.attribute("storeysAboveGround")) * STOREY_M
    if 0 < height_m <= HIGHEST_M:
        return height_m
    if is_needed:
        raise _Dropped("no_height")
    return 0.0


def _raised(surfaces: list[Surface], height_m: float) -> list[Surface]:
    """Return footprints as solids: their roofs, and a wall under each edge."""
    solids = list[Surface]()
    for surface in surfaces:
        roof = [np.add(ring, (0.0, 0.0, height_m)) for ring in surface]
        solids += [surface, roof]
        for low, high in zip(surface, roof, strict=True):
            walls = zip(low, np.roll(low, -1, axis=0), np.roll(high, -1, axis=0), high, strict=True)
            solids += [[np.stack(wall)] for wall in walls]
    return solids


def _surfaces(geometry: _Geometry, vertices: np.ndarray, where: str) -> list[Surface]:
    """Return the surfaces of a geometry; for a solid those of its outer shell."""
    if geometry.type.endswith("Surface"):
        shells = [geometry.boundaries]
    elif geometry.type == "Solid":
        shells = geometry.boundaries[:1]  # the outer one
    else:
        shells = []
        for solid in geometry.boundaries:
            shells += solid[:1] if isinstance(solid, list) else [solid]
    try:
        outer = validated(_Shells, shells, where)
    except InputError as error:
        expected = "nested lists of rings of at least three indices of vertices"
        raise InputError(error.what, where=error.where, got=error.got, expected=expected, fix=VALIDATE) from error
    return [_rings(surface, vertices, f"{where} surface {k}") for k, surface in enumerate(chain(*outer))]


def _rings(surface: _Surface, vertices: np.ndarray, where: str) -> Surface:
    """Return the rings of a surface, the outline first; raise InputError for vertices that cannot be used."""
    highest = max(map(max, surface))
    if highest >= len(vertices):
        what = "the ring refers to a vertex that does not exist"
        expected = f"an index from 0 to {len(vertices) - 1}"
        raise InputError(what, where=where, got=str(highest)[:60], expected=expected, fix=VALIDATE)
    rings = [vertices[ring] for ring in surface]
    if not all(np.isfinite(ring).all() for ring in rings):
        raise InputError("a coordinate is not a finite number", where=where, fix=VALIDATE)
    num_vertices = sum(map(len, rings))
    if num_vertices > MOST_VERTICES:
        got = f"a surface of {num_vertices:,} vertices"
        raise over_limit(where, got, f"{MOST_VERTICES:,} vertices", "simplify the surface")
    return rings
