"""A SimWorld city: the world file of its generator, with the table of asset sizes.

The source is Unreal's: centimetres, left-handed, y to the right, yaw clockwise; it is converted here and nowhere else.
A box stands with its foot at the node's location, its size is the table's full size times the node's scale. What the
source does not hold: street furniture has placeholder cubes in the size table, so ASSETS gives plausible sizes (counted
as `default`); roads have no size, so carriageway and pavement come from what stands beside them (counted as `road`).
A world that names its own surfaces, as `cosfly world` writes it (nodes such as Sidewalks_C, named after a kind), is
taken at its word: nothing is added to it.
`header.extent_sources` holds the counts.
"""

from __future__ import annotations

import itertools
import logging
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, field_validator

from cosfly.formats.boxes import BoxMap, LicenceId, MapHeader, MapSource
from cosfly.formats.columns import LARGEST
from cosfly.formats.kinds import KIND_NAMES
from cosfly.geometry.axes import box_corners
from cosfly.maps.boxlist import BoxList
from cosfly.runtime.config import Config
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.json_io import read_json, validated
from cosfly.simulators.assets import Asset, asset_of, kind_of

log = logging.getLogger(__name__)

LEAST_M = 1e-3  # no object is smaller
M_PER_CM = 0.01
PLACEHOLDER_CM = 256.0  # the size table gives this cube to every asset that was never measured
PAVEMENT_TOP_M, ROAD_TOP_M, PAINT_TOP_M, BASE_TOP_M, SLAB_M = 0.0, -0.06, -0.03, -0.12, 0.3
BESIDE_ROAD_M = 60.0  # what stands farther from every centre line says nothing about the road
KERB_M = 0.5  # from the kerb to the middle of the row of street furniture
ROAD_SHARE_OF_FRONT = 0.43  # carriageway half width / distance of the fronts, where no furniture marks the kerb
DEFAULT_FRONT_M = 27.0  # where no building stands along a road: the generator's usual distance
MAP_MARGIN_M = 10.0
ROAD_PIECES = "BP_Road*"  # of ASSETS: pieces without a size
SURFACE_NODE = "Sidewalks_C"  # a world with such states its own surfaces


class SimWorldConfig(Config):
    """A SimWorld city."""

    name: str = Field("SimWorld", min_length=1, description="map name, the head of the playback tree's folder names")
    world: Path | None = Field(None, description="world file, progen_world.json")
    sizes: list[Path] = Field(
        [], description="asset size table or a list, the first with an asset counts; none: Bbox.json beside the world"
    )
    tool: str = Field("SimWorld city generator", description="tool and version that made the world, for the records")
    licence: LicenceId = Field("apache-2.0", description="licence, as the hub spells it; goes into every release")
    credits: str = Field("SimWorld, maitrix-org and contributors", description="who must be named: the world's makers")
    road_length_m: ClassVar[float] = 200.0  # length of a road piece, m: the generator's default
    unknown: Literal["error", "drop"] = Field(
        "error", description="what an asset without a kind or a size is: an error, or left out and counted"
    )
    stand_m: float = Field(
        0.3, ge=0.0, description="boxes whose foot is at most this high reach down to the ground, m; 0: left floating"
    )
    paint: bool = Field(True, description="add centre dashes to the roads, which the source does not hold")

    @field_validator("sizes", mode="before")
    @classmethod
    def _one_path_is_a_list(cls, sizes: Any) -> Any:
        return [sizes] if isinstance(sizes, str | Path) else sizes

    def inputs(self) -> dict[str, Path]:
        if self.world is None:
            fix = "--set maps.simworld.world=FILE"
            raise ConfigError("no file is given", where="maps.simworld.world", expected="a path", fix=fix)
        if self.world.is_dir():  # its size table would be looked for beside the folder
            raise InputError("a folder, not a world", where=self.world, expected="a world file of SimWorld, JSON")
        for number, path in enumerate(self.size_tables()):
            if not path.is_file():
                raise InputError(
                    "there is no asset size table", where=path, expected="SimWorld's Bbox.json",
                    fix=f"--set maps.simworld.sizes=FILE (now {f'entry {number}' if self.sizes else 'beside it'})",
                )  # fmt: skip
        return {"world": self.world, **{f"sizes_{k}": path for k, path in enumerate(self.size_tables())}}

    def size_tables(self) -> list[Path]:
        assert self.world is not None
        return self.sizes or [self.world.parent / "Bbox.json"]


