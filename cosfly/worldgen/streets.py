"""The streets of a town: their centre lines from a pattern, a river and bridges, and all of them as boxes.

A pattern returns lines; `straight_streets` cuts them at their crossings and bends. Coordinates are m, the origin is the
middle of the town, +x is east and +y north. Boxes have the yaw of their street. Pavements are at z = 0, carriageways,
paint and the ground below a few centimetres lower, so that no two share a plane.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import compress, pairwise
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from cosfly.maps.boxlist import PAVED_TOP_M, ROAD_TOP_M, SLAB_M, BoxList
from cosfly.maps.footprints import Rectangle, cover, polygons_of, rectangle_polygon
from cosfly.maps.town_parts import RAILING_M, WATER_BOTTOM_M, WATER_TOP_M, Plot, add_road_paint, furnish, pavement_m
from cosfly.worldgen.plan import PATH_M, VERGE_M, Range, WorldPlan

# Streets.
LANE_M = 9.0  # narrower streets have no carriageway

PARALLEL_SHARE = 0.4  # of a block: a street that is nearer to the one at a bank all along is dropped
SHORE_SWAY_M = 3.0
GRID_M = 0.05  # of the ends of streets
# Share of the distance between crossings within which the corners of irregular cells are one.
SAME_CORNER_SHARE = 0.3

# Boxes and furniture.
GROUND_TOP_M = ROAD_TOP_M - 0.02  # two centimetres: a depth buffer separates them at 300 m
PIECE_M = 2.0  # smallest rectangles that fill a corner
BETWEEN_CROSSINGS_M = 70.0
SHORTEST_M = 12.0  # shorter parts of streets have neither crossings nor furniture
LANE_EDGE_M = 1.6  # from the front of a lane without carriageway to where its kerb would be
LEAST_PARKING_M, LEAST_AVENUE_M = 6.0, 14.0  # narrower carriageways have no parked cars, narrower streets no trees
TREE_SHARE = 0.7  # of places of street trees that are planted


class Line(NamedTuple):
    """The centre line of a street, (n, 2) m, and its width from front to front."""

    points: np.ndarray
    width_m: float


@dataclass(frozen=True, eq=False)
class StraightStreet:
    """A straight piece of street: centre line from start to end, (2,) m; width from front to front; carriageway."""

    start: np.ndarray
    end: np.ndarray
    width_m: float

    @property
    def road_m(self) -> float:
        """Width of the carriageway; 0 for lanes and paths."""
        return self.width_m - 2 * pavement_m(self.width_m) if self.width_m >= LANE_M else 0.0

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(self.end - self.start))

    @property
    def direction(self) -> np.ndarray:
        return (self.end - self.start) / self.length_m

    @property
    def yaw_deg(self) -> float:
        return math.degrees(math.atan2(*self.direction[::-1]))

    def at(self, along_m: float, across_m: float) -> np.ndarray:
        """Return the point at a distance along the street and to its left."""
        x, y = self.direction
        return self.start + along_m * np.array([x, y]) + across_m * np.array([-y, x])

    def rectangle(self, along: Range, across: Range) -> Rectangle:
        """Return the rectangle between two distances along the street and two to its left, with the street's yaw."""
        x, y = self.at(sum(along) / 2, sum(across) / 2)
        return Rectangle((float(x), float(y)), (along[1] - along[0], abs(across[1] - across[0])), self.yaw_deg)


class Network(NamedTuple):
    """Streets and water of a town."""

    streets: list[StraightStreet]
    water: BaseGeometry
    bridges: list[StraightStreet]  # those of `streets` that cross the water


# --- patterns ---------------------------------------------------------------------------------------------------------


def _spaced(length_m: float, pitch_m: float, unevenness: float, rng: np.random.Generator) -> np.ndarray:
    """Return places from -length_m / 2 to length_m / 2, about pitch_m apart."""
    shares = 1.0 + unevenness * rng.uniform(-1.0, 1.0, max(1, round(length_m / pitch_m)))
    return np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * length_m - length_m / 2


