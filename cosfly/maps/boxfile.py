"""Boxes of one's own: a `boxes_3d.json`, a table (CSV), or GeoJSON.

A row of a table is a box under the names of COLUMNS. A feature of GeoJSON is a point with these properties, or an
outline with a height; an outline that is no rectangle becomes the rectangles that cover it. What a file means is in
its column names: nothing is guessed, and extent, heights, yaws and overlaps are logged for the user to judge.
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
from typing import Any, NamedTuple

import numpy as np
import shapely
from pydantic import Field, field_validator
from shapely.geometry import Polygon

from cosfly.formats.boxes import UNKNOWN_LICENCE, BoxMap, LicenceId, MapHeader, MapSource, read_boxes
from cosfly.formats.columns import LARGEST
from cosfly.formats.geojson import read_features
from cosfly.formats.kinds import GROUND_KINDS, KINDS, SURFACE_KINDS
from cosfly.maps.boxlist import BoxList
from cosfly.maps.derived_ground import with_derived_ground
from cosfly.maps.footprints import CUT_SHARES, cover
from cosfly.runtime.config import Config
from cosfly.runtime.errors import ConfigError, InputError, nearest
from cosfly.runtime.io import read_text

log = logging.getLogger(__name__)

NUMBERS = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "yaw_deg")
COLUMNS = ("type", "id", "name", *NUMBERS)
REQUIRED = ("type", "x_m", "y_m", "length_m", "width_m")  # of a table; height_m too, but for surfaces
TYPES = [kind for kind in KINDS if kind != "NONE"]
SLAB_M = 0.3  # thickness of a surface without a height: its top is the ground
FAR_M = 10_000.0  # a map whose middle is farther from the origin is moved there
DEGREES_AT_MOST = 2.0  # GeoJSON whose coordinates are this near to each other is longitude and latitude
OUTLINE_FILL, OUTLINE_PIECE_M = 0.9, 3.0  # least share that an outline fills of its boxes; shortest piece that is cut
OVERLAP_M = 0.05  # boxes that share less than this only touch
EARTH_M, EARTH_E2 = 6_378_137.0, 0.00669437999014  # WGS 84: equatorial radius, squared eccentricity


class BoxesConfig(Config):
    """Boxes of one's own."""

    name: str = Field("Boxes", min_length=1, description="map name, the head of the playback tree's folder names")
    path: Path | None = Field(None, description="boxes_3d.json, .csv or .geojson; names of columns: docs/files.md")
    types: dict[str, str] = Field({}, description="names of the file -> types of cosfly, as in {house: Buildings}")
    ignore: list[str] = Field([], description="columns or properties not read; ['*']: all that are unknown")
    ground_z_m: float = Field(0.0, description="height of the flat ground, in the file's coordinates, m")
    derive_ground: bool = Field(False, description="the same as maps.cityjson.derive_ground, for boxes of one's own")
    licence: LicenceId = Field(
        UNKNOWN_LICENCE, description="licence of the boxes, as the hub spells it (cc-by-4.0); goes into every release"
    )
    credits: str = Field("", description="who must be named: the map's makers, one sentence or more")

    @field_validator("types")
    @classmethod
    def _types_are_known(cls, types: dict[str, str]) -> dict[str, str]:
        if wrong := [f"{name}: unknown type {kind!r}" for name, kind in types.items() if kind not in TYPES]:
            raise ValueError(f"{'; '.join(wrong)}; there are {', '.join(TYPES)}")
        return types

    def inputs(self) -> dict[str, Path]:
        if self.path is None:
            fix = "--set maps.boxes.path=FILE"
            raise ConfigError("no file is given", where="maps.boxes.path", expected="a path", fix=fix)
        return {"boxes": self.path}


class _Row(NamedTuple):
    where: str
    values: Mapping[str, Any]
    outline: Polygon | None = None
    wrong: str = ""


def load(cfg: BoxesConfig, seed: int = 0) -> BoxMap:
    """Read boxes; the seed changes nothing."""
    path = cfg.inputs()["boxes"]
    readers = {".json": _read_ours, ".csv": _read_rows, ".geojson": _read_rows}
    if path.suffix.lower() not in readers:
        raise InputError("unknown kind of map", where=path, got=path.suffix, expected=", ".join(readers))
    box_map = readers[path.suffix.lower()](cfg, path)
    given = cfg.model_dump(include=cfg.model_fields_set & {"name", "licence", "credits"})
    source = MapSource(tool=box_map.header.source.tool or "boxes", file=path.name)
    header = box_map.header.model_copy(update={**given, "source": source})
    low, high = box_map.bounds()
    middle = np.round((low + high)[:2] / 2)
    if np.abs(middle).max() > FAR_M and header.ground is None:
        log.info("%s: the middle of the map, %s, becomes the origin", path.name, middle.tolist())
        header = header.model_copy(update={"offset_m": {"x": float(middle[0]), "y": float(middle[1]), "z": 0.0}})
        box_map = replace(box_map, centers=box_map.centers - [*middle, 0.0])
    box_map = replace(box_map, header=header)
    log.info("%s: %s", path.name, plausibility(box_map))
    return with_derived_ground(box_map) if cfg.derive_ground else box_map


