"""Boxes of your own: a `boxes_3d.json`, a table (CSV), or GeoJSON, also of OpenStreetMap and Overture.

A row of a table is a box with the fields of COLUMNS. A feature of GeoJSON is a point with these properties, an outline
or a line; an outline that is not a rectangle becomes the rectangles that cover it, a line a box for each straight
piece. A row that cannot be used is skipped and counted; too many of them refuse the file. Extent, heights, yaws and
overlaps are logged for the user.
"""

import csv
import io
import logging
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
import shapely.errors
from pydantic import Field, field_validator
from shapely.geometry import LineString, Point, Polygon, shape

from cosfly.formats.boxes import UNKNOWN_LICENCE, BoxMap, MapHeader, MapSource, read_boxes
from cosfly.formats.columns import LARGEST
from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.maps.boxlist import WIDEST_M, BoxList, MapLicence, MapName, SkippedEntries, listed, origin_m, required
from cosfly.maps.footprints import (
    CUT_SHARES,
    THINNEST_M,
    Rectangle,
    check_outline,
    cover,
    credits_with,
    num_cuts,
    oriented_rectangle,
    polygons_of,
    with_derived_ground,
)
from cosfly.maps.street_features import PAVEMENT_CREDITS, PAVEMENT_M, Feature, completed, is_underground
from cosfly.maps.units import METRES, Units, declared_units, length_m, seen_units, to_metres
from cosfly.runtime.config import Config, read_yaml
from cosfly.runtime.errors import ConfigError, InputError, nearest, shown
from cosfly.runtime.io import read_text
from cosfly.runtime.json_io import read_json

log = logging.getLogger(__name__)

NUMBERS = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_deg")
# Names of OpenStreetMap and Overture, and columns without a unit: x, y and z in `maps.boxes.units`, sizes in metres.
OTHER_NAMES = {name.rpartition("_")[0]: name for name in NUMBERS} | {
    "lon": "x_m", "longitude": "x_m", "lat": "y_m", "latitude": "y_m",
    "num_floors": "building:levels", "levels": "building:levels", "min_floor": "building:min_level",
}  # fmt: skip
DECLARED = ("min_height", "building:levels", "building:min_level", "lanes")
COLUMNS = ("type", "id", "name", *NUMBERS, *DECLARED)
SIZES = ("length_m", "width_m", "height_m", "min_height")  # numbers in metres, or texts with a unit
OTHERS = ("z_m", "yaw_deg", "building:levels", "building:min_level", "lanes")
OSM_COLUMNS = ("building", "highway", "natural", "leisure", "landuse", "waterway", "barrier", "class")  # of types
PLACE = ("x_m", "y_m", "length_m", "width_m")  # every table has them; and height_m, except of surfaces
NOTHING = "NONE"
TYPES = [kind for kind in KINDS if kind != NOTHING]
GEOMETRIES = ("Point", "LineString", "Polygon", "MultiPoint", "MultiLineString", "MultiPolygon")  # of GeoJSON
NOT_MAPPED = ("unmapped_type", "underground", "outside_bounds")  # reasons to skip a valid feature
LARGEST_PLACE = 1e8  # absolute value of a coordinate of GeoJSON, in any unit
MOST_NAME = 40  # characters of a name in messages
HSTORE_TAG = re.compile(r'"([^"\\]+)"=>"([^"\\]*)"')
LINE_M = 0.1  # farthest that a corner of a line may be moved
SLAB_M = 0.3  # thickness of a surface without a height: its top is the ground
STOREY_M, LANE_M = 3.0, 3.5
# Width of a line, sides of a point, and height of a thing where `type_column` names the types and nothing is declared.
DEFAULT_SIZES_M = {
    "Buildings": (10.0, 6.0), "Roads": (7.0, SLAB_M), "Sidewalks": (PAVEMENT_M, SLAB_M), "RailTrack": (3.0, SLAB_M),
    "Water": (4.0, SLAB_M), "Vegetation": (4.0, 6.0), "Poles": (0.3, 5.0), "TrafficLight": (0.4, 4.0),
    "Walls": (0.3, 2.0), "Fences": (0.2, 1.5), "GuardRail": (0.3, 0.8), "Static": (1.0, 1.0), "Terrain": (2.0, SLAB_M),
}  # fmt: skip
WIDE_M = 3000.0  # a wider map may have ways that leave the view
FAR_M = 10_000.0  # a map with its middle farther from the origin is moved there
OUTLINE_FILL = 0.9  # share of its boxes that an outline fills
FINE_FILL = 0.98  # the same if it has holes, so that they stay open, and of water, whose outline is round
OUTLINE_PIECE_M = 3.0  # pieces of an outline that are no longer are not cut again
# Settings that a boxes_3d.json ignores.
TABLE_SETTINGS = {"types", "ignore", "ground_z_m", "units", "type_column", "bounds"}


