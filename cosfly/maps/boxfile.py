"""Boxes of one's own: a `boxes_3d.json`, a table (CSV), or GeoJSON.

A row of a table is a box: its middle, its size or half of it, its yaw, its type, under any of the NAMES. A feature of
GeoJSON is a point with these properties, or an outline with a height; an outline that is no rectangle becomes the
rectangles that cover it. All that is wrong with a file is told at once; what can be meant, but hardly is, in warnings.
"""

from __future__ import annotations

import csv
import io
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from pydantic import Field, field_validator
from shapely.geometry import Polygon

from cosfly.errors import ConfigError, InputError, nearest
from cosfly.maps.boxlist import BoxList
from cosfly.maps.derived_ground import with_derived_ground
from cosfly.maps.footprints import CUT_SHARES, cover
from cosfly.products.boxes import UNKNOWN_LICENCE, BoxMap, LicenceId, MapHeader, MapSource, read_boxes
from cosfly.products.columns import LARGEST
from cosfly.products.kinds import GROUND_KINDS, KINDS, SURFACE_KINDS
from cosfly.reading.files import read_text
from cosfly.reading.geojson import read_features
from cosfly.work.config import Config

log = logging.getLogger(__name__)

# What a table may call its columns, and GeoJSON its properties. Sizes are before turning: length along the yaw's
# direction.
NAMES: dict[str, tuple[str, ...]] = {
    "x": ("x", "center_x", "centre_x"),
    "y": ("y", "center_y", "centre_y"),
    "z": ("z", "center_z", "centre_z"),
    "length": ("length", "size_x"),
    "width": ("width", "size_y"),
    "height": ("height", "size_z"),
    "half_length": ("half_length", "half_x", "extent_x"),
    "half_width": ("half_width", "half_y", "extent_y"),
    "half_height": ("half_height", "half_z", "extent_z"),
    "low": ("low", "bottom", "z_min", "base"),
    "high": ("high", "top", "z_max"),
    "yaw_deg": ("yaw_deg", "yaw"),
    "yaw_rad": ("yaw_rad",),
    "type": ("type", "category", "kind", "class"),
    "id": ("id",),
    "name": ("name",),  # tells a person which one is meant
}
FIELDS = {name: field for field, names in NAMES.items() for name in names}
FAR_M = 10_000.0  # a map whose middle is farther from the origin is moved there
DEGREES_AT_MOST = 2.0  # a map of less than 2 m is none: coordinates this near to each other are longitude and latitude
TYPES = [kind for kind in KINDS if kind != "NONE"]
SLAB_M = 0.3  # thickness of a surface whose outline has no height: its top is the ground
WIDEST_M, TALL_M = 20_000.0, 400.0  # no map is wider, the usual building is lower: else the file is in centimetres
MOST_AT_A_PLACE = 10  # buildings with one middle: a body, its roof, rooms inside; more is a mistake in x and y
HANGS_M = 5.0  # a town whose every foot is higher over its ground is told from another level, as of the sea
FEWEST_TURNED = 3  # boxes, for their yaws to look like radians
EARTH_M, EARTH_E2 = 6_378_137.0, 0.00669437999014  # WGS 84: equatorial radius, squared eccentricity


class BoxesConfig(Config):
    """Boxes of one's own."""

    name: str = Field("Boxes", min_length=1, description="map name, the head of the playback tree's folder names")
    path: Path | None = Field(None, description="boxes_3d.json, .csv or .geojson; names of columns: docs/files.md")
    types: dict[str, str] = Field({}, description="names of the file -> types of cosfly, as in {house: Buildings}")
    ignore: list[str] = Field([], description="columns or properties not read; ['*']: all without a meaning here")
    metres_per_unit: float = Field(
        1.0, gt=0.0, description="metres of a unit of the file: 0.01 for Unreal's centimetres"
    )
    left_handed: bool = Field(False, description="y is right of x, yaw turns clockwise, as in CARLA and Unreal")
    ground_z_m: float = Field(0.0, description="height of the flat ground, in the file's coordinates, m")
    outline_fill: float = Field(0.9, gt=0.0, le=1.0, description="least share of each box that an outline fills")
    outline_piece_m: float = Field(3.0, gt=0.0, description="pieces of an outline this short are not cut again, m")
    derive_ground: bool = Field(False, description="the same as maps.cityjson.derive_ground, for boxes of one's own")
    licence: LicenceId = Field(
        UNKNOWN_LICENCE, description="licence of the boxes, as the hub spells it (cc-by-4.0); goes into every release"
    )
    credits: str = Field("", description="who must be named: the map's makers, one sentence or more")
    tool: str = Field("", description="tool and version that made the file, for the records")

    @field_validator("types")
    @classmethod
    def _types_are_known(cls, types: dict[str, str]) -> dict[str, str]:
        if wrong := {name: kind for name, kind in types.items() if kind not in TYPES}:
            told = [f"{name}: there is no type {kind!r}{nearest(kind, TYPES)}" for name, kind in wrong.items()]
            raise ValueError(f"{'; '.join(told)}; there are {', '.join(TYPES)}")
        return types

    def inputs(self) -> dict[str, Path]:
        if self.path is None:
            fix = "--set maps.boxes.path=FILE"
            raise ConfigError("no file is given", where="maps.boxes.path", expected="a path", fix=fix)
        return {"boxes": self.path}