class _Vector(BaseModel):
    x: FiniteFloat
    y: FiniteFloat
    z: FiniteFloat


class _Orientation(BaseModel):
    pitch: FiniteFloat
    yaw: FiniteFloat
    roll: FiniteFloat


class _Properties(BaseModel):
    location: _Vector
    orientation: _Orientation
    scale: _Vector


class _Node(BaseModel):
    id: str
    instance_name: str
    properties: _Properties


class _Size(BaseModel):
    bbox: _Vector


class Centerline(NamedTuple):
    """One straight road piece, world metres."""

    start: np.ndarray
    end: np.ndarray

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(self.end - self.start))

    @property
    def direction(self) -> np.ndarray:
        return (self.end - self.start) / self.length_m

    @property
    def yaw_deg(self) -> float:
        return float(np.degrees(np.arctan2(*self.direction[::-1])))


def load(cfg: SimWorldConfig, seed: int = 0) -> BoxMap:
    """Read a SimWorld city; the seed changes nothing."""
    cfg.inputs()
    assert cfg.world is not None
    nodes = _read_nodes(cfg.world)
    sizes = read_sizes(cfg.size_tables())
    boxes, sources, dropped, road_nodes = BoxList(), {"road": 0, "bbox": 0, "engine": 0, "default": 0}, 0, []
    for node in nodes:
        asset = _asset(node.instance_name)
        if asset is not None and asset.pattern == ROAD_PIECES:
            road_nodes.append(node)
            continue
        size = sizes.get(node.instance_name)
        if asset is None or size is None:
            dropped += _unknown(cfg, node, "kind" if asset is None else "size")
            continue
        sources[_add_node(boxes, cfg, node, asset, size)] += 1
    widths: dict = {}
    num_asset_boxes = len(boxes)
    if SURFACE_NODE not in {node.instance_name for node in nodes}:
        lines = _centerlines(cfg, road_nodes)
        widths = _add_roads(boxes, lines)
        sources["road"] = widths.pop("num_boxes")
        num_asset_boxes = len(boxes)
        _add_unsourced(boxes, cfg, lines, widths)
    header = MapHeader(
        name=cfg.name,
        source=MapSource(tool=cfg.tool, version="world file", file=cfg.world.name),
        licence=cfg.licence,
        credits=cfg.credits,
        ground_z_m=0.0,
        extent_sources=sources,
        roads=widths,
        added_boxes=len(boxes) - num_asset_boxes,
        num_objects=len(nodes),
        dropped_objects={"unknown_asset": dropped} if dropped else {},
    )
    return boxes.box_map(header)


# --- reading ----------------------------------------------------------------------------------------------------------


def _asset(name: str) -> Asset | None:
    """Find an asset by its name, or the kind that a node of a world of ours is named after."""
    kind = None if (asset := asset_of(name)) else kind_of(name)
    return Asset(name, kind) if kind else asset


def _group(value: object, name: str, kind: type, path: Path):
    group = value.get(name) if isinstance(value, dict) else None
    if not isinstance(group, kind) or not group:
        expected = f"{'a list' if kind is list else 'an object'} that is not empty"
        raise InputError(f"holds no {name}", where=f"{path}: {name}", got=type(group).__name__, expected=expected)
    return group


def _read_nodes(path: Path) -> list[_Node]:
    nodes = []
    for number, value in enumerate(_group(read_json(path, what="SimWorld world"), "nodes", list, path)):
        name = value.get("id", "?") if isinstance(value, dict) else "?"
        where = f"{path}: nodes[{number}] ({name})"
        node = validated(_Node, value, where)
        scale, turn = node.properties.scale, node.properties.orientation
        if min(scale.x, scale.y, scale.z) <= 0:
            got = str([scale.x, scale.y, scale.z])
            raise InputError("a scale is not positive", where=f"{where}: properties.scale", got=got)
        if turn.pitch or turn.roll:
            where, got = f"{where}: properties.orientation", f"pitch {turn.pitch}, roll {turn.roll}"
            raise InputError("a tilted object", where=where, got=got, expected="0 and 0")
        nodes.append(node)
    return nodes


