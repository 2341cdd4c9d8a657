"""Rows of a table (CSV) and features of GeoJSON, also of OpenStreetMap and Overture, with coordinates in metres.

A row of a table is a point. boxfile.py makes boxes of the rows.
"""

import csv
import io
import logging
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
import shapely.errors
from pydantic import Field, field_validator
from shapely.geometry import Point, Polygon, shape

from cosfly.formats.boxes import UNKNOWN_LICENCE
from cosfly.formats.columns import LARGEST
from cosfly.formats.kinds import KINDS
from cosfly.maps.boxlist import WIDEST_M, MapLicence, MapName, required
from cosfly.maps.units import METRES, Units, declared_units, seen_units, to_metres
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError, nearest, shown
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
OSM_COLUMNS = ("building", "highway", "natural", "leisure", "landuse", "waterway", "barrier", "class")  # of types
PLACE = ("x_m", "y_m", "length_m", "width_m")  # every table has them; and height_m, except of surfaces
GEOMETRIES = ("Point", "LineString", "Polygon", "MultiPoint", "MultiLineString", "MultiPolygon")  # of GeoJSON
LARGEST_PLACE = 1e8  # absolute value of a coordinate of GeoJSON, in any unit
MOST_NAME = 40  # characters of a name in messages
HSTORE_TAG = re.compile(r'"([^"\\]+)"=>"([^"\\]*)"')
NOTHING = "NONE"
TYPES = [kind for kind in KINDS if kind != NOTHING]


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
        description="column of the type; building,highway,... for OpenStreetMap: the first that gives a type, "
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


class Row(NamedTuple):
    """One row of a table or one feature."""

    where: str  # its place in the file, such as `line 3`
    values: Mapping[str, Any]  # by column
    shape: Any = Point()  # a geometry of shapely
    problem: str = ""  # why it cannot be used
    reason: str = "bad_geometry"  # of the problem, for the counts
    kind: str = ""  # of its boxes; empty before it is found
    tag: str = ""  # the value that gives the kind


def is_geojson(path: Path) -> bool:
    """Return whether a JSON file is GeoJSON; InputError: it is Overpass's own JSON."""
    value = read_json(path, what="map")
    if isinstance(value, dict) and "elements" in value:
        fix = "in Overpass Turbo choose Export, then GeoJSON"
        raise InputError("the file is Overpass's own JSON", where=path, expected="GeoJSON", fix=fix)
    return isinstance(value, dict) and value.get("type") in ("FeatureCollection", "Feature")


def read_rows(cfg: BoxesConfig, path: Path, *, is_table: bool) -> list[Row]:
    """Return the rows of a table or the features of GeoJSON, cropped and in metres; one with a problem is not used."""
    units = cfg.units
    if is_table:
        rows = _table_rows(cfg, path)
    else:
        rows, units = _feature_rows(cfg, path)
    if not rows:
        raise InputError("the file has no boxes", where=path, expected="at least one row or feature with a box")
    if cfg.bounds:
        rows = _cropped(rows, cfg.bounds, path)
    return _in_metres(rows, units, path, is_table=is_table)


# --- rows of a file ---------------------------------------------------------------------------------------------------


def _table_rows(cfg: BoxesConfig, path: Path) -> list[Row]:
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


def _table_row(where: str, names: Sequence[str], cells: Sequence[str]) -> Row:
    values = {name: cell for name, cell in zip(names, cells, strict=False) if cell}
    position = {name: number_of(values.get(name)) for name in ("x_m", "y_m")}
    problems = []
    if len(cells) != len(names):
        problems.append(f"{len(cells)} cells, but the first line has {len(names)}")
    for name, number in position.items():
        if name not in values:
            problems.append(f"{name} is missing")
        elif math.isnan(number):
            problems.append(f"{name} is not a finite number: {values[name][:MOST_NAME]!r}")
    if problems:
        return Row(where, values, problem=problems[0], reason="bad_value")
    return Row(where, values, Point(*position.values()))


