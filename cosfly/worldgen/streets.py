"""Streets to boxes with the yaw of each street: carriageways, pavements, crossings, bridges, furniture.

Pavements are at z = 0, carriageways, paint and the ground below a few centimetres lower, so that no two share a plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from cosfly.maps.boxlist import BoxList
from cosfly.maps.footprints import Rectangle, cover, polygons_of, rectangle_polygon
from cosfly.maps.town_blocks import ROAD_TOP_M, SLAB_M, TOPS_M, WATER_TOP_M
from cosfly.worldgen.patterns import Network, Size, StraightStreet

GROUND_TOP_M = ROAD_TOP_M - 0.02  # two centimetres: a depth buffer separates them at 300 m
PAINT_TOP_M = ROAD_TOP_M + 0.03
WATER_BOTTOM_M = -1.2
PIECE_M = 2.0  # smallest rectangles that fill a corner
CROSSING_M = 3.0  # width of a zebra crossing
CROSSING_FROM_CORNER_M = 1.0
BETWEEN_CROSSINGS_M = 70.0
DASH_M, DASH_STEP_M = 3.0, 9.0
FURNITURE_STEP_M = 8.0
PARKING_STEP_M, PARKED_FROM_KERB_M = 6.6, 1.15
TRUCK_SHARE = 0.06  # of parked cars
RAILING_M = 0.2


@dataclass(frozen=True)
class Stretch:
    """A street with its ends. reach_m: how far its front-to-front strip extends before start and after end.

    clear: the stretch along it without carriageways of other streets. crossings: middles of zebra crossings.
    """

    street: StraightStreet
    reach_m: Size
    clear: Size
    crossings: list[float]

    @property
    def strip(self) -> Polygon:
        """The whole street, from front to front."""
        return rectangle_polygon(self.part(-self.reach_m[0], self.street.length_m + self.reach_m[1]))

    def part(self, low_m: float, high_m: float) -> Rectangle:
        """Return a part of the street, from front to front."""
        half = self.street.width_m / 2
        return self.street.rectangle((low_m, high_m), (-half, half))


def _ends(streets: list[StraightStreet]) -> list[tuple[list[float], list[int]]]:
    """Return of each street the tangent of half the turn at either end, and the number of other streets there.

    A street that ends there alone has the tangent 0.
    """
    arms: dict[tuple[float, ...], list[tuple[int, np.ndarray]]] = {}
    keys = [[tuple(np.round(end, 1) + 0.0) for end in (street.start, street.end)] for street in streets]
    for number, street in enumerate(streets):
        for key, away in zip(keys[number], (street.direction, -street.direction), strict=True):
            arms.setdefault(key, []).append((number, away))
    found = []
    for number, street in enumerate(streets):
        tangents, counts = list[float](), list[int]()
        for key, away in zip(keys[number], (street.direction, -street.direction), strict=True):
            others = [other for k, other in arms[key] if k != number]
            straightest = max((float(-away @ other) for other in others), default=1.0)
            turn = math.acos(min(1.0, max(0.0, straightest)))
            tangents.append(math.tan(turn / 2))
            counts.append(len(others))
        found.append((tangents, counts))
    return found


def lay_streets(boxes: BoxList, net: Network) -> list[Stretch]:
    """Add carriageways, pavements, crossings and the water with its bridges; return the streets as they lie."""
    roads = list[BaseGeometry]()
    ends = _ends(net.streets)
    for street, (tangents, _) in zip(net.streets, ends, strict=True):
        half, low, high = (street.road_m / 2 * factor for factor in (1.0, *tangents))
        road = street.rectangle((-low, street.length_m + high), (-half, half))
        roads.append(rectangle_polygon(road) if half else Polygon())
        if half:
            _lay(boxes, "Roads", road)
    tree = shapely.STRtree(roads)
    stretches = []
    for number, (street, (tangents, counts)) in enumerate(zip(net.streets, ends, strict=True)):
        half, dead_end_m = street.width_m / 2, (street.width_m - street.road_m) / 2  # which pavement closes
        first, last = (half * t if count else dead_end_m for t, count in zip(tangents, counts, strict=True))
        whole = Stretch(street, (first, last), (0.0, street.length_m), [])
        others = shapely.union_all([roads[k] for k in tree.query(whole.strip, predicate="intersects") if k != number])
        clear = _clear_of(street, shapely.intersection(whole.strip, others))
        stretches.append(replace(whole, clear=clear, crossings=_crossings(street, clear, counts)))
        _add_pavements(boxes, stretches[-1], shapely.union(others, roads[number]))
        _add_paint(boxes, stretches[-1])
    water = shapely.difference(
        net.water, shapely.union_all([one.strip for one in stretches if one.street in net.bridges])
    )
    for polygon in polygons_of(water):
        for piece in cover(polygon, min_fill=0.97, min_size_m=PIECE_M, max_size_m=400.0):
            boxes.add("Water", piece.center, piece.size, WATER_BOTTOM_M, WATER_TOP_M, piece.yaw_deg)
    for street in net.bridges:
        for side in (-1, 1):
            place = street.length_m / 2, side * (street.width_m - RAILING_M) / 2
            add_along(boxes, street, "Fences", place, (street.length_m, RAILING_M), -SLAB_M, 1.1)
    return stretches


def _clear_of(street: StraightStreet, crossed: BaseGeometry) -> Size:
    """Return the longest stretch of a street between the parts of it that other carriageways cross."""
    low, high = 0.0, street.length_m
    for part in polygons_of(crossed):
        along = (shapely.get_coordinates(part) - street.start) @ street.direction
        if (along.min() + along.max()) / 2 < street.length_m / 2:
            low = max(low, float(along.max()))
        else:
            high = min(high, float(along.min()))
    return low, high


def _crossings(street: StraightStreet, clear: Size, counts: list[int]) -> list[float]:
    """Return the middles of the zebra crossings along a street: at its junctions, and evenly between them."""
    low, high = clear
    if not street.road_m or high - low < 4 * CROSSING_M:
        return []
    edge_m = CROSSING_FROM_CORNER_M + CROSSING_M / 2
    between = int((high - low) // BETWEEN_CROSSINGS_M)
    places = np.linspace(low, high, between + 2)[1:-1].tolist()
    return [low + edge_m] * (counts[0] > 1) + places + [high - edge_m] * (counts[1] > 1)


def _add_pavements(boxes: BoxList, stretch: Stretch, roads: BaseGeometry) -> None:
    """Add what is not carriageway of a street: two strips where it is clear, pieces of any shape at its ends."""
    street, (low, high) = stretch.street, stretch.clear
    half, kerb = street.width_m / 2, street.road_m / 2
    first, last = -stretch.reach_m[0], street.length_m + stretch.reach_m[1]
    if high - low > PIECE_M:
        for across in ((-half, -kerb), (kerb, half)) if kerb else ((-half, half),):
            _lay(boxes, "Sidewalks", street.rectangle((low, high), across))
    else:
        low = high = first
    for part in ((first, low), (high, last)):
        if part[1] > part[0]:
            pave(boxes, shapely.difference(rectangle_polygon(stretch.part(*part)), roads))


def pave(boxes: BoxList, area: BaseGeometry, piece_m: float = PIECE_M) -> None:
    """Cover an area of any shape with pavement. piece_m: side of pieces that may reach over its edge."""
    for polygon in polygons_of(area):
        for piece in cover(polygon, min_fill=0.9, min_size_m=piece_m, max_size_m=80.0):
            _lay(boxes, "Sidewalks", piece)


def _lay(boxes: BoxList, kind: str, piece: Rectangle) -> None:
    """Add ground at the height of its kind."""
    boxes.add(kind, piece.center, piece.size, TOPS_M[kind] - SLAB_M, TOPS_M[kind], piece.yaw_deg)


def add_along(
    boxes: BoxList,
    street: StraightStreet,
    kind: str,
    place: tuple[float, float],
    size: Size,
    low_m: float,
    high_m: float,
) -> None:
    """Add a box at a place along and across a street, with the street's yaw."""
    boxes.add(kind, street.at(*place), size, low_m, high_m, street.yaw_deg)


