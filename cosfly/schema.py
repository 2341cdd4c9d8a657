"""What stages 1-4 leave on disk: boxes, region of interest, pedestrian paths, drone traces. One reader, one writer each.

World frame, right-handed metres; files carry degrees (cosfly/geometry.py). Every reader checks schema, version, shapes
and finiteness and names file and field. The playback tree of stages 5-7 has its own module, cosfly/playback.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from cosfly.errors import InputError, nearest
from cosfly.geometry import axis_aligned_half_extents
from cosfly.store import check_schema, dump_json, read_json, write_bytes, write_json

DT_S = 0.5  # pipeline-wide time step (2 Hz): pedestrians, planners, frames, windows

# The tracked person: an axis-aligned box round the hip point, which is the target's position everywhere.
PERSON_HALF_EXTENTS_M = (0.3, 0.3, 0.9)
TARGET_HEIGHT_M = 0.9  # hip height over the ground: the box stands on it

# --- categories -------------------------------------------------------------------------------------------------------

# CARLA 0.9.16 CityObjectLabel: name -> number. Numbers differ between CARLA versions, so sources are mapped by name.
KINDS: dict[str, int] = {
    "NONE": 0, "Roads": 1, "Sidewalks": 2, "Buildings": 3, "Walls": 4, "Fences": 5, "Poles": 6, "TrafficLight": 7,
    "TrafficSigns": 8, "Vegetation": 9, "Terrain": 10, "Sky": 11, "Pedestrians": 12, "Rider": 13, "Car": 14, "Truck": 15,
    "Bus": 16, "Train": 17, "Motorcycle": 18, "Bicycle": 19, "Static": 20, "Dynamic": 21, "Other": 22, "Water": 23,
    "RoadLines": 24, "Ground": 25, "Bridge": 26, "RailTrack": 27, "GuardRail": 28,
}  # fmt: skip
KIND_NAMES = {number: name for name, number in KINDS.items()}

# CARLA's own palette (CityScapes), so that masks look as its users expect; index = kind.
KIND_COLORS: dict[str, str] = {
    "NONE": "#000000", "Roads": "#804080", "Sidewalks": "#f423e8", "Buildings": "#464646", "Walls": "#66669c",
    "Fences": "#be9999", "Poles": "#999999", "TrafficLight": "#faaa1e", "TrafficSigns": "#dcdc00", "Vegetation": "#6b8e23",
    "Terrain": "#98fb98", "Sky": "#4682b4", "Pedestrians": "#dc143c", "Rider": "#ff0000", "Car": "#00008e",
    "Truck": "#000046", "Bus": "#003c64", "Train": "#005064", "Motorcycle": "#0000e6", "Bicycle": "#770b20",
    "Static": "#6ebea0", "Dynamic": "#aa7832", "Other": "#375a50", "Water": "#2d3c96", "RoadLines": "#9dea32",
    "Ground": "#510051", "Bridge": "#966464", "RailTrack": "#e6968c", "GuardRail": "#b4a5b4",
}  # fmt: skip

# Surfaces that people and cars stand on: never an obstacle, whatever their thickness.
GROUND_KINDS = frozenset(KINDS[name] for name in ("Roads", "Sidewalks", "Terrain", "RoadLines", "Ground", "RailTrack"))


# --- boxes ------------------------------------------------------------------------------------------------------------

BOXES_SCHEMA, BOXES_VERSION = "cosfly.boxes_3d", "1.0"


@dataclass(frozen=True)
class BoxMap:
    """A map of boxes, the product of stages 1 and 2.

    centers, half_extents: (n, 3) float64, m. rotations_deg: (n, 3) float64: pitch, yaw, roll. kinds: (n,) uint8, KINDS.
    ids: (n,) uint64, unique and stable. `header` holds name, source, axes, ground height, and what a stage adds (passes).
    """

    centers: np.ndarray
    half_extents: np.ndarray
    rotations_deg: np.ndarray
    kinds: np.ndarray
    ids: np.ndarray
    header: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def name(self) -> str:
        return str(self.header.get("name", "map"))

    @property
    def mins(self) -> np.ndarray:
        """(n, 3) low corners of the axis-aligned boxes round the rotated ones."""
        return self.centers - axis_aligned_half_extents(self.half_extents, self.rotations_deg)

    @property
    def maxs(self) -> np.ndarray:
        return self.centers + axis_aligned_half_extents(self.half_extents, self.rotations_deg)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Low and high corner of all boxes, (3,) each."""
        return self.mins.min(axis=0), self.maxs.max(axis=0)

    def select(self, index: np.ndarray) -> BoxMap:
        """Give the boxes at an index or mask, header unchanged."""
        return replace(
            self,
            centers=self.centers[index],
            half_extents=self.half_extents[index],
            rotations_deg=self.rotations_deg[index],
            kinds=self.kinds[index],
            ids=self.ids[index],
        )

    def counts(self) -> dict[str, int]:
        """Boxes by kind name, largest first."""
        numbers, counts = np.unique(self.kinds, return_counts=True)
        order = sorted(zip(counts.tolist(), numbers.tolist(), strict=True), key=lambda pair: (-pair[0], pair[1]))
        return {KIND_NAMES[number]: count for count, number in order}


