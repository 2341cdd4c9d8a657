"""A plan to a world: the procedural layout, the objects of the prompt placed in it, and SimWorld's nodes of both.

A box of a kind without an asset of SimWorld is named after the kind, as Water_C, with a cube of 1 m as its size.

Source: app:simworld:step1, the layout and the incremental placement layer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.maps.boxlist import BoxList
from cosfly.maps.footprints import footprints
from cosfly.maps.synthetic import VERGE_M, Streets, TownPlan, build_town, street_grid
from cosfly.maps.town_blocks import LAWN_TOP_M, PAVED_TOP_M, SLAB_M
from cosfly.runtime.seeding import rng_for
from cosfly.simulators.assets import ASSETS
from cosfly.worldgen.plan import OBJECTS, SPACE_M, Object, WorldPlan, assets, town_plan

CM_PER_M = 100.0
ROAD_PIECE_M = 200.0  # length of SimWorld's piece of road
ROAD_SCALE = (0.95, 0.9, 1.0)  # scale of the piece at that length
STRETCH = 6.0  # most that an asset's box may be stretched along one side relative to another
STEP_M = 2.0  # between places that are tried
SCALES = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4)
# Boxes that objects are placed around, and those that make room for them.
HARD = ("Buildings", "Walls", "Water", "Roads", "Car", "Truck", "Bus", "TrafficLight", "TrafficSigns")
SOFT = ("Vegetation", "Static", "Fences", "Poles")
PATH_M = 2.4  # width of a way to a building
TREE_M = 2.5  # lower vegetation is a hedge

Size = tuple[float, ...]


class Placed(NamedTuple):
    """One placed object: middle, m; scale of its footprint; rows of its boxes in the placement."""

    name: str
    number: int
    xy: tuple[float, float]
    yaw_deg: float
    scale: float
    rows: tuple[int, int]


@dataclass
class Town:
    """A layout and the objects placed in it. not_placed: name of a missing object -> reason, an entry for each."""

    name: str
    plan: TownPlan
    streets: Streets
    layout: BoxMap
    placement: BoxMap
    placed: list[Placed] = field(default_factory=list)
    not_placed: list[tuple[str, str]] = field(default_factory=list)

    @property
    def boxes(self) -> BoxMap:
        return self.layout.joined(self.placement)

    @property
    def land_m2(self) -> float:
        """The area without the river."""
        return self.plan.size_m * (self.plan.size_m - self.plan.river_m)


def of_kinds(box_map: BoxMap, *names: str) -> np.ndarray:
    """Return which boxes are of some kinds, (n,) bool."""
    return box_map.is_any_of({KINDS[name] for name in names})


def trees_of(box_map: BoxMap) -> np.ndarray:
    """Return which boxes are trees, (n,) bool: vegetation higher than a hedge, and not long."""
    sizes = 2 * box_map.half_extents
    return of_kinds(box_map, "Vegetation") & (sizes[:, 2] > TREE_M) & (sizes[:, :2].max(1) < 3 * sizes[:, :2].min(1))


def build(plan: WorldPlan, name: str, seed: int) -> Town:
    """Build the town of a plan: the same plan, seed and name give the same town."""
    settings = town_plan(plan)
    layout = build_town(settings, name, seed)
    town = Town(name, settings, street_grid(settings, seed), layout, BoxList().box_map())
    town.not_placed += [(missing, "not in the object table") for missing in plan.unknown_objects()]
    _place_objects(town, plan)
    _set_trees(town, plan, rng_for(seed, "world", "trees"))
    return town


def _place_objects(town: Town, plan: WorldPlan) -> None:
    """Place the named objects, the largest first, each as near the middle of the town as there is room.

    Soft boxes below an object, such as trees, are removed; hard ones block it.
    """
    boxes = BoxList()
    taken = list[BaseGeometry]()  # outlines of the placed objects
    outlines = footprints(town.layout)
    hard = outlines[of_kinds(town.layout, *HARD)]
    pavements = shapely.union_all(outlines[of_kinds(town.layout, "Sidewalks")])
    for thing, count in sorted(plan.known_objects(), key=lambda pair: -math.prod(pair[0].size_m)):
        if thing.where == "layout":
            _count_bridges(town, thing, count)
            continue
        free = _free_area(town, thing)
        for number in range(count):
            place = _find_place(thing, free, hard, taken)
            if place is None:
                town.not_placed.append((thing.name, "no water in the plan" if free.is_empty else "no room"))
                continue
            outline, yaw_deg, scale = place
            xy = (outline.centroid.x, outline.centroid.y)
            first = len(boxes)
            _add_object(boxes, thing, xy, yaw_deg, scale)
            town.placed.append(Placed(thing.name, number, xy, yaw_deg, scale, (first, len(boxes))))
            taken.append(outline)
            if any(part[0] == "Buildings" for part in thing.parts):
                _pave_way(boxes, outline, pavements)
    town.placement = boxes.box_map()
    soft = of_kinds(town.layout, *SOFT)
    covered = shapely.intersects(outlines, shapely.union_all(taken).buffer(0.5)) if taken else np.zeros(len(soft), bool)
    town.layout = town.layout.select(np.flatnonzero(~(soft & covered)))


def _count_bridges(town: Town, thing: Object, count: int) -> None:
    """Record which of `count` bridges the layout has: at most one where a street crosses the river."""
    crossings = town.plan.num_blocks + 1 if town.plan.river_m else 0
    num_built = min(count, town.plan.bridges or crossings, crossings)
    town.placed += [Placed(thing.name, number, (0.0, 0.0), 0.0, 1.0, (0, 0)) for number in range(num_built)]
    town.not_placed += [(thing.name, "no street to carry it")] * (count - num_built)


def _pave_way(boxes: BoxList, outline: BaseGeometry, pavements: BaseGeometry) -> None:
    """Add a path from a building to the nearest pavement, if there is a gap."""
    line = shapely.shortest_line(outline, pavements)
    if line.length > 0.5:
        (x0, y0), (x1, y1) = line.coords
        middle = ((x0 + x1) / 2, (y0 + y1) / 2)
        yaw_deg = math.degrees(math.atan2(y1 - y0, x1 - x0))
        boxes.add("Sidewalks", middle, (line.length + 2.0, PATH_M), PAVED_TOP_M - SLAB_M, PAVED_TOP_M, yaw_deg)


def _free_area(town: Town, thing: Object) -> BaseGeometry:
    """Return the area where an object may be placed: open blocks, the quay along the water, or the water."""
    plan = town.plan
    half = plan.size_m / 2
    if thing.where == "open":
        built = shapely.STRtree(footprints(town.layout)[of_kinds(town.layout, "Buildings")])
        blocks = [shapely.box(*low, *high) for low, high in town.streets.blocks()]
        return shapely.union_all([block for block in blocks if not len(built.query(block, predicate="intersects"))])
    if plan.shore_m:
        near, far = (-0.5, VERGE_M - 0.5) if thing.where == "quay" else (-plan.shore_m, 0.0)
        return shapely.box(-half + 2, -half + near, half - 2, -half + far)
    if thing.where == "water" and plan.river_m:
        return shapely.union_all(footprints(town.layout)[of_kinds(town.layout, "Water")])
    return shapely.Polygon()


def _find_place(
    thing: Object, free: BaseGeometry, hard: np.ndarray, taken: list[BaseGeometry]
) -> tuple[BaseGeometry, float, float] | None:
    """Return the free outline of an object that is nearest to the middle of the town, its yaw and its scale.

    None if the object fits nowhere, even at its least scale.
    """
    if free.is_empty:
        return None
    shapely.prepare(free)
    by_water = thing.where != "open"
    tree = shapely.STRtree(taken if by_water else [*hard, *taken])
    low_x, low_y, high_x, high_y = free.bounds
    anchor = (0.0, high_y if by_water else 0.0)
    x, y = np.meshgrid(np.arange(low_x, high_x, STEP_M), np.arange(low_y, high_y, STEP_M))
    centers = np.stack([x.ravel(), y.ravel()], axis=1)
    if by_water:  # at the upper edge of the free area: on the quay, or next to the landing
        centers[:, 1] = high_y - thing.size_m[1] / 2 - 0.3
    centers = centers[np.argsort(np.hypot(*(centers - anchor).T), kind="stable")]
    x, y = centers.T
    for scale in (step for step in SCALES if step >= thing.least_scale - 1e-9):
        for yaw_deg in (0.0,) if by_water else (0.0, 90.0):
            size_m = thing.size_m if yaw_deg == 0 else thing.size_m[::-1]
            half_x, half_y = (side * scale / 2 for side in size_m)
            outlines = shapely.box(x - half_x, y - half_y, x + half_x, y + half_y)
            for outline in outlines[shapely.contains_properly(free, outlines)]:
                if not len(tree.query(outline, predicate="dwithin", distance=SPACE_M / 2)):
                    return outline, yaw_deg, scale
    return None


def _add_object(boxes: BoxList, thing: Object, xy: tuple[float, float], yaw_deg: float, scale: float) -> None:
    """Add an object's boxes; the heights of its high parts are scaled like its footprint."""
    cos, sin = (1.0, 0.0) if yaw_deg % 180 == 0 else (0.0, 1.0)
    for kind, x, y, wide, deep, low, high in thing.parts:
        middle = (xy[0] + scale * (cos * x - sin * y), xy[1] + scale * (sin * x + cos * y))
        height_scale = scale if high > 1.0 else 1.0
        scaled_low = low * height_scale if low > 0 else low
        boxes.add(kind, middle, (wide * scale, deep * scale), scaled_low, high * height_scale, yaw_deg)