class TypeRule(NamedTuple):
    """The kind of features of OpenStreetMap and Overture: a rule of `feature_rules.yaml`."""

    column: str  # pattern
    value: str  # pattern
    geometry: str  # part of the name of a geometry, such as Line; empty: any
    kind: str  # NONE: no boxes

    def covers(self, column: str, value: str, geometry: str) -> bool:
        """Return whether the rule applies to a feature with this value in the column of its type."""
        is_form = self.geometry in geometry
        return is_form and fnmatchcase(column, self.column) and fnmatchcase(value, self.value)


# A line of the file stands for several columns and values, separated by `|`.
FEATURES = read_yaml(Path(__file__).with_name("feature_rules.yaml"))
TYPE_RULES = [
    TypeRule(column, value, line.get("geometry", ""), kind)
    for line in FEATURES["rules"]
    for column in line["column"].split("|") for values, kind in line["kinds"].items() for value in values.split("|")
]  # fmt: skip
STREETS_WITH_PAVEMENTS = FEATURES["streets_with_pavements"].split("|")
WIDTHS_M: dict[str, float] = FEATURES["widths_m"]
ROOFS = FEATURES["roofs"].split("|")


class BoxesConfig(Config):
    """Boxes of your own."""

    name: MapName = "Boxes"
    path: Path | None = Field(None, description="boxes_3d.json, .csv or .geojson file; docs/maps.md lists the columns")
    units: Units = Field(
        "auto",
        description="unit of the coordinates: m, degrees (longitude, latitude), ft (0.3048 m) or us-ft (0.3048006 m); "
        "auto: what the file declares, and without that what its outlines look like",
    )
    type_column: str = Field(
        "type",
        min_length=1,
        description="column of the type; building,highway,natural for OpenStreetMap: the first that gives a type, "
        "values become types by a list, other columns are ignored and sizes have defaults; class for Overture",
    )
    types: dict[str, str] = Field(
        {}, description="type names of the file and their types in cosfly, such as {house: Buildings}; NONE drops them"
    )
    most_skipped: float = Field(
        0.2, ge=0, le=1, description="largest share of rows or features that may be skipped because they are invalid"
    )
    bounds: tuple[float, float, float, float] | None = Field(
        None,
        description="crop the map to west, south, east, north, in the file's coordinates (degrees: longitude first)",
    )
    ignore: list[str] = Field([], description="columns or properties to ignore; ['*']: all unknown ones")
    ground_z_m: float = Field(0.0, description="height of the flat ground, in the file's coordinates, m")
    derive_ground: bool = Field(False, description="derive streets, pavements and lawn from the buildings")
    derive_pavements: bool = Field(
        True, description="add pavements of 2 m along streets of OpenStreetMap and Overture that have none"
    )
    licence: MapLicence = UNKNOWN_LICENCE
    credits: str = Field("", description="attribution of the map's makers, in one or more sentences")

    @field_validator("types")
    @classmethod
    def _types_are_known(cls, types: dict[str, str]) -> dict[str, str]:
        problems = [f"{name} has the unknown type {kind!r}" for name, kind in types.items() if kind not in KINDS]
        if problems:
            raise ValueError(f"{'; '.join(problems)}; expected one of {', '.join(KINDS)}")
        return types

    @field_validator("bounds")
    @classmethod
    def _bounds_are_ordered(cls, bounds: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if bounds and not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
            raise ValueError("expected west, south, east, north, with west < east and south < north")
        return bounds

    @property
    def type_columns(self) -> list[str]:
        return [column.strip() for column in self.type_column.split(",")]

    @property
    def is_plain(self) -> bool:
        """Whether the columns are those of cosfly, and each must be known."""
        return self.type_column == "type"

    def inputs(self) -> dict[str, Path]:
        return {"boxes": required(self.path, "maps.boxes.path")}


class _Row(NamedTuple):
    """One row of a table or one feature."""

    where: str  # its place in the file, such as `line 3`
    values: Mapping[str, Any]  # by column
    shape: Any = Point()  # a geometry of shapely
    problem: str = ""  # why it cannot be used
    reason: str = "bad_geometry"  # of the problem, for the counts


class _Skipped(Exception):
    """The row is not used: the reason for the counts, and the problem in words."""

    def __init__(self, reason: str, problem: str) -> None:
        super().__init__(problem)
        self.reason = reason


@dataclass
class _BoxesOfRows:
    boxes: BoxList = field(default_factory=BoxList)
    row_of_box: list[int] = field(default_factory=list)  # index of the row of each box
    size_sources: Counter[str] = field(default_factory=Counter)  # number of boxes by the source of their sizes
    dropped: SkippedEntries = field(default_factory=SkippedEntries)  # rows without boxes
    repairs: list[str] = field(default_factory=list)  # places of outlines that were repaired
    unread: list[str] = field(default_factory=list)  # properties that are not numbers


class _Size(NamedTuple):
    """The size of the boxes of a row."""

    numbers: Mapping[str, float]  # finite values by column; lengths in m
    low_m: float
    high_m: float
    source: str  # file, levels or default
    unread: Sequence[str] = ()  # properties that are not numbers, in whose place a default is used


def load(cfg: BoxesConfig, seed: int = 0) -> BoxMap:
    """Read boxes; the seed changes nothing."""
    path = cfg.inputs()["boxes"]
    suffix = path.suffix.lower()
    if suffix not in (".json", ".csv", ".geojson"):
        raise InputError(
            "the file type of the map is not supported", where=path, got=path.suffix, expected=".json, .csv or .geojson"
        )
    if suffix == ".json":
        if cfg.model_dump(include=TABLE_SETTINGS) != BoxesConfig().model_dump(include=TABLE_SETTINGS):
            raise ConfigError(
                "boxes_3d.json contains its own types, units and ground height, so settings for them would have no "
                "effect",
                where="maps.boxes",
                fix=f"remove the settings {', '.join(f'maps.boxes.{name}' for name in sorted(TABLE_SETTINGS))}",
            )
        box_map = read_boxes(path)
    else:
        box_map = _read_rows(cfg, path, is_table=suffix == ".csv")
    changes: dict[str, Any] = cfg.model_dump(include=cfg.model_fields_set & {"name", "licence", "credits"})
    changes["source"] = MapSource(tool=box_map.header.source.tool or "boxes", file=path.name)
    low, high = box_map.bounds()
    origin = origin_m(low, high, path)
    width_m = float((high - low)[:2].max())
    if suffix != ".json" and width_m > WIDE_M and not cfg.bounds:
        log.warning("%s: the map is %.1f km wide; maps.boxes.bounds crops it", path.name, width_m / 1000)
    if np.abs(origin).max() > FAR_M:
        log.info("%s: the middle of the map, %s, becomes the origin", path.name, origin[:2].tolist())
        changes["offset_m"] = dict(zip("xyz", origin.tolist(), strict=True))
        box_map = replace(box_map, centers=box_map.centers - origin)
    if suffix != ".json" and box_map.header.derived_ground:
        changes["credits"] = credits_with(PAVEMENT_CREDITS, cfg.credits)
    box_map = replace(box_map, header=box_map.header.model_copy(update=changes))
    return with_derived_ground(box_map) if cfg.derive_ground else box_map


def _read_rows(cfg: BoxesConfig, path: Path, *, is_table: bool) -> BoxMap:
    """Return the boxes of a table or of features."""
    units = cfg.units
    if is_table:
        rows = _table_rows(cfg, path)
    else:
        rows, units = _feature_rows(cfg, path)
    if not rows:
        raise InputError("the file has no boxes", where=path, expected="at least one row or feature with a box")
    if cfg.bounds:
        rows = _cropped(rows, cfg.bounds, path)
    rows = _in_metres(rows, units, path, is_table=is_table)
    num_objects = len(rows)
    if not cfg.is_plain:
        rows = _completed(rows, cfg)
    made = _make_boxes(rows, cfg)
    ids = _ids_of(rows) if cfg.is_plain else []
    _check_and_report(made, rows, ids, cfg, path)
    header = MapHeader(name=cfg.name, ground_z_m=cfg.ground_z_m, num_objects=num_objects)
    changes: dict[str, Any] = {"dropped_objects": dict(made.dropped.counts)} if made.dropped.counts else {}
    if num_derived := sum(index >= num_objects for index in made.row_of_box):
        log.info("%s: %d boxes of pavements and crossings are added to streets", path.name, num_derived)
        changes |= {"added_boxes": num_derived, "derived_ground": num_derived}
    if set(made.size_sources) != {"file"}:
        changes["extent_sources"] = dict(made.size_sources)
    box_map = made.boxes.box_map(header.model_copy(update=changes))
    if ids and len(set(made.row_of_box)) == len(box_map):  # no row became several boxes
        box_map = replace(box_map, ids=np.array([ids[index] for index in made.row_of_box], dtype=np.uint64))
    return box_map


def _completed(rows: list[_Row], cfg: BoxesConfig) -> list[_Row]:
    """Return the rows of a map of streets as pedestrians meet it, and after them those of what is added."""
    with_pavements = STREETS_WITH_PAVEMENTS if cfg.derive_pavements else []
    features, added = completed([_feature_of(row, cfg) for row in rows], with_pavements)
    completed_rows: list[_Row] = []
    for row, feature in zip(rows, features, strict=True):
        is_retyped = feature.kind == "RoadLines"  # a crossing
        values = {cfg.type_columns[0]: feature.kind} if is_retyped else row.values
        completed_rows.append(row if row.problem else row._replace(shape=feature.shape, values=values))
    for feature in added:
        completed_rows.append(_Row("an added surface", {cfg.type_columns[0]: feature.kind}, feature.shape))
    return completed_rows


def _feature_of(row: _Row, cfg: BoxesConfig) -> Feature:
    """Return a row as a feature, without a kind if the row cannot be used, which is counted later."""
    unknown = Feature("", row.shape, tags=row.values)
    if row.problem:
        return unknown
    try:
        kind, value = _typed(row, cfg)
        width_m = _size_of(row, kind, value, cfg).numbers.get("width_m", 0.0)
    except _Skipped:
        return unknown
    return unknown._replace(kind=kind, value=value, width_m=width_m)


def _make_boxes(rows: list[_Row], cfg: BoxesConfig) -> _BoxesOfRows:
    """Make the boxes of all rows, in metres; a row that cannot be used is counted."""
    made = _BoxesOfRows()
    boxes = made.boxes
    for part in shapely.get_parts([row.shape for row in rows if not row.problem]):
        if isinstance(part, Polygon):
            boxes.reserve(num_cuts(part, OUTLINE_PIECE_M, np.inf, CUT_SHARES), len(part.exterior.coords))
    for index, row in enumerate(rows):
        num_before = len(boxes)
        try:
            source = _add_row(made, row, cfg)
        except _Skipped as error:
            del boxes.rows[num_before:], boxes.kinds[num_before:]
            made.dropped.add(error.reason, row.where, str(error), is_bad=error.reason not in NOT_MAPPED)
        else:
            made.size_sources[source] += len(boxes) - num_before
            made.row_of_box += [index] * (len(boxes) - num_before)
    return made


def _check_and_report(made: _BoxesOfRows, rows: list[_Row], ids: list[int], cfg: BoxesConfig, path: Path) -> None:
    """Raise InputError if the ids are invalid or too many rows are; log what a user may want to correct."""
    dropped = made.dropped
    if len(set(ids)) < len(ids) or not all(0 <= box_id < 2**63 for box_id in ids):
        dropped.add("bad_id", "id", "the ids must be different whole numbers")
        dropped.num_bad += len(rows)
    if not len(made.boxes):
        dropped.num_bad += len(rows)
    expected = (
        f"at most {cfg.most_skipped:.0%} invalid rows (maps.boxes.most_skipped); columns {', '.join(COLUMNS)}; "
        f"types {', '.join(TYPES)}, or types listed in maps.boxes.types"
    )
    dropped.check(path, len(rows) - sum(dropped.counts[reason] for reason in NOT_MAPPED), cfg.most_skipped, expected)
    if made.repairs:
        log.warning("%s: %s", path.name, listed(made.repairs, "the outline crosses itself and is repaired"))
    if made.unread:
        log.warning("%s: %s", path.name, listed(made.unread, "the value is not a number, so a default is used"))
    if made.size_sources["levels"] or made.size_sources["default"]:
        words = "%s: %d boxes have their size from the file, %d a height from their storeys, %d a default size"
        log.warning(words, path.name, *(made.size_sources[name] for name in ("file", "levels", "default")))


def _ids_of(rows: Sequence[_Row]) -> list[int]:
    """Return the ids of the rows, -1 for a text that is no whole number; none if a row has no id."""
    texts = [str(row.values["id"]) for row in rows if row.values.get("id")]
    if len(texts) < len(rows):
        return []
    return [int(text) if text.isascii() and text.isdecimal() else -1 for text in texts]


# --- rows of a file ---------------------------------------------------------------------------------------------------


def _table_rows(cfg: BoxesConfig, path: Path) -> list[_Row]:
    reader = csv.reader(io.StringIO(read_text(path, what="table of boxes").removeprefix("\ufeff")), strict=True)
    try:
        lines = [(f"line {reader.line_num}", [cell.strip() for cell in line]) for line in reader]
    except csv.Error as error:
        where = f"{path}: line {reader.line_num}"
        fix = "export the table again as CSV"
        raise InputError("the file is not a CSV table", where=where, got=str(error), fix=fix) from None
    lines = [(where, cells) for where, cells in lines if any(cells)]
    if not lines:
        return []
    names = [OTHER_NAMES.get(cell, cell) for cell in lines[0][1]]
    problems = [] if set(cfg.type_columns) & set(names) else [f"the column {cfg.type_column} is missing"]
    problems += _unknown_columns(names, cfg)
    problems += [f"the column {name} is missing" for name in PLACE if name not in names]
    problems += [f"the column {name} occurs twice" for name, count in Counter(names).items() if count > 1]
    if problems:
        raise InputError.of_all(problems, where=path, expected=f"columns {', '.join(COLUMNS)}, separated by commas")
    return [_table_row(where, names, cells) for where, cells in lines[1:]]


def _table_row(where: str, names: Sequence[str], cells: Sequence[str]) -> _Row:
    values = {name: cell for name, cell in zip(names, cells, strict=False) if cell}
    position = {name: _number(values.get(name)) for name in ("x_m", "y_m")}
    problems = []
    if len(cells) != len(names):
        problems.append(f"{len(cells)} cells, but the first line has {len(names)}")
    for name, number in position.items():
        if name not in values:
            problems.append(f"{name} is missing")
        elif math.isnan(number):
            problems.append(f"{name} is not a finite number: {values[name][:MOST_NAME]!r}")
    if problems:
        return _Row(where, values, problem=problems[0], reason="bad_value")
    return _Row(where, values, Point(*position.values()))


def _feature_rows(cfg: BoxesConfig, path: Path) -> tuple[list[_Row], Units]:
    """Read the features of a GeoJSON file, and the unit that is set or that the file declares."""
    value = read_json(path, what="map")
    if not isinstance(value, dict) or value.get("type") not in ("FeatureCollection", "Feature", *GEOMETRIES):
        expected = f"FeatureCollection, Feature, {', '.join(GEOMETRIES)}"
        fix = "export the file again as GeoJSON"
        raise InputError("the file is not GeoJSON", where=f"{path}: type", expected=f"one of {expected}", fix=fix)
    items = value.get("features") if value["type"] == "FeatureCollection" else [value]
    if not isinstance(items, list):
        what = "the FeatureCollection has no list of features"
        fix = "export the file again as GeoJSON"
        raise InputError(what, where=f"{path}: features", expected="a list of Feature objects", fix=fix)
    units = cfg.units
    if units == "auto":
        systems = [value.get("crs"), *(item.get("crs") for item in items if isinstance(item, dict))]
        declared = list({str(system): system for system in systems if system is not None}.values())
        units = declared_units(declared, f"{path}: crs") or "auto"
    features = [_feature(item, number) for number, item in enumerate(items, 1)]
    if problems := _unknown_columns(list(dict.fromkeys(name for row in features for name in row.values)), cfg):
        raise InputError.of_all(problems, where=path, expected=f"columns {', '.join(COLUMNS)}")
    heights = shapely.get_coordinates([feature.shape for feature in features], include_z=True)[:, 2]
    heights = heights[np.isfinite(heights) & (heights != 0)]
    if len(heights):
        log.warning(
            "%s: z of coordinates, %.4g to %.4g, is ignored; all is on the ground, at %g m (z_m of a feature counts)",
            path.name, heights.min(), heights.max(), cfg.ground_z_m,
        )  # fmt: skip
    return features, units


def _feature(item: Any, number: int) -> _Row:
    """Return a Feature or a bare geometry with its properties; `number` counts from 1."""
    item = item if isinstance(item, dict) else {}
    properties = item["properties"] if isinstance(item.get("properties"), dict) else {}
    tags = properties.get("other_tags")
    if isinstance(tags, str):  # where ogr2ogr writes the rest of OpenStreetMap's tags: "building"=>"yes","height"=>"9"
        properties = dict(HSTORE_TAG.findall(tags)) | {name: v for name, v in properties.items() if v is not None}
    values = {OTHER_NAMES[name]: value for name, value in properties.items() if name in OTHER_NAMES}
    values |= {name: value for name, value in properties.items() if name not in OTHER_NAMES}
    where = f"feature {number}"
    for name in (properties.get("name"), item.get("id"), properties.get("id")):
        if name not in (None, ""):
            where += f" ({str(name)[:MOST_NAME]})"
            break
    geometry = item.get("geometry") if item.get("type") == "Feature" else item
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in GEOMETRIES:
        problem = f"the geometry {str(kind)[:MOST_NAME]} is not supported; expected one of {', '.join(GEOMETRIES)}"
        return _Row(where, values, problem=problem)
    try:
        outline = shape(geometry)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, shapely.errors.ShapelyError):
        outline = Polygon()
    corners = shapely.get_coordinates(outline)
    if len(corners) == 0 or not (np.abs(corners) <= LARGEST_PLACE).all():  # NaN fails
        problem = f"the coordinates of the {kind} are invalid; expected [x, y], at least four points in a ring"
        return _Row(where, values, problem=problem)
    return _Row(where, values, outline)