def _add_paint(boxes: BoxList, stretch: Stretch) -> None:
    """Add the stripes of crossings, and dashes between them."""
    street, (low, high) = stretch.street, stretch.clear
    if not street.road_m:
        return
    edge = street.road_m / 2 - 0.4
    stripes = np.linspace(-edge, edge, 1 + round(2 * edge / 1.1))
    paint = [(at, across, CROSSING_M, 0.55) for at in stretch.crossings
             for across in stripes]  # fmt: skip
    paint += [
        (at, 0.0, DASH_M, 0.16) for at in np.arange(low + 8.0, high - 8.0, DASH_STEP_M)
        if all(abs(at - crossing) > CROSSING_M + 1.0 for crossing in stretch.crossings)
    ]  # fmt: skip
    for along, across, length_m, width_m in paint:
        add_along(boxes, street, "RoadLines", (along, across), (length_m, width_m), ROAD_TOP_M - 0.04, PAINT_TOP_M)


def furnish(boxes: BoxList, stretch: Stretch, parked_share: float, rng: np.random.Generator) -> None:
    """Add lamps, benches, trees, signs and parked cars along a street, clear of its crossings."""
    street, (low, high) = stretch.street, stretch.clear
    kerb = street.road_m / 2
    edge = kerb + 1.0 if kerb else street.width_m / 2 - 0.6
    for side in (-1, 1):
        for number, along in enumerate(np.arange(low + 9.0, high - 8.0, FURNITURE_STEP_M)):
            place = along, side * edge
            if any(abs(along - crossing) < CROSSING_M for crossing in stretch.crossings):
                continue
            if number % 3 == 0:
                add_along(boxes, street, "Poles", place, (0.2, 0.2), 0.0, 7.6 if kerb else 4.0)
                if kerb:  # over the carriageway
                    add_along(boxes, street, "Poles", (along, side * (kerb + 0.1)), (0.16, 2.0), 7.45, 7.6)
            elif number % 3 == 1 and kerb and street.width_m >= 14.0 and rng.random() < 0.7:
                crown_m = rng.uniform(2.6, 3.8)
                add_along(boxes, street, "Vegetation", place, (crown_m, crown_m), 0.0, rng.uniform(5.5, 9.0))
            elif rng.random() < 0.4 and (kerb or street.width_m >= 4.0):
                add_along(boxes, street, "Static", place, (1.8, 0.55), 0.0, 0.48)
        if street.road_m < 6.0:
            continue
        for along in np.arange(low + 9.5, high - 11.0, PARKING_STEP_M):
            is_clear = all(abs(along - crossing) > CROSSING_M + 3.0 for crossing in stretch.crossings)
            if rng.random() < parked_share and is_clear:
                kind, size, top = ("Truck", (6.2, 2.2), 2.7) if rng.random() < TRUCK_SHARE else (
                    "Car", (rng.uniform(4.0, 4.7), 1.8), rng.uniform(1.4, 1.65))  # fmt: skip
                add_along(boxes, street, kind, (along, side * (kerb - PARKED_FROM_KERB_M)), size, ROAD_TOP_M, top)
