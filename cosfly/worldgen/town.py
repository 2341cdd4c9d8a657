"""A plan to a world: streets, buildings on lots along them, the objects of the prompt, and SimWorld's nodes of all.

A box of a kind without an asset of SimWorld is named after the kind, as Water_C, with a cube of 1 m as its size.

Source: app:simworld:step1, the layout and the incremental placement layer.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from functools import cache
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely.affinity import rotate
from shapely.geometry.base import BaseGeometry

from cosfly.formats.boxes import OUR_LICENCE, BoxMap, MapHeader, MapSource
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.maps.boxlist import SLAB_M, BoxList
from cosfly.maps.footprints import Rectangle, footprints, oriented_rectangle, polygons_of, rectangle_polygon
from cosfly.runtime.seeding import rng_for
from cosfly.simulators.assets import ASSETS
from cosfly.worldgen.plan import VERGE_M, Buildings, Object, Range, WorldPlan, assets
from cosfly.worldgen.streets import GROUND_TOP_M, lay_streets, network, pave

CM_PER_M = 100.0
ROAD_PIECE_M = 200.0  # length of SimWorld's piece of road
ROAD_SCALE = (0.95, 0.9, 1.0)  # scale of the piece at that length
STRETCH = 6.0  # most that an asset's box may be stretched along one side relative to another
STEP_M = 2.0  # between places that are tried
SCALES = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4)
SPACE_M = 4.0  # free ground around each object
TREE_M = 2.5  # lower vegetation is a hedge
DOOR_M = 1.6  # width of a path to a building
BLOCK_PIECE_M = 6.0  # of pavement inside blocks, whose edges lie on that of streets
LEAST_BLOCK_M2 = 400.0  # of a plaza or a green block
GROW = 1.25  # factor of the sides of a town in which objects find no room
MOST_GROWTH = 5  # times
LEAST_TOWN_M = 170.0  # side of a town without a size, so that people find a way of 100 m

Size = tuple[float, ...]


class Placed(NamedTuple):
    """One placed object: middle, m; scale of its footprint."""

    name: str
    number: int
    xy: tuple[float, float]
    yaw_deg: float
    scale: float


def of_kinds(box_map: BoxMap, *names: str) -> np.ndarray:
    """Return which boxes are of some kinds, (n,) bool."""
    return box_map.is_any_of({KINDS[name] for name in names})


def trees_of(box_map: BoxMap) -> np.ndarray:
    """Return which boxes are trees, (n,) bool: vegetation higher than a hedge, and not long."""
    sizes = 2 * box_map.half_extents
    return of_kinds(box_map, "Vegetation") & (sizes[:, 2] > TREE_M) & (sizes[:, :2].max(1) < 3 * sizes[:, :2].min(1))


def build(plan: WorldPlan, name: str, seed: int) -> Town:
    """Build the town of a plan: the same plan, seed and name give the same town.

    A town without a size is as large as its blocks, or, where all buildings are counted, as these need.
    """
    widest_m = max((max(thing.size_m) * thing.least_scale for thing, _ in plan.known_objects()), default=0.0)
    plan = plan.model_copy(update={"block_m": max(plan.block_m, min(widest_m + 2 * SPACE_M, 150.0))})
    if plan.size_m:
        return Town(plan, plan.size_m, name, seed)
    pitch_m = plan.block_m + plan.street_m
    edges_m = 2 * VERGE_M + plan.avenue_m + plan.river_m
    side_m = plan.blocks_along * pitch_m + edges_m
    counted = {kind.name: kind.count for kind in plan.buildings if kind.count}
    if plan.only_these and counted:
        fronts_m = sum((one.count or 0) * (sum(one.footprint_m) / 2 + 1.3 * plan.gap_m) for one in plan.buildings)
        side_m = max(LEAST_TOWN_M, math.sqrt(fronts_m * pitch_m / 3) + edges_m)
    for _ in range(MOST_GROWTH):
        town = Town(plan, _stretched(plan, side_m, seed), name, seed)
        wanted, num_built = sum(counted.values()), sum(town.built[kind] for kind in counted)
        if num_built < wanted:
            side_m *= min(2.0, 1.05 * math.sqrt(wanted / max(1, num_built)))
        elif any(reason == "no room" for _, reason in town.not_placed):
            side_m *= GROW
        else:
            break
    return town


def _stretched(plan: WorldPlan, side_m: float, seed: int) -> Range:
    """Return the sides of a town of about side_m**2; linear towns are long."""
    rng = rng_for(seed, "world", "ratio")
    ratio = rng.uniform(1.0, 1.25) * (1.7 if plan.pattern == "linear" else 1.0)
    is_wide = plan.pattern == "linear" or plan.river_m or rng.random() < 0.5
    width, height = side_m * math.sqrt(ratio), side_m / math.sqrt(ratio)
    return (width, height) if is_wide else (height, width)


def _footprints(low: float, high: float) -> list[Range]:
    """Return the footprints of SimWorld's buildings in a range; if fewer than four fit, others."""
    sizes = [(size[0], size[1]) for name, size in assets().items() if name.startswith("BP_Building")]
    fitting = [size for size in sizes if low <= min(size) and max(size) <= high]
    sides = np.linspace(low, high, 6).tolist()
    return fitting if len(fitting) >= 4 else [(x, max(0.6 * low, x * share)) for x in sides for share in (0.6, 0.9)]


