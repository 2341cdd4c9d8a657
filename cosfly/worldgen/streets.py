"""The streets of a town: their centre lines from a pattern, a river and bridges, and all of them as boxes.

A pattern returns lines; `straight_streets` cuts them at their crossings and bends. Coordinates are m, the origin is the
middle of the town, +x is east and +y north. Boxes have the yaw of their street. Pavements are at z = 0, carriageways,
paint and the ground below a few centimetres lower, so that no two share a plane.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from cosfly.maps.boxlist import PAVED_TOP_M, ROAD_TOP_M, SLAB_M, BoxList
from cosfly.maps.footprints import Rectangle, cover, polygons_of, rectangle_polygon
from cosfly.maps.town_parts import RAILING_M, WATER_BOTTOM_M, WATER_TOP_M, Plot, add_road_paint, furnish
from cosfly.worldgen.plan import PATH_M, VERGE_M, Range, WorldPlan

LANE_M = 9.0  # narrower streets have no carriageway
WIDE_M = 26.0  # wider streets have wide pavements
PARALLEL_M = 16.0  # a street that is nearer to a bank or to the promenade all along is dropped
GRID_M = 0.05  # of the ends of streets


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
        pavement_m = 6.0 if self.width_m >= WIDE_M else max(2.5, 0.22 * self.width_m)
        return self.width_m - 2 * pavement_m if self.width_m >= LANE_M else 0.0

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
    """Streets, water and bridges of a town. bridges: the streets of `streets` that cross the river."""

    streets: list[StraightStreet]
    water: BaseGeometry
    bridges: list[StraightStreet]


def _spaced(length_m: float, pitch_m: float, unevenness: float, rng: np.random.Generator) -> np.ndarray:
    """Return places from -length_m / 2 to length_m / 2, about pitch_m apart."""
    shares = 1.0 + unevenness * rng.uniform(-1.0, 1.0, max(1, round(length_m / pitch_m)))
    return np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * length_m - length_m / 2


def grid(plan: WorldPlan, size_m: Range, rng: np.random.Generator) -> list[Line]:
    """Return streets at right angles; the proportions of blocks, the avenues and the offsets of rows vary."""
    stretch = rng.uniform(0.75, 1.35)
    pitch_x, pitch_y = plan.block_m * stretch + plan.street_m, plan.block_m / stretch + plan.street_m
    rows = _spaced(size_m[1], pitch_y, plan.unevenness, rng)
    columns = _spaced(size_m[0], pitch_x, plan.unevenness, rng)
    is_staggered = rng.random() < 0.4
    avenues = rng.integers(len(rows)), rng.integers(len(columns))
    lines = [
        Line(np.array([[columns[0], y], [columns[-1], y]]), plan.avenue_m if k == avenues[0] else plan.street_m)
        for k, y in enumerate(rows)
    ]
    for band, (low, high) in enumerate(pairwise(rows)):
        shift = (columns[1] - columns[0]) / 2 if is_staggered and band % 2 else 0.0
        for k, x in enumerate(columns):
            is_inner = 0 < k < len(columns) - 1
            at = x - shift if is_inner else x
            width_m = plan.avenue_m if k == avenues[1] and not is_staggered else plan.street_m
            lines.append(Line(np.array([[at, low], [at, high]]), width_m))
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
    lines = []
    for number, radius in enumerate(radii):
        arc_m = 2 * math.pi * radius * half.min() / len(angles)
        if number and arc_m > 1.7 * (plan.block_m + plan.street_m):  # streets between the avenues, from here outwards
            gaps = np.diff(angles, append=angles[0] + 2 * math.pi)
            between = angles + gaps / 2
            lines += [Line(_polar(between[k], [radii[number], 1.0], half), plan.street_m) for k in range(len(between))]
            angles = np.sort(np.concatenate([angles, between]))
        lines.append(Line(_polar(np.append(angles, angles[0]), radius, half), plan.street_m))
        if not number:
            lines += [Line(_polar(angle, [inner, 1.0], half), plan.avenue_m) for angle in angles]
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
    x, y = np.meshgrid(*(np.arange(-2, count + 2) for count in counts))
    seeds = np.stack([x + 0.5 + 0.25 * (2 * (y % 2) - 1), y + 0.5], axis=-1).reshape(-1, 2)  # in staggered rows
    seeds = (seeds + 0.33 * rng.uniform(-1.0, 1.0, seeds.shape)) * (2 * half / counts) - half
    cells = shapely.get_parts(shapely.voronoi_polygons(shapely.multipoints(seeds)))
    cells = cells[shapely.contains(shapely.box(*(-half), *half), shapely.centroid(cells))]
    corners = list[np.ndarray]()  # those nearer to each other than a share of the pitch are one
    sides: dict[tuple[int, int], int] = {}  # the number of cells at each edge
    for cell in cells:
        ring = []
        for point in np.clip(shapely.get_coordinates(cell), -half, half):
            away_m = np.linalg.norm(np.array(corners).reshape(-1, 2) - point, axis=1)
            near = np.flatnonzero(away_m < 0.3 * pitch_m).tolist()
            ring.append(near[0] if near else len(corners))
            corners += [] if near else [point]
        for edge in {(min(ends), max(ends)) for ends in pairwise(ring) if ends[0] != ends[1]}:
            sides[edge] = sides.get(edge, 0) + 1
    lines = []
    for (a, b), num_cells in sides.items():
        across = np.array([[0.0, -1.0], [1.0, 0.0]]) @ (corners[b] - corners[a])
        bend = (corners[a] + corners[b]) / 2 + across * float(np.clip(rng.normal(0.0, 0.12), -0.2, 0.2))
        points = np.stack([corners[a], np.clip(bend, -half, half), corners[b]])
        lines.append(Line(points, outer_m if num_cells == 1 else inner_m))
    return lines


def linear(plan: WorldPlan, size_m: Range, rng: np.random.Generator) -> list[Line]:
    """Return one long road with short streets to its sides; a river brings its own roads."""
    width, depth = size_m
    pitch_m = plan.block_m + plan.street_m
    x = _spaced(width, 1.4 * pitch_m, 0.2, rng)
    sway = 0.0 if plan.river_m else min(0.12 * depth, 0.25 * pitch_m)
    main = np.stack([x, sway * rng.uniform(-1.0, 1.0, len(x))], axis=1)
    lines = [] if plan.river_m else [Line(main, plan.avenue_m)]
    side = 1.0 if rng.random() < 0.5 else -1.0
    for number, (a, b) in enumerate(pairwise(main)):
        foot = a + (b - a) * rng.uniform(0.35, 0.65)
        for way in (1.0, -1.0) if plan.river_m or number % 3 == 2 else (side,):
            reach_m = min(depth / 2, pitch_m * rng.uniform(0.9, 1.3))
            tip = foot + np.array([rng.uniform(-0.2, 0.2) * reach_m, way * reach_m])
            lines.append(Line(np.stack([foot, tip]), plan.street_m))
        side = -side
    return lines


PATTERNS: dict[str, Callable[[WorldPlan, Range, np.random.Generator], list[Line]]] = {
    "grid": grid, "radial": radial, "organic": winding, "linear": linear, "campus": winding,
}  # fmt: skip


def network(plan: WorldPlan, size_m: Range, rng: np.random.Generator) -> Network:
    """Return the streets and the water of a town of a size."""
    margin_m = VERGE_M + max(plan.avenue_m, plan.street_m) / 2
    half_x, half_y = size_m[0] / 2, size_m[1] / 2
    inner = size_m[0] - 2 * margin_m, size_m[1] - 2 * margin_m
    lines = PATTERNS[plan.pattern](plan, inner, rng)
    window = shapely.box(margin_m - half_x, -half_y, half_x - margin_m, half_y)
    water: BaseGeometry = Polygon()
    bridges: list[Line] = []
    if plan.river_m:
        x = np.linspace(-half_x, half_x, 6)
        sway = min(0.08 * size_m[1], 12.0) * rng.uniform(-1.0, 1.0, len(x))
        sway[0], sway[-1] = sway[1], sway[-2]
        river = LineString(np.stack([x, rng.uniform(-0.1, 0.1) * size_m[1] + sway], axis=1))
        width_m = plan.avenue_m if plan.pattern == "linear" else plan.street_m
        crossings = shapely.get_coordinates([shapely.intersection(LineString(line.points), river) for line in lines])
        lines, banks = _with_banks(lines, river, (plan.river_m + width_m) / 2 + 0.3, width_m, window)
        bridges = _bridges(plan, river, banks, crossings, inner[0])
        water = shapely.union(water, shapely.buffer(river, plan.river_m / 2, cap_style="flat", join_style="mitre"))
    streets = straight_streets([*lines, *bridges])
    crossing = [
        street for street in streets if bridges and water.contains(shapely.Point(street.at(street.length_m / 2, 0)))
    ]
    return Network(streets, water, crossing)


def _with_banks(
    lines: list[Line], course: LineString, apart_m: float, width_m: float, window: Polygon
) -> tuple[list[Line], list[LineString]]:
    """Return lines up to streets along both sides of a water, with these streets; and those of them in the window."""
    sides = [shapely.intersection(course.offset_curve(side * apart_m), window) for side in (1, -1)]
    banks = [bank for bank in sides if not bank.is_empty]
    zone = shapely.buffer(course, apart_m, cap_style="flat")
    near = shapely.buffer(shapely.union_all(banks), PARALLEL_M)  # streets that lie in it are dropped
    outside = [
        Line(np.array(part.coords), line.width_m)
        for line in lines
        for part in shapely.get_parts(shapely.difference(LineString(line.points), zone))
        if part.length > GRID_M and not near.contains(part)
    ]
    return [*outside, *(Line(np.array(bank.coords), width_m) for bank in banks)], banks


def _bridges(
    plan: WorldPlan, river: LineString, banks: list[LineString], crossings: np.ndarray, length_m: float
) -> list[Line]:
    """Return straight bridges from bank to bank: where streets cross the river, else evenly spaced."""
    count = plan.bridges or int(np.clip(len(crossings), 1, 4))
    x = (np.arange(count) + 0.5) / count * length_m - length_m / 2
    if len(crossings):
        nearest = crossings[np.abs(crossings[:, 0] - x[:, None]).argmin(axis=1), 0]
        x = np.unique(np.where(np.abs(nearest - x) < 0.3 * length_m / count, nearest, x))
    lines = []
    for place in x:
        middle = shapely.intersection(river, LineString([(place, -1e4), (place, 1e4)]))
        points = [shapely.get_coordinates(shapely.shortest_line(bank, middle))[0] for bank in banks]
        lines.append(Line(np.array(points), plan.street_m))
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
            of = tree.query(shapely.Point((start + end) / 2), predicate="dwithin", distance=0.05)
            streets.append(StraightStreet(start, end, max(lines[k].width_m for k in of)))
    return streets


# --- boxes ------------------------------------------------------------------------------------------------------------

GROUND_TOP_M = ROAD_TOP_M - 0.02  # two centimetres: a depth buffer separates them at 300 m
PIECE_M = 2.0  # smallest rectangles that fill a corner
BETWEEN_CROSSINGS_M = 70.0
SHORTEST_M = 12.0  # shorter parts of streets have neither crossings nor furniture
LANE_EDGE_M = 1.6  # from the front of a lane without carriageway to where its kerb would be
LEAST_PARKING_M, LEAST_AVENUE_M = 6.0, 14.0  # narrower carriageways have no parked cars, narrower streets no trees
TREE_SHARE = 0.7  # of places of street trees that are planted


def _ends(streets: list[StraightStreet]) -> tuple[np.ndarray, np.ndarray]:
    """Return of both ends of each street the tangent of half the turn, and the number of other streets, (n, 2) each.

    A street that ends there alone has the tangent 0.
    """
    places = shapely.points([end for street in streets for end in (street.start, street.end)])
    away = np.array([sign * street.direction for street in streets for sign in (1.0, -1.0)])
    one, other = shapely.STRtree(places).query(places, predicate="dwithin", distance=0.01)  # on a grid
    one, other = one[one != other], other[one != other]
    straightest = np.full(len(away), -1.0)
    np.maximum.at(straightest, one, -(away[one] * away[other]).sum(axis=1))
    counts = np.bincount(one, minlength=len(away))
    turns = np.arccos(np.where(counts, straightest, 1.0).clip(0.0, 1.0))
    return np.tan(turns / 2).reshape(-1, 2), counts.reshape(-1, 2)


def lay_streets(boxes: BoxList, net: Network, parked_share: float, rng: np.random.Generator) -> list[Polygon]:
    """Add the streets with their furniture, and the water with its bridges; return the streets from front to front."""
    roads = list[Polygon]()
    tangents, counts = _ends(net.streets)
    for street, (low, high) in zip(net.streets, tangents, strict=True):
        half = street.road_m / 2
        road = street.rectangle((-half * low, street.length_m + half * high), (-half, half))
        roads.append(rectangle_polygon(road) if half else Polygon())
        if half:
            boxes.add("Roads", road.center, road.size, ROAD_TOP_M - SLAB_M, ROAD_TOP_M, road.yaw_deg)
    tree = shapely.STRtree(roads)
    strips = list[Polygon]()
    for number, street in enumerate(net.streets):
        half, dead_end_m = street.width_m / 2, (street.width_m - street.road_m) / 2  # which pavement closes
        first, last = np.where(counts[number], half * tangents[number], dead_end_m).tolist()
        strip = rectangle_polygon(street.rectangle((-first, street.length_m + last), (-half, half)))
        others = shapely.union_all([roads[k] for k in tree.query(strip, predicate="intersects") if k != number])
        clear = _clear_of(street, shapely.intersection(strip, others))
        pave(boxes, shapely.difference(strip, shapely.union(others, roads[number])))
        plot = Plot(boxes.framed(street.start, street.yaw_deg), street.start, street.end, rng)
        _furnish(plot, street, clear, counts[number] > 1, parked_share if street not in net.bridges else None)
        for side in (-1, 1) if street in net.bridges else ():
            railing = (street.length_m / 2, side * (street.width_m - RAILING_M) / 2), (street.length_m, RAILING_M)
            plot.add("Fences", *railing, -SLAB_M, 1.1)
        strips.append(strip)
    bridges = [strip for street, strip in zip(net.streets, strips, strict=True) if street in net.bridges]
    for polygon in polygons_of(shapely.difference(net.water, shapely.union_all(bridges))):
        for piece in cover(polygon, min_fill=0.97, min_size_m=PIECE_M, max_size_m=400.0):
            boxes.add("Water", piece.center, piece.size, WATER_BOTTOM_M, WATER_TOP_M, piece.yaw_deg)
    return strips


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
    plot: Plot, street: StraightStreet, clear: Range, are_crossings: np.ndarray, parked_share: float | None
) -> None:
    """Add paint to a street, with crossings at junctions and evenly between them, and furniture; None: no furniture."""
    low, high = clear
    edge = street.road_m / 2 or street.width_m / 2 - LANE_EDGE_M
    num_parts = 1 + int(max(0.0, high - low) // BETWEEN_CROSSINGS_M)
    for number, part in enumerate(pairwise(np.linspace(low, high, num_parts + 1).tolist())):
        if part[1] - part[0] < SHORTEST_M:
            continue
        if street.road_m:
            crossings = number == 0 and are_crossings[0], number < num_parts - 1 or are_crossings[1]
            add_road_paint(plot, 0, part, (-edge, edge), crossings)
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