class WrongRow(Exception):
    """What is wrong with one row, in words."""


class _Row(NamedTuple):
    """One row or feature: its columns by field, its outline in metres, and what is wrong with it already."""

    where: str
    values: Mapping[str, Any]
    outline: Polygon | None = None
    wrong: str = ""


def load(cfg: BoxesConfig, seed: int = 0) -> BoxMap:
    """Read boxes; the seed changes nothing."""
    path = cfg.inputs()["boxes"]
    readers = {".csv": _table_rows, ".geojson": _feature_rows}
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _told(_read_ours(cfg, path), cfg, path)
    if suffix not in readers:
        raise InputError(
            "an unknown kind of map", where=path, got=path.suffix or "no suffix", expected=".json, .csv or .geojson"
        )
    rows = list(readers[suffix](cfg, path))
    if not rows:
        raise InputError(
            "the map holds no boxes", where=path,
            got="nothing after the first line" if suffix == ".csv" else "no features",
            expected="a box a line, or a feature each; docs/files.md has examples",
        )  # fmt: skip
    boxes, ids, places = BoxList(), list[Any](), dict[str, list[str]]()
    for row in rows:
        try:
            _add(boxes, row, cfg)
        except WrongRow as wrong:
            places.setdefault(str(wrong), []).append(row.where)
        ids.append(row.values.get("id"))
    if places:
        # What is wrong with many rows is told once, or it would hide what is wrong with a few.
        problems = [_placed(where, wrong) for wrong, where in places.items()]
        raise InputError.of_all(problems, where=path, expected=_hint(problems))
    header = MapHeader(name=cfg.name, ground_z_m=cfg.ground_z_m, num_objects=len(rows))
    box_map = boxes.box_map(header)
    if len(box_map) == len(rows) and all(ids):
        box_map = replace(box_map, ids=_ids(ids, path))
    yaws_deg = [yaw for row in rows if (yaw := float(row.values.get("yaw_deg", 0.0)))]
    if len(yaws_deg) >= FEWEST_TURNED and max(map(abs, yaws_deg)) <= 2 * math.pi and any(yaw % 1 for yaw in yaws_deg):
        log.warning(
            "%s: all %d yaws lie within %.3g degrees: if these are radians, name the column yaw_rad",
            path, len(yaws_deg), max(map(abs, yaws_deg)),
        )  # fmt: skip
    return _told(box_map, cfg, path)


def _placed(where: Sequence[str], wrong: str) -> str:
    first = f"{where[0]}: {wrong}" if where[0] else wrong
    return f"{first} (and {len(where) - 1} more)" if len(where) > 1 else first


def _hint(problems: Sequence[str]) -> str | None:
    """Say what would have been right, where names are what is wrong."""
    hints = {
        "has no meaning": f"columns {', '.join(FIELDS)}; --set 'maps.boxes.ignore=[\"*\"]' leaves the others out",
        "type": f"types are {', '.join(TYPES)}; --set 'maps.boxes.types={{house: Buildings}}' translates others",
    }
    found = [hint for word, hint in hints.items() if any(word in problem for problem in problems)]
    return "; ".join(found) or None


def _read_ours(cfg: BoxesConfig, path: Path) -> BoxMap:
    if cfg.types or cfg.ignore or cfg.metres_per_unit != 1.0 or cfg.left_handed or cfg.ground_z_m:
        raise ConfigError(
            "boxes_3d.json has its own types, metres, axes and ground", where="maps.boxes",
            got=", ".join(sorted(cfg.model_fields_set - {"path", "name", "licence", "credits", "tool"})),
            fix="leave these settings out, or give a .csv",
        )  # fmt: skip
    return read_boxes(path)