def _unknown_columns(names: Sequence[str], cfg: BoxesConfig) -> list[str]:
    """Return a message for each column or property that has no meaning here."""
    if "*" in cfg.ignore or not cfg.is_plain:
        return []
    if tags := [tag for tag in OSM_COLUMNS if tag in names]:
        fix = f"set maps.boxes.type_column={','.join(tags)}"
        return [f"the properties look like those of OpenStreetMap or Overture; {fix}"]
    accepted = {*COLUMNS, *cfg.ignore}
    return [f"unknown column {name!r}{nearest(name, COLUMNS)}" for name in names if name not in accepted]


def _number(value: Any) -> float:
    """Return a value as a number; NaN if it is none, or larger than any length."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return math.nan
    return number if abs(number) <= LARGEST else math.nan


# --- coordinates ------------------------------------------------------------------------------------------------------


def _cropped(rows: list[_Row], bounds: tuple[float, float, float, float], path: Path) -> list[_Row]:
    """Return rows with their shapes cut at west, south, east and north, with a problem if nothing is left."""
    cropped: list[_Row] = []
    for row in rows:
        try:
            part = shapely.clip_by_rect(row.shape, *bounds)
        except shapely.errors.ShapelyError:  # an outline that crosses itself
            part = shapely.clip_by_rect(shapely.make_valid(row.shape), *bounds)
        if part.is_empty and not row.problem:
            row = row._replace(problem="it is outside maps.boxes.bounds", reason="outside_bounds")
        cropped.append(row._replace(shape=part))
    if all(row.problem for row in cropped) and not all(row.problem for row in rows):
        whole = shapely.total_bounds([row.shape for row in rows])
        expected = f"west, south, east, north within {', '.join(f'{value:.6g}' for value in whole)}"
        what = "maps.boxes.bounds contains no part of the map"
        raise InputError(what, where=path, got=shown(list(bounds)), expected=expected)
    return cropped


def _in_metres(rows: list[_Row], units: Units, path: Path, *, is_table: bool) -> list[_Row]:
    """Return rows with their coordinates in metres, with a problem if they are far from the middle of the others."""
    shapes = np.array([row.shape for row in rows])
    coordinates = shapely.get_coordinates(shapes)
    if not len(coordinates):
        return rows
    units = _units_of(rows, coordinates, units, path, is_table=is_table)
    project = to_metres(units, coordinates)
    middle = np.median(project(coordinates), axis=0)
    metric_rows: list[_Row] = []
    for row, metric_shape in zip(rows, shapely.transform(shapes, project), strict=True):
        metric_row = row._replace(shape=metric_shape)
        z = _number(row.values.get("z_m"))
        if is_table and not math.isnan(z):
            metric_row = metric_row._replace(values={**row.values, "z_m": z * METRES.get(units, 1.0)})
        farthest_m = float(np.abs(shapely.get_coordinates(metric_shape) - middle).max(initial=0.0))
        if farthest_m > WIDEST_M:
            place = ", ".join(f"{value:.6g}" for value in shapely.get_coordinates(row.shape)[0])
            problem = f"it is {farthest_m / 1000:,.0f} km from the middle of the map, at {place}"
            metric_row = metric_row._replace(problem=problem, reason="far_away")
        metric_rows.append(metric_row)
    return metric_rows


def _units_of(rows: list[_Row], coordinates: np.ndarray, units: Units, path: Path, *, is_table: bool) -> Units:
    """Return the unit of the coordinates: the one that is set or declared, or what they look like.

    In a table degrees are never assumed; they must be set.
    """
    shapes = [row.shape for row in rows if not row.problem]
    bounds = shapely.bounds(shapes)
    sizes = np.maximum(bounds[:, 2] - bounds[:, 0], bounds[:, 3] - bounds[:, 1])
    if not sizes.any():  # points only
        coordinates = shapely.get_coordinates(shapes)
        points = shapely.points(coordinates)
        tree = shapely.STRtree(points)
        _, sizes = tree.query_nearest(points, exclusive=True, all_matches=False, return_distance=True)
    seen = seen_units(coordinates, sizes)
    if units == "auto" and seen is None:
        what = "the coordinates fit both metres and degrees"
        fix = "set maps.boxes.units to `m` or to `degrees`"
        raise InputError(what, where=path, got=f"a median size of {np.median(sizes):.3g} units", fix=fix)
    if units == "auto" and seen is not None and not (is_table and seen == "degrees"):
        return seen
    if seen is not None and len(coordinates) > 1 and (seen == "degrees") != (units == "degrees"):
        name = "degrees" if units == "degrees" else "metres"
        what = f"the coordinates are too {'large' if units == 'degrees' else 'small'} to be {name}"
        got = f"{coordinates.min(axis=0).tolist()} to {coordinates.max(axis=0).tolist()}"
        expected = f"coordinates in {name}, the unit that maps.boxes.units or the file states"
        fix = f"if the coordinates are in {seen}, pass --set maps.boxes.units={seen}"
        raise InputError(what, where=path, got=got, expected=expected, fix=fix)
    return units


# --- boxes of a row ---------------------------------------------------------------------------------------------------


def _add_row(made: _BoxesOfRows, row: _Row, cfg: BoxesConfig) -> str:
    """Add the boxes of a row; return the source of their sizes. _Skipped is raised if a row cannot be used."""
    boxes = made.boxes
    if row.problem:
        raise _Skipped(row.reason, row.problem)
    kind, value = _typed(row, cfg)
    size = _size_of(row, kind, value, cfg)
    num_before = len(boxes)
    try:
        for part in shapely.get_parts(row.shape):
            for center, sides_m, yaw_deg in _rectangles(part, kind, size.numbers, row.where, made.repairs):
                boxes.add(kind, center, sides_m, size.low_m, size.high_m, yaw_deg)
    except ValueError as error:  # so far from the origin that its size is lost
        raise _Skipped("bad_value", str(error)) from None
    if len(boxes) == num_before:
        raise _Skipped("no_area", "the outline has no area")
    made.unread += [f"{row.where}: {text}" for text in size.unread]
    return size.source


def _typed(row: _Row, cfg: BoxesConfig) -> tuple[str, str]:
    """Return the kind of a row and the value that gives it, of the first column that gives one.

    _Skipped: No column gives a kind.
    """
    if not cfg.is_plain and is_underground(row.values):
        raise _Skipped("underground", "it is below the ground")
    columns = [column for column in cfg.type_columns if row.values.get(column)] or cfg.type_columns[:1]
    values = {column: str(row.values.get(column) or "") for column in columns}
    for column, value in values.items():
        kind = cfg.types.get(value, value)
        if kind in TYPES:
            return kind, value
        if kind == NOTHING:
            raise _Skipped("unmapped_type", f"maps.boxes.types drops {value[:MOST_NAME]!r}")
        if cfg.is_plain:
            raise _Skipped("unknown_type", f"unknown type {value[:MOST_NAME]!r}{nearest(value, [*TYPES, *cfg.types])}")
        for rule in TYPE_RULES:
            if rule.covers(column, value, row.shape.geom_type):
                if rule.kind in TYPES:
                    return rule.kind, value
                break  # no boxes
    if not any(values.values()):
        properties = ", ".join(row.values)[:80] or "none"
        problem = f"maps.boxes.type_column names no property of this feature, which has {properties}"
    elif row.values.get("highway") == "crossing":
        problem = "the node is on a mapped crossing, is an unmarked crossing, or is on no street"
    else:
        tags = ", ".join(f"{column}={value[:MOST_NAME]!r}" for column, value in values.items())
        problem = f"there is no type for {tags}; maps.boxes.types can name one"
    raise _Skipped("unmapped_type", problem)


def _size_of(row: _Row, kind: str, value: str, cfg: BoxesConfig) -> _Size:
    """Return the size of a row's boxes: as declared, by its storeys and lanes, or the default of its value or kind."""
    values = {name: length_m(row.values[name]) for name in SIZES if row.values.get(name) is not None}
    values |= {name: _number(row.values[name]) for name in OTHERS if row.values.get(name) is not None}
    numbers = {name: number for name, number in values.items() if not math.isnan(number)}
    unread = [name for name in values if name not in numbers]
    not_finite = unread if cfg.is_plain else []
    forms = {part.geom_type for part in shapely.get_parts(row.shape)}
    source = "file"
    if "height_m" not in numbers and "building:levels" in numbers:
        numbers["height_m"] = numbers["building:levels"] * STOREY_M
        source = "levels"
    if "LineString" in forms and "lanes" in numbers:
        numbers.setdefault("width_m", numbers["lanes"] * LANE_M)
    above_m = numbers.get("min_height", numbers.get("building:min_level", 0.0) * STOREY_M)
    is_slab = "height_m" not in numbers and KINDS[kind] in GROUND_KINDS
    is_needed = {
        "length_m": "Point" in forms,
        "width_m": bool(forms & {"Point", "LineString"}),
        "height_m": not is_slab,
    }
    needed = [name for name in is_needed if is_needed[name]]
    if not cfg.is_plain and kind in DEFAULT_SIZES_M:
        width_m, height_m = DEFAULT_SIZES_M[kind]
        defaults = {"length_m": width_m, "width_m": WIDTHS_M.get(value, width_m), "height_m": above_m + height_m}
        if any(name not in numbers for name in needed):
            source = "default"
        is_slab = is_slab or ("height_m" not in numbers and height_m == SLAB_M)
        numbers = defaults | numbers
        if value in ROOFS and not above_m:
            above_m = max(0.0, numbers["height_m"] - SLAB_M)
    problems = [f"{name} is missing" for name in needed if name not in numbers and name not in not_finite]
    problems += [f"{name} is not a finite number: {str(row.values[name])[:MOST_NAME]!r}" for name in not_finite]
    problems += [f"{name} must be above 0" for name in needed if numbers.get(name, 1.0) <= 0]
    if above_m and numbers.get("height_m", math.inf) <= above_m:
        problems.append(f"height_m must be above the minimum height, {above_m:g} m")
    if problems:
        raise _Skipped("bad_value", ", ".join(problems))
    height_m = SLAB_M if is_slab else numbers["height_m"] - above_m
    low_m = cfg.ground_z_m - SLAB_M if is_slab else cfg.ground_z_m + above_m
    if "z_m" in numbers:
        low_m = numbers["z_m"] - height_m / 2
    texts = [f"{name}={str(row.values[name])[:MOST_NAME]!r}" for name in unread]
    return _Size(numbers, low_m, low_m + height_m, source, texts)


