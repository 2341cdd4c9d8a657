"""Streets to boxes with the yaw of each street: carriageways, pavements, crossings, bridges, furniture.

Pavements are at z = 0, carriageways, paint and the ground below a few centimetres lower, so that no two share a plane.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from cosfly.maps.boxlist import PAVED_TOP_M, ROAD_TOP_M, SLAB_M, BoxList
from cosfly.maps.footprints import cover, polygons_of, rectangle_polygon
from cosfly.maps.town_parts import (
    RAILING_M,
    WATER_BOTTOM_M,
    WATER_TOP_M,
    Plot,
    Range,
    add_road_paint,
    furnish,
)
from cosfly.worldgen.patterns import Network, StraightStreet

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
