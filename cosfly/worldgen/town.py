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
from shapely import Polygon
from shapely.affinity import rotate
from shapely.geometry.base import BaseGeometry

from cosfly.formats.boxes import OUR_LICENCE, BoxMap, MapHeader, MapSource
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.maps.boxlist import SLAB_M, BoxList
from cosfly.maps.footprints import Rectangle, footprints, oriented_rectangle, polygons_of, rectangle_polygon
from cosfly.runtime.seeding import rng_for
from cosfly.simulators.assets import ASSETS
from cosfly.worldgen.plan import VERGE_M, Buildings, Object, Range, WorldPlan, assets
from cosfly.worldgen.streets import GROUND_TOP_M, LANE_M, lay_streets, network, pave

CM_PER_M = 100.0
ROAD_PIECE_M = 200.0  # length of SimWorld's piece of road
ROAD_SCALE = (0.95, 0.9, 1.0)  # scale of the piece at that length
STRETCH = 6.0  # most that an asset's box may be stretched along one side relative to another
STEP_M = 2.0  # between places that are tried
LOT_STEP_M = 1.0  # the same along a street
SCALES = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4)
SPACE_M = 4.0  # free ground around each object
TREE_M = 2.5  # lower vegetation is a hedge
DOOR_M = 1.6  # width of a path to a building
BLOCK_PIECE_M = 6.0  # of pavement inside blocks, whose edges lie on that of streets
LEAST_BLOCK_M2 = 400.0  # of a plaza or a green block
GROW = 1.25  # factor of the sides of a town in which objects find no room
MOST_GROWTH = 5  # times
LEAST_TOWN_M = 170.0  # side of a town without a size, so that people find a way of 100 m
WIDEST_BLOCK_M = 150.0  # blocks grow up to this size for a large object
PATH_HALF_M = 1.5  # half width of a path across a green
GARDEN_SETBACK_M = 2.5  # houses that stand farther back have gardens, so their blocks are not paved
HEIGHT_SHAPE = (1.3, 1.7)  # of the beta distribution of heights: few buildings are very low or very high
MOST_OF_BLOCK = 0.5  # share of an open block that an object may cover if there is room elsewhere
LONGEST_IN_WATER = 0.4  # length of a jetty, share of the river's width
TREE_GOAL = 0.35  # place of the number of trees in its range

Size = tuple[float, ...]


class Placed(NamedTuple):
    name: str
    number: int  # among the objects of the name
    xy: tuple[float, float]  # middle, m
    yaw_deg: float
    scale: float  # of its footprint


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
    widest_m = max((max(obj.size_m) * obj.least_scale for obj, _ in plan.known_objects()), default=0.0)
    plan = plan.model_copy(update={"block_m": max(plan.block_m, min(widest_m + 2 * SPACE_M, WIDEST_BLOCK_M))})
    if plan.size_m:
        return Town(plan, plan.size_m, name, seed)
    counts = {kind.name: kind.count for kind in plan.buildings if kind.count}
    num_requested = sum(counts.values())
    side_m = _side_m(plan)
    for _ in range(MOST_GROWTH):
        town = Town(plan, _stretched(plan, side_m, seed), name, seed)
        num_built = sum(town.built[kind] for kind in counts)
        if num_built < num_requested:
            side_m *= min(2.0, 1.05 * math.sqrt(num_requested / max(1, num_built)))
        elif any(reason == "no room" for _, reason in town.not_placed):
            side_m *= GROW
        else:
            break
    return town


def _side_m(plan: WorldPlan) -> float:
    """Return the first side of a square town without a size."""
    pitch_m = plan.block_m + plan.street_m
    edges_m = 2 * VERGE_M + plan.avenue_m + plan.river_m
    counted = [kind for kind in plan.buildings if kind.count]
    if not (plan.only_these and counted):
        return plan.blocks_along * pitch_m + edges_m
    fronts_m = sum((kind.count or 0) * (sum(kind.footprint_m) / 2 + 1.3 * plan.gap_m) for kind in counted)
    return max(LEAST_TOWN_M, math.sqrt(fronts_m * pitch_m / 3) + edges_m)


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
    if len(fitting) >= 4:
        return fitting
    return [(x, max(0.6 * low, x * share)) for x in np.linspace(low, high, 6).tolist() for share in (0.6, 0.9)]