def _set_trees(town: Town, plan: WorldPlan, rng: np.random.Generator) -> None:
    """Fell the trees in front of doors, then fell or plant until their number is within the plan's range."""
    outlines = footprints(town.boxes)
    sizes = 2 * town.boxes.half_extents[:, :2]
    ways = outlines[of_kinds(town.boxes, "Sidewalks") & (sizes.min(1) <= PATH_M)]
    if len(ways):
        before_door = shapely.dwithin(outlines[: len(town.layout)], shapely.union_all(ways), 0.8)
        town.layout = town.layout.select(np.flatnonzero(~(before_door & trees_of(town.layout))))
    hectares = town.land_m2 / 1e4
    trees = np.flatnonzero(trees_of(town.layout))
    goal = round((0.65 * plan.trees_per_ha[0] + 0.35 * plan.trees_per_ha[1]) * hectares)
    if len(trees) > plan.trees_per_ha[1] * hectares:
        felled = rng.choice(trees, len(trees) - goal, replace=False)
        town.layout = town.layout.select(np.setdiff1d(np.arange(len(town.layout)), felled))
    elif len(trees) < goal:
        town.layout = town.layout.joined(_planted(town, goal - len(trees), rng))


def _planted(town: Town, count: int, rng: np.random.Generator) -> BoxMap:
    """Return new trees on lawns and gardens, clear of all other boxes and of the ways."""
    world = town.boxes
    boxes = BoxList()
    outlines = footprints(world)
    lawns = outlines[of_kinds(world, "Terrain") & (np.abs(world.maxs[:, 2] - LAWN_TOP_M) < 0.005)]
    standing = ~of_kinds(world, "Roads", "Sidewalks", "Terrain", "RoadLines") & (world.maxs[:, 2] > 0.0)
    blocked = [*outlines[standing], *outlines[of_kinds(world, "Roads", "Sidewalks")], *outlines[len(town.layout) :]]
    obstacles = shapely.STRtree(blocked)
    weights = shapely.area(lawns)
    if not len(lawns) or not weights.sum():
        return boxes.box_map()
    bounds = shapely.bounds(lawns)
    for row in rng.choice(len(lawns), 40 * count, p=weights / weights.sum()):
        xy = rng.uniform(bounds[row, :2], bounds[row, 2:])
        crown_m = rng.uniform(3.0, 5.5)
        outline = shapely.box(*(xy - crown_m / 2), *(xy + crown_m / 2))
        if not len(obstacles.query(outline, predicate="dwithin", distance=0.4)):
            boxes.add("Vegetation", xy, (crown_m, crown_m * rng.uniform(0.9, 1.1)), 0.0, rng.uniform(5.0, 11.0))
            if len(boxes) == count:
                break
    return boxes.box_map()


