"""A SimWorld city: the world file of its generator, with the table of asset sizes.

The file has Unreal's axes: centimetres, left-handed, yaw clockwise. A box stands on the node's location; its size is
the full size in the table times the node's scale. The table lacks sizes of street furniture (source `default`, from
`assets.yaml`), and the world lacks widths of roads (source `road`: from the objects along them). A world that holds its
own surfaces, such as those of `cosfly world`, gets none added. `header.extent_sources` counts the sources of sizes.
"""

import logging
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import shapely
from pydantic import AliasPath, BaseModel, Field, FiniteFloat, field_validator

from cosfly.formats.boxes import BoxMap, MapHeader, MapSource
from cosfly.formats.columns import LARGEST
from cosfly.formats.kinds import KINDS
from cosfly.maps.boxlist import (
    BASE_TOP_M,
    PAINT_TOP_M,
    ROAD_TOP_M,
    SLAB_M,
    BoxList,
    MapLicence,
    MapName,
    Pair,
    SkippedEntries,
    required,
)
from cosfly.maps.footprints import footprints
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import read_json, validated
from cosfly.simulators.assets import Asset, asset_of, kind_of

log = logging.getLogger(__name__)

LEAST_M = 1e-3  # smallest side of an object
M_PER_CM = 0.01
ROAD_LENGTH_M = 200.0  # of a road piece, the default of the generator
STAND_M = 0.3  # boxes that begin at most this high are extended down to the ground
PLACEHOLDER_CM = 256.0  # side of the cube that the size table has for assets without a measured size
BESIDE_ROAD_M = 60.0  # largest distance of objects that count for the width of roads from a centre line
KERB_M = 0.5  # from the kerb to the middle of street furniture
LEAST_FURNITURE = 4  # objects that locate the kerb
LEAST_KERB_M = 2.0  # from the centre line to the kerb
ROAD_SHARE_OF_FRONT = 0.43  # half width of the carriageway / distance of the fronts, if too little furniture is there
DEFAULT_FRONT_M = 27.0  # usual distance of fronts in the generator, for roads without buildings
DASH_M, DASH_STEP_M, DASH_WIDTH_M = 3.0, 9.0, 0.16  # of the paint on a centre line
MAP_MARGIN_M = 10.0
ROAD_PIECES = "BP_Road*"  # of `assets.yaml`: pieces without a size
SURFACE_NODE = "Sidewalks_C"  # only worlds with their own surfaces have it


class SimWorldConfig(Config):
    """A SimWorld city."""

    name: MapName = "SimWorld"
    world: Path | None = Field(None, description="world file, progen_world.json")
    sizes: list[Path] = Field(
        [], description="asset size tables, of which the first with an asset applies; empty: Bbox.json near the world"
    )
    licence: MapLicence = "apache-2.0"
    credits: str = Field("SimWorld, maitrix-org and contributors", description="attribution of the world's makers")
    most_skipped: float = Field(
        0.0, ge=0, le=1, description="largest share of objects whose assets have no kind or size, which are dropped"
    )

    @field_validator("sizes", mode="before")
    @classmethod
    def _one_path_is_a_list(cls, sizes: Any) -> Any:
        return [sizes] if isinstance(sizes, str | Path) else sizes

    def inputs(self) -> dict[str, Path]:
        world = required(self.world, "maps.simworld.world")
        if world.is_dir():  # its size table would be looked for next to the folder
            raise InputError("maps.simworld.world is a folder", where=world, expected="a JSON file of SimWorld")
        tables = self.sizes or [world.parent / "Bbox.json"]
        for path in tables:
            if not path.is_file():
                fix = "pass --set maps.simworld.sizes=FILE"
                raise InputError("the size table does not exist", where=path, expected="SimWorld's Bbox.json", fix=fix)
        return {"world": world, **{f"sizes_{k}": path for k, path in enumerate(tables)}}


Positive = Annotated[FiniteFloat, Field(gt=0)]
Place = Annotated[FiniteFloat, Field(ge=-1e9, le=1e9)]  # cm


class _Vector(BaseModel):
    x: Place
    y: Place
    z: Place


class _Size(BaseModel):
    x: Positive
    y: Positive
    z: Positive

    def array(self) -> np.ndarray:
        return np.array([self.x, self.y, self.z])