def make_box_map(
    centers: Any, half_extents: Any, rotations_deg: Any, kinds: Any, ids: Any = None, header: dict | None = None
) -> BoxMap:
    """Make a BoxMap from anything array-like; ids default to 1..n."""
    centers = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    return BoxMap(
        centers,
        np.asarray(half_extents, dtype=np.float64).reshape(-1, 3),
        np.asarray(rotations_deg, dtype=np.float64).reshape(-1, 3),
        np.asarray(kinds, dtype=np.uint8).reshape(-1),
        np.arange(1, len(centers) + 1, dtype=np.uint64)
        if ids is None
        else np.asarray(ids, dtype=np.uint64).reshape(-1),
        dict(header or {}),
    )


def check_boxes(box_map: BoxMap, where: str | Path) -> None:
    """Check what every map must hold, whoever made it.

    Raises:
        InputError: NaN, a negative extent, an unknown kind or a repeated id; names the box and the field.
    """
    for name, field_name in (("centers", "center"), ("half_extents", "extent"), ("rotations_deg", "rotation")):
        bad = np.flatnonzero(~np.isfinite(getattr(box_map, name)).all(axis=1))
        if len(bad):
            row = int(bad[0])
            raise InputError(
                "a box is not finite", where=f"{where}: box {box_map.ids[row]}: {field_name}",
                got=str(getattr(box_map, name)[row].tolist()), expected="finite numbers",
            )  # fmt: skip
    bad = np.flatnonzero((box_map.half_extents < 0).any(axis=1))
    if len(bad):
        row = int(bad[0])
        raise InputError(
            "a box has a negative extent", where=f"{where}: box {box_map.ids[row]}: extent",
            got=str(box_map.half_extents[row].tolist()), expected="half sizes of at least 0 m",
        )  # fmt: skip
    unknown = [int(kind) for kind in np.unique(box_map.kinds) if int(kind) not in KIND_NAMES]
    if unknown:
        raise InputError("unknown semantic id", where=where, got=str(unknown[0]), expected="0 to 28")
    ids, counts = np.unique(box_map.ids, return_counts=True)
    if (counts > 1).any():
        raise InputError("a box id occurs more than once", where=where, got=str(ids[counts > 1][0]))


def write_boxes(path: Path, box_map: BoxMap) -> None:
    """Write boxes in the paper's fields (tab:boxes_schema), one box a line."""
    check_boxes(box_map, path)
    columns = {name: np.round(getattr(box_map, name), 6) for name in ("centers", "half_extents", "rotations_deg")}
    box_map = replace(box_map, **columns)  # so that min and max agree with what is read back
    mins, maxs = box_map.mins, box_map.maxs
    low, high = box_map.bounds() if len(box_map) else (np.zeros(3), np.zeros(3))
    header = {
        "schema": BOXES_SCHEMA,
        "schema_version": BOXES_VERSION,
        **box_map.header,
        "axes": "right-handed, metres, x east, y north, z up; degrees",
        "bounds": {"min": _rounded(low), "max": _rounded(high)},
        "num_boxes": len(box_map),
        "counts": box_map.counts(),
    }
    lines = []
    for i in range(len(box_map)):
        kind = KIND_NAMES[int(box_map.kinds[i])]
        lines.append(
            dump_json(
                {
                    "type": kind,
                    "semantic_id": int(box_map.kinds[i]),
                    "color": KIND_COLORS[kind],
                    "id": int(box_map.ids[i]),
                    "center": _rounded(box_map.centers[i]),
                    "extent": _rounded(box_map.half_extents[i]),
                    "rotation": _rounded(box_map.rotations_deg[i]),
                    "min": _rounded(mins[i]),
                    "max": _rounded(maxs[i]),
                }
            )
        )
    text = dump_json(header, indent=1)[:-2] + ',\n "boxes": [\n' + ",\n".join(lines) + "\n]}\n"
    write_bytes(path, text.encode())