def read_sizes(paths: list[Path]) -> dict[str, np.ndarray]:
    """Return full sizes in cm by asset name; groups (buildings, elements, details) are joined."""
    sizes: dict[str, np.ndarray] = {}
    for path in paths:
        table = read_json(path, what="asset size table")
        if not isinstance(table, dict) or not table:
            raise InputError("not an asset size table", where=path, expected="an object of groups of assets")
        for group in table:
            for name, value in _group(table, group, dict, path).items():
                where = f"{path}: {group}.{name}"
                box = validated(_Size, value, where).bbox
                if min(box.x, box.y, box.z) <= 0:
                    raise InputError("a size is not positive", where=f"{where}: bbox", got=str([box.x, box.y, box.z]))
                sizes.setdefault(name, np.array([box.x, box.y, box.z]))
    return sizes


def _unknown(cfg: SimWorldConfig, node: _Node, what: str) -> int:
    """Count an asset that cannot be placed, or stop because of it."""
    if cfg.unknown == "error":
        to_size, to_kinds = (
            "a size table that has it to maps.simworld.sizes",
            "it to ASSETS in cosfly/simulators/assets.py",
        )
        raise InputError(
            f"an asset without a {what}", where=f"{cfg.world}: {node.id}.instance_name", got=node.instance_name,
            fix=f"add {to_size if what == 'size' else to_kinds}, or leave such out: --set maps.simworld.unknown=drop",
        )  # fmt: skip
    log.warning("%s: %s has no %s and is left out", node.id, node.instance_name, what)
    return 1


def _add_node(boxes: BoxList, cfg: SimWorldConfig, node: _Node, asset: Asset, size_cm: np.ndarray) -> str:
    """Add one object; gives the source of its extent."""
    location, scale = node.properties.location, node.properties.scale
    is_placeholder = asset.default_size_m is not None and bool((size_cm == PLACEHOLDER_CM).all())
    size = np.array(asset.default_size_m) if is_placeholder else size_cm * M_PER_CM
    size = size * [scale.x, scale.y, scale.z]
    if not LEAST_M <= size.min() <= size.max() <= LARGEST:
        raise InputError(
            "the size of an object cannot be", where=f"{cfg.world}: {node.id}",
            got=f"{size.tolist()} m, of size and scale", expected=f"{LEAST_M:g} m or more",
            fix="mend its scale, or its asset's size in the table",
        )  # fmt: skip
    foot = location.z * M_PER_CM
    low = 0.0 if 0 < foot <= cfg.stand_m else foot
    xy = (location.x * M_PER_CM, -location.y * M_PER_CM)  # Unreal's y points right
    boxes.add(asset.kind, xy, size[:2], low, foot + size[2], -node.properties.orientation.yaw)
    return "default" if is_placeholder else "bbox"


# --- roads ------------------------------------------------------------------------------------------------------------


def _centerlines(cfg: SimWorldConfig, nodes: list[_Node]) -> list[Centerline]:
    """Centre lines in world metres, from the road pieces: a location is a piece's middle, x its direction.

    The roads.json beside a world is not read: in the city that SimWorld ships it holds 7 roads, two of them nowhere in
    the world, and the world holds 10.
    """
    lines = []
    for node in nodes:
        turn = -np.radians(node.properties.orientation.yaw)
        middle = np.array([node.properties.location.x, -node.properties.location.y]) * M_PER_CM
        half = np.array([np.cos(turn), np.sin(turn)]) * cfg.road_length_m / 2
        lines.append(Centerline(middle - half, middle + half))
    return lines


def _distances_m(points: np.ndarray, lines: list[Centerline]) -> np.ndarray:
    """Distance of (n, 2) points to the nearest centre line, (n,)."""
    best = np.full(len(points), np.inf)
    for line in lines:
        along = np.clip((points - line.start) @ line.direction, 0.0, line.length_m)
        best = np.minimum(best, np.linalg.norm(points - line.start - along[:, None] * line.direction, axis=1))
    return best


def _half_widths(boxes: BoxList, lines: list[Centerline]) -> tuple[float, float]:
    """Half the carriageway's width, and the distance of the fronts from the centre line, m.

    Both are what nearly all objects keep clear of (tenth percentile): fronts from the nearest points of buildings, the
    kerb from the middles of street furniture.
    """
    box_map = boxes.box_map()
    kinds = np.array([KIND_NAMES[int(kind)] for kind in box_map.kinds])
    fronts = [DEFAULT_FRONT_M]
    rows = np.flatnonzero(kinds == "Buildings")
    if len(rows):
        edges = np.concatenate([_outline(box_map, int(row)) for row in rows])
        nearest = _distances_m(edges, lines).reshape(len(rows), -1).min(axis=1)
        fronts = nearest[nearest < BESIDE_ROAD_M].tolist() or fronts
    front = float(np.percentile(fronts, 10))
    furniture = _distances_m(box_map.centers[(kinds == "Static") | (kinds == "Motorcycle"), :2], lines)
    furniture = furniture[furniture < front]
    kerb = float(np.percentile(furniture, 10)) - KERB_M if len(furniture) >= 4 else ROAD_SHARE_OF_FRONT * front
    return round(max(kerb, 2.0), 2), round(max(front, kerb + 1.0), 2)