class _Node(BaseModel):
    id: str
    instance_name: str
    location: _Vector = Field(validation_alias=AliasPath("properties", "location"))
    scale: _Size = Field(validation_alias=AliasPath("properties", "scale"))
    yaw: FiniteFloat = Field(validation_alias=AliasPath("properties", "orientation", "yaw"))
    # Tilted objects are no upright boxes.
    pitch: FiniteFloat = Field(ge=0, le=0, validation_alias=AliasPath("properties", "orientation", "pitch"))
    roll: FiniteFloat = Field(ge=0, le=0, validation_alias=AliasPath("properties", "orientation", "roll"))

    @property
    def xy_m(self) -> np.ndarray:
        """The location in the world: Unreal's y points right."""
        return np.array([self.location.x * M_PER_CM, -self.location.y * M_PER_CM])

    # The roads.json of a world is not read: in SimWorld's city it has 7 roads, two of which the world lacks, but the
    # world has 10.
    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """The ends of the centre line of a road piece, along its x, whose middle is the location."""
        turn = -np.radians(self.yaw)
        half = np.array([np.cos(turn), np.sin(turn)]) * ROAD_LENGTH_M / 2
        return self.xy_m - half, self.xy_m + half

    @property
    def direction(self) -> np.ndarray:
        """The direction of a road piece, (2,)."""
        return (self.ends[1] - self.ends[0]) / ROAD_LENGTH_M


class _World(BaseModel):
    nodes: list[_Node] = Field(min_length=1)


class _Asset(BaseModel):
    bbox: _Size


_SizeTable = dict[str, dict[str, _Asset]]  # group (buildings, elements, details) -> asset -> size, cm


def load(cfg: SimWorldConfig, seed: int = 0) -> BoxMap:
    """Read a SimWorld city; the seed changes nothing."""
    world, *tables = cfg.inputs().values()
    nodes = validated(_World, read_json(world, what="SimWorld world"), world).nodes
    sizes = read_sizes(tables)
    has_surfaces = any(node.instance_name == SURFACE_NODE for node in nodes)
    stand_m = 0.0 if has_surfaces else STAND_M
    boxes = BoxList()
    size_sources = {"road": 0, "bbox": 0, "engine": 0, "default": 0}
    dropped = SkippedEntries()
    roads: list[_Node] = []
    for node in nodes:
        asset = asset_of(node.instance_name) or _asset_of_kind(node.instance_name)
        size_cm = sizes.get(node.instance_name)
        if asset is not None and asset.pattern == ROAD_PIECES:
            roads.append(node)
        elif asset is None or size_cm is None:
            problem = f"the asset {node.instance_name} has no {'kind' if asset is None else 'size'}"
            dropped.add("unknown_asset", node.id, problem)
        else:
            size_sources[_add_node(boxes, node, asset, size_cm, stand_m, world)] += 1
    if has_surfaces and roads:  # the world has its roads as surfaces
        dropped.counts["repeated_road"] = len(roads)
    expected = (
        f"at most {cfg.most_skipped:.0%} of the objects without a kind or size (maps.simworld.most_skipped); sizes are "
        "in the tables of maps.simworld.sizes, kinds in cosfly/simulators/assets.yaml"
    )
    dropped.check(world, len(nodes), cfg.most_skipped, expected)
    widths: dict[str, float] = {}
    num_of_objects = num_with_roads = len(boxes)
    if not has_surfaces:
        widths = _add_roads(boxes, roads)
        num_with_roads = len(boxes)
        _add_ground_and_paint(boxes, roads, widths)
    size_sources["road"] = num_with_roads - num_of_objects
    tool = "cosfly world" if has_surfaces else "SimWorld city generator"
    header = MapHeader(
        name=cfg.name, source=MapSource(tool=tool, version="world file", file=world.name), licence=cfg.licence,
        credits=cfg.credits, ground_z_m=0.0, extent_sources=size_sources, roads=widths,
        added_boxes=len(boxes) - num_with_roads, num_objects=len(nodes), dropped_objects=dict(dropped.counts),
    )  # fmt: skip
    return boxes.box_map(header)


def _asset_of_kind(name: str) -> Asset | None:
    """Return the asset of a node that `cosfly world` named after a kind, such as Water_C; else None."""
    kind = kind_of(name)
    return Asset(name, kind) if kind else None


def read_sizes(paths: list[Path]) -> dict[str, np.ndarray]:
    """Return full sizes in cm by asset name; the groups and tables are joined, and the first entry counts."""
    sizes: dict[str, np.ndarray] = {}
    for path in paths:
        for group in validated(_SizeTable, read_json(path, what="asset size table"), path).values():
            for name, asset in group.items():
                sizes.setdefault(name, asset.bbox.array())
    return sizes


def _add_node(boxes: BoxList, node: _Node, asset: Asset, size_cm: np.ndarray, stand_m: float, world: Path) -> str:
    """Add one object; return the source of its extent."""
    is_placeholder = asset.size_m is not None and bool((size_cm == PLACEHOLDER_CM).all())
    size = np.array(asset.size_m) if is_placeholder else size_cm * M_PER_CM
    size = size * node.scale.array()
    if not LEAST_M <= size.min() <= size.max() <= LARGEST:
        raise InputError(
            "the size of the object is out of range", where=f"{world}: {node.id}", got=f"{size.tolist()} m",
            expected=f"sides from {LEAST_M:g} to {LARGEST:g} m",
            fix="correct the scale of the object or the size of its asset",
        )  # fmt: skip
    foot = node.location.z * M_PER_CM
    low = 0.0 if 0 < foot <= stand_m else foot
    boxes.add(asset.kind, node.xy_m, size[:2], low, foot + size[2], -node.yaw)
    return "default" if is_placeholder else "bbox"


