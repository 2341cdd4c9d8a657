"""A plan to a world: the procedural layout, what the prompt names placed in it, and SimWorld's nodes of both.

Source: app:simworld:step1, the layout and the incremental placement layer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from cosfly.formats.boxes import BoxMap, make_box_map
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.geometry.axes import box_corners
from cosfly.maps import synthetic
from cosfly.maps.boxlist import BoxList
from cosfly.maps.stage import MapsConfig, load_map
from cosfly.maps.synthetic import SyntheticConfig
from cosfly.maps.town_blocks import LAWN_TOP_M, PAVED_TOP_M, SLAB_M
from cosfly.runtime.seeding import rng_for
from cosfly.worldgen.objects import Object, asset_for, assets
from cosfly.worldgen.plan import SPACE_M, WorldPlan, objects_of, town_settings, unknown_objects

CM_PER_M = 100.0
ROAD_PIECE_M, ROAD_SCALE = 200.0, (0.95, 0.9, 1.0)  # of SimWorld's piece of road: its length, and the scale it has then
STEP_M = 2.0  # between places that are tried
SCALES = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4)
HARD = (
    "Buildings",
    "Walls",
    "Water",
    "Roads",
    "Car",
    "Truck",
    "Bus",
    "TrafficLight",
    "TrafficSigns",
)  # stays: placed round it
SOFT = ("Vegetation", "Static", "Fences", "Poles")  # makes room for what is placed
PATH_M = 2.4  # width of a way to a building
TREE_M = 2.5  # what is green and lower is a hedge


class Placed(NamedTuple):
    """One object of a prompt as it stands: middle, m; scale of its footprint; rows of its boxes in the placement."""

    name: str
    number: int
    xy: tuple[float, float]
    yaw_deg: float
    scale: float
    rows: tuple[int, int]


@dataclass
class Town:
    """A layout and what was placed in it. left_out: what was named and is not there -> why, an entry for each."""

    settings: SyntheticConfig
    layout: BoxMap
    placement: BoxMap
    placed: list[Placed] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)

    @property
    def boxes(self) -> BoxMap:
        return self.layout.joined(self.placement)


def footprints(box_map: BoxMap) -> np.ndarray:
    """Return the footprint of every box as a polygon, (n,)."""
    corners = [
        box_corners(center, half, math.radians(yaw))[[0, 2, 6, 4], :2]
        for center, half, yaw in zip(box_map.centers, box_map.half_extents, box_map.rotations_deg[:, 1], strict=True)
    ]
    return shapely.polygons(np.array(corners).reshape(-1, 4, 2))


def of_kinds(box_map: BoxMap, *names: str) -> np.ndarray:
    return box_map.is_any_of({KINDS[name] for name in names})


def trees_of(box_map: BoxMap) -> np.ndarray:
    """Return which boxes are trees, (n,) bool: green, higher than a hedge, and not long."""
    sizes = 2 * box_map.half_extents
    return of_kinds(box_map, "Vegetation") & (sizes[:, 2] > TREE_M) & (sizes[:, :2].max(1) < 3 * sizes[:, :2].min(1))


def build(plan: WorldPlan, name: str, seed: int) -> Town:
    """Make the town of a plan: the same plan, seed and name give the same."""
    settings = town_settings(plan, name)
    layout = load_map(MapsConfig(source="synthetic", synthetic=settings), seed=seed)
    town = Town(settings, layout, make_box_map(*(np.zeros((0, 3)),) * 3, []))
    town.left_out += [(one, "not in the object table") for one in unknown_objects(plan)]
    _place_objects(town, plan)
    _set_trees(town, plan, rng_for(seed, "world", "trees"))
    return town


# --- what the prompt names --------------------------------------------------------------------------------------------


def _place_objects(town: Town, plan: WorldPlan) -> None:
    """Place the largest first, each as near the middle of the town as it finds room; what stands loose makes way."""
    boxes = BoxList()
    taken = list[BaseGeometry]()
    outlines = footprints(town.layout)
    hard = outlines[of_kinds(town.layout, *HARD)]
    pavements = shapely.union_all(outlines[of_kinds(town.layout, "Sidewalks")])
    wanted = sorted(objects_of(plan), key=lambda pair: -math.prod(pair[0].size_m))
    for one, count in wanted:
        if one.where == "layout":
            _count_bridges(town, one, count)
            continue
        free = _free_area(town, one)
        for number in range(count):
            place = _place(one, free, hard, taken)
            if place is None:
                town.left_out.append((one.name, "no room" if not free.is_empty else "no water in the plan"))
                continue
            outline, yaw, scale = place
            xy, first = (outline.centroid.x, outline.centroid.y), len(boxes)
            _add_object(boxes, one, xy, yaw, scale)
            town.placed.append(Placed(one.name, number, xy, yaw, scale, (first, len(boxes))))
            taken.append(outline)
            if any(part[0] == "Buildings" for part in one.parts):
                _add_path(boxes, outline, pavements)
    town.placement = boxes.box_map()
    soft = of_kinds(town.layout, *SOFT)
    covered = shapely.intersects(outlines, shapely.union_all(taken).buffer(0.5)) if taken else np.zeros(len(soft), bool)
    town.layout = town.layout.select(np.flatnonzero(~(soft & covered)))


def _count_bridges(town: Town, one: Object, count: int) -> None:
    there = town.settings.num_blocks + 1 if town.settings.river_m else 0
    there = min(count, town.settings.bridges or there, there)
    town.placed += [Placed(one.name, number, (0.0, 0.0), 0.0, 1.0, (0, 0)) for number in range(there)]
    town.left_out += [(one.name, "no street to carry it")] * (count - there)


def _free_area(town: Town, one: Object) -> BaseGeometry:
    """Where an object may stand: open blocks, the quay before the water, or the water off it."""
    half = town.settings.size_m / 2
    if one.where == "open":
        return shapely.union_all(_open_blocks(town))
    if town.settings.shore_m:
        near = -half - 0.5 if one.where == "quay" else -half - town.settings.shore_m
        far = -half + town.settings.verge_m - 0.5 if one.where == "quay" else -half
        return shapely.box(-half + 2, near, half - 2, far)
    if one.where == "water" and town.settings.river_m:
        return shapely.union_all(footprints(town.layout)[of_kinds(town.layout, "Water")])
    return shapely.Polygon()


def _open_blocks(town: Town) -> list[BaseGeometry]:
    """Blocks without buildings, as the grid of streets leaves them."""
    streets = synthetic.street_grid(town.settings, town.layout.header.source.seed or 0)
    built = shapely.STRtree(footprints(town.layout)[of_kinds(town.layout, "Buildings")])
    blocks = [
        shapely.box(a.high_m, c.high_m, b.low_m, d.low_m)
        for a, b in pairwise(streets.columns)
        for c, d in pairwise(streets.rows)
    ]
    return [block for block in blocks if not len(built.query(block, predicate="intersects"))]


def _place(
    one: Object, free: BaseGeometry, hard: np.ndarray, taken: list[BaseGeometry]
) -> tuple[BaseGeometry, float, float] | None:
    """Return the outline, nearest to the middle of the town, in which an object fits whole, its yaw and its scale."""
    if free.is_empty:
        return None
    by_water = one.where != "open"
    tree = shapely.STRtree(taken if by_water else [*hard, *taken])
    low_x, low_y, high_x, high_y = free.bounds
    anchor = (0.0, high_y if by_water else 0.0)
    x, y = np.meshgrid(np.arange(low_x, high_x, STEP_M), np.arange(low_y, high_y, STEP_M))
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    if by_water:  # on the quay, or as far as the landing: at the upper edge of the free area
        places[:, 1] = high_y - one.size_m[1] / 2 - 0.3
    places = places[np.argsort(np.hypot(*(places - anchor).T), kind="stable")]
    for scale in (step for step in SCALES if step >= one.least_scale - 1e-9):
        for yaw in (0.0,) if by_water else (0.0, 90.0):
            a, b = (side * scale / 2 for side in (one.size_m if yaw == 0 else one.size_m[::-1]))
            outlines = shapely.box(places[:, 0] - a, places[:, 1] - b, places[:, 0] + a, places[:, 1] + b)
            for outline in outlines[shapely.contains_properly(free, outlines)]:
                if not len(tree.query(outline, predicate="dwithin", distance=SPACE_M / 2)):
                    return outline, yaw, scale
    return None


def _add_object(boxes: BoxList, one: Object, xy: tuple[float, float], yaw_deg: float, scale: float) -> None:
    """Add an object's boxes; scaled, its height shrinks as its footprint does."""
    c, s = (1.0, 0.0) if yaw_deg % 180 == 0 else (0.0, 1.0)
    for kind, x, y, wide, deep, low, high in one.parts:
        middle = (xy[0] + scale * (c * x - s * y), xy[1] + scale * (s * x + c * y))
        rises = scale if high > 1.0 else 1.0
        boxes.add(kind, middle, (wide * scale, deep * scale), low * (rises if low > 0 else 1.0), high * rises, yaw_deg)