@cache
def _asset_tables() -> dict[str, dict[str, Size]]:
    """Return the assets that boxes of a kind may get, and their full sizes, m."""
    furniture: dict[str, Size] = {
        {"BP_Trash_bin_*": "BP_Trash_bin_a_C"}.get(asset.pattern, asset.pattern.replace("*", "")): tuple(asset.size_m)
        for asset in ASSETS if asset.size_m is not None and asset.kind == "Static"
    }  # fmt: skip
    buildings, trees = (
        {name: size for name, size in assets().items() if name.startswith(start)}
        for start in ("BP_Building", "BP_Tree")
    )
    return {"Buildings": buildings, "Vegetation": trees, "Static": furniture}


def asset_for(kind: str, size_m: Size) -> tuple[str, Size]:
    """Return the asset with the most similar box, and its size; one named after the kind if none is similar."""
    stretches = {  # logarithms of the factors along x, y, z that turn the asset into the box
        name: [math.log(wanted / asset) for wanted, asset in zip(size_m, asset_size_m, strict=True)]
        for name, asset_size_m in _asset_tables().get(kind, {}).items()
    }
    name = min(stretches, key=lambda name: sum(x * x for x in stretches[name]), default=None)
    if (
        name is None
        or max(stretches[name]) - min(stretches[name]) > math.log(STRETCH)
        or (kind == "Static" and max(map(abs, stretches[name])) > math.log(2.0))
    ):
        return f"{kind}_C", (1.0, 1.0, 1.0)
    return name, _asset_tables()[kind][name]


