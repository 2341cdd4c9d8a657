"""Polygons to oriented rectangles: a polygon is cut in two until the rectangle around each piece is nearly full.

With them `with_derived_ground` lays ground into a map of buildings without streets. The map's header counts its boxes
(`derived_ground`), and its credits, that every release repeats, say so.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS, PAVED_KINDS
from cosfly.geometry.axes import box_corners
from cosfly.geometry.grid import blocks_walking
from cosfly.maps.boxlist import BoxList
from cosfly.runtime.io import over_limit

log = logging.getLogger(__name__)

MIN_AREA_M2 = 0.02  # smaller pieces are rounding errors of a cut
THINNEST_M = 1e-3  # thinner rectangles are rounding errors too
MOST_CROSSINGS = 500  # of an outline with itself; 1,000 take a second to resolve
PAIRS_AT_ONCE = 1_000_000  # pairs of edges that are compared before the count is checked
MOST_NEW_CORNERS = 50_000  # of merged outlines that cross each other
MAX_DEPTH = 16  # of cuts
# Pieces of a polygon by its outline, and by its area: a larger one gets larger pieces. Cuts at shares take longer.
MOST_PIECES, MOST_PIECES_OF_SHARES = 1_000, 400
CUT_SHARES = (0.25, 0.4, 0.5, 0.6, 0.75)  # where houses may be cut

# Derived ground.
PAVEMENT_M = 2.5  # pedestrians keep half a metre from walls
NEAR_M = 25.0  # asphalt lies between facades up to this far apart
NARROW_M = 4.0  # narrower asphalt is a leftover of corners
VERGE_M = 10.0  # of lawn around the map
GROUND_SLAB_M, LAWN_TOP_M = 0.3, -0.1  # asphalt and pavement lie in the ground's plane
CREDITS = "Streets, pavements and lawn are derived by cosfly from the buildings, not mapped."

Interval = tuple[float, float]
WHOLE: Interval = (-0.6, 0.6)  # of a rectangle, and a little more


class Rectangle(NamedTuple):
    """A turned rectangle: centre, full sizes (the first along the yaw direction), m."""

    center: tuple[float, float]
    size: tuple[float, float]
    yaw_deg: float


def polygons_of(geometry: BaseGeometry) -> list[Polygon]:
    """Return the polygons with an area in any geometry."""
    if isinstance(geometry, Polygon):
        return [geometry] if geometry.area > MIN_AREA_M2 else []
    return [part for child in getattr(geometry, "geoms", ()) for part in polygons_of(child)]


def oriented_rectangle(polygon: Polygon) -> Rectangle:
    """Return the smallest rectangle around a polygon; one of its sides lies along a side of the convex hull."""
    hull = np.asarray(polygon.convex_hull.exterior.coords)
    edges = np.diff(hull, axis=0)
    angles = np.unique(np.round(np.mod(np.arctan2(edges[:, 1], edges[:, 0]), np.pi / 2), 9))
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    along = cos * hull[:, 0] + sin * hull[:, 1]  # (angles, corners): the hull in the axes of each angle
    across = cos * hull[:, 1] - sin * hull[:, 0]
    sizes = np.stack([np.ptp(along, axis=1), np.ptp(across, axis=1)], axis=1)
    best = int(np.argmin(sizes.prod(axis=1)))
    middle_along = (along[best].min() + along[best].max()) / 2
    middle_across = (across[best].min() + across[best].max()) / 2
    c, s = float(cos[best, 0]), float(sin[best, 0])
    center = (c * middle_along - s * middle_across, s * middle_along + c * middle_across)
    return Rectangle(center, (float(sizes[best, 0]), float(sizes[best, 1])), float(np.degrees(angles[best])))


def footprints(box_map: BoxMap) -> np.ndarray:
    """Return the footprint of every upright box as a polygon, (n,)."""
    corners = box_corners(box_map.centers, box_map.half_extents, np.radians(box_map.rotations_deg[:, 1]))
    return shapely.polygons(corners[:, [0, 2, 6, 4], :2])


def rectangle_polygon(rectangle: Rectangle, along: Interval = (-0.5, 0.5), across: Interval = (-0.5, 0.5)) -> Polygon:
    """Return a rectangle as a polygon, or its part within intervals, in shares of its sizes from the middle."""
    yaw = np.radians(rectangle.yaw_deg)
    x = np.array([np.cos(yaw), np.sin(yaw)]) * rectangle.size[0]
    y = np.array([-np.sin(yaw), np.cos(yaw)]) * rectangle.size[1]
    corners = ((along[0], across[0]), (along[1], across[0]), (along[1], across[1]), (along[0], across[1]))
    return Polygon([np.array(rectangle.center) + a * x + b * y for a, b in corners])


def cover(
    polygon: Polygon,
    *,
    min_fill: float,
    min_size_m: float,
    max_size_m: float = np.inf,
    shares: Sequence[float] = (0.5,),
) -> list[Rectangle]:
    """Cover a valid polygon, but not its holes and pieces below MIN_AREA_M2, with oriented rectangles.

    A piece is done when its rectangle's longer side is at most `min_size_m`, or at most `max_size_m` and the piece
    fills it to `min_fill`. Otherwise it is cut in two across the longer side. With several shares it may also be cut
    across the other side, and the cut that leaves the least empty area is chosen. Both sizes grow with a very large
    polygon, so that a few corners cannot ask for a million pieces.
    """
    min_size_m, max_size_m = _sizes_for(polygon, min_size_m, max_size_m, shares)
    done: list[Rectangle] = []
    waiting = [(piece, 0) for piece in polygons_of(polygon)]
    while waiting:
        piece, depth = waiting.pop()
        rectangle = oriented_rectangle(piece)
        area = rectangle.size[0] * rectangle.size[1]
        longest = max(rectangle.size)
        is_full = piece.area >= min_fill * area and longest <= max_size_m
        if not (is_full or area <= MIN_AREA_M2 or longest <= min_size_m or depth == MAX_DEPTH):
            waiting += [(part, depth + 1) for part in _cut(piece, rectangle, shares)]
        elif min(rectangle.size) > THINNEST_M:
            done.append(rectangle)
    return done


def _sizes_for(polygon: Polygon, min_size_m: float, max_size_m: float, shares: Sequence[float]) -> tuple[float, float]:
    most = MOST_PIECES if len(shares) == 1 else MOST_PIECES_OF_SHARES
    min_size_m = max(min_size_m, polygon.length / most)
    return min_size_m, max(max_size_m, min_size_m, float(np.sqrt(abs(polygon.area) / most)))  # negative if invalid


def num_cuts(polygon: Polygon, min_size_m: float, max_size_m: float, shares: Sequence[float]) -> float:
    """Estimate the cuts that `cover` tries besides those at corners: along slanted edges and of large areas."""
    min_size_m, max_size_m = _sizes_for(polygon, min_size_m, max_size_m, shares)
    yaw = np.radians(oriented_rectangle(polygon).yaw_deg) if polygon.area > 0 else 0.0
    axes = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    rings = [np.asarray(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors)]
    slanted_m = sum(float(np.abs(np.diff(ring, axis=0) @ axes).min(axis=1).sum()) for ring in rings)
    return len(shares) * (2 * slanted_m / min_size_m + polygon.area / max_size_m**2)


def _cut(piece: Polygon, rectangle: Rectangle, shares: Sequence[float]) -> list[Polygon]:
    """Cut a piece at one of the shares of its rectangle; see `cover`."""
    longer = 0 if rectangle.size[0] >= rectangle.size[1] else 1
    if len(shares) == 1:
        return _cut_at(piece, rectangle, longer, shares[0])
    least_m2 = np.inf
    best: list[Polygon] = []
    for axis in (longer, 1 - longer):
        for share in shares:
            parts = _cut_at(piece, rectangle, axis, share)
            empty_m2 = sum(float(np.prod(oriented_rectangle(part).size)) for part in parts) - piece.area
            if empty_m2 < least_m2 - 1e-9:
                least_m2 = empty_m2
                best = parts
    return best


def _cut_at(piece: Polygon, rectangle: Rectangle, axis: int, share: float) -> list[Polygon]:
    """Cut a piece across a side of its rectangle, 0 or 1, at a share of the side."""
    parts: list[Polygon] = []
    for interval in ((WHOLE[0], share - 0.5), (share - 0.5, WHOLE[1])):
        along, across = (interval, WHOLE) if axis == 0 else (WHOLE, interval)
        parts += polygons_of(shapely.intersection(piece, rectangle_polygon(rectangle, along, across)))
    return parts


def check_outline(polygon: Polygon, where: str) -> None:
    """Reject an outline with so many crossings that making it valid would take minutes and gigabytes."""
    if not polygon.is_valid and num_crossings(polygon) > MOST_CROSSINGS:
        most = f"{MOST_CROSSINGS:,} crossings"
        raise over_limit(where, f"an outline with more than {most}", most, "correct the outline")


def num_crossings(polygon: Polygon) -> int:
    """Count the pairs of edges that meet and are not neighbours in a ring; stop soon after MOST_CROSSINGS."""
    rings = [shapely.get_coordinates(ring) for ring in (polygon.exterior, *polygon.interiors)]
    ends = np.concatenate([np.stack([ring[:-1], ring[1:]], axis=1) for ring in rings])
    edges = shapely.linestrings(ends[(ends[:, 0] != ends[:, 1]).any(axis=1)])
    tree = shapely.STRtree(edges)
    num_pairs = -3 * len(edges)  # each edge meets itself and its two neighbours
    step = max(1, PAIRS_AT_ONCE // max(1, len(edges)))
    for start in range(0, len(edges), step):
        num_pairs += len(tree.query(edges[start : start + step], predicate="intersects")[0])
        if num_pairs > 2 * MOST_CROSSINGS:
            break
    return max(0, num_pairs // 2)


def united(polygons: list[Polygon]) -> BaseGeometry:
    """Merge polygons that may be invalid; raise InputError if they cross so often that the result is vast."""
    if not polygons:
        return MultiPolygon()
    merged = shapely.union_all(shapely.make_valid(np.array(polygons, dtype=object)))
    num_corners = shapely.count_coordinates(merged)
    if num_corners > max(MOST_NEW_CORNERS, 3 * shapely.count_coordinates(polygons)):
        most = f"{MOST_NEW_CORNERS:,} corners, or three times as many as before"
        raise over_limit("map", f"outlines that cross at {num_corners:,} corners", most, "correct the outlines")
    return merged


# --- derived ground: pavement along facades, asphalt between near buildings, lawn elsewhere ---------------------------


def credits_with(sentence: str, credits: str) -> str:
    """Return credits with a sentence about what cosfly added."""
    return f"{credits.rstrip('. ')}. {sentence}".removeprefix(". ")


def with_derived_ground(box_map: BoxMap) -> BoxMap:
    """Return a map with derived ground; the same map if it has streets, pavements or squares, or no buildings."""
    standing = box_map.select(blocks_walking(box_map) & (box_map.kinds == KINDS["Buildings"]))
    if len(standing) == 0 or box_map.is_any_of(PAVED_KINDS).any():
        reason = "the map has streets, pavements or squares" if len(standing) else "the map has no buildings"
        log.info("no ground is derived, because %s", reason)
        return box_map
    boxes = BoxList()
    if not (box_map.kinds == KINDS["Terrain"]).any():
        low, high = box_map.bounds()
        boxes.span("Terrain", low[:2] - VERGE_M, high[:2] + VERGE_M, LAWN_TOP_M - GROUND_SLAB_M, LAWN_TOP_M)
    built = united(footprints(standing).tolist())
    between = shapely.buffer(shapely.buffer(built, NEAR_M / 2), -NEAR_M / 2)
    free = shapely.difference(between, shapely.buffer(built, PAVEMENT_M, join_style="mitre"))
    streets = shapely.buffer(shapely.buffer(free, -NARROW_M / 2), NARROW_M / 2 + 0.5).simplify(0.5)
    for polygon in polygons_of(streets):
        for piece in cover(polygon, min_fill=0.9, min_size_m=6.0, max_size_m=60.0):
            boxes.add("Roads", piece.center, piece.size, -GROUND_SLAB_M, 0.0, piece.yaw_deg)
    # One slab under each house, so that pavements have the facades' directions and no seams.
    for center, half, turn in zip(standing.centers, standing.half_extents, standing.rotations_deg, strict=True):
        size = 2 * (half[:2] + PAVEMENT_M)
        boxes.add("Sidewalks", center[:2], size, -GROUND_SLAB_M, 0.0, turn[1])
    derived = boxes.box_map()
    derived.centers[:, 2] += box_map.ground_z_m
    derived.ids[:] = np.setdiff1d(np.arange(1, len(box_map) + len(derived) + 1), box_map.ids)[: len(derived)]
    header = box_map.header
    changes = {
        "derived_ground": len(derived),
        "added_boxes": header.added_boxes + len(derived),
        "credits": credits_with(CREDITS, header.credits),
    }
    return replace(box_map.joined(derived), header=header.model_copy(update=changes))