def read_boxes(path: Path) -> BoxMap:
    """Read `boxes_3d.json` or `step2_simplified.json`; also a bare list of boxes, as the paper's exporter writes.

    Raises:
        InputError: names the file, the box and the field.
    """
    value = read_json(path, what="map")
    header: dict[str, Any] = {"name": path.stem}
    records: Any = value
    if not isinstance(value, list):
        header = check_schema(value, BOXES_SCHEMA, BOXES_VERSION, path)
        records = header.pop("boxes", None)
        if not isinstance(records, list):
            raise InputError("no list of boxes", where=f"{path}: boxes", got=type(records).__name__, expected="a list")
    if not records:
        raise InputError("the map holds no boxes", where=path, fix="check the source, or the stage that made it")
    kinds, ids = [], []
    for i, record in enumerate(records):
        if not isinstance(record, dict):
            raise InputError("not a box", where=f"{path}: boxes[{i}]", got=type(record).__name__, expected="an object")
        kind = record.get("type")
        if kind not in KINDS:
            hint = nearest(str(kind), KINDS)
            raise InputError(
                f"unknown type{hint}",
                where=f"{path}: boxes[{i}].type",
                got=repr(kind),
                expected="a CityObjectLabel name",
            )
        kinds.append(KINDS[kind])
        box_id = record.get("id")
        if not isinstance(box_id, int) or isinstance(box_id, bool) or not 0 <= box_id < 2**64:
            raise InputError(
                "not an id", where=f"{path}: boxes[{i}].id", got=repr(box_id), expected="a non-negative integer"
            )
        ids.append(box_id)
    centers, extents, rotations = (_vectors(records, name, path) for name in ("center", "extent", "rotation"))
    box_map = make_box_map(centers, extents, rotations, kinds, ids, header)
    check_boxes(box_map, path)
    return box_map


def _vectors(records: list[dict], name: str, path: Path) -> np.ndarray:
    """Read one three-vector field of all records, (n, 3)."""
    try:
        values = np.array([record[name] for record in records])
        if values.shape == (len(records), 3) and values.dtype.kind in "fiu":  # not numbers in quotes, not null
            return values.astype(np.float64)
    except (KeyError, TypeError, ValueError):
        pass
    for i, record in enumerate(records):  # slow, only to name the culprit
        value = record.get(name)
        ok = isinstance(value, list) and len(value) == 3 and all(type(v) in (int, float) for v in value)
        if not ok:
            raise InputError(
                "not a vector", where=f"{path}: boxes[{i}].{name}", got=repr(value), expected="three numbers"
            )
    raise InputError("not vectors", where=f"{path}: boxes[].{name}", expected="three numbers each")


def _rounded(vector: np.ndarray, digits: int = 6) -> list[float]:
    """Micrometres are enough for a map, and short numbers keep files small."""
    return [round(float(v), digits) + 0.0 for v in vector]  # + 0.0 turns -0.0 into 0.0


# --- region of interest -----------------------------------------------------------------------------------------------


class RoiPolygon(BaseModel):
    """One outer ring with holes, world x and y in metres."""

    model_config = ConfigDict(extra="allow")
    points_world: list[tuple[float, float]]
    holes: list[list[tuple[float, float]]] = []


class Roi(BaseModel):
    """`roi_polygon.json`: the paper's form (one closed ring), and ours with holes and several outer rings."""

    model_config = ConfigDict(extra="allow")
    description: str = ""
    closed: bool = True
    points_world: list[tuple[float, float]] = []
    holes: list[list[tuple[float, float]]] = []
    polygons: list[RoiPolygon] = []

    def rings(self) -> list[RoiPolygon]:
        """All polygons in one form."""
        own = [RoiPolygon(points_world=self.points_world, holes=self.holes)] if self.points_world else []
        return own + self.polygons


