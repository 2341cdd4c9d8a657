"""Boxes of your own: a `boxes_3d.json`, a table (CSV), or GeoJSON.

A row of a table is a box with the fields of COLUMNS. A feature of GeoJSON is a point with these properties, or an
outline with a height; an outline that is not a rectangle becomes the rectangles that cover it. The names of columns
carry the meaning and the unit: nothing is guessed, and extent, heights, yaws and overlaps are logged for the user.
"""

from __future__ import annotations

import csv
import io
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import shapely
import shapely.errors
from pydantic import Field, field_validator
from shapely.geometry import Polygon, shape

from cosfly.formats.boxes import UNKNOWN_LICENCE, BoxMap, LicenceId, MapHeader, MapSource, read_boxes
from cosfly.formats.columns import LARGEST
from cosfly.formats.kinds import GROUND_KINDS, KINDS, SURFACE_KINDS
from cosfly.maps.boxlist import BoxList, origin_m, required
from cosfly.maps.footprints import CUT_SHARES, Rectangle, cover, with_derived_ground
from cosfly.runtime.config import Config
from cosfly.runtime.errors import ConfigError, InputError, nearest
from cosfly.runtime.io import read_text
from cosfly.runtime.json_io import read_json

log = logging.getLogger(__name__)

NUMBERS = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_deg")
COLUMNS = ("type", "id", "name", *NUMBERS)
PLACE = ("x_m", "y_m", "length_m", "width_m")  # every table has them; and height_m, except of surfaces
TYPES = [kind for kind in KINDS if kind != "NONE"]
GEOMETRIES = ("Point", "Polygon", "MultiPolygon")  # of GeoJSON
LARGEST_PLACE = 1e9  # absolute value of a coordinate of GeoJSON
MOST_NAME = 40  # characters of a name in messages
SLAB_M = 0.3  # thickness of a surface without a height: its top is the ground
FAR_M = 10_000.0  # a map with its middle farther from the origin is moved there
OUTLINE_FILL, OUTLINE_PIECE_M = 0.9, 3.0  # share of its boxes that an outline fills; shortest piece that is cut
OVERLAP_M = 0.05  # boxes that share less than this only touch
WIDEST_DEG = 2.0  # of a map in longitude and latitude: beyond this a plane that touches the Earth is no map of it
EARTH_M, EARTH_E2 = 6_378_137.0, 0.00669437999014  # WGS 84: equatorial radius, squared eccentricity


class BoxesConfig(Config):
    """Boxes of your own."""

    name: str = Field(
        "Boxes", min_length=1, description="name of the map, with which folder names in the playback tree begin"
    )
    path: Path | None = Field(None, description="boxes_3d.json, .csv or .geojson file; docs/files.md lists the columns")
    units: Literal["m", "degrees"] = Field(
        "m", description="unit of the coordinates of GeoJSON: m, or degrees of longitude and latitude"
    )
    types: dict[str, str] = Field(
        {}, description="type names of the file and their types in cosfly, such as {house: Buildings}"
    )
    ignore: list[str] = Field([], description="columns or properties to ignore; ['*']: all unknown ones")
    ground_z_m: float = Field(0.0, description="height of the flat ground, in the file's coordinates, m")
    derive_ground: bool = Field(False, description="derive streets, pavements and lawn from the buildings")
    licence: LicenceId = Field(
        UNKNOWN_LICENCE, description="licence of the boxes, as spelled on the Hugging Face Hub (cc-by-4.0)"
    )
    credits: str = Field("", description="attribution of the map's makers, in one or more sentences")

    @field_validator("types")
    @classmethod
    def _types_are_known(cls, types: dict[str, str]) -> dict[str, str]:
        problems = [f"{name} has the unknown type {kind!r}" for name, kind in types.items() if kind not in TYPES]
        if problems:
            raise ValueError(f"{'; '.join(problems)}; expected one of {', '.join(TYPES)}")
        return types

    def inputs(self) -> dict[str, Path]:
        return {"boxes": required(self.path, "maps.boxes.path")}


class _Row(NamedTuple):
    """One row of a table, a feature or one part of it; `problem` is empty if it could be read."""

    where: str
    values: Mapping[str, Any]
    outline: Any = None  # a geometry of shapely
    problem: str = ""