def layout_nodes(town: Town) -> list[dict[str, Any]]:
    """Return SimWorld's nodes of the layout: a piece of road for each stretch of a street, and every box."""
    nodes = list[dict[str, Any]]()
    for axis in (0, 1):
        crossings = [strip.middle_m for strip in town.streets.along(1 - axis)]
        for strip in town.streets.along(axis):
            for low, high in pairwise(crossings) if strip is not town.streets.river else ():
                middle = (low + high) / 2
                place = (middle, -strip.middle_m, 0.0) if axis == 0 else (strip.middle_m, -middle, 0.0)
                scale = np.array([ROAD_SCALE[0] * (high - low) / ROAD_PIECE_M, *ROAD_SCALE[1:]])
                nodes.append(_node(f"GEN_Road_{len(nodes)}", "BP_Road1_C", place, -90.0 * axis, scale))
    kinds = [KIND_NAMES[int(kind)] for kind in town.layout.kinds]
    return nodes + [_box_node(town.layout, row, kind) for row, kind in enumerate(kinds)]


def placement_nodes(town: Town) -> list[dict[str, Any]]:
    """Return SimWorld's nodes of the placed objects and of the ways to them."""
    names = ["way"] * len(town.placement)
    asset_names: list[str | None] = [None] * len(names)
    for thing in town.placed:
        for row in range(*thing.rows):
            names[row] = f"OBJ_{thing.name.replace(' ', '_')}_{thing.number}"
            asset_names[row] = OBJECTS[thing.name].asset
    return [_box_node(town.placement, row, names[row], asset_names[row]) for row in range(len(names))]


def _box_node(box_map: BoxMap, row: int, name: str, asset: str | None = None) -> dict[str, Any]:
    """Return the node of a box: Unreal's axes, cm; the foot of an asset at the location."""
    size = 2 * box_map.half_extents[row]
    x, y, z = box_map.centers[row]
    if asset:
        asset_size_m = assets()[asset]
    else:
        asset, asset_size_m = asset_for(KIND_NAMES[int(box_map.kinds[row])], size.tolist())
    foot = x, -y, z - size[2] / 2
    return _node(f"GEN_BP_{name}_{row}", asset, foot, -box_map.rotations_deg[row, 1], size / asset_size_m)


def _node(name: str, asset: str, place: Any, yaw_deg: float, scale: Any) -> dict[str, Any]:
    def vector(values: Any) -> dict[str, float]:
        return {axis: round(float(value), 9) for axis, value in zip("xyz", values, strict=True)}

    turn = {"pitch": 0, "yaw": float(yaw_deg) + 0.0, "roll": 0}
    location = vector([CM_PER_M * value for value in place])
    properties = {"location": location, "orientation": turn, "scale": vector(scale)}
    return {"id": name, "instance_name": asset, "properties": properties}