def _warn(box_map: BoxMap, path: Path) -> None:
    """Tell what can be meant, and hardly is: boxes given again and again, many buildings at one place."""
    parts = (box_map.kinds[:, None], box_map.centers, box_map.half_extents, box_map.rotations_deg)
    boxes = np.unique(np.column_stack(parts), axis=0)
    if len(boxes) < len(box_map):
        num_again = len(box_map) - len(boxes)
        log.warning("%s: %d of %d boxes repeat another exactly: leave them out", path, num_again, len(box_map))
    middles = np.round(boxes[boxes[:, 0] == KINDS["Buildings"], 1:3], 1)
    places, counts = np.unique(middles, axis=0, return_counts=True)
    if counts.max(initial=0) > MOST_AT_A_PLACE:
        x, y = places[counts.argmax()]
        log.warning(
            "%s: %d of %d buildings have their middle at x %g, y %g: do the columns x and y hold the places?",
            path, counts.max(), len(middles), x, y,
        )  # fmt: skip


def _check_heights(box_map: BoxMap, path: Path) -> None:
    """Refuse a map of whose obstacles none reaches above the ground, or none comes near it."""
    box_map = box_map.select(~box_map.is_any_of(SURFACE_KINDS))
    ground_m = box_map.ground.height_at(box_map.centers)
    feet_m, tops_m = box_map.mins[:, 2] - ground_m, box_map.maxs[:, 2] - ground_m
    if len(tops_m) and (tops_m.max() <= 0.0 or feet_m.min() >= HANGS_M):
        is_below, foot_m = tops_m.max() <= 0.0, float(np.median(box_map.mins[:, 2]))
        end = f"the highest ends {-tops_m.max():.6g} m" if is_below else f"the lowest begins {feet_m.min():.6g} m"
        fix = f"mend z, or tell where the ground is: --set maps.boxes.ground_z_m={foot_m:.6g}"
        raise InputError(
            f"all that stands lies {'below' if is_below else 'high above'} the ground", where=path,
            got=f"{len(tops_m)} boxes, {end} {'below' if is_below else 'above'} it", expected="boxes that stand on it",
            fix=fix if path.suffix.lower() != ".json" else f"mend z, or ground_z_m of the header to {foot_m:.6g}",
        )  # fmt: skip


def _told(box_map: BoxMap, cfg: BoxesConfig, path: Path) -> BoxMap:
    """Give the map with what the settings say of it, near the origin, if its size can be."""
    _check_heights(box_map, path)
    _warn(box_map, path)
    low, high = box_map.bounds()
    heights_m = 2 * box_map.half_extents[box_map.kinds == KINDS["Buildings"], 2]
    usual_m = float(np.median(heights_m)) if len(heights_m) else 0.0
    if (high - low)[:2].max() > WIDEST_M or usual_m > TALL_M:
        raise InputError(
            "the map is too wide, or its buildings too high: are these centimetres?", where=path,
            got=f"{' x '.join(f'{size:.6g}' for size in high - low)} m, buildings of usually {usual_m:.6g} m",
            expected=f"at most {WIDEST_M / 1000:g} km, and less than {TALL_M:g} m",
            fix="write all of the file in metres, or scale a table: --set maps.boxes.metres_per_unit=0.01",
        )  # fmt: skip
    given = cfg.model_dump(include=cfg.model_fields_set & {"name", "licence", "credits"})
    source = MapSource(tool=cfg.tool or box_map.header.source.tool or "boxes", file=path.name)
    header = box_map.header.model_copy(update={**given, "source": source})
    middle = np.round((low + high)[:2] / 2)
    if np.abs(middle).max() > FAR_M and header.ground is None:
        log.info("%s: the middle of the map, %s, becomes the origin", path.name, middle.tolist())
        offset = {"x": float(middle[0]), "y": float(middle[1]), "z": 0.0}
        header = header.model_copy(update={"offset_m": offset})
        box_map = replace(box_map, centers=box_map.centers - [*middle, 0.0])
    box_map = replace(box_map, header=header)
    return with_derived_ground(box_map) if cfg.derive_ground else box_map


# --- rows -------------------------------------------------------------------------------------------------------------