def load(cfg: BoxesConfig, seed: int = 0) -> BoxMap:
    """Read boxes; the seed changes nothing."""
    path = cfg.inputs()["boxes"]
    suffix = path.suffix.lower()
    if suffix not in (".json", ".csv", ".geojson"):
        raise InputError(
            "the file type of the map is not supported", where=path, got=path.suffix, expected=".json, .csv or .geojson"
        )
    if suffix == ".json" and (cfg.types or cfg.ignore or cfg.ground_z_m):
        raise ConfigError(
            "boxes_3d.json contains its own types and ground height, so settings for them would have no effect",
            where="maps.boxes",
            fix="remove maps.boxes.types, maps.boxes.ignore and maps.boxes.ground_z_m",
        )
    box_map = read_boxes(path) if suffix == ".json" else _read_rows(cfg, path, suffix)
    settings = cfg.model_dump(include=cfg.model_fields_set & {"name", "licence", "credits"})
    source = MapSource(tool=box_map.header.source.tool or "boxes", file=path.name)
    header = box_map.header.model_copy(update={**settings, "source": source})
    low, high = box_map.bounds()
    if np.abs((low + high)[:2] / 2).max() > FAR_M and header.ground is None:
        origin = origin_m(low, high, path)
        log.info("%s: the middle of the map, %s, becomes the origin", path.name, origin[:2].tolist())
        header = header.model_copy(update={"offset_m": dict(zip("xyz", origin.tolist(), strict=True))})
        box_map = replace(box_map, centers=box_map.centers - origin)
    box_map = replace(box_map, header=header)
    log.info("%s: %s", path.name, plausibility(box_map))
    return with_derived_ground(box_map) if cfg.derive_ground else box_map


def plausibility(box_map: BoxMap) -> str:
    """Return one line that shows a user mistaken units, axes and angles."""
    low, high = box_map.bounds()
    solid = box_map.select(~box_map.is_any_of(SURFACE_KINDS))
    text = f"{len(box_map)} boxes, {' x '.join(f'{size:.6g}' for size in high - low)} m"
    if not len(solid):
        return text
    yaws_deg = solid.rotations_deg[:, 1]
    feet_m = solid.mins[:, 2] - solid.ground.height_at(solid.centers)
    heights_m = 2 * solid.half_extents[:, 2]
    outlines = shapely.box(*(solid.mins[:, :2] + OVERLAP_M / 2).T, *(solid.maxs[:, :2] - OVERLAP_M / 2).T)
    first, second = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    shared_m = np.minimum(*solid.maxs[[first, second], 2]) - np.maximum(*solid.mins[[first, second], 2])
    overlapping = np.unique(first[(first != second) & (shared_m > OVERLAP_M)])
    return (
        f"{text}; obstacles {heights_m.min():.4g} to {heights_m.max():.4g} m high, bases {feet_m.min():.4g} to "
        f"{feet_m.max():.4g} m above the ground, yaw {yaws_deg.min():.4g} to {yaws_deg.max():.4g} degrees, "
        f"{len(overlapping) / len(solid):.0%} overlap another obstacle"
    )


def _read_rows(cfg: BoxesConfig, path: Path, suffix: str) -> BoxMap:
    rows = list(_table_rows(cfg, path) if suffix == ".csv" else _feature_rows(cfg, path))
    if not rows:
        raise InputError("the file has no boxes", where=path, expected="at least one row or feature with a box")
    boxes = BoxList()
    rows_by_problem = dict[str, list[str]]()  # so that each problem is listed once
    for row in rows:
        if problem := row.problem or _add(boxes, row, cfg):
            rows_by_problem.setdefault(problem, []).append(row.where)
    ids = _ids_of(rows)
    if len(set(ids)) < len(ids) or not all(0 <= number < 2**63 for number in ids):
        rows_by_problem["the ids must be different whole numbers"] = [""]
    if rows_by_problem:
        problems = []
        for problem, places in rows_by_problem.items():
            more = f" (and {len(places) - 1} more)" if len(places) > 1 else ""
            problems.append(f"{places[0]}: {problem}{more}".removeprefix(": "))
        expected = f"columns {', '.join(COLUMNS)}; types {', '.join(TYPES)}, or types listed in maps.boxes.types"
        raise InputError.of_all(problems, where=path, expected=expected)
    box_map = boxes.box_map(MapHeader(name=cfg.name, ground_z_m=cfg.ground_z_m, num_objects=len(rows)))
    if len(box_map) == len(ids):  # no outline became several boxes
        return replace(box_map, ids=np.array(ids, dtype=np.uint64))
    return box_map