def read_roi(path: Path) -> Roi:
    """Read a region of interest.

    Raises:
        InputError: malformed, not closed, or a ring of fewer than three finite points.
    """
    value = read_json(path, what="region of interest")
    try:
        roi = Roi.model_validate(value)
    except ValidationError as error:
        detail = error.errors()[0]
        place = ".".join(map(str, detail["loc"])) or "top level"
        what = "not an object" if detail["type"] == "model_type" else detail["msg"]
        raise InputError(what, where=f"{path}: {place}", got=repr(detail["input"])[:80]) from None
    if not roi.closed:
        raise InputError(
            "the polygon is not closed",
            where=f"{path}: closed",
            got="false",
            expected="true",
            fix="close it in the editor",
        )
    if not roi.rings():
        raise InputError("no polygon", where=f"{path}: points_world", expected="at least three points")
    for number, polygon in enumerate(roi.rings()):
        for ring in (polygon.points_world, *polygon.holes):
            if len(ring) < 3 or not np.isfinite(np.array(ring, dtype=np.float64)).all():
                raise InputError(
                    "not a ring",
                    where=f"{path}: polygon {number}",
                    got=f"{len(ring)} points",
                    expected="at least three finite points",
                )
    return roi


# --- pedestrian paths -------------------------------------------------------------------------------------------------

PATHS_SCHEMA, PATHS_VERSION = "cosfly.path", "1.0"


@dataclass(frozen=True)
class PedestrianPath:
    """One walk, the product of stage 3.

    polyline_m: (k, 2) the A* route. time_s: (n,), step DT_S, from 0. positions_m: (n, 3), feet on the ground. speeds_mps: (n,).
    """

    path_id: str
    polyline_m: np.ndarray
    time_s: np.ndarray
    positions_m: np.ndarray
    speeds_mps: np.ndarray

    def as_json(self) -> dict:
        return {
            "id": self.path_id,
            "start": _rounded(self.polyline_m[0]),
            "goal": _rounded(self.polyline_m[-1]),
            "length_m": round(float(np.linalg.norm(np.diff(self.polyline_m, axis=0), axis=1).sum()), 3),
            "polyline": [_rounded(p, 4) for p in self.polyline_m],
            "t": _rounded(self.time_s, 4),
            **{axis: _rounded(self.positions_m[:, k], 4) for k, axis in enumerate("xyz")},
            "speed": _rounded(self.speeds_mps, 4),
        }

    @classmethod
    def from_json(cls, record: dict, where: str) -> PedestrianPath:
        columns = {name: _column(record, name, where) for name in ("t", "x", "y", "z", "speed")}
        lengths = {name: len(column) for name, column in columns.items()}
        if len(set(lengths.values())) != 1:
            raise InputError("columns of different lengths", where=where, got=str(lengths))
        polyline = _matrix(record, "polyline", 2, where)
        positions = np.stack([columns["x"], columns["y"], columns["z"]], axis=1)
        return cls(_text_id(record, where), polyline, columns["t"], positions, columns["speed"])


def write_paths(path: Path, paths: list[PedestrianPath], header: dict) -> None:
    """Write `path.json`; `header` holds the map's name, seed and whatever the stage wants on record."""
    value = {"schema": PATHS_SCHEMA, "schema_version": PATHS_VERSION, **header, "dt_s": DT_S}
    write_json(path, {**value, "paths": [p.as_json() for p in paths]}, indent=None)


def read_paths(path: Path) -> list[PedestrianPath]:
    """Read `path.json`.

    Raises:
        InputError: names the file, the path and the field.
    """
    value = check_schema(read_json(path, what="pedestrian paths"), PATHS_SCHEMA, PATHS_VERSION, path)
    return [PedestrianPath.from_json(r, f"{path}: paths[{i}]") for i, r in enumerate(_records(value, "paths", path))]


# --- drone traces -----------------------------------------------------------------------------------------------------

TRACE_SCHEMA, TRACE_VERSION = "cosfly.drone_trace", "1.0"