def grid(plan: WorldPlan, size_m: Range, rng: np.random.Generator) -> list[Line]:
    """Return streets at right angles; the proportions of blocks, the avenues and the offsets of rows vary."""
    stretch = rng.uniform(0.75, 1.35)
    rows = _spaced(size_m[1], plan.block_m / stretch + plan.street_m, plan.unevenness, rng)
    columns = _spaced(size_m[0], plan.block_m * stretch + plan.street_m, plan.unevenness, rng)
    is_staggered = rng.random() < 0.4
    avenue_row = rng.integers(len(rows))
    avenue_column = rng.integers(len(columns))
    lines = []
    for k, y in enumerate(rows):
        width_m = plan.avenue_m if k == avenue_row else plan.street_m
        lines.append(Line(np.array([[columns[0], y], [columns[-1], y]]), width_m))
    for band, (low, high) in enumerate(pairwise(rows)):
        shift = (columns[1] - columns[0]) / 2 if is_staggered and band % 2 else 0.0
        for k, column in enumerate(columns):
            is_inner = 0 < k < len(columns) - 1
            x = column - shift if is_inner else column
            width_m = plan.avenue_m if k == avenue_column and not is_staggered else plan.street_m
            lines.append(Line(np.array([[x, low], [x, high]]), width_m))
    return lines


def radial(plan: WorldPlan, size_m: Range, rng: np.random.Generator) -> list[Line]:
    """Return avenues that meet at a ring around the middle, and streets on rings between them."""
    half = np.array(size_m) / 2
    count = int(rng.integers(5, 9))
    steps = 1.0 + 0.35 * plan.unevenness * rng.uniform(-1, 1, count)
    angles = rng.uniform(0, 2 * math.pi) + np.cumsum(steps / steps.sum()) * 2 * math.pi
    inner = max(plan.block_m / 2, count * (plan.avenue_m + 6.0) / (2 * math.pi)) / half.min()
    num_rings = max(1, math.ceil((1.0 - inner) * half.min() / (plan.block_m + plan.street_m) - 0.3))
    radii = np.linspace(inner, 1.0, num_rings + 1)
    lines = [Line(_polar(np.append(angles, angles[0]), inner, half), plan.street_m)]  # the inner ring
    lines += [Line(_polar(angle, [inner, 1.0], half), plan.avenue_m) for angle in angles]
    for radius in radii[1:]:
        arc_m = 2 * math.pi * radius * half.min() / len(angles)
        if arc_m > 1.7 * (plan.block_m + plan.street_m):  # streets between the others, from this ring outwards
            gaps = np.diff(angles, append=angles[0] + 2 * math.pi)
            between = angles + gaps / 2
            lines += [Line(_polar(angle, [radius, 1.0], half), plan.street_m) for angle in between]
            angles = np.sort(np.concatenate([angles, between]))
        lines.append(Line(_polar(np.append(angles, angles[0]), radius, half), plan.street_m))
    return lines


def _polar(angles: float | np.ndarray, radii: float | list[float], half: np.ndarray) -> np.ndarray:
    """Return points by angle and by radius, a share of the half sides of the town."""
    turn, share = np.broadcast_arrays(angles, radii)
    return np.stack([np.cos(turn), np.sin(turn)], axis=1) * share[:, None] * half


def winding(plan: WorldPlan, size_m: Range, rng: np.random.Generator) -> list[Line]:
    """Return the edges of irregular cells, bent at random.

    organic: streets, with main streets around the whole town. campus: footpaths over lawns, and a street around them.
    """
    is_campus = plan.pattern == "campus"
    inner_m, outer_m = (PATH_M, plan.street_m) if is_campus else (plan.street_m, plan.avenue_m)
    pitch_m = plan.block_m + inner_m
    half = np.array(size_m) / 2
    counts = np.maximum(2, np.round(np.array(size_m) / pitch_m)).astype(int)
    corners, num_cells_of_edge = _edges_of_cells(_irregular_cells(counts, half, rng), half, SAME_CORNER_SHARE * pitch_m)
    lines = []
    for (a, b), num_cells in num_cells_of_edge.items():
        across = np.array([[0.0, -1.0], [1.0, 0.0]]) @ (corners[b] - corners[a])
        bend = (corners[a] + corners[b]) / 2 + across * float(np.clip(rng.normal(0.0, 0.12), -0.2, 0.2))
        points = np.stack([corners[a], np.clip(bend, -half, half), corners[b]])
        is_border = num_cells == 1
        lines.append(Line(points, outer_m if is_border else inner_m))
    return lines