def _ids_of(rows: Sequence[_Row]) -> list[int]:
    """Return the ids of the rows, -1 for a text that is no whole number; none if a row has no id."""
    texts = [str(row.values["id"]) for row in rows if row.values.get("id")]
    if len(texts) < len(rows):
        return []
    return [int(text) if text.isascii() and text.isdecimal() else -1 for text in texts]


def _table_rows(cfg: BoxesConfig, path: Path) -> Iterator[_Row]:
    lines = csv.reader(io.StringIO(read_text(path, what="table of boxes").removeprefix("\ufeff")), strict=True)
    names: list[str] = []
    try:
        for line in lines:
            cells = [cell.strip() for cell in line]
            if not any(cells):
                continue
            if not names:
                names = cells
                problems = _unknown(names, cfg)
                problems += [f"the column {name} is missing" for name in ("type", *PLACE) if name not in names]
                problems += [f"the column {name} occurs twice" for name, count in Counter(names).items() if count > 1]
                if problems:
                    raise InputError.of_all(
                        problems, where=path, expected=f"columns {', '.join(COLUMNS)}, separated by commas"
                    )
                continue
            problem = "" if len(cells) == len(names) else f"{len(cells)} cells, but the first line has {len(names)}"
            values = {name: cell for name, cell in zip(names, cells, strict=False) if cell and name in COLUMNS}
            yield _Row(f"line {lines.line_num}", values, problem=problem)
    except csv.Error as error:
        where, fix = f"{path}: line {lines.line_num}", "export the table again as CSV"
        raise InputError("the file is not a CSV table", where=where, got=str(error), fix=fix) from None


def _feature_rows(cfg: BoxesConfig, path: Path) -> Iterator[_Row]:
    value = read_json(path, what="map")
    if not isinstance(value, dict) or value.get("type") not in ("FeatureCollection", "Feature", *GEOMETRIES):
        expected, fix = f"FeatureCollection, Feature, {', '.join(GEOMETRIES)}", "export the file again as GeoJSON"
        raise InputError("the file is not GeoJSON", where=f"{path}: type", expected=f"one of {expected}", fix=fix)
    items = value.get("features") if value["type"] == "FeatureCollection" else [value]
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        what, fix = "the FeatureCollection has no list of features", "export the file again as GeoJSON"
        raise InputError(what, where=f"{path}: features", expected="a list of Feature objects", fix=fix)
    features = [_feature(item, number) for number, item in enumerate(items, 1)]
    names = dict.fromkeys(name for feature in features for name in feature.values)
    yield from (_Row("", {}, problem=problem) for problem in _unknown(list(names), cfg))
    places = shapely.get_coordinates([feature.outline for feature in features])
    project = _to_metres(cfg, places, path) if len(places) else None
    for feature in features:
        row = {k: value for k, value in feature.values.items() if value is not None and k in COLUMNS}
        if feature.problem or project is None:
            yield feature._replace(values=row)
            continue
        for part in shapely.get_parts(shapely.transform(feature.outline, project)):
            if isinstance(part, Polygon):
                yield _Row(feature.where, row, part)
            else:
                yield _Row(feature.where, {**row, "x_m": part.x, "y_m": part.y})


def _feature(item: dict[str, Any], number: int) -> _Row:
    """Return a Feature or a bare geometry with its properties; `number` counts from 1."""
    properties = item["properties"] if isinstance(item.get("properties"), dict) else {}
    where = f"feature {number}"
    names = (properties.get("name"), item.get("id"), properties.get("id"))
    if name := next((str(value)[:MOST_NAME] for value in names if value not in (None, "")), None):
        where += f" ({name})"
    geometry = item.get("geometry") if item.get("type") == "Feature" else item
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in GEOMETRIES:
        problem = f"the geometry {str(kind)[:MOST_NAME]} is not supported; expected one of {', '.join(GEOMETRIES)}"
        return _Row(where, properties, problem=problem)
    try:
        outline = shapely.force_2d(shape(geometry))
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, shapely.errors.ShapelyError):
        outline = Polygon()
    places = shapely.get_coordinates(outline)
    if len(places) == 0 or not (np.abs(places) <= LARGEST_PLACE).all():  # NaN fails
        problem = f"the coordinates of the {kind} are invalid; expected [x, y], at least four points in a ring"
        return _Row(where, properties, problem=problem)
    return _Row(where, properties, outline)