def _feature_rows(cfg: BoxesConfig, path: Path) -> tuple[list[Row], Units]:
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
    names = list(dict.fromkeys(name for row in features for name in row.values))
    if problems := _unknown_columns(names, cfg):
        raise InputError.of_all(problems, where=path, expected=f"columns {', '.join(COLUMNS)}")
    if names and not set(cfg.type_columns) & set(names):
        what = f"no feature has a property of maps.boxes.type_column{nearest(cfg.type_columns[0], names)}"
        raise InputError(what, where=path, got=cfg.type_column, expected=f"some of {', '.join(names)[:300]}")
    heights = shapely.get_coordinates([feature.shape for feature in features], include_z=True)[:, 2]
    heights = heights[np.isfinite(heights) & (heights != 0)]
    if len(heights):
        log.warning(
            "%s: z of coordinates, %.4g to %.4g, is ignored; all is on the ground, at %g m (z_m of a feature counts)",
            path.name, heights.min(), heights.max(), cfg.ground_z_m,
        )  # fmt: skip
    return features, units


def _feature(item: Any, number: int) -> Row:
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
        return Row(where, values, problem=problem)
    try:
        outline = shape(geometry)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, shapely.errors.ShapelyError):
        outline = Polygon()
    corners = shapely.get_coordinates(outline)
    if len(corners) == 0 or not (np.abs(corners) <= LARGEST_PLACE).all():  # NaN fails
        problem = f"the coordinates of the {kind} are invalid; expected [x, y], at least four points in a ring"
        return Row(where, values, problem=problem)
    return Row(where, values, outline)


def _unknown_columns(names: Sequence[str], cfg: BoxesConfig) -> list[str]:
    """Return a message for each column or property that has no meaning here."""
    if "*" in cfg.ignore or not cfg.is_plain:
        return []
    if tags := [tag for tag in OSM_COLUMNS if tag in names]:
        fix = f"set maps.boxes.type_column={','.join(tags)}"
        return [f"the properties look like those of OpenStreetMap or Overture; {fix}"]
    accepted = {*COLUMNS, *cfg.ignore}
    return [f"unknown column {name!r}{nearest(name, COLUMNS)}" for name in names if name not in accepted]


def number_of(value: Any) -> float:
    """Return a value as a number; NaN if it is none, or larger than any length."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return math.nan
    return number if abs(number) <= LARGEST else math.nan


# --- coordinates ------------------------------------------------------------------------------------------------------


def _cropped(rows: list[Row], bounds: tuple[float, float, float, float], path: Path) -> list[Row]:
    """Return rows with their shapes cut at west, south, east and north, with a problem if nothing is left."""
    cropped: list[Row] = []
    for row in rows:
        try:
            part = shapely.clip_by_rect(row.shape, *bounds)
        except shapely.errors.ShapelyError:  # an outline that crosses itself
            part = shapely.clip_by_rect(shapely.make_valid(row.shape), *bounds)
        if part.is_empty and not row.problem:
            row = row._replace(problem="outside maps.boxes.bounds", reason="outside_bounds")
        cropped.append(row._replace(shape=part))
    if all(row.problem for row in cropped) and not all(row.problem for row in rows):
        whole = shapely.total_bounds([row.shape for row in rows])
        expected = f"west, south, east, north within {', '.join(f'{value:.6g}' for value in whole)}"
        what = "maps.boxes.bounds contains no part of the map"
        raise InputError(what, where=path, got=shown(list(bounds)), expected=expected)
    return cropped


def _in_metres(rows: list[Row], units: Units, path: Path, *, is_table: bool) -> list[Row]:
    """Return rows with their coordinates in metres, with a problem if they are far from the middle of the others."""
    shapes = np.array([row.shape for row in rows])
    coordinates = shapely.get_coordinates(shapes)
    if not len(coordinates):
        return rows
    units = _units_of(rows, coordinates, units, path, is_table=is_table)
    project = to_metres(units, coordinates)
    middle = np.median(project(coordinates), axis=0)
    metric_rows: list[Row] = []
    for row, metric_shape in zip(rows, shapely.transform(shapes, project), strict=True):
        metric_row = row._replace(shape=metric_shape)
        z = number_of(row.values.get("z_m"))
        if is_table and not math.isnan(z):
            metric_row = metric_row._replace(values={**row.values, "z_m": z * METRES.get(units, 1.0)})
        farthest_m = float(np.abs(shapely.get_coordinates(metric_shape) - middle).max(initial=0.0))
        if farthest_m > WIDEST_M:
            place = ", ".join(f"{value:.6g}" for value in shapely.get_coordinates(row.shape)[0])
            problem = f"it is {farthest_m / 1000:,.0f} km from the middle of the map, at {place}"
            metric_row = metric_row._replace(problem=problem, reason="far_away")
        metric_rows.append(metric_row)
    return metric_rows


def _units_of(rows: list[Row], coordinates: np.ndarray, units: Units, path: Path, *, is_table: bool) -> Units:
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