def _irregular_cells(counts: np.ndarray, half: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return Voronoi polygons of jittered points in staggered rows, about counts[0] x counts[1], within the town."""
    x, y = np.meshgrid(*(np.arange(-2, count + 2) for count in counts))
    points = np.stack([x + 0.5 + 0.25 * (2 * (y % 2) - 1), y + 0.5], axis=-1).reshape(-1, 2)
    points = (points + 0.33 * rng.uniform(-1.0, 1.0, points.shape)) * (2 * half / counts) - half
    cells = shapely.get_parts(shapely.voronoi_polygons(shapely.multipoints(points)))
    return cells[shapely.contains(shapely.box(*(-half), *half), shapely.centroid(cells))]


def _edges_of_cells(
    cells: np.ndarray, half: np.ndarray, same_m: float
) -> tuple[list[np.ndarray], dict[tuple[int, int], int]]:
    """Return the corners of cells, (2,) m each, and for each edge, a pair of corners, the number of cells at it.

    Corners within `same_m` of each other are one, so that no street is very short.
    """
    corners = list[np.ndarray]()
    num_cells: dict[tuple[int, int], int] = {}
    for cell in cells:
        ring = []
        for point in np.clip(shapely.get_coordinates(cell), -half, half):
            away_m = np.linalg.norm(np.array(corners).reshape(-1, 2) - point, axis=1)
            near = np.flatnonzero(away_m < same_m).tolist()
            if near:
                ring.append(near[0])
            else:
                ring.append(len(corners))
                corners.append(point)
        for edge in {(min(ends), max(ends)) for ends in pairwise(ring) if ends[0] != ends[1]}:
            num_cells[edge] = num_cells.get(edge, 0) + 1
    return corners, num_cells


def linear(plan: WorldPlan, size_m: Range, rng: np.random.Generator) -> list[Line]:
    """Return one long road with short streets to its sides; a river brings its own roads."""
    width, depth = size_m
    pitch_m = plan.block_m + plan.street_m
    x = _spaced(width, 1.4 * pitch_m, 0.2, rng)
    sway = 0.0 if plan.river_m else min(0.12 * depth, 0.25 * pitch_m)
    main = np.stack([x, sway * rng.uniform(-1.0, 1.0, len(x))], axis=1)
    lines = [] if plan.river_m else [Line(main, plan.avenue_m)]
    side = 1.0 if rng.random() < 0.5 else -1.0
    if plan.is_shore:
        main[:, 1] -= depth / 2  # in the water, which cuts the side streets
    for number, (a, b) in enumerate(pairwise(main)):
        foot = a + (b - a) * rng.uniform(0.35, 0.65)
        signs = (1.0, -1.0) if plan.river_m or number % 3 == 2 else (side,)
        for sign in (1.0,) if plan.is_shore else signs:
            reach_m = min(depth / 2, pitch_m * rng.uniform(0.9, 1.3))
            if plan.is_shore:
                reach_m = min(depth, reach_m + plan.river_m)
            tip = foot + np.array([rng.uniform(-0.2, 0.2) * reach_m, sign * reach_m])
            lines.append(Line(np.stack([foot, tip]), plan.street_m))
        side = -side
    return lines


PATTERNS: dict[str, Callable[[WorldPlan, Range, np.random.Generator], list[Line]]] = {
    "grid": grid, "radial": radial, "organic": winding, "linear": linear, "campus": winding,
}  # fmt: skip


# --- network ----------------------------------------------------------------------------------------------------------


def network(plan: WorldPlan, size_m: Range, rng: np.random.Generator) -> Network:
    """Return the streets and the water of a town of a size."""
    margin_m = VERGE_M + max(plan.avenue_m, plan.street_m) / 2
    half_x, half_y = size_m[0] / 2, size_m[1] / 2
    inner_m = size_m[0] - 2 * margin_m, size_m[1] - 2 * margin_m
    lines = PATTERNS[plan.pattern](plan, inner_m, rng)
    if not plan.river_m:
        return Network(straight_streets(lines), Polygon(), [])
    window = shapely.box(margin_m - half_x, -half_y, half_x - margin_m, half_y)
    river = _river(plan, size_m, rng)
    width_m = plan.avenue_m if plan.pattern == "linear" else plan.street_m
    crossings = shapely.get_coordinates([shapely.intersection(LineString(line.points), river) for line in lines])
    apart_m = (plan.river_m + width_m) / 2 + 0.3
    banks = _banks(river, apart_m, window)[: 1 if plan.is_shore else 2]  # the northern one first
    lines = _outside_river(lines, river, apart_m, banks, PARALLEL_SHARE * plan.block_m + width_m)
    lines += [Line(np.array(bank.coords), width_m) for bank in banks]
    lines += _bridges(plan, river, banks, crossings, inner_m[0])
    water = shapely.buffer(river, plan.river_m / 2, cap_style="flat", join_style="mitre")
    # The union sets the order of the corners, on which the boxes of the water depend.
    water = shapely.union(Polygon(), shapely.intersection(water, shapely.box(-half_x, -half_y, half_x, half_y)))
    streets = straight_streets(lines)
    bridges = [street for street in streets if water.contains(shapely.Point(street.at(street.length_m / 2, 0)))]
    return Network(streets, water, bridges)


def _river(plan: WorldPlan, size_m: Range, rng: np.random.Generator) -> LineString:
    """Return the middle of a river that sways from the west to the east edge of a town, and leaves it straight.

    The water at a shore is a river along the southern edge.
    """
    x = np.linspace(-size_m[0] / 2, size_m[0] / 2, 6)
    sway = min(0.08 * size_m[1], SHORE_SWAY_M if plan.is_shore else 12.0) * rng.uniform(-1.0, 1.0, len(x))
    sway[0] = sway[1]
    sway[-1] = sway[-2]
    y = rng.uniform(-0.1, 0.1) * size_m[1]
    if plan.is_shore:
        y = (plan.river_m - size_m[1]) / 2 - SHORE_SWAY_M
    return LineString(np.stack([x, y + sway], axis=1))


def _banks(river: LineString, apart_m: float, window: Polygon) -> list[LineString]:
    """Return the middles of the streets along both sides of a river, at a distance from its middle, in a window."""
    sides = [shapely.intersection(river.offset_curve(side * apart_m), window) for side in (1, -1)]
    return [bank for bank in sides if not bank.is_empty]


def _outside_river(
    lines: list[Line], river: LineString, apart_m: float, banks: list[LineString], parallel_m: float
) -> list[Line]:
    """Return the parts of lines up to the banks. Parts that run along a bank within parallel_m are dropped; the lines
    that end at them are extended to the bank."""
    zone = shapely.buffer(river, apart_m, cap_style="flat")
    all_banks = shapely.union_all(banks)
    along_banks = shapely.buffer(all_banks, parallel_m)
    parts = [
        Line(np.array(part.coords), line.width_m)
        for line in lines
        for part in shapely.get_parts(shapely.difference(LineString(line.points), zone))
        if part.length > GRID_M
    ]
    is_dropped = [along_banks.contains(LineString(part.points)) for part in parts]
    dropped = shapely.union_all([LineString(part.points) for part in compress(parts, is_dropped)])
    outside = []
    for (points, width_m), is_out in zip(parts, is_dropped, strict=True):
        if is_out:
            continue
        first, last = (
            shapely.get_coordinates(shapely.shortest_line(all_banks, end))[:1]
            if end.dwithin(dropped, GRID_M) else np.empty((0, 2))
            for end in map(shapely.Point, points[[0, -1]])
        )  # fmt: skip
        outside.append(Line(np.concatenate([first, points, last]), width_m))
    return outside


def _bridges(
    plan: WorldPlan, river: LineString, banks: list[LineString], crossings: np.ndarray, length_m: float
) -> list[Line]:
    """Return straight bridges from bank to bank: where streets cross the river, else evenly spaced."""
    if plan.is_shore or plan.bridges == 0:
        return []
    count = plan.bridges or int(np.clip(len(crossings), 1, 4))
    x = (np.arange(count) + 0.5) / count * length_m - length_m / 2
    if len(crossings):
        nearest = crossings[np.abs(crossings[:, 0] - x[:, None]).argmin(axis=1), 0]
        x = np.unique(np.where(np.abs(nearest - x) < 0.3 * length_m / count, nearest, x))
    lines = []
    for bridge_x in x:
        middle = shapely.intersection(river, LineString([(bridge_x, -1e4), (bridge_x, 1e4)]))
        points = [shapely.get_coordinates(shapely.shortest_line(bank, middle))[0] for bank in banks]
        lines.append(Line(np.array(points), plan.bridge_m or plan.street_m))
    return lines


def straight_streets(lines: list[Line]) -> list[StraightStreet]:
    """Cut lines at their crossings and bends. Where lines coincide, the widest one counts."""
    shapes = np.array([LineString(line.points) for line in lines], dtype=object)
    tree = shapely.STRtree(shapes)
    streets = []
    for part in shapely.get_parts(shapely.union_all(shapes, grid_size=GRID_M)):
        for start, end in pairwise(shapely.get_coordinates(part)):
            if np.linalg.norm(end - start) < GRID_M:
                continue
            line_indices = tree.query(shapely.Point((start + end) / 2), predicate="dwithin", distance=GRID_M)
            streets.append(StraightStreet(start, end, max(lines[k].width_m for k in line_indices)))
    return streets


# --- boxes ------------------------------------------------------------------------------------------------------------


def _joints(streets: list[StraightStreet]) -> tuple[np.ndarray, np.ndarray]:
    """Return, for both ends of each street, the tangent of half the turn and the number of other streets, (n, 2) each.

    The turn is that to the street that continues most straight. Half of it times half the width is the length by which
    both streets are extended, so that their outer edges meet. It is 0 at the end of a single street.
    """
    ends = shapely.points([end for street in streets for end in (street.start, street.end)])
    away = np.array([sign * street.direction for street in streets for sign in (1.0, -1.0)])
    first, second = shapely.STRtree(ends).query(ends, predicate="dwithin", distance=0.01)  # on a grid
    is_pair = first != second
    first, second = first[is_pair], second[is_pair]
    straightest = np.full(len(away), -1.0)  # cosine of the least turn
    np.maximum.at(straightest, first, -(away[first] * away[second]).sum(axis=1))
    counts = np.bincount(first, minlength=len(away))
    turns = np.arccos(np.where(counts, straightest, 1.0).clip(0.0, 1.0))
    return np.tan(turns / 2).reshape(-1, 2), counts.reshape(-1, 2)


def lay_streets(boxes: BoxList, net: Network, parked_share: float, rng: np.random.Generator) -> list[Polygon]:
    """Add the streets with their furniture, and the water with its bridges; return the streets from front to front."""
    tangents, num_others = _joints(net.streets)
    roads = _lay_roads(boxes, net.streets, tangents)
    tree = shapely.STRtree(roads)
    strips = list[Polygon]()
    bridge_strips = list[Polygon]()
    for k, street in enumerate(net.streets):
        half = street.width_m / 2
        dead_end_m = (street.width_m - street.road_m) / 2  # of pavement, which closes it
        before_m, after_m = np.where(num_others[k], half * tangents[k], dead_end_m).tolist()
        strip = rectangle_polygon(street.rectangle((-before_m, street.length_m + after_m), (-half, half)))
        crossing = shapely.union_all([roads[j] for j in tree.query(strip, predicate="intersects") if j != k])
        clear = _clear_of(street, shapely.intersection(strip, crossing))
        pave(boxes, shapely.difference(strip, shapely.union(crossing, roads[k])))
        plot = Plot(boxes.framed(street.start, street.yaw_deg), street.start, street.end, rng)
        has_crossings = num_others[k] > 1
        if street in net.bridges:
            _furnish(plot, street, clear, has_crossings, None)
            line = LineString([street.start, street.end])
            over_water = shapely.get_coordinates(shapely.intersection(line, net.water))
            ends_m = shapely.line_locate_point(line, shapely.points(over_water))
            for side in (-1, 1):
                middle = ((ends_m.min() + ends_m.max()) / 2, side * (street.width_m - RAILING_M) / 2)
                plot.add("Fences", middle, (np.ptp(ends_m), RAILING_M), -SLAB_M, 1.1)
            bridge_strips.append(strip)
        else:
            _furnish(plot, street, clear, has_crossings, parked_share)
        strips.append(strip)
    for polygon in polygons_of(shapely.difference(net.water, shapely.union_all(bridge_strips))):
        for piece in cover(polygon, min_fill=0.97, min_size_m=PIECE_M, max_size_m=400.0):
            boxes.add("Water", piece.center, piece.size, WATER_BOTTOM_M, WATER_TOP_M, piece.yaw_deg)
    return strips


def _lay_roads(boxes: BoxList, streets: list[StraightStreet], tangents: np.ndarray) -> list[Polygon]:
    """Add the carriageways; return their outlines, empty for a street without one."""
    outlines = list[Polygon]()
    for street, (low, high) in zip(streets, tangents, strict=True):
        half = street.road_m / 2
        if half:
            road = street.rectangle((-half * low, street.length_m + half * high), (-half, half))
            boxes.add("Roads", road.center, road.size, ROAD_TOP_M - SLAB_M, ROAD_TOP_M, road.yaw_deg)
            outlines.append(rectangle_polygon(road))
        else:
            outlines.append(Polygon())
    return outlines


def _clear_of(street: StraightStreet, crossed: BaseGeometry) -> Range:
    """Return the longest stretch of a street between the parts of it that other carriageways cross."""
    low, high = 0.0, street.length_m
    for part in polygons_of(crossed):
        along = (shapely.get_coordinates(part) - street.start) @ street.direction
        if (along.min() + along.max()) / 2 < street.length_m / 2:
            low = max(low, float(along.max()))
        else:
            high = min(high, float(along.min()))
    return low, high


def _furnish(
    plot: Plot, street: StraightStreet, clear: Range, has_crossings: np.ndarray, parked_share: float | None
) -> None:
    """Add paint to a street, with crossings at junctions and evenly between them, and furniture.

    has_crossings: (2,) whether there is a crossing at its start and at its end.
    parked_share: of parking places that are taken; None adds no furniture.
    """
    low, high = clear
    edge = street.road_m / 2 if street.road_m else street.width_m / 2 - LANE_EDGE_M
    num_parts = 1 + int(max(0.0, high - low) // BETWEEN_CROSSINGS_M)
    for number, part in enumerate(pairwise(np.linspace(low, high, num_parts + 1).tolist())):
        if part[1] - part[0] < SHORTEST_M:
            continue
        if street.road_m:
            at_start = number == 0 and has_crossings[0]  # the next parts begin where the previous has its crossing
            at_end = number < num_parts - 1 or has_crossings[1]
            add_road_paint(plot, 0, part, (-edge, edge), (at_start, at_end))
        if parked_share is not None:
            furnish(
                plot, 0, part, (-edge, edge), has_road=street.road_m > 0,
                parked_share=parked_share if street.road_m >= LEAST_PARKING_M else 0.0,
                tree_share=TREE_SHARE if street.road_m and street.width_m >= LEAST_AVENUE_M else 0.0,
            )  # fmt: skip


def pave(boxes: BoxList, area: BaseGeometry, piece_m: float = PIECE_M) -> None:
    """Cover an area of any shape with pavement. piece_m: side of pieces that may reach over its edge."""
    for polygon in polygons_of(area):
        for piece in cover(polygon, min_fill=0.95, min_size_m=piece_m, max_size_m=80.0):
            boxes.add("Sidewalks", piece.center, piece.size, PAVED_TOP_M - SLAB_M, PAVED_TOP_M, piece.yaw_deg)