class Town:
    """A town of a size: its ground, then objects, buildings and trees on what is left.

    size_m: from west to east and from south to north.
    """

    def __init__(self, plan: WorldPlan, size_m: Range, name: str, seed: int) -> None:
        self.plan = plan
        self.size_m = size_m
        self.name = name
        self.seed = seed
        self.built = Counter[str]()  # numbers of buildings by kind
        self.placed = list[Placed]()
        self.counted = list[tuple[str, Range]]()  # kinds and places of the counted buildings
        # Names and reasons of missing objects, an entry for each.
        self.not_placed = [(missing, "not in the object table") for missing in plan.unknown_objects()]
        self.object_nodes = list[tuple[str, str | None]]()  # name and asset of each box of `placement`
        self._boxes = BoxList()  # streets and buildings
        self._objects = BoxList()
        self._taken = list[BaseGeometry]()  # outlines of buildings and objects
        self._outline = shapely.box(-size_m[0] / 2, -size_m[1] / 2, size_m[0] / 2, size_m[1] / 2)
        # Of the open blocks; one is paved for objects if none is planned, except among gardens.
        has_objects = any(obj.where in ("open", "green", "quay") for obj, _ in plan.known_objects())
        self.num_open = max(plan.plazas + plan.greens, int(has_objects))
        self.num_plazas = plan.plazas or int(self.num_open > plan.greens and plan.setback_m < GARDEN_SETBACK_M)
        self.network = network(plan, size_m, rng_for(seed, "world", "streets"))
        self._strips = self._lay_streets()  # outlines of streets, from front to front
        # A millimetre wider, because rounding leaves gaps between strips that touch.
        between_blocks = shapely.union(shapely.union_all(self._strips).buffer(1e-3), self.network.water)
        self._blocks = shapely.difference(self._outline, between_blocks)
        self._closed_blocks = self._find_closed_blocks()
        self._buildable = self._find_buildable()
        self.open_blocks = self._choose_open_blocks()
        self._paved = shapely.STRtree([*self._strips, *self._pave_open_blocks()])  # where paths to doors begin
        self._buildable = shapely.difference(self._buildable, shapely.union_all(self.open_blocks).buffer(0.1))
        shapely.prepare(self._buildable)
        for obj, count in sorted(plan.known_objects(), key=lambda pair: -math.prod(pair[0].size_m)):
            self._place_object(obj, count)
        self._build_houses()
        if plan.setback_m < GARDEN_SETBACK_M and plan.street_m >= LANE_M:  # lanes are seen between unpaved yards
            for block in self._closed_blocks:
                if block.area < 4 * plan.block_m**2 and block not in self.open_blocks:
                    pave(self._boxes, block, BLOCK_PIECE_M)
        source = MapSource(tool="cosfly world", version="3", seed=seed)
        header = MapHeader(name=name, source=source, licence=OUR_LICENCE, ground_z_m=0.0)
        self.placement = self._objects.box_map()
        self.layout = self._boxes.box_map(header)
        self.layout = self._with_trees(rng_for(seed, "world", "trees"))

    @property
    def boxes(self) -> BoxMap:
        return self.layout.joined(self.placement)

    @property
    def land_m2(self) -> float:
        """The area without the water."""
        return float(shapely.difference(self._outline, self.network.water).area)

    # --- the ground ---

    def _lay_streets(self) -> list[Polygon]:
        """Add the ground and the streets with their furniture; return the outlines of the streets."""
        low_x, low_y, high_x, high_y = self._outline.bounds
        self._boxes.span("Terrain", (low_x, low_y), (high_x, high_y), GROUND_TOP_M - SLAB_M, GROUND_TOP_M)
        furniture = rng_for(self.seed, "world", "furniture")
        return lay_streets(self._boxes, self.network, self.plan.parked_share, furniture)

    def _find_closed_blocks(self) -> list[Polygon]:
        """Return the blocks that do not touch the edge of the town, the nearest to its middle first."""
        edge = self._outline.boundary
        blocks = [block for block in polygons_of(self._blocks) if block.area > LEAST_BLOCK_M2]
        closed = [block for block in blocks if edge.distance(block) > 0.1]
        return sorted(closed, key=lambda block: block.centroid.distance(shapely.Point(0, 0)))

    def _find_buildable(self) -> BaseGeometry:
        """Return the ground on which buildings may stand, away from three edges of the town."""
        low_x, low_y, high_x, high_y = self._outline.bounds
        inside = self._blocks if self.plan.pattern == "linear" else shapely.union_all(self._closed_blocks)
        return shapely.intersection(inside, shapely.box(2.0 + low_x, low_y, high_x - 2.0, high_y - 2.0))

    def _choose_open_blocks(self) -> list[Polygon]:
        """Return plazas, the blocks nearest to the middle, then greens."""
        plan = self.plan
        rng = rng_for(self.seed, "world", "open")
        blocks = self._closed_blocks[: max(1, len(self._closed_blocks) // 2)]
        num_middle = max(1, self.num_plazas)  # without a plaza, one green is in the middle
        rest = blocks[num_middle:]
        chosen = blocks[:num_middle] + [rest[k] for k in rng.permutation(len(rest))]
        if len(chosen) < self.num_open:  # open lots along streets
            lots = self._lots([(0.7 * plan.block_m,) * 2], rng, setback_m=0.0)
            chosen += [rectangle_polygon(lot) for lot in islice(lots, self.num_open - len(chosen))]
        return chosen[: self.num_open]

    def _pave_open_blocks(self) -> list[BaseGeometry]:
        """Pave the plazas, and two paths that cross each green; return the paved areas."""
        paved: list[BaseGeometry] = [*self.open_blocks[: self.num_plazas]]
        whole = (-0.6, 0.6)  # shares of a side: a little more than the green
        for green in self.open_blocks[self.num_plazas :]:
            shape = oriented_rectangle(green)
            along, across = ((-PATH_HALF_M / side, PATH_HALF_M / side) for side in shape.size)
            for path in (rectangle_polygon(shape, along, whole), rectangle_polygon(shape, whole, across)):
                paved.append(shapely.intersection(green, path))
        for area in paved:
            pave(self._boxes, area, BLOCK_PIECE_M)
        return paved

    # --- buildings ---

    def _lots(self, sizes: list[Range], rng: np.random.Generator, *, setback_m: float) -> Iterator[Rectangle]:
        """Yield free lots along the streets, the nearest to the middle of the town first.

        Each has one of the sizes; its front is the side with negative y.
        """
        streets = zip(self.network.streets, self._strips, strict=True)
        taken = [*self._taken]
        smallest = min(sizes, key=math.prod)
        for street, strip in sorted(streets, key=lambda pair: np.linalg.norm(pair[0].start + pair[0].end)):
            front_m = street.width_m / 2 + 0.05 + setback_m  # from the centre line
            reach_m = max(map(max, sizes)) + setback_m + self.plan.gap_m
            near = [outline for outline in taken if outline.dwithin(strip, reach_m)]
            for side in (1, -1):
                along_m = 0.0
                while along_m < street.length_m:
                    for width_m, depth_m in dict.fromkeys((sizes[int(rng.integers(len(sizes)))], smallest)):
                        across = (side * front_m, side * (front_m + depth_m))
                        lot = street.rectangle((along_m, along_m + width_m), across)
                        outline = rectangle_polygon(lot)
                        is_taken = shapely.dwithin(np.array(near, dtype=object), outline, self.plan.gap_m).any()
                        if not is_taken and self._buildable.contains(outline):
                            yield lot._replace(yaw_deg=lot.yaw_deg + 90.0 * (1 - side))
                            taken.append(outline)
                            near.append(outline)
                            along_m += width_m + self.plan.gap_m * rng.uniform(1.0, 1.6)
                            break
                    else:
                        along_m += LOT_STEP_M

    def _build_houses(self) -> None:
        """Build the counted buildings on lots spread over the town, then fill the lots that are left."""
        rng = rng_for(self.seed, "world", "lots")
        setback_m = self.plan.setback_m
        kinds = self.plan.kinds_of_buildings()
        for kind in kinds:
            if kind.count is not None:
                lots = list(self._lots(_footprints(*kind.footprint_m), rng, setback_m=setback_m))
                spread = np.linspace(0, len(lots) - 1, min(kind.count, len(lots))).round().astype(int)
                for index in spread:
                    self._build_house(lots[index], kind, rng)
        uncounted = [kind for kind in kinds if kind.count is None]
        if uncounted:
            sizes = [size for kind in uncounted for size in _footprints(*kind.footprint_m)]
            for lot in self._lots(sizes, rng, setback_m=setback_m):
                depth_m = lot.size[1]
                fitting = [
                    kind for kind in uncounted
                    if kind.footprint_m[0] * 0.6 <= depth_m and 0.6 * depth_m <= kind.footprint_m[1]
                ] or uncounted  # fmt: skip
                self._build_house(lot, fitting[int(rng.integers(len(fitting)))], rng)

    def _build_house(self, lot: Rectangle, kind: Buildings, rng: np.random.Generator) -> None:
        """Build one house on a lot, and the path to its door."""
        low, high = kind.heights_m
        height = low + (high - low) * rng.beta(*HEIGHT_SHAPE)
        self._boxes.add("Buildings", lot.center, lot.size, 0.0, height, lot.yaw_deg)
        self._add_path(self._boxes, lot)
        self._taken.append(rectangle_polygon(lot))
        self.built[kind.name] += 1
        if kind.count is not None:
            self.counted.append((kind.name, lot.center))

    def _add_path(self, boxes: BoxList, place: Rectangle) -> None:
        """Add a path from a building to the nearest pavement."""
        outline = rectangle_polygon(place)
        line = shapely.shortest_line(outline, self._paved.geometries[self._paved.nearest(outline)])
        if line.length > 0.5:
            (x, y), (to_x, to_y) = line.coords
            path = boxes.framed((x, y), math.degrees(math.atan2(to_y - y, to_x - x)))
            path.lay("Sidewalks", (-0.25, -DOOR_M / 2), (line.length + 0.25, DOOR_M / 2))

    # --- objects ---

    def _place_object(self, obj: Object, count: int) -> None:
        """Place an object `count` times: in open blocks, at a street or in the water."""
        if obj.where == "layout":
            num_built = min(count, len(self.network.bridges))
            self.placed += [Placed(obj.name, number, (0.0, 0.0), 0.0, 1.0) for number in range(num_built)]
            self.not_placed += [(obj.name, "no street to carry it")] * (count - num_built)
            return
        scales = [scale for scale in SCALES if scale >= obj.least_scale - 1e-9]
        for number in range(count):
            scaled_place = self._find_place(obj, scales)
            if scaled_place is None:
                may_exist = obj.where in ("open", "green", "quay") or not self.network.water.is_empty
                self.not_placed.append((obj.name, "no room" if may_exist else "no water in the plan"))
                continue
            place, scale = scaled_place
            _add_object(self._objects, obj, place, scale)
            node = f"OBJ_{obj.name.replace(' ', '_')}_{number}"
            self.object_nodes += [(node, obj.asset)] * len(obj.parts)
            if any(part.kind == "Buildings" for part in obj.parts):
                self._add_path(self._objects, place)
            self.object_nodes += [("way", None)] * (len(self._objects) - len(self.object_nodes))
            self.placed.append(Placed(obj.name, number, place.center, place.yaw_deg, scale))
            self._taken.append(rectangle_polygon(place))

    def _find_place(self, obj: Object, scales: list[float]) -> tuple[Rectangle, float] | None:
        """Return the outline and the scale of an object where there is room, else None."""
        if obj.where in ("water", "bank") or (obj.where == "quay" and self.plan.river_m):
            bridges = shapely.union_all([
                rectangle_polygon(bridge.rectangle((0.0, bridge.length_m), (-bridge.width_m, bridge.width_m)))
                for bridge in self.network.bridges
            ])  # fmt: skip
            water = shapely.difference(self.network.water, bridges)
            if obj.where == "water":
                return self._place_in(obj, water, scales, 0.0)
            return self._place_at_bank(obj, water)
        plazas, greens = self.open_blocks[: self.num_plazas], self.open_blocks[self.num_plazas :]
        blocks = greens + plazas if obj.where == "green" else self.open_blocks
        roomy = [block for block in blocks if math.prod(obj.size_m) < MOST_OF_BLOCK * block.area]
        return (
            self._place_in_blocks(obj, roomy, scales)
            or self._place_on_lot(obj, scales)
            or self._place_in_blocks(obj, blocks, scales)
        )

    def _place_in_blocks(
        self, obj: Object, blocks: list[Polygon], scales: list[float]
    ) -> tuple[Rectangle, float] | None:
        """Return a place and the scale of an object in the first block with room; else None."""
        for block in blocks:
            scaled_place = self._place_in(obj, block, scales, oriented_rectangle(block).yaw_deg)
            if scaled_place is not None:
                return scaled_place
        return None

    def _place_on_lot(self, obj: Object, scales: list[float]) -> tuple[Rectangle, float] | None:
        """Return a lot along a street and the scale of an object; else None."""
        for scale in scales:
            size = obj.size_m[0] * scale, obj.size_m[1] * scale
            lots = self._lots([size], rng_for(self.seed, "world", obj.name), setback_m=self.plan.setback_m)
            lot = next(lots, None)
            if lot is not None:
                return lot, scale
        return None

    def _place_at_bank(self, obj: Object, water: BaseGeometry) -> tuple[Rectangle, float] | None:
        """Return a place and the scale of an object that reaches from a bank into the water; else None."""
        scale = min(1.0, LONGEST_IN_WATER * self.plan.river_m / obj.size_m[1])
        bank = self.network.water.boundary.difference(self._outline.boundary.buffer(1.0))
        near_bank = shapely.intersection(water, bank.buffer(scale * obj.size_m[1] + STEP_M))
        scaled_place = self._place_in(obj, near_bank, [scale], 0.0)
        if scaled_place is None:
            return None
        place, _ = scaled_place
        start, end = np.array(shapely.shortest_line(rectangle_polygon(place), bank).coords)
        return place._replace(center=tuple(np.array(place.center) + end - start)), scale

    def _place_in(
        self, obj: Object, area: BaseGeometry, scales: list[float], yaw_deg: float
    ) -> tuple[Rectangle, float] | None:
        """Return a place and the scale of an object in an area, along its yaw or across, near the middle; else None."""
        if area.is_empty:
            return None
        turned = rotate(area, -yaw_deg, origin=(0, 0))
        near = [outline for outline in self._taken if outline.distance(area) < SPACE_M]
        tree = shapely.STRtree([rotate(outline, -yaw_deg, origin=(0, 0)) for outline in near])
        shapely.prepare(turned)
        low_x, low_y, high_x, high_y = turned.bounds
        x, y = np.meshgrid(np.arange(low_x, high_x, STEP_M), np.arange(low_y, high_y, STEP_M))
        centers = np.stack([x.ravel(), y.ravel()], axis=1)
        away_m = np.hypot(*(centers - np.array(turned.centroid.coords[0])).T)
        x, y = centers[np.argsort(away_m, kind="stable")].T
        turns_deg = (0.0, 90.0) if obj.where in ("open", "green") else (0.0,)
        for scale in scales:
            wide, deep = (side * scale for side in obj.size_m)
            for turn_deg in turns_deg:
                half_x, half_y = (wide / 2, deep / 2) if turn_deg == 0 else (deep / 2, wide / 2)
                outlines = shapely.box(x - half_x, y - half_y, x + half_x, y + half_y)
                for outline in outlines[shapely.contains_properly(turned, outlines)]:
                    if not len(tree.query(outline, predicate="dwithin", distance=SPACE_M / 2)):
                        middle = rotate(outline.centroid, yaw_deg, origin=(0, 0))
                        return Rectangle((middle.x, middle.y), (wide, deep), yaw_deg + turn_deg), scale
        return None

    # --- trees ---

    def _with_trees(self, rng: np.random.Generator) -> BoxMap:
        """Return the layout with trees felled or planted until their number is within the plan's range."""
        low, high = self.plan.trees_per_ha
        hectares = self.land_m2 / 1e4
        trees = np.flatnonzero(trees_of(self.layout))
        goal = round(((1 - TREE_GOAL) * low + TREE_GOAL * high) * hectares)
        if len(trees) > high * hectares:
            felled = rng.choice(trees, len(trees) - goal, replace=False)
            return self.layout.select(np.setdiff1d(np.arange(len(self.layout)), felled))
        if len(trees) < goal:
            return self.layout.joined(self._planted(goal - len(trees), rng))
        return self.layout

    def _planted(self, count: int, rng: np.random.Generator) -> BoxMap:
        """Return new trees in the blocks, clear of all other boxes and of the paths to doors."""
        world = self.boxes
        boxes = BoxList()
        is_ground = of_kinds(world, "Roads", "Terrain", "RoadLines") | (world.maxs[:, 2] <= 0.0)
        is_path = of_kinds(world, "Sidewalks") & ((2 * world.half_extents[:, :2]).min(1) < 5.0)
        obstacles = shapely.STRtree([*footprints(world)[~is_ground | is_path], *self._taken])  # and pitches
        ground = shapely.difference(self._blocks, shapely.union_all(self.open_blocks[: self.num_plazas]))
        shapely.prepare(ground)
        low_x, low_y, high_x, high_y = ground.bounds
        for xy in rng.uniform((low_x, low_y), (high_x, high_y), (40 * count, 2)):
            crown_m = rng.uniform(3.0, 5.5)
            outline = shapely.box(*(xy - crown_m / 2), *(xy + crown_m / 2))
            if ground.contains(outline) and not len(obstacles.query(outline, predicate="dwithin", distance=0.4)):
                boxes.add("Vegetation", xy, (crown_m, crown_m * rng.uniform(0.9, 1.1)), 0.0, rng.uniform(5.0, 11.0))
                if len(boxes) == count:
                    break
        return boxes.box_map()


def _add_object(boxes: BoxList, obj: Object, place: Rectangle, scale: float) -> None:
    """Add an object's boxes; the heights of its high parts are scaled like its footprint."""
    placed = boxes.framed(place.center, place.yaw_deg)
    for part in obj.parts:
        tall = scale if part.high > 1.0 else 1.0
        center, size = (scale * part.x, scale * part.y), (part.wide * scale, part.deep * scale)
        placed.add(part.kind, center, size, min(part.low, part.low * tall), part.high * tall)


# --- nodes of SimWorld ------------------------------------------------------------------------------------------------


@cache
def _asset_tables() -> dict[str, dict[str, Size]]:
    """Return the assets that boxes of a kind may get, and their full sizes, m."""
    furniture: dict[str, Size] = {}
    for asset in ASSETS:
        if asset.size_m is not None and asset.kind == "Static":
            is_bin = asset.pattern == "BP_Trash_bin_*"  # of several assets; other patterns stand for one
            furniture["BP_Trash_bin_a_C" if is_bin else asset.pattern.replace("*", "")] = tuple(asset.size_m)
    buildings = {name: size for name, size in assets().items() if name.startswith("BP_Building")}
    trees = {name: size for name, size in assets().items() if name.startswith("BP_Tree")}
    return {"Buildings": buildings, "Vegetation": trees, "Static": furniture}


def asset_for(kind: str, size_m: Size) -> tuple[str, Size]:
    """Return the asset with the most similar box, and its size; one named after the kind if none is similar."""
    table = _asset_tables().get(kind, {})
    stretches = {  # logarithms of the factors along x, y, z that turn the asset into the box
        name: [math.log(side_m / asset_side_m) for side_m, asset_side_m in zip(size_m, asset_size_m, strict=True)]
        for name, asset_size_m in table.items()
    }
    name = min(stretches, key=lambda name: sum(x * x for x in stretches[name]), default=None)
    if name is not None:
        stretch = stretches[name]
        is_distorted = max(stretch) - min(stretch) > math.log(STRETCH)
        has_other_size = kind == "Static" and max(map(abs, stretch)) > math.log(2.0)
        if not (is_distorted or has_other_size):
            return name, table[name]
    return f"{kind}_C", (1.0, 1.0, 1.0)


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