def _add_path(boxes: BoxList, outline: BaseGeometry, pavements: BaseGeometry) -> None:
    """Pave the way from a building to the nearest pavement, where it does not stand on one."""
    line = shapely.shortest_line(outline, pavements)
    if line.length > 0.5:
        (x0, y0), (x1, y1) = line.coords
        middle, yaw = ((x0 + x1) / 2, (y0 + y1) / 2), math.degrees(math.atan2(y1 - y0, x1 - x0))
        boxes.add("Sidewalks", middle, (line.length + 2.0, PATH_M), PAVED_TOP_M - SLAB_M, PAVED_TOP_M, yaw)


# --- trees ------------------------------------------------------------------------------------------------------------


def land_m2(town: Town) -> float:
    """Return the town's area without its river, m2."""
    return town.settings.size_m * (town.settings.size_m - town.settings.river_m)


def _set_trees(town: Town, plan: WorldPlan, rng: np.random.Generator) -> None:
    """Fell those before a door, then fell or plant until the town's are within the plan's range, streets' and all."""
    outlines, sizes = footprints(town.boxes), 2 * town.boxes.half_extents[:, :2]
    ways = outlines[of_kinds(town.boxes, "Sidewalks") & (sizes.min(1) <= PATH_M)]
    if len(ways):
        before_door = shapely.dwithin(outlines[: len(town.layout)], shapely.union_all(ways), 0.8)
        town.layout = town.layout.select(np.flatnonzero(~(before_door & trees_of(town.layout))))
    hectares = land_m2(town) / 1e4
    trees = np.flatnonzero(trees_of(town.layout))
    goal = round((0.65 * plan.trees_per_ha[0] + 0.35 * plan.trees_per_ha[1]) * hectares)
    if len(trees) > plan.trees_per_ha[1] * hectares:
        felled = rng.choice(trees, len(trees) - goal, replace=False)
        town.layout = town.layout.select(np.setdiff1d(np.arange(len(town.layout)), felled))
    elif len(trees) < goal:
        town.layout = town.layout.joined(_planted(town, goal - len(trees), rng))