class Town:
    """A town of a size: its ground, then objects, buildings and trees on what is left.

    size_m: from west to east and from south to north. layout: streets and buildings. placement: the objects. built:
    numbers of buildings by kind. not_placed: name of a missing object -> reason, an entry for each.
    """

    def __init__(self, plan: WorldPlan, size_m: Range, name: str, seed: int) -> None:
        self.plan, self.size_m, self.name, self.seed = plan, size_m, name, seed
        self.built = Counter[str]()
        self.placed = list[Placed]()
        self.not_placed = [(missing, "not in the object table") for missing in plan.unknown_objects()]
        self.object_nodes = list[tuple[str, str | None]]()  # name and asset of each box of `placement`
        self._boxes, self._objects = BoxList(), BoxList()
        self._taken = list[BaseGeometry]()  # outlines of buildings and objects
        self._lay_ground()
        self._open_blocks()
        for thing, count in sorted(plan.known_objects(), key=lambda pair: -math.prod(pair[0].size_m)):
            self._place_object(thing, count)
        self._build_houses()
        if plan.setback_m < 2.5:
            for block in self._closed:
                if block.area < 4 * plan.block_m**2 and block not in self.open_blocks:
                    pave(self._boxes, block, BLOCK_PIECE_M)
        source = MapSource(tool="cosfly world", version="3", seed=seed)
        header = MapHeader(name=name, source=source, licence=OUR_LICENCE, ground_z_m=0.0)
        self.layout, self.placement = self._boxes.box_map(header), self._objects.box_map()
        self._set_trees(rng_for(seed, "world", "trees"))

    @property
    def boxes(self) -> BoxMap:
        return self.layout.joined(self.placement)

    @property
    def land_m2(self) -> float:
        """The area without the water."""
        x, y = self.size_m[0] / 2, self.size_m[1] / 2
        return float(shapely.difference(shapely.box(-x, -y, x, y), self.network.water).area)

    def _lay_ground(self) -> None:
        """Add the ground and the streets, and find the blocks: the ground between streets and water."""
        plan, boxes = self.plan, self._boxes
        x, y = self.size_m[0] / 2, self.size_m[1] / 2
        boxes.span("Terrain", (-x, -y), (x, y), GROUND_TOP_M - SLAB_M, GROUND_TOP_M)
        self.network = network(plan, self.size_m, rng_for(self.seed, "world", "streets"))
        furniture = rng_for(self.seed, "world", "furniture")
        self._strips = lay_streets(boxes, self.network, plan.parked_share, furniture)
        self._paved = shapely.STRtree(self._strips)  # where paths to doors begin
        strips = shapely.union_all(self._strips)
        ground = shapely.box(-x, -y, x, y)
        self._blocks = shapely.difference(ground, shapely.union(strips, self.network.water))
        self._closed = [
            block for block in polygons_of(self._blocks)
            if block.area > LEAST_BLOCK_M2 and ground.boundary.distance(block) > 0.1
        ]  # fmt: skip
        self._closed.sort(key=lambda block: block.centroid.distance(shapely.Point(0, 0)))
        inside = shapely.union_all(self._closed) if plan.pattern == "campus" else self._blocks
        self._buildable = shapely.intersection(inside, shapely.box(2.0 - x, -y, x - 2.0, y - 2.0))

    def _open_blocks(self) -> None:
        """Choose plazas, the nearest to the middle, and greens; pave plazas, and paths across greens."""
        plan = self.plan
        rng = rng_for(self.seed, "world", "open")
        has_objects = any(thing.where == "open" for thing, _ in plan.known_objects())
        wanted = max(plan.plazas + plan.greens, int(has_objects))
        blocks = self._closed[: max(1, len(self._closed) // 2)]
        num_plazas = plan.plazas or int(has_objects and not plan.greens)
        rest = blocks[num_plazas:]
        chosen = blocks[:num_plazas] + [rest[k] for k in rng.permutation(len(rest))]
        if len(chosen) < wanted:  # open lots along streets
            lots = self._lots([(0.7 * plan.block_m,) * 2], rng, setback_m=0.0)
            chosen += [rectangle_polygon(lot) for lot in islice(lots, wanted - len(chosen))]
        self.open_blocks = chosen[:wanted]
        paved = self.open_blocks[: plan.plazas]
        for green in self.open_blocks[plan.plazas :]:
            shape = oriented_rectangle(green)
            for across, side in enumerate(shape.size):
                bands = [(-0.6, 0.6), (-1.5 / side, 1.5 / side)]
                paved.append(shapely.intersection(green, rectangle_polygon(shape, *bands[:: 1 if across else -1])))
        for area in paved:
            pave(self._boxes, area, BLOCK_PIECE_M)
        self._paved = shapely.STRtree([*self._strips, *paved])
        self._buildable = shapely.difference(self._buildable, shapely.union_all(self.open_blocks).buffer(0.1))
        shapely.prepare(self._buildable)

    def _lots(self, sizes: list[Range], rng: np.random.Generator, *, setback_m: float) -> Iterator[Rectangle]:
        """Yield free lots along the streets, the nearest to the middle of the town first.

        Each has one of the sizes; its front is the side with negative y.
        """
        streets = zip(self.network.streets, self._strips, strict=True)
        taken = [*self._taken]
        for street, strip in sorted(streets, key=lambda pair: np.linalg.norm(pair[0].start + pair[0].end)):
            front_m = street.width_m / 2 + 0.05 + setback_m
            reach_m = max(map(max, sizes)) + setback_m + self.plan.gap_m
            near = [outline for outline in taken if outline.dwithin(strip, reach_m)]
            for side in (1, -1):
                along = 0.0
                while along < street.length_m:
                    front, depth = sizes[int(rng.integers(len(sizes)))]
                    lot = street.rectangle((along, along + front), (side * front_m, side * (front_m + depth)))
                    outline = rectangle_polygon(lot)
                    is_taken = shapely.dwithin(np.array(near, dtype=object), outline, self.plan.gap_m).any()
                    if is_taken or not self._buildable.contains(outline):
                        along += STEP_M
                        continue
                    yield lot._replace(yaw_deg=lot.yaw_deg + 90.0 * (1 - side))
                    taken.append(outline)
                    near.append(outline)
                    along += front + self.plan.gap_m * rng.uniform(1.0, 1.6)

    def _build_houses(self) -> None:
        """Build the counted buildings on lots spread over the town, then fill the lots that are left."""
        rng = rng_for(self.seed, "world", "lots")
        kinds = self.plan.kinds_of_buildings()
        for kind in kinds:
            if kind.count is not None:
                lots = list(self._lots(_footprints(*kind.footprint_m), rng, setback_m=self.plan.setback_m))
                spread = np.linspace(0, len(lots) - 1, min(kind.count, len(lots))).round().astype(int)
                for number in spread:
                    self._build_house(lots[number], kind, rng)
        if fill := [kind for kind in kinds if kind.count is None]:
            sizes = [size for kind in fill for size in _footprints(*kind.footprint_m)]
            for lot in self._lots(sizes, rng, setback_m=self.plan.setback_m):
                low, high = (factor * lot.size[1] for factor in (0.6, 1.0))
                fitting = [kind for kind in fill if kind.footprint_m[0] * 0.6 <= high and low <= kind.footprint_m[1]]
                self._build_house(lot, (fitting or fill)[int(rng.integers(len(fitting or fill)))], rng)

    def _build_house(self, lot: Rectangle, kind: Buildings, rng: np.random.Generator) -> None:
        """Build one house on a lot, and the path to its door."""
        low, high = kind.heights_m
        height = low + (high - low) * rng.beta(1.3, 1.7)
        self._boxes.add("Buildings", lot.center, lot.size, 0.0, height, lot.yaw_deg)
        self._add_path(self._boxes, lot)
        self._taken.append(rectangle_polygon(lot))
        self.built[kind.name] += 1

    def _add_path(self, boxes: BoxList, place: Rectangle) -> None:
        """Add a path from a building to the nearest pavement."""
        outline = rectangle_polygon(place)
        line = shapely.shortest_line(outline, self._paved.geometries[self._paved.nearest(outline)])
        if line.length > 0.5:
            (x, y), (to_x, to_y) = line.coords
            path = boxes.framed((x, y), math.degrees(math.atan2(to_y - y, to_x - x)))
            path.lay("Sidewalks", (-0.25, -DOOR_M / 2), (line.length + 0.25, DOOR_M / 2))

    def _place_object(self, thing: Object, count: int) -> None:
        """Place an object `count` times: in open blocks, at a street or in the water."""
        if thing.where == "layout":
            num_built = min(count, len(self.network.bridges))
            self.placed += [Placed(thing.name, number, (0.0, 0.0), 0.0, 1.0) for number in range(num_built)]
            self.not_placed += [(thing.name, "no street to carry it")] * (count - num_built)
            return
        scales = [scale for scale in SCALES if scale >= thing.least_scale - 1e-9]
        for number in range(count):
            if (found := self._find_place(thing, scales)) is None:
                has_place = thing.where == "open" or not self.network.water.is_empty
                self.not_placed.append((thing.name, "no room" if has_place else "no water in the plan"))
                continue
            place, scale = found
            _add_object(self._objects, thing, place, scale)
            node = f"OBJ_{thing.name.replace(' ', '_')}_{number}"
            self.object_nodes += [(node, thing.asset)] * len(thing.parts)
            if any(part[0] == "Buildings" for part in thing.parts):
                self._add_path(self._objects, place)
            self.object_nodes += [("way", None)] * (len(self._objects) - len(self.object_nodes))
            self.placed.append(Placed(thing.name, number, place.center, place.yaw_deg, scale))
            self._taken.append(rectangle_polygon(place))

    def _find_place(self, thing: Object, scales: list[float]) -> tuple[Rectangle, float] | None:
        """Return the outline and the scale of an object where there is room, else None."""
        areas: list[tuple[BaseGeometry, float]] = []
        if thing.where == "open":
            areas = [(block, oriented_rectangle(block).yaw_deg) for block in self.open_blocks]
        elif thing.where == "water":
            over = [one.rectangle((0.0, one.length_m), (-one.width_m, one.width_m)) for one in self.network.bridges]
            bridges = shapely.union_all([rectangle_polygon(one) for one in over])
            areas = [(shapely.difference(self.network.water, bridges), 0.0)]
        for area, yaw_deg in areas:
            if not area.is_empty and (place := self._place_in(thing, area, scales, yaw_deg)) is not None:
                return place
        for scale in scales if thing.where == "open" else ():
            size = thing.size_m[0] * scale, thing.size_m[1] * scale
            lots = self._lots([size], rng_for(self.seed, "world", thing.name), setback_m=self.plan.setback_m)
            if lot := next(lots, None):
                return lot, scale
        return None

    def _place_in(
        self, thing: Object, area: BaseGeometry, scales: list[float], yaw_deg: float
    ) -> tuple[Rectangle, float] | None:
        """Return a place of an object in an area, along its yaw or across, near the middle."""
        turned = rotate(area, -yaw_deg, origin=(0, 0))
        near = [outline for outline in self._taken if outline.distance(area) < SPACE_M]
        tree = shapely.STRtree([rotate(outline, -yaw_deg, origin=(0, 0)) for outline in near])
        shapely.prepare(turned)
        low_x, low_y, high_x, high_y = turned.bounds
        x, y = np.meshgrid(np.arange(low_x, high_x, STEP_M), np.arange(low_y, high_y, STEP_M))
        centers = np.stack([x.ravel(), y.ravel()], axis=1)
        away_m = np.hypot(*(centers - np.array(turned.centroid.coords[0])).T)
        x, y = centers[np.argsort(away_m, kind="stable")].T
        for scale in scales:
            wide, deep = (side * scale for side in thing.size_m)
            for turn_deg in (0.0, 90.0) if thing.where == "open" else (0.0,):
                half_x, half_y = (wide / 2, deep / 2) if turn_deg == 0 else (deep / 2, wide / 2)
                outlines = shapely.box(x - half_x, y - half_y, x + half_x, y + half_y)
                for outline in outlines[shapely.contains_properly(turned, outlines)]:
                    if not len(tree.query(outline, predicate="dwithin", distance=SPACE_M / 2)):
                        middle = rotate(outline.centroid, yaw_deg, origin=(0, 0))
                        return Rectangle((middle.x, middle.y), (wide, deep), yaw_deg + turn_deg), scale
        return None

    def _set_trees(self, rng: np.random.Generator) -> None:
        """Fell or plant trees until their number is within the plan's range."""
        low, high = self.plan.trees_per_ha
        hectares = self.land_m2 / 1e4
        trees = np.flatnonzero(trees_of(self.layout))
        goal = round((0.65 * low + 0.35 * high) * hectares)
        if len(trees) > high * hectares:
            felled = rng.choice(trees, len(trees) - goal, replace=False)
            self.layout = self.layout.select(np.setdiff1d(np.arange(len(self.layout)), felled))
        elif len(trees) < goal:
            self.layout = self.layout.joined(self._planted(goal - len(trees), rng))

    def _planted(self, count: int, rng: np.random.Generator) -> BoxMap:
        """Return new trees in the blocks, clear of all other boxes and of the paths to doors."""
        world, boxes = self.boxes, BoxList()
        is_ground = of_kinds(world, "Roads", "Terrain", "RoadLines") | (world.maxs[:, 2] <= 0.0)
        is_path = of_kinds(world, "Sidewalks") & ((2 * world.half_extents[:, :2]).min(1) < 5.0)
        obstacles = shapely.STRtree(footprints(world)[~is_ground | is_path])
        shapely.prepare(self._blocks)
        low_x, low_y, high_x, high_y = self._blocks.bounds
        for xy in rng.uniform((low_x, low_y), (high_x, high_y), (40 * count, 2)):
            crown_m = rng.uniform(3.0, 5.5)
            outline = shapely.box(*(xy - crown_m / 2), *(xy + crown_m / 2))
            if self._blocks.contains(outline) and not len(obstacles.query(outline, predicate="dwithin", distance=0.4)):
                boxes.add("Vegetation", xy, (crown_m, crown_m * rng.uniform(0.9, 1.1)), 0.0, rng.uniform(5.0, 11.0))
                if len(boxes) == count:
                    break
        return boxes.box_map()


def _add_object(boxes: BoxList, thing: Object, place: Rectangle, scale: float) -> None:
    """Add an object's boxes; the heights of its high parts are scaled like its footprint."""
    placed = boxes.framed(place.center, place.yaw_deg)
    for kind, x, y, wide, deep, low, high in thing.parts:
        tall = scale if high > 1.0 else 1.0
        placed.add(kind, (scale * x, scale * y), (wide * scale, deep * scale), min(low, low * tall), high * tall)


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
    """Return SimWorld's nodes of the layout: a piece of road for each street with a carriageway, and every box."""
    nodes = list[dict[str, Any]]()
    for street in town.network.streets:
        if street.road_m:
            x, y = street.at(street.length_m / 2, 0.0)
            scale = np.array([ROAD_SCALE[0] * street.length_m / ROAD_PIECE_M, *ROAD_SCALE[1:]])
            nodes.append(_node(f"GEN_Road_{len(nodes)}", "BP_Road1_C", (x, -y, 0.0), -street.yaw_deg, scale))
    kinds = [KIND_NAMES[int(kind)] for kind in town.layout.kinds]
    return nodes + [_box_node(town.layout, row, kind) for row, kind in enumerate(kinds)]


def placement_nodes(town: Town) -> list[dict[str, Any]]:
    """Return SimWorld's nodes of the placed objects and of the ways to them."""
    return [_box_node(town.placement, row, *node) for row, node in enumerate(town.object_nodes)]


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
