"""Is a world valid, is it what its plan says, how is it beside other cities, how unlike are several."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import cv2
import numpy as np
import shapely

from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import GROUND_KINDS
from cosfly.products.motion import in_axes_of
from cosfly.products.traces import DroneTrace
from cosfly.worlds.plan import WorldPlan
from cosfly.worlds.town import Town, footprints, land_m2, of_kinds, trees_of

CELL_M = 0.5
HEAD_M = 2.0  # what is higher does not stand in a walker's way
STEP_M = 0.25  # what is lower does not either
AT_THE_DOOR_M = 2.0  # from a building to the pavement it is reached by
WALK_M = 100.0  # the longest walk that must find room: app:simworld:step4 samples 50 to 100 m
OVERLAP_M = 0.05
GRID_M = 4.0  # of the pictures of buildings that are compared between worlds
WAY_POINTS = 50


class Buildings(NamedTuple):
    """Buildings as they are seen from above: boxes that touch are one. polygons (n,), tops_m (n,)."""

    polygons: np.ndarray
    tops_m: np.ndarray

    @property
    def sides_m(self) -> np.ndarray:
        """Side of the square of each one's area."""
        return np.sqrt(shapely.area(self.polygons))

    @property
    def gaps_m(self) -> np.ndarray:
        """From each to the nearest other one."""
        if len(self.polygons) < 2:
            return np.zeros(0)
        tree = shapely.STRtree(self.polygons)
        _, gaps = tree.query_nearest(self.polygons, exclusive=True, return_distance=True, all_matches=False)
        return gaps


def buildings_of(box_map: BoxMap) -> Buildings:
    rows = np.flatnonzero(of_kinds(box_map, "Buildings"))
    boxes = box_map.select(rows)
    outlines = footprints(boxes)
    joined = shapely.get_parts(shapely.union_all(shapely.buffer(outlines, 0.02, join_style="mitre")))
    tops = np.zeros(len(joined))
    part, box = shapely.STRtree(outlines).query(joined, predicate="intersects")
    np.maximum.at(tops, part, boxes.maxs[box, 2])
    return Buildings(joined, tops)


def check_world(town: Town, plan: WorldPlan) -> list[dict[str, Any]]:
    """Give each check of a world: its name, what was found, what is expected, whether it holds."""
    world, buildings = town.boxes, buildings_of(town.boxes)
    own = buildings_of(town.layout)
    reached, component_m, share = _reach(world, buildings)
    low, high = plan.heights_m
    extra = 3.0 if plan.lanes else 0.0  # ridges of old houses stand on their walls
    heights_m = own.tops_m if len(own.tops_m) else np.array([low])
    trees = trees_of(world).sum() / land_m2(town) * 1e4
    covered = shapely.area(own.polygons).sum() / land_m2(town)

    def check(name: str, got: float, least: float, most: float) -> dict[str, Any]:
        is_met = bool(least - 1e-6 <= got <= most + 1e-6)
        return {"check": name, "got": round(float(got), 4), "least": least, "most": most, "is_met": is_met}

    return [
        check("overlapping buildings", _num_overlaps(world), 0, 0),
        check("buildings without a pavement", len(buildings.polygons) - reached, 0, 0),
        check("length of the largest walkable component, m", component_m, WALK_M, 1e5),
        check("walkable ground in it", share, 0.8, 1.0),
        check("building share", covered, *plan.building_share),
        check("lowest building, m", heights_m.min(), low, high + extra),
        check("highest building, m", heights_m.max(), low, high + extra),
        check("trees per hectare", trees, *plan.trees_per_ha),
    ]


def _num_overlaps(box_map: BoxMap) -> int:
    """Count pairs of boxes of buildings that share more than a sliver of space."""
    boxes = box_map.select(np.flatnonzero(of_kinds(box_map, "Buildings")))
    outlines = shapely.buffer(footprints(boxes), -OVERLAP_M / 2, join_style="mitre")
    one, other = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    above = np.minimum(boxes.maxs[one, 2], boxes.maxs[other, 2]) - np.maximum(boxes.mins[one, 2], boxes.mins[other, 2])
    return int(((one < other) & (above > OVERLAP_M)).sum())