def _to_metres(cfg: BoxesConfig, places: np.ndarray, path: Path) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that converts coordinates of the file, (n, 2), to metres east and north.

    Degrees are projected on the plane that touches the Earth in the middle of all coordinates of the file, `places`.
    """
    low, high = places.min(axis=0), places.max(axis=0)
    size = float((high - low).max())
    may_be_degrees = size <= WIDEST_DEG and (np.abs(places) <= [180.0, 90.0]).all()
    if (cfg.units == "degrees" and not may_be_degrees) or (cfg.units == "m" and may_be_degrees and size > 0):
        other_unit = "degrees" if cfg.units == "m" else "m"
        raise InputError(
            f"the coordinates in the file do not look like {'metres' if cfg.units == 'm' else cfg.units}",
            where=path,
            got=f"{low.tolist()} to {high.tolist()}",
            expected="a map wider than 2 m" if cfg.units == "m" else "longitude and latitude of one town",
            fix=f"if the unit of the coordinates is {other_unit}, pass --set maps.boxes.units={other_unit}",
        )
    if cfg.units == "m":
        return lambda ring: ring
    middle = (low + high) / 2
    log.info("longitude and latitude are converted to metres east and north of %.6f, %.6f", *middle)
    latitude = math.radians(middle[1])
    curvature = 1 - EARTH_E2 * math.sin(latitude) ** 2
    east_m = EARTH_M / math.sqrt(curvature) * math.cos(latitude)  # metres in a radian of longitude
    north_m = EARTH_M * (1 - EARTH_E2) / curvature**1.5  # metres in a radian of latitude
    return lambda ring: np.radians(ring - middle) * [east_m, north_m]


def _unknown(names: Sequence[str], cfg: BoxesConfig) -> list[str]:
    if "*" in cfg.ignore:
        return []
    accepted = {*COLUMNS, *cfg.ignore}
    return [f"unknown column {name!r}{nearest(name, COLUMNS)}" for name in names if name not in accepted]


def _add(boxes: BoxList, row: _Row, cfg: BoxesConfig) -> str:
    """Add the boxes of a row; return its problems, an empty text if there are none."""
    type_name = str(row.values.get("type", ""))
    kind = cfg.types.get(type_name, type_name)
    numbers = {name: _number(row.values[name]) for name in NUMBERS if name in row.values}
    is_slab = "height_m" not in numbers and kind in TYPES and KINDS[kind] in GROUND_KINDS
    needed = list(PLACE) if row.outline is None else []
    if not is_slab:
        needed.append("height_m")
    sizes = [name for name in needed if name not in ("x_m", "y_m")]
    problems = [] if kind in TYPES else [f"unknown type {type_name[:40]!r}{nearest(type_name, [*TYPES, *cfg.types])}"]
    problems += [f"{name} is missing" for name in needed if name not in numbers]
    not_finite = [name for name, number in numbers.items() if math.isnan(number)]
    problems += [f"{name} is not a finite number: {str(row.values[name])[:40]!r}" for name in not_finite]
    problems += [f"{name} must be above 0" for name in sizes if numbers.get(name, 1.0) <= 0]
    if row.outline is not None and not row.outline.is_valid:
        problems.append(f"the outline crosses itself: {shapely.is_valid_reason(row.outline)}")
    if problems:
        return ", ".join(problems)
    height_m = SLAB_M if is_slab else numbers["height_m"]
    if "z_m" in numbers:
        low_m = numbers["z_m"] - height_m / 2
    else:
        low_m = cfg.ground_z_m - SLAB_M if is_slab else cfg.ground_z_m
    if row.outline is None:
        x_m, y_m, length_m, width_m = (numbers[name] for name in PLACE)
        rectangles = [Rectangle((x_m, y_m), (length_m, width_m), numbers.get("yaw_deg", 0.0))]
    else:
        rectangles = cover(row.outline, min_fill=OUTLINE_FILL, min_size_m=OUTLINE_PIECE_M, shares=CUT_SHARES)
    try:
        for center, size, yaw_deg in rectangles:
            boxes.add(kind, center, size, low_m, low_m + height_m, yaw_deg)
    except ValueError as error:  # so far from the origin that its size is lost
        return str(error)
    return ""


def _number(value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return math.nan
    return number if abs(number) <= LARGEST else math.nan