def _table_rows(cfg: BoxesConfig, path: Path) -> Iterator[_Row]:
    lines = csv.reader(io.StringIO(read_text(path, what="table of boxes").removeprefix("\ufeff")), strict=True)
    names: list[str] = []
    try:
        for line in lines:
            if not any(cell.strip() for cell in line):
                continue
            if not names:
                names = line
                fields, problems = _fields(names, cfg)
                if len(names) == 1 and (mark := next((mark for mark in ";\t|" if mark in names[0]), "")):
                    raise InputError(
                        "the columns are not parted by commas", where=f"{path}: line {lines.line_num}",
                        got=repr(names[0][:80]), fix="export the table as CSV with commas",
                        expected=f"commas, where {'tabs' if mark == chr(9) else mark} stand, and decimal points",
                    )  # fmt: skip
                problems += [
                    f"no column for {f} ({', '.join(NAMES[f])})" for f in ("x", "y", "type") if f not in fields
                ]
                for f in ("length", "width"):  # a box needs both; a height some kinds do without
                    if not {f, f"half_{f}"} & set(fields):
                        problems.append(f"no column for {f} ({', '.join(NAMES[f] + NAMES[f'half_{f}'])})")
                yield from (_Row("", {}, wrong=problem) for problem in problems)
                lost = {} if "type" in fields else {"type": "Static"}
                continue
            if len(line) != len(names):
                wrong = f"{len(line)} cells, where the first line has {len(names)}"
                yield _Row(f"line {lines.line_num}", {}, wrong=wrong)
                continue
            cells = ((field, cell.strip()) for field, cell in zip(fields, line, strict=True) if field)
            values = {field: cell for field, cell in cells if cell}
            if problems and not (wrong := _wrong_in(lost | values, cfg.types)):
                continue  # what a lost column leaves out is told once
            yield _Row(f"line {lines.line_num}", values, wrong=wrong if problems else "")
    except csv.Error as error:
        raise InputError("not a table", where=f"{path}: line {lines.line_num}", got=str(error)) from None


def _feature_rows(cfg: BoxesConfig, path: Path) -> Iterator[_Row]:
    features = read_features(path, what="map")
    names = list(dict.fromkeys(name for feature in features for name in feature.properties))
    found, problems = _fields(names, cfg)
    fields = dict(zip(names, found, strict=True))
    yield from (_Row("properties", {}, wrong=problem) for problem in problems)
    project = _projection([ring for feature in features for part in feature.parts for ring in part])
    for feature in features:
        row = {
            field: value for name, value in feature.properties.items() if value is not None and (field := fields[name])
        }
        if feature.wrong:
            yield _Row(feature.where, row, wrong=feature.wrong)
        for part in feature.parts:
            rings = [project(ring) for ring in part]
            if len(rings[0]) == 1:
                yield _Row(feature.where, {**row, "x": rings[0][0, 0], "y": rings[0][0, 1]})
            else:
                yield _Row(feature.where, row, Polygon(rings[0], rings[1:]))