def _planted(town: Town, count: int, rng: np.random.Generator) -> BoxMap:
    """Return new trees on lawns, gardens and edges of pavements, clear of all that stands there and of the ways."""
    world, boxes = town.boxes, BoxList()
    outlines = footprints(world)
    lawns = outlines[of_kinds(world, "Terrain") & (np.abs(world.maxs[:, 2] - LAWN_TOP_M) < 0.005)]
    standing = ~of_kinds(world, "Roads", "Sidewalks", "Terrain", "RoadLines") & (world.maxs[:, 2] > 0.0)
    blocked = [*outlines[standing], *outlines[of_kinds(world, "Roads", "Sidewalks")], *outlines[len(town.layout) :]]
    tree, weights = shapely.STRtree(blocked), shapely.area(lawns)
    if not len(lawns) or not weights.sum():
        return boxes.box_map()
    bounds = shapely.bounds(lawns)
    for row in rng.choice(len(lawns), 40 * count, p=weights / weights.sum()):
        xy, crown = rng.uniform(bounds[row, :2], bounds[row, 2:]), rng.uniform(3.0, 5.5)
        own = shapely.box(*(xy - crown / 2), *(xy + crown / 2))
        if not len(tree.query(own, predicate="dwithin", distance=0.4)):
            boxes.add("Vegetation", xy, (crown, crown * rng.uniform(0.9, 1.1)), 0.0, rng.uniform(5.0, 11.0))
            if len(boxes) == count:
                break
    return boxes.box_map()


# --- SimWorld's nodes -------------------------------------------------------------------------------------------------


def world_nodes(
    box_map: BoxMap, ids: Sequence[str] = (), named_assets: Sequence[str | None] = ()
) -> list[dict[str, Any]]:
    """Return a node of SimWorld's world format for every box: Unreal's axes, cm; the foot of an asset at the
    location."""
    nodes = []
    for row in range(len(box_map)):
        kind, size = KIND_NAMES[int(box_map.kinds[row])], 2 * box_map.half_extents[row]
        asset, own = asset_for(kind, size.tolist())
        if row < len(named_assets) and (named := named_assets[row]):
            asset, own = named, assets()[named]
        x, y, z = box_map.centers[row]
        name = f"GEN_BP_{ids[row] if ids else kind}_{row}"
        nodes.append(_node(name, asset, (x, -y, z - size[2] / 2), -box_map.rotations_deg[row, 1], size / own))
    return nodes


def road_nodes(settings: SyntheticConfig, seed: int) -> list[dict[str, Any]]:
    """Return a piece of road for every stretch of a street: what SimWorld draws; its surfaces are nodes of their
    own."""
    streets, nodes = synthetic.street_grid(settings, seed), list[dict[str, Any]]()
    for axis in (0, 1):
        crossings = [strip.middle_m for strip in streets.along(1 - axis)]
        for strip in streets.along(axis):
            if strip is streets.river:
                continue
            for low, high in pairwise(crossings):
                middle = (low + high) / 2
                place = (middle, -strip.middle_m, 0.0) if axis == 0 else (strip.middle_m, -middle, 0.0)
                scale = np.array([ROAD_SCALE[0] * (high - low) / ROAD_PIECE_M, *ROAD_SCALE[1:]])
                nodes.append(_node(f"GEN_Road_{len(nodes)}", "BP_Road1_C", place, -90.0 * axis, scale))
    return nodes


def _node(name: str, asset: str, place: Any, yaw_deg: float, scale: Any) -> dict[str, Any]:
    def vector(values: Any) -> dict[str, float]:
        return {axis: round(float(value), 9) for axis, value in zip("xyz", values, strict=True)}

    turn = {"pitch": 0, "yaw": float(yaw_deg) + 0.0, "roll": 0}
    location = vector([CM_PER_M * value for value in place])
    return {
        "id": name,
        "instance_name": asset,
        "properties": {"location": location, "orientation": turn, "scale": vector(scale)},
    }