def plausibility(box_map: BoxMap) -> str:
    """Return one line from which a user sees mistaken units, axes and angles."""
    low, high = box_map.bounds()
    solid = box_map.select(~box_map.is_any_of(SURFACE_KINDS))
    text = f"{len(box_map)} boxes, {' x '.join(f'{size:.6g}' for size in high - low)} m"
    if not len(solid):
        return text
    ground_m, yaws_deg = solid.ground.height_at(solid.centers), solid.rotations_deg[:, 1]
    feet_m, heights_m = solid.mins[:, 2] - ground_m, 2 * solid.half_extents[:, 2]
    flat = shapely.box(*(solid.mins[:, :2] + OVERLAP_M / 2).T, *(solid.maxs[:, :2] - OVERLAP_M / 2).T)
    one, other = shapely.STRtree(flat).query(flat, predicate="intersects")
    shared_m = np.minimum(*solid.maxs[[one, other], 2]) - np.maximum(*solid.mins[[one, other], 2])
    overlapping = np.unique(one[(one != other) & (shared_m > OVERLAP_M)])
    return (
        f"{text}; obstacles {heights_m.min():.4g} to {heights_m.max():.4g} m high, feet {feet_m.min():.4g} to "
        f"{feet_m.max():.4g} m above the ground, yaw {yaws_deg.min():.4g} to {yaws_deg.max():.4g} degrees, "
        f"{len(overlapping) / len(solid):.0%} overlap another"
    )


def _read_ours(cfg: BoxesConfig, path: Path) -> BoxMap:
    if cfg.types or cfg.ignore or cfg.ground_z_m:
        what, fix = "boxes_3d.json has its own types and ground", "leave types, ignore and ground_z_m out"
        raise ConfigError(what, where="maps.boxes", fix=fix)
    return read_boxes(path)


def _read_rows(cfg: BoxesConfig, path: Path) -> BoxMap:
    rows = list((_table_rows if path.suffix.lower() == ".csv" else _feature_rows)(cfg, path))
    if not rows:
        raise InputError("the map holds no boxes", where=path, expected="a box a line, or a feature each")
    boxes, places = BoxList(), dict[str, list[str]]()  # what is wrong -> with which rows, so that it is listed once
    for row in rows:
        if wrong := _add(boxes, row, cfg):
            places.setdefault(wrong, []).append(row.where)
    ids = [str(row.values["id"]) for row in rows if row.values.get("id")]
    numbers = [int(text) if text.isascii() and text.isdecimal() else -1 for text in ids if len(ids) == len(rows)]
    if len(set(numbers)) < len(numbers) or not all(0 <= number < 2**63 for number in numbers):
        places["id is not a whole number, each once"] = [""]
    if places:
        more = {wrong: f" (and {len(where) - 1} more)" if len(where) > 1 else "" for wrong, where in places.items()}
        problems = [f"{where[0]}: {wrong}{more[wrong]}".removeprefix(": ") for wrong, where in places.items()]
        expected = f"columns {', '.join(COLUMNS)}; types {', '.join(TYPES)}, or translated by maps.boxes.types"
        raise InputError.of_all(problems, where=path, expected=expected)
    box_map = boxes.box_map(MapHeader(name=cfg.name, ground_z_m=cfg.ground_z_m, num_objects=len(rows)))
    return replace(box_map, ids=np.array(numbers, dtype=np.uint64)) if len(box_map) == len(numbers) else box_map


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
                problems = _unknown(names, cfg) + [f"no column {name}" for name in REQUIRED if name not in names]
                problems += [f"column {name} occurs twice" for name, count in Counter(names).items() if count > 1]
                if problems:
                    raise InputError.of_all(problems, where=path, expected=f"columns {', '.join(COLUMNS)}, by commas")
                continue
            wrong = "" if len(cells) == len(names) else f"{len(cells)} cells, where the first line has {len(names)}"
            values = {name: cell for name, cell in zip(names, cells, strict=False) if cell and name in COLUMNS}
            yield _Row(f"line {lines.line_num}", values, wrong=wrong)
    except csv.Error as error:
        raise InputError("not a table", where=f"{path}: line {lines.line_num}", got=str(error)) from None