def _outline(box_map: BoxMap, row: int) -> np.ndarray:
    """Points along a footprint's edges, (n, 2)."""
    corners = box_corners(box_map.centers[row], box_map.half_extents[row], np.radians(box_map.rotations_deg[row, 1]))
    ring = corners[[0, 2, 6, 4, 0], :2]
    shares = np.linspace(0.0, 1.0, 25)[:, None]
    return np.concatenate([a + shares * (b - a) for a, b in itertools.pairwise(ring)])


def _add_roads(boxes: BoxList, lines: list[Centerline]) -> dict:
    """Add carriageways and pavements, without overlaps: a square at every junction, straight pieces between."""
    if not lines:
        return {"num_boxes": 0}
    kerb, front = _half_widths(boxes, lines)
    before = len(boxes)
    junctions: dict[tuple[int, int], list[np.ndarray]] = {}
    for line in lines:
        for end, away in ((line.start, line.direction), (line.end, -line.direction)):
            junctions.setdefault(tuple(np.round(end).astype(int)), []).append(away)
        middle, yaw = (line.start + line.end) / 2, line.yaw_deg
        normal = np.array([-line.direction[1], line.direction[0]])
        if line.length_m > 2 * front:  # a junction's slabs reach as far as the fronts
            _slab(boxes, "Roads", middle, (line.length_m - 2 * front, 2 * kerb), yaw)
            for side in (-1, 1):
                size = (line.length_m - 2 * front, front - kerb)
                _slab(boxes, "Sidewalks", middle + side * (front + kerb) / 2 * normal, size, yaw)
    for place, arms in junctions.items():
        _add_junction(boxes, np.array(place, dtype=np.float64), arms, kerb, front)
    return {"num_boxes": len(boxes) - before, "carriageway_m": 2 * kerb, "front_to_front_m": 2 * front}


def _add_junction(boxes: BoxList, place: np.ndarray, arms: list[np.ndarray], kerb: float, front: float) -> None:
    """The crossing square, pavement at its four corners, and pavement across the sides that no road leaves by."""
    x = arms[0]
    y = np.array([-x[1], x[0]])
    yaw = float(np.degrees(np.arctan2(x[1], x[0])))
    _slab(boxes, "Roads", place, (2 * kerb, 2 * kerb), yaw)
    middle, width = (front + kerb) / 2, front - kerb
    for a in (-1, 1):
        for b in (-1, 1):
            _slab(boxes, "Sidewalks", place + middle * (a * x + b * y), (width, width), yaw)
    along, across = (width, 2 * kerb), (2 * kerb, width)
    for side, size in ((x, along), (-x, along), (y, across), (-y, across)):
        is_road = any(arm @ side > 0.7 for arm in arms)
        _slab(boxes, "Roads" if is_road else "Sidewalks", place + middle * side, size, yaw)


def _slab(boxes: BoxList, kind: str, middle: np.ndarray, size: tuple[float, float], yaw_deg: float) -> None:
    top = ROAD_TOP_M if kind == "Roads" else PAVEMENT_TOP_M
    boxes.add(kind, middle, size, top - SLAB_M, top, yaw_deg)


def _add_unsourced(boxes: BoxList, cfg: SimWorldConfig, lines: list[Centerline], widths: dict) -> None:
    """Add the ground below everything, and paint: neither is in the source."""
    low, high = boxes.box_map().bounds()
    boxes.add_span("Terrain", low[:2] - MAP_MARGIN_M, high[:2] + MAP_MARGIN_M, BASE_TOP_M - SLAB_M, BASE_TOP_M)
    if not cfg.paint:
        return
    for line in lines:
        for at in np.arange(widths["carriageway_m"], line.length_m - widths["carriageway_m"], 9.0):
            place = line.start + (at + 1.5) * line.direction
            boxes.add("RoadLines", place, (3.0, 0.16), ROAD_TOP_M - 0.04, PAINT_TOP_M, line.yaw_deg)