@dataclass(frozen=True)
class DroneTrace:
    """One flight, the product of stage 4; n points at the pedestrian's time stamps.

    time_s: (n,). positions_m: (n, 3) drone. rotations_deg: (n, 3) pitch, yaw, roll of the camera, which looks at the target.
    targets_m: (n, 3) the pedestrian's tracked point (hip height). visibility: (n,) five-ray fraction in [0, 1].
    clearances_m: (n,) signed distance to the nearest obstacle. metrics and solver: JSON-able facts.
    drop_reason: why the planner-stage prefilter (sec:step6) rejects the flight, None if it passes; only those are rendered.
    """

    path_id: str
    planner: str
    time_s: np.ndarray
    positions_m: np.ndarray
    rotations_deg: np.ndarray
    targets_m: np.ndarray
    visibility: np.ndarray
    clearances_m: np.ndarray
    metrics: dict = field(default_factory=dict)
    solver: dict = field(default_factory=dict)
    drop_reason: str | None = None

    def as_json(self) -> dict:
        names = ("x", "y", "z")
        return {
            "id": self.path_id,
            "planner": self.planner,
            "drop_reason": self.drop_reason,
            "metrics": self.metrics,
            "solver": self.solver,
            "t": _rounded(self.time_s, 4),
            "drone": {
                **{axis: _rounded(self.positions_m[:, k], 4) for k, axis in enumerate(names)},
                **{name: _rounded(self.rotations_deg[:, k], 4) for k, name in enumerate(("pitch", "yaw", "roll"))},
            },
            "target": {axis: _rounded(self.targets_m[:, k], 4) for k, axis in enumerate(names)},
            "visibility": _rounded(self.visibility, 4),
            "clearance": _rounded(self.clearances_m, 4),
        }

    @classmethod
    def from_json(cls, record: dict, where: str) -> DroneTrace:
        time_s = _column(record, "t", where)
        groups = {}
        for group, names in (("drone", ("x", "y", "z", "pitch", "yaw", "roll")), ("target", ("x", "y", "z"))):
            part = record.get(group)
            if not isinstance(part, dict):
                raise InputError("missing", where=f"{where}.{group}", expected="an object of columns")
            groups[group] = np.stack([_column(part, name, f"{where}.{group}", len(time_s)) for name in names], axis=1)
        return cls(
            _text_id(record, where), str(record.get("planner", "")), time_s, groups["drone"][:, :3], groups["drone"][:, 3:],
            groups["target"], _column(record, "visibility", where, len(time_s)),
            _column(record, "clearance", where, len(time_s)), record.get("metrics", {}), record.get("solver", {}), record.get("drop_reason"),
        )  # fmt: skip


def write_traces(path: Path, traces: list[DroneTrace], header: dict) -> None:
    """Write `drone_trace.json`; `header` holds the map's name, planner settings and seed."""
    value = {"schema": TRACE_SCHEMA, "schema_version": TRACE_VERSION, **header, "dt_s": DT_S}
    write_json(path, {**value, "traces": [t.as_json() for t in traces]}, indent=None)


def read_traces(path: Path) -> list[DroneTrace]:
    """Read `drone_trace.json`.

    Raises:
        InputError: names the file, the trace and the field.
    """
    value = check_schema(read_json(path, what="drone traces"), TRACE_SCHEMA, TRACE_VERSION, path)
    return [DroneTrace.from_json(r, f"{path}: traces[{i}]") for i, r in enumerate(_records(value, "traces", path))]


# --- shared reading ---------------------------------------------------------------------------------------------------


def _records(value: dict, name: str, path: Path) -> list[dict]:
    records = value.get(name)
    if not isinstance(records, list) or not all(isinstance(r, dict) for r in records):
        raise InputError("not a list of objects", where=f"{path}: {name}")
    return records


def _text_id(record: dict, where: str) -> str:
    if not isinstance(record.get("id"), str):
        raise InputError("not an id", where=f"{where}.id", got=repr(record.get("id")), expected="text")
    return record["id"]


def _column(record: dict, name: str, where: str, length: int | None = None) -> np.ndarray:
    """Read a list of finite numbers, (n,) float64."""
    try:
        column = np.array(record[name], dtype=np.float64)
    except KeyError:
        raise InputError("missing", where=f"{where}.{name}", expected="a list of numbers") from None
    except (TypeError, ValueError):
        column = np.empty((0, 0))
    if column.ndim != 1 or len(column) == 0 or not np.isfinite(column).all() or length not in (None, len(column)):
        wanted = "a list of finite numbers" if length is None else f"{length} finite numbers"
        raise InputError("not a column", where=f"{where}.{name}", got=repr(record[name])[:60], expected=wanted)
    return column


def _matrix(record: dict, name: str, width: int, where: str) -> np.ndarray:
    """Read a list of vectors of finite numbers, (n, width) float64."""
    try:
        matrix = np.array(record.get(name), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty((0, 0))
    if matrix.ndim != 2 or matrix.shape[1] != width or not np.isfinite(matrix).all():
        raise InputError(
            "not a list of vectors",
            where=f"{where}.{name}",
            got=repr(record.get(name))[:60],
            expected=f"{width} finite numbers each",
        )
    return matrix