def _feature_rows(cfg: BoxesConfig, path: Path) -> Iterator[_Row]:
    features = read_features(path, what="map")
    names = dict.fromkeys(name for feature in features for name in feature.properties)
    yield from (_Row("", {}, wrong=problem) for problem in _unknown(list(names), cfg))
    project = _projection([ring for feature in features for part in feature.parts for ring in part])
    for feature in features:
        row = {k: value for k, value in feature.properties.items() if value is not None and k in COLUMNS}
        if feature.wrong:
            yield _Row(feature.where, row, wrong=feature.wrong)
        for part in feature.parts:
            rings = [project(ring) for ring in part]
            if len(rings[0]) == 1:
                yield _Row(feature.where, {**row, "x_m": rings[0][0, 0], "y_m": rings[0][0, 1]})
            else:
                yield _Row(feature.where, row, Polygon(rings[0], rings[1:]))


def _projection(rings: list[np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """Return what turns coordinates, (n, 2), into metres: of degrees, the plane that touches the Earth."""
    places = np.concatenate(rings) if rings else np.zeros((1, 2))
    low, high = places.min(axis=0), places.max(axis=0)
    if (high - low).max() > DEGREES_AT_MOST or (np.abs(places) > [180.0, 90.0]).any():
        return lambda ring: ring
    middle = (low + high) / 2
    log.info("longitude and latitude: metres east and north of %.6f, %.6f", *middle)
    latitude = math.radians(middle[1])
    bent = 1 - EARTH_E2 * math.sin(latitude) ** 2
    east_m, north_m = EARTH_M / math.sqrt(bent) * math.cos(latitude), EARTH_M * (1 - EARTH_E2) / bent**1.5  # a radian
    return lambda ring: np.radians(ring - middle) * [east_m, north_m]


def _unknown(names: Sequence[str], cfg: BoxesConfig) -> list[str]:
    known = {*COLUMNS, *(names if "*" in cfg.ignore else cfg.ignore)}
    return [f"unknown column {name!r}{nearest(name, COLUMNS)}" for name in names if name not in known]


def _add(boxes: BoxList, row: _Row, cfg: BoxesConfig) -> str:
    """Add the boxes of a row; return what is wrong with the row, "" if nothing."""
    if row.wrong:
        return row.wrong
    name = str(row.values.get("type", ""))
    kind, numbers = cfg.types.get(name, name), {k: _number(row.values[k]) for k in NUMBERS if k in row.values}
    wrong = [] if kind in TYPES else [f"unknown type {name[:40]!r}{nearest(name, [*TYPES, *cfg.types])}"]
    is_slab = "height_m" not in numbers and kind in TYPES and KINDS[kind] in GROUND_KINDS
    sizes = (
        *(("x_m", "y_m", "length_m", "width_m") if row.outline is None else ()),
        *(() if is_slab else ("height_m",)),
    )
    wrong += [f"no {size}" for size in sizes if size not in numbers]
    wrong += [f"{k} is not a finite number: {str(row.values[k])[:40]!r}" for k, v in numbers.items() if math.isnan(v)]
    wrong += [f"{size} is not more than 0" for size in sizes[-3:] if size[0] in "lwh" and numbers.get(size, 1.0) <= 0]
    if row.outline is not None and not row.outline.is_valid:
        wrong.append(f"the outline crosses itself: {shapely.is_valid_reason(row.outline)}")
    if wrong:
        return ", ".join(wrong)
    height_m = SLAB_M if is_slab else numbers["height_m"]
    low_m = cfg.ground_z_m - (SLAB_M if is_slab else 0.0)
    if "z_m" in numbers:
        low_m = numbers["z_m"] - height_m / 2
    if row.outline is None:
        place, size = (numbers["x_m"], numbers["y_m"]), (numbers["length_m"], numbers["width_m"])
        boxes.add(kind, place, size, low_m, low_m + height_m, numbers.get("yaw_deg", 0.0))
        return ""
    for rectangle in cover(row.outline, min_fill=OUTLINE_FILL, min_size_m=OUTLINE_PIECE_M, shares=CUT_SHARES):
        boxes.add(kind, rectangle.center, rectangle.size, low_m, low_m + height_m, rectangle.yaw_deg)
    return ""


def _number(value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return math.nan
    return number if abs(number) <= LARGEST else math.nan
