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
FLAT_M, STOREY_M, HIGHEST_M = 0.01, 3.0, 2_000.0  # a footprint is flatter; of a storey; of a building
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
    """One object.

    surfaces: those of the coarsest geometry with a height; boxes are made of them. detailed: those of the most
    detailed geometry of a solid; the renderer draws them.
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

        def moved_surfaces(surfaces: list[Surface]) -> list[Surface]:
            return [[move(ring) for ring in surface] for surface in surfaces]

        return self._replace(surfaces=moved_surfaces(self.surfaces), detailed=moved_surfaces(self.detailed))


class CityModel(NamedTuple):
    """The objects that a rule covers, and those that are not used."""

    objects: list[CityObject]
    dropped: SkippedEntries
    num_objects: int
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
    version, head, features = _read_parts(path)
    if units == "auto":
        declared = head.metadata.get("referenceSystem") if isinstance(head.metadata, dict) else None
        units = declared_units(declared, f"{path}: metadata.referenceSystem") or "m"
        if units == "degrees":
            raise refused(str(declared), f"{path}: metadata.referenceSystem")
    objects = dict[str, CityObject]()
    seen_ids = set[str]()
    num_objects = 0
    dropped = SkippedEntries()
    for where, part in [(str(path), head), *features] if head.objects else features:
        with np.errstate(all="ignore"):  # each ring is checked for finite numbers
            vertices = _vectors(part.vertices, f"{where}: vertices") * head.scale + head.translate
            vertices *= METRES[units]
        num_objects += len(part.objects)
        for object_id, value in part.objects.items():
            place = f"{where}: CityObjects.{object_id}"
            if object_id in seen_ids:
                dropped.add("repeated_id")
                continue
            seen_ids.add(object_id)
            try:
                objects[object_id] = _city_object(object_id, validated(_Object, value, place), part, vertices, place)
            except _Dropped as error:
                dropped.add(str(error))
            except InputError as error:
                dropped.add("invalid", str(error.where), str(error).removeprefix(f"{error.where}: "))
    middle = np.median([item.corners().mean(axis=0) for item in objects.values()] or [np.zeros(3)], axis=0)
    for object_id, item in list(objects.items()):
        if (np.abs(item.corners() - middle) > WIDEST_M).any():
            dropped.add("far_away", object_id, "it is more than 20 km from the middle of the map")
            del objects[object_id]
    dropped.check(path, num_objects, most_skipped, f"at most {most_skipped:.0%} invalid or far objects")
    if not objects:
        counts = f"dropped objects: {counts_text(dropped.counts)}" if dropped.counts else "no objects"
        expected = "an object with a geometry and a supported type, such as Building"
        raise InputError("the file has no usable object", where=f"{path}: CityObjects", got=counts, expected=expected)
    return CityModel(list(objects.values()), dropped, num_objects, version)


def _read_parts(path: Path) -> tuple[str, _Document, list[tuple[str, _Part]]]:
    """Return the version, the document, and the features of a sequence with their places in the file."""
    data = read_unpacked(path, what="city model", most_mb=CITY_MB)
    lines = data.replace(RECORD_SEPARATOR, b"").splitlines()
    texts = [(str(path), data)]
    if len(lines) > 1 and b'"CityJSONFeature"' in data and lines[0].rstrip().endswith(b"}"):  # not of one document
        texts = [(f"{path}: line {k + 1}", line) for k, line in enumerate(lines) if line.strip()]
    version = ""
    parts = list[tuple[str, Any]]()
    for where, text in texts:
        value = parse_document(text, where)
        object_type = shown(value.get("type")) if isinstance(value, dict) else json_type(value)
        expected = "CityJSONFeature" if parts else "CityJSON"
        if object_type != repr(expected):
            raise InputError(
                f"the JSON object is not a {expected} object",
                where=f"{where}: type",
                got=object_type,
                expected=repr(expected),
                fix="pass a CityJSON file, or a sequence of a CityJSON object and CityJSONFeature objects",
            )
        if not parts:
            version = ".".join(str(value.get("version")).split(".")[:2])  # 1.1.3 is 1.1
            if version not in VERSIONS:
                raise InputError(
                    "the version of CityJSON is not supported",
                    where=f"{where}: version",
                    got=shown(value.get("version")),
                    expected=" or ".join(VERSIONS),
                    fix="convert the file, for instance with `cjio OLD upgrade save NEW`",
                )
        parts.append((where, validated(_Part if parts else _Document, value, where)))
    return version, parts[0][1], parts[1:]


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
    usable = [k for k, geometry in enumerate(geometries) if geometry.type in GEOMETRIES]
    if not usable:
        raise _Dropped("no_geometry")

    def level(k: int) -> float:
        return geometries[k].level

    def surfaces_of(k: int) -> list[Surface]:
        return _surfaces(geometries[k], vertices, f"{where}.geometry[{k}].boundaries")

    coarsest = min(usable, key=lambda k: (level(k) < 1, level(k)))  # level 0 has no height
    finest = max(usable, key=level)
    surfaces = surfaces_of(coarsest)
    if not surfaces:
        raise _Dropped("no_geometry")
    if rule.form != "solid":
        return CityObject(object_id, rule, surfaces, [])
    children = item.children if isinstance(item.children, list) else []
    if level(coarsest) < 1 and any(isinstance(child, str) and child in part.objects for child in children):
        raise _Dropped("outline_of_parts")  # its parts have the walls; the outline would hide their courtyards
    heights = np.concatenate([ring[:, 2] for surface in surfaces for ring in surface])
    if np.ptp(heights) < FLAT_M and (height_m := _height_of(item, is_needed=rule.kind == "Buildings")):
        surfaces = _raised(surfaces, height_m)
        return CityObject(object_id, rule, surfaces, surfaces)
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
    shells = geometry.boundaries  # of a solid
    if geometry.type.endswith("Surface"):
        shells = [geometry.boundaries]
    elif geometry.type != "Solid":
        shells = [shell for solid in shells for shell in (solid[:1] if isinstance(solid, list) else [solid])]
    try:
        outer = validated(_Shells, shells[:1] if geometry.type == "Solid" else shells, where)
    except InputError as error:
        expected = "nested lists of rings of at least three indices of vertices"
        raise InputError(error.what, where=error.where, got=error.got, expected=expected, fix=VALIDATE) from error
    return [_rings(surface, vertices, f"{where} surface {k}") for k, surface in enumerate(chain(*outer))]


def _rings(surface: _Surface, vertices: np.ndarray, where: str) -> Surface:
    """Return the rings of a surface, the outline first; raise InputError for vertices that cannot be used."""
    if (highest := max(map(max, surface))) >= len(vertices):
        what, expected = "the ring refers to a vertex that does not exist", f"an index from 0 to {len(vertices) - 1}"
        raise InputError(what, where=where, got=str(highest)[:60], expected=expected, fix=VALIDATE)
    rings = [vertices[ring] for ring in surface]
    if not all(np.isfinite(ring).all() for ring in rings):
        raise InputError("a coordinate is not a finite number", where=where, fix=VALIDATE)
    if (num_vertices := sum(map(len, rings))) > MOST_VERTICES:
        got = f"a surface of {num_vertices:,} vertices"
        raise over_limit(where, got, f"{MOST_VERTICES:,} vertices", "simplify the surface")
    return rings