def _projection(rings: list[np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """Give what turns coordinates, (n, 2), into metres: of degrees, the plane that touches the Earth."""
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


def _fields(names: Sequence[str], cfg: BoxesConfig) -> tuple[list[str | None], list[str]]:
    """Give the field that each column holds, None of those that are not read, and what is wrong with the names."""
    fields = [None if name in cfg.ignore else FIELDS.get(name.strip().lower()) for name in names]
    problems = []
    if "*" not in cfg.ignore:
        problems += [
            f"column {name!r} has no meaning here{nearest(name.strip().lower(), FIELDS)}"
            for name, field in zip(names, fields, strict=True) if field is None and name not in cfg.ignore
        ]  # fmt: skip
    for field, count in Counter(field for field in fields if field).items():
        if count > 1:
            alike = ", ".join(n for n, f in zip(names, fields, strict=True) if f == field)
            problems.append(f"{count} columns are the {field}: {alike}")
    return fields, problems


def _ids(given: list[Any], path: Path) -> np.ndarray:
    """Give the ids of the rows, which must be whole numbers, each once."""
    texts = [str(value) for value in given]
    wrong = [text for text in texts if not (text.isascii() and text.isdecimal() and int(text) < 2**63)]
    problems = [f"id {text!r} is not a whole number below 2^63" for text in wrong]
    problems += [f"id {text} occurs {count} times" for text, count in Counter(texts).items() if count > 1]
    if problems:
        raise InputError.of_all(problems, where=path)
    return np.array([int(text) for text in texts], dtype=np.uint64)


# --- a row to boxes ---------------------------------------------------------------------------------------------------


def _add(boxes: BoxList, row: _Row, cfg: BoxesConfig) -> None:
    if row.wrong:
        raise WrongRow(row.wrong)
    kind, numbers = _read_values(row.values, cfg.types)
    if "yaw_deg" in numbers and "yaw_rad" in numbers:
        raise WrongRow("yaw twice, in degrees and in radians")
    if abs(numbers.get("yaw_rad", 0.0)) > 2 * math.pi:
        raise WrongRow("yaw_rad is more than a full turn of 6.2832; a column of degrees is called yaw_deg")
    yaw_deg = numbers.pop("yaw_deg", math.degrees(numbers.pop("yaw_rad", 0.0)))
    metres = {name: value * cfg.metres_per_unit for name, value in numbers.items()}
    low_m, high_m = _span_of(metres, kind, cfg.ground_z_m)
    turn = -1.0 if cfg.left_handed else 1.0
    if row.outline is None:
        missing = [name for name in ("x", "y") if name not in metres]
        if missing:
            raise WrongRow(f"no {' and no '.join(missing)}")
        size = (_size_of(metres, "length"), _size_of(metres, "width"))
        boxes.add(kind, (metres["x"], turn * metres["y"]), size, low_m, high_m, turn * yaw_deg)
        return
    outline = shapely.transform(row.outline, lambda places: places * [cfg.metres_per_unit, turn * cfg.metres_per_unit])
    if not outline.is_valid:
        raise WrongRow(f"the outline crosses itself: {shapely.is_valid_reason(outline)}")
    for rectangle in cover(outline, min_fill=cfg.outline_fill, min_size_m=cfg.outline_piece_m, shares=CUT_SHARES):
        boxes.add(kind, rectangle.center, rectangle.size, low_m, high_m, rectangle.yaw_deg)


def _wrong_in(values: Mapping[str, Any], types: Mapping[str, str]) -> str:
    """Say what is wrong with the type and the numbers of a row; "" where nothing is."""
    try:
        _read_values(values, types)
    except WrongRow as error:
        return str(error)
    return ""


def _read_values(values: Mapping[str, Any], types: Mapping[str, str]) -> tuple[str, dict[str, float]]:
    """Give the type and the numbers of a row, by field, in the file's units.

    Args:
        values: by field, as the file has them. types: names of the file -> types of cosfly.
    """
    wrong, kind, numbers = list[str](), "", dict[str, float]()
    try:
        kind = _kind(values, types)
    except WrongRow as error:
        wrong.append(str(error))
    for name, value in values.items():
        if name not in ("type", "id", "name"):
            try:
                numbers[name] = _number(name, value)
            except WrongRow as error:
                wrong.append(str(error))
    if wrong:
        raise WrongRow(", ".join(wrong))
    return kind, numbers


def _kind(values: Mapping[str, Any], types: Mapping[str, str]) -> str:
    name = str(values.get("type", ""))
    kind = types.get(name, name)
    if kind not in TYPES:
        alike = {known.lower(): known for known in [*KINDS, *types]}
        close = get_close_matches(name.lower(), alike, n=1)
        meant = f" (did you mean {alike[close[0]]!r}?)" if close else ""
        raise WrongRow(f"unknown type {name[:40]!r}{meant}" if name else "no type")
    return kind


def _number(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not abs(number) <= LARGEST:
        point = "; write a decimal point, no comma" if "," in str(value) else ""
        raise WrongRow(f"{name} is not a finite number: {str(value)[:40]!r}{point}")
    return number


def _size_of(metres: Mapping[str, float], name: str) -> float:
    """Give a full size, m, which may be told as its half; raises WrongRow."""
    half = metres.get(f"half_{name}")
    if (name in metres) == (half is not None):
        raise WrongRow(f"{name} twice, whole and half" if half is not None else f"neither {name} nor half_{name}")
    size = metres[name] if half is None else 2 * half
    if not size > 0:
        raise WrongRow(f"{name} is not more than 0: {size:g} m")
    return size


def _span_of(metres: Mapping[str, float], kind: str, ground_m: float) -> tuple[float, float]:
    """Give the lowest and highest point, m, of what a row says of its heights; raises WrongRow."""
    has_height = "height" in metres or "half_height" in metres
    if "high" in metres:
        if has_height or "z" in metres:
            raise WrongRow("its heights are told twice: high beside height or z")
        low, high = metres.get("low", ground_m), metres["high"]
    elif not has_height and KINDS[kind] in GROUND_KINDS:
        top = metres.get("z", metres.get("low", ground_m))
        low, high = top - SLAB_M, top
    else:
        height = _size_of(metres, "height")
        if "z" in metres and "low" in metres:
            raise WrongRow("its heights are told twice: low beside z")
        low = metres["z"] - height / 2 if "z" in metres else metres.get("low", ground_m)
        high = low + height
    if not high > low:
        raise WrongRow(f"its top, {high:g} m, is not above its foot, {low:g} m")
    return low, high