def _reach(box_map: BoxMap, buildings: Buildings) -> tuple[int, float, float]:
    """Give how many buildings stand at the largest walkable component, its length, its share of all that is walkable.

    Walkable is what is paved, roads with it, and free up to a walker's head.
    """
    low = box_map.bounds()[0][:2]
    shape = np.ceil((box_map.bounds()[1][:2] - low) / CELL_M).astype(int)[::-1] + 1
    blocked = (box_map.maxs[:, 2] > STEP_M) & (box_map.mins[:, 2] < HEAD_M) & ~box_map.is_any_of(GROUND_KINDS)
    outlines = footprints(box_map)
    walkable = _drawn(outlines[of_kinds(box_map, "Sidewalks", "Roads")], low, shape, CELL_M)
    walkable[
        _drawn(outlines[blocked | of_kinds(box_map, "Water") & (box_map.maxs[:, 2] > 0)], low, shape, CELL_M) > 0
    ] = 0
    count, labels, stats, _ = cv2.connectedComponentsWithStats(walkable)
    if count < 2:
        return 0, 0.0, 0.0
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    length_m = CELL_M * float(np.hypot(*stats[largest, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]))
    near = cv2.dilate(
        (labels == largest).astype(np.uint8), np.ones((2 * int(AT_THE_DOOR_M / CELL_M) + 1,) * 2, np.uint8)
    )
    reached = sum(
        bool((near & _drawn(np.array([polygon]), low, shape, CELL_M)).any()) for polygon in buildings.polygons
    )
    return reached, length_m, stats[largest, cv2.CC_STAT_AREA] / stats[1:, cv2.CC_STAT_AREA].sum()


def _drawn(polygons: np.ndarray, low: np.ndarray, shape: np.ndarray, cell_m: float) -> np.ndarray:
    picture = np.zeros(shape, np.uint8)
    for polygon in polygons:
        corners = np.round((np.asarray(polygon.exterior.coords)[:, :2] - low) / cell_m - 0.5).astype(np.int32)
        cv2.fillPoly(picture, [corners], 1)
    return picture


# --- beside other cities ----------------------------------------------------------------------------------------------

MEASURES = ("side of buildings, m", "gap to the next building, m", "height of buildings, m")


def measures(box_map: BoxMap) -> dict[str, np.ndarray]:
    """Give what cities are compared by, one value for each building."""
    buildings = buildings_of(box_map)
    return dict(zip(MEASURES, (buildings.sides_m, buildings.gaps_m, buildings.tops_m), strict=True))


def compare(ours: BoxMap, other: BoxMap) -> list[dict[str, Any]]:
    """Give quartiles of each measure in both, and how far its distributions are apart (Kolmogorov, Smirnov)."""
    rows = []
    for name, one in measures(ours).items():
        two = measures(other)[name]
        values = np.sort(np.concatenate([one, two]))
        both = [np.searchsorted(np.sort(each), values, side="right") / max(1, len(each)) for each in (one, two)]
        quartiles = [np.percentile(each, (25, 50, 75)).round(1).tolist() if len(each) else [] for each in (one, two)]
        distance = round(float(np.abs(both[0] - both[1]).max()), 3)
        rows.append({"measure": name, "ours": quartiles[0], "other": quartiles[1], "distance": distance})
    return rows


# --- several worlds ---------------------------------------------------------------------------------------------------


def unlikeness(worlds: Sequence[BoxMap]) -> list[float]:
    """Give for every pair of worlds the share of ground built up in one of them that is not in both, 0 to 1."""
    half = max(np.abs(np.stack(world.bounds())[:, :2]).max() for world in worlds)
    low, shape = np.array([-half, -half]), np.full(2, int(2 * half / GRID_M) + 1)
    built = [_drawn(buildings_of(world).polygons, low, shape, GRID_M) > 0 for world in worlds]
    return [round(1.0 - float((a & b).sum() / max(1, (a | b).sum())), 3) for a, b in combinations(built, 2)]


def ways_apart(worlds: Sequence[Sequence[DroneTrace]]) -> list[float]:
    """Give for every pair of worlds how far a walk and its flight are from the nearest of the other world, mean, m.

    They are laid over each other with one start and one direction from start to end, WAY_POINTS at even times.
    """
    shapes = [np.stack([_laid_out(trace) for trace in traces]) for traces in worlds]
    gaps_m = (np.linalg.norm(a[:, None] - b[None], axis=-1).mean(axis=-1) for a, b in combinations(shapes, 2))
    return [round(float((gap.min(axis=0).mean() + gap.min(axis=1).mean()) / 2), 2) for gap in gaps_m]


def _laid_out(trace: DroneTrace) -> np.ndarray:
    """Walk and flight from the walk's start, x towards its end, (2 * WAY_POINTS, 3) m."""
    rows = np.linspace(0, len(trace.time_s) - 1, WAY_POINTS).round().astype(int)
    away_m = np.concatenate([trace.targets_m[rows], trace.positions_m[rows]]) - trace.targets_m[0]
    end_m = trace.targets_m[-1] - trace.targets_m[0]
    return in_axes_of(float(np.degrees(np.arctan2(end_m[1], end_m[0]))), away_m)