def _rectangles(
    part: Any, kind: str, numbers: Mapping[str, float], where: str, repairs: list[str]
) -> Iterator[Rectangle]:
    """Yield the rectangles of a point, a line or an outline."""
    if isinstance(part, Point):
        yield Rectangle((part.x, part.y), (numbers["length_m"], numbers["width_m"]), numbers.get("yaw_deg", 0.0))
    elif isinstance(part, LineString):
        width_m = numbers["width_m"]
        for start, end in pairwise(np.asarray(part.simplify(LINE_M).coords)):
            step = end - start
            length = float(np.hypot(*step))
            if length > 0:  # half of the width more, so that a bend has no gap
                yaw_deg = float(np.degrees(np.arctan2(step[1], step[0])))
                yield Rectangle(tuple((start + end) / 2), (length + width_m / 2, width_m), yaw_deg)
    else:
        for polygon in _valid_polygons(part, where, repairs):
            fill = FINE_FILL if polygon.interiors or kind == "Water" else OUTLINE_FILL
            pieces = cover(polygon, min_fill=fill, min_size_m=OUTLINE_PIECE_M, shares=CUT_SHARES)
            if not pieces and polygon.area > 0:  # too small to be cut
                rectangle = oriented_rectangle(polygon)
                pieces = [rectangle] if min(rectangle.size) > THINNEST_M else []
            yield from pieces


def _valid_polygons(outline: Polygon, where: str, repairs: list[str]) -> list[Polygon]:
    """Return an outline as valid polygons; its place is added to `repairs` if it crosses itself."""
    if outline.is_valid:
        return [outline]
    try:
        check_outline(outline, where)
    except InputError as error:
        raise _Skipped("bad_geometry", f"{error.what}: {error.got}") from None
    polygons = polygons_of(shapely.make_valid(outline))
    if polygons:
        repairs.append(where)
    return polygons
