"""Boxes of your own: a `boxes_3d.json`, a table (CSV), or GeoJSON, also of OpenStreetMap and Overture.

A row of a table is a box with the fields of COLUMNS. A feature of GeoJSON is a point with these properties, an outline
or a line; an outline that is not a rectangle becomes the rectangles that cover it, a line a box for each straight
piece. A row that cannot be used is skipped and counted; too many of them refuse the file. Extent, heights, yaws and
overlaps are logged for the user.
"""

import logging
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon

from cosfly.formats.boxes import BoxMap, MapHeader, MapSource, read_boxes
from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.maps.box_rows import COLUMNS, MOST_NAME, NOTHING, TYPES, BoxesConfig, Row, is_geojson, number_of, read_rows
from cosfly.maps.boxlist import BoxList, SkippedEntries, listed, origin_m
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
)  # fmt: skip
from cosfly.maps.street_features import PAVEMENT_CREDITS, PAVEMENT_M, Feature, completed, is_underground
from cosfly.maps.units import length_m
from cosfly.runtime.config import read_yaml
from cosfly.runtime.errors import ConfigError, InputError, counts_text, nearest

log = logging.getLogger(__name__)

SIZES = ("length_m", "width_m", "height_m", "min_height", "diameter_crown")  # numbers in metres, or texts with a unit
OTHERS = ("z_m", "yaw_deg", "building:levels", "building:min_level", "lanes")
NOT_MAPPED = ("unmapped_type", "underground", "outside_bounds")  # reasons to skip a valid feature
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
TABLE_SETTINGS = ("types", "ignore", "ground_z_m", "units", "type_column", "bounds")


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
    is_ours = suffix == ".json" and not is_geojson(path)
    if is_ours:
        defaults = BoxesConfig()
        if names := [name for name in TABLE_SETTINGS if getattr(cfg, name) != getattr(defaults, name)]:
            what = "boxes_3d.json contains its own types, units and ground height, so these settings have no effect"
            raise ConfigError(what, where="maps.boxes", got=", ".join(names), fix="remove them")
        box_map = read_boxes(path)
    else:
        box_map = _read_rows(cfg, path, is_table=suffix == ".csv")
    changes: dict[str, Any] = cfg.model_dump(include=cfg.model_fields_set & {"name", "licence", "credits"})
    changes["source"] = MapSource(tool=box_map.header.source.tool or "boxes", file=path.name)
    low, high = box_map.bounds()
    origin = origin_m(low, high, path)
    width_m = float((high - low)[:2].max())
    if not is_ours and width_m > WIDE_M and not cfg.bounds:
        log.warning("%s: the map is %.1f km wide; maps.boxes.bounds crops it", path.name, width_m / 1000)
    if np.abs(origin).max() > FAR_M:
        log.info("%s: the middle of the map, %s, becomes the origin", path.name, origin[:2].tolist())
        changes["offset_m"] = dict(zip("xyz", origin.tolist(), strict=True))
        box_map = replace(box_map, centers=box_map.centers - origin)
    if not is_ours and box_map.header.derived_ground:
        changes["credits"] = credits_with(PAVEMENT_CREDITS, cfg.credits)
    box_map = replace(box_map, header=box_map.header.model_copy(update=changes))
    return with_derived_ground(box_map) if cfg.derive_ground else box_map


def _read_rows(cfg: BoxesConfig, path: Path, *, is_table: bool) -> BoxMap:
    """Return the boxes of a table or of features."""
    rows = [_with_kind(row, cfg) for row in read_rows(cfg, path, is_table=is_table)]
    num_objects = len(rows)
    if not cfg.is_plain:
        rows = _completed(rows, cfg)
    made = _make_boxes(rows, cfg)
    ids = _ids_of(rows) if cfg.is_plain else []
    _check_and_report(made, rows, ids, cfg, path)
    header = MapHeader(name=cfg.name, ground_z_m=cfg.ground_z_m, num_objects=num_objects)
    changes: dict[str, Any] = {"dropped_objects": dict(made.dropped.counts)} if made.dropped.counts else {}
    if added := Counter(rows[index].kind for index in made.row_of_box if index >= num_objects):
        log.info("%s: added boxes of pavements, crossings and woods: %s", path.name, counts_text(added))
        num_ground = sum(count for kind, count in added.items() if KINDS[kind] in GROUND_KINDS)
        changes |= {"added_boxes": added.total()} | ({"derived_ground": num_ground} if num_ground else {})
    if set(made.size_sources) != {"file"}:
        changes["extent_sources"] = dict(made.size_sources)
    box_map = made.boxes.box_map(header.model_copy(update=changes))
    if ids and len(set(made.row_of_box)) == len(box_map):  # no row became several boxes
        box_map = replace(box_map, ids=np.array([ids[index] for index in made.row_of_box], dtype=np.uint64))
    return box_map


def _completed(rows: list[Row], cfg: BoxesConfig) -> list[Row]:
    """Return the rows of a map of streets as pedestrians meet it, and after them those of what is added."""
    with_pavements = STREETS_WITH_PAVEMENTS if cfg.derive_pavements else []
    features, added = completed([_feature_of(row, cfg) for row in rows], with_pavements)
    completed_rows: list[Row] = []
    for row, feature in zip(rows, features, strict=True):
        if feature.kind == "RoadLines":  # a crossing
            completed_rows.append(Row(row.where, {}, feature.shape, kind=feature.kind))
        else:
            completed_rows.append(row._replace(shape=feature.shape))
    return completed_rows + [Row("an added surface", {}, feature.shape, kind=feature.kind) for feature in added]