def _half_widths(boxes: BoxList, roads: list[_Node]) -> tuple[float, float]:
    """Return the distances of the kerb and of the fronts from the centre line, m.

    Both are tenth percentiles: fronts of the nearest points of buildings, the kerb of the middles of street furniture.
    """
    box_map = boxes.box_map()
    middles = shapely.multilinestrings([np.stack(road.ends) for road in roads])
    nearest = shapely.distance(footprints(box_map.select(box_map.kinds == KINDS["Buildings"])), middles)
    fronts = nearest[nearest < BESIDE_ROAD_M].tolist() or [DEFAULT_FRONT_M]
    front = float(np.percentile(fronts, 10))
    is_furniture = box_map.is_any_of({KINDS["Static"], KINDS["Motorcycle"]})
    furniture = shapely.distance(shapely.points(box_map.centers[is_furniture, :2]), middles)
    furniture = furniture[furniture < front]
    has_kerb = len(furniture) >= LEAST_FURNITURE
    kerb = float(np.percentile(furniture, 10)) - KERB_M if has_kerb else ROAD_SHARE_OF_FRONT * front
    kerb = max(kerb, LEAST_KERB_M)
    return round(kerb, 2), round(max(front, kerb + 1.0), 2)


def _add_roads(boxes: BoxList, roads: list[_Node]) -> dict[str, float]:
    """Add carriageways and pavements, without overlaps: a square at every junction, straight pieces between."""
    if not roads:
        return {}
    kerb, front = _half_widths(boxes, roads)
    junctions: dict[tuple[int, int], list[np.ndarray]] = {}  # place -> directions of its roads
    for node in roads:
        for end, away in zip(node.ends, (node.direction, -node.direction), strict=True):
            junctions.setdefault(tuple(np.round(end).astype(int)), []).append(away)
        if 2 * front < ROAD_LENGTH_M:  # junctions reach as far as the fronts
            road = boxes.framed(node.ends[0], _yaw_deg(node.direction))
            end_m = ROAD_LENGTH_M - front
            road.lay("Roads", (front, -kerb), (end_m, kerb))
            road.lay("Sidewalks", (front, -front), (end_m, -kerb))
            road.lay("Sidewalks", (front, kerb), (end_m, front))
    for place, arms in junctions.items():
        _add_junction(boxes, place, arms, kerb, front)
    return {"carriageway_m": 2 * kerb, "front_to_front_m": 2 * front}


def _add_junction(boxes: BoxList, place: Pair, arms: list[np.ndarray], kerb: float, front: float) -> None:
    """Add the nine fields of a junction: carriageway in the middle and towards its arms, pavement in the others.

    arms: directions of its roads, (2,) each; the fields are aligned with the first.
    """
    x = arms[0]
    y = np.array([-x[1], x[0]])
    junction = boxes.framed(place, _yaw_deg(x))
    bands = {-1: (-front, -kerb), 0: (-kerb, kerb), 1: (kerb, front)}
    for column, row in ((0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1), (1, 0), (-1, 0), (0, 1), (0, -1)):
        away = column * x + row * y
        is_corner = column != 0 and row != 0
        is_road = column == row == 0 or (not is_corner and any(arm @ away > 0.7 for arm in arms))
        low, high = zip(bands[column], bands[row], strict=True)
        junction.lay("Roads" if is_road else "Sidewalks", low, high)


def _yaw_deg(direction: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(direction[1], direction[0])))


def _add_ground_and_paint(boxes: BoxList, roads: list[_Node], widths: dict) -> None:
    """Add the ground below everything and dashes on the centre lines, which the source lacks."""
    low, high = boxes.box_map().bounds()
    boxes.span("Terrain", low[:2] - MAP_MARGIN_M, high[:2] + MAP_MARGIN_M, BASE_TOP_M - SLAB_M, BASE_TOP_M)
    for node in roads:
        road = boxes.framed(node.ends[0], _yaw_deg(node.direction))
        for start_m in np.arange(widths["carriageway_m"], ROAD_LENGTH_M - widths["carriageway_m"], DASH_STEP_M):
            middle = (start_m + DASH_M / 2, 0.0)
            road.add("RoadLines", middle, (DASH_M, DASH_WIDTH_M), ROAD_TOP_M - 0.04, PAINT_TOP_M)
