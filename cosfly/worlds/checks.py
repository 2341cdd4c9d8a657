"""Checks of a world: is it valid, and does it match its plan."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
import shapely

from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import GROUND_KINDS
from cosfly.worlds.plan import WorldPlan
from cosfly.worlds.town import Town, footprints, land_m2, of_kinds, trees_of

CELL_M = 0.5
HEAD_M = 2.0  # what is higher does not stand in a walker's way
STEP_M = 0.25  # what is lower does not either
AT_THE_DOOR_M = 2.0  # from a building to the pavement it is reached by
WALK_M = 100.0  # the longest walk that must find room: app:simworld:step4 samples 50 to 100 m
OVERLAP_M = 0.05


class Buildings(NamedTuple):
    """Buildings as they are seen from above: boxes that touch are one. polygons (n,), tops_m (n,)."""

    polygons: np.ndarray
    tops_m: np.ndarray


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