def _feature_of(row: Row, cfg: BoxesConfig) -> Feature:
    """Return a row as a feature, without a kind if the row cannot be used, which is counted later."""
    try:
        width_m = _size_of(row, cfg).numbers.get("width_m", 0.0) if row.kind else 0.0
    except _Skipped:
        return Feature("", row.shape, tags=row.values)
    return Feature(row.kind, row.shape, row.tag, width_m, row.values)


def _make_boxes(rows: list[Row], cfg: BoxesConfig) -> _BoxesOfRows:
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


def _check_and_report(made: _BoxesOfRows, rows: list[Row], ids: list[int], cfg: BoxesConfig, path: Path) -> None:
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


def _ids_of(rows: Sequence[Row]) -> list[int]:
    """Return the ids of the rows, -1 for a text that is no whole number; none if a row has no id."""
    texts = [str(row.values["id"]) for row in rows if row.values.get("id")]
    if len(texts) < len(rows):
        return []
    return [int(text) if text.isascii() and text.isdecimal() else -1 for text in texts]


# --- boxes of a row ---------------------------------------------------------------------------------------------------


def _add_row(made: _BoxesOfRows, row: Row, cfg: BoxesConfig) -> str:
    """Add the boxes of a row; return the source of their sizes. _Skipped is raised if a row cannot be used."""
    boxes = made.boxes
    if row.problem:
        raise _Skipped(row.reason, row.problem)
    size = _size_of(row, cfg)
    num_before = len(boxes)
    try:
        for part in shapely.get_parts(row.shape):
            for center, sides_m, yaw_deg in _rectangles(part, row.kind, size.numbers, row.where, made.repairs):
                boxes.add(row.kind, center, sides_m, size.low_m, size.high_m, yaw_deg)
    except ValueError as error:  # so far from the origin that its size is lost
        raise _Skipped("bad_value", str(error)) from None
    if len(boxes) == num_before:
        raise _Skipped("no_area", "the outline has no area")
    made.unread += [f"{row.where}: {text}" for text in size.unread]
    return size.source


def _with_kind(row: Row, cfg: BoxesConfig) -> Row:
    """Return a row with its kind and the value that gives it, or with the reason why there is none."""
    if row.problem:
        return row
    try:
        kind, tag = _kind_and_tag(row, cfg)
    except _Skipped as error:
        return row._replace(problem=str(error), reason=error.reason)
    return row._replace(kind=kind, tag=tag)


def _kind_and_tag(row: Row, cfg: BoxesConfig) -> tuple[str, str]:
    """Return the kind of a row and its value in the first column that gives one; _Skipped: no column does."""
    if not cfg.is_plain and is_underground(row.values):
        raise _Skipped("underground", "below the ground")
    columns = [column for column in cfg.type_columns if row.values.get(column)] or cfg.type_columns[:1]
    values = {column: str(row.values.get(column) or "") for column in columns}
    for column, value in values.items():
        kind = cfg.types.get(value, value)
        if kind in TYPES:
            return kind, value
        if kind == NOTHING:
            raise _Skipped("unmapped_type", f"{value[:MOST_NAME]!r}, which maps.boxes.types drops,")
        if cfg.is_plain:
            raise _Skipped("unknown_type", f"unknown type {value[:MOST_NAME]!r}{nearest(value, [*TYPES, *cfg.types])}")
        for rule in TYPE_RULES:
            if rule.covers(column, value, row.shape.geom_type):
                if rule.kind in TYPES:
                    return rule.kind, value
                break  # no boxes
    if not any(values.values()):
        problem = "without a property of maps.boxes.type_column"
    elif row.values.get("highway") == "crossing":
        problem = "crossings that are unmarked, on another crossing or on no street"
    else:
        problem = " ".join(f"{column}={value[:MOST_NAME]}" for column, value in values.items())
    raise _Skipped("unmapped_type", problem)


def _size_of(row: Row, cfg: BoxesConfig) -> _Size:
    """Return the size of a row's boxes: as declared, by its storeys and lanes, or the default of its value or kind."""
    values = {name: length_m(row.values[name]) for name in SIZES if row.values.get(name) is not None}
    values |= {name: number_of(row.values[name]) for name in OTHERS if row.values.get(name) is not None}
    numbers = {name: number for name, number in values.items() if not math.isnan(number)}
    unread = [name for name in values if name not in numbers]
    not_finite = unread if cfg.is_plain else []
    forms = {part.geom_type for part in shapely.get_parts(row.shape)}
    source = "file"
    if "height_m" not in numbers and "building:levels" in numbers:
        numbers["height_m"] = numbers["building:levels"] * STOREY_M
        source = "levels"
    if row.kind == "Vegetation" and "diameter_crown" in numbers:
        numbers |= {name: numbers["diameter_crown"] for name in ("length_m", "width_m") if name not in numbers}
    if "LineString" in forms and "lanes" in numbers:
        numbers.setdefault("width_m", numbers["lanes"] * LANE_M)
    above_m = numbers.get("min_height", numbers.get("building:min_level", 0.0) * STOREY_M)
    is_slab = "height_m" not in numbers and KINDS[row.kind] in GROUND_KINDS
    is_needed = {
        "length_m": "Point" in forms,
        "width_m": bool(forms & {"Point", "LineString"}),
        "height_m": not is_slab,
    }
    needed = [name for name in is_needed if is_needed[name]]
    if not cfg.is_plain and row.kind in DEFAULT_SIZES_M:
        width_m, height_m = DEFAULT_SIZES_M[row.kind]
        defaults = {"length_m": width_m, "width_m": WIDTHS_M.get(row.tag, width_m), "height_m": above_m + height_m}
        if any(name not in numbers for name in needed):
            source = "default"
        is_slab = is_slab or ("height_m" not in numbers and height_m == SLAB_M)
        numbers = defaults | numbers
        if row.tag in ROOFS and not above_m:
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
