"""The footing of each cell: pavement, open ground, carriageway or crossing.

In a map that marks crossings, a crossing is carriageway under stripes: after gaps below GAP_M are closed, its paint is
MARKED_M wide in every direction, unlike dashes and edge lines. In other maps, carriageway may be crossed from pavement
to pavement along the grid axis (of four, with the diagonals) with the least distance, if this is at most ACROSS_SHARE
of the distance at right angles to it. So routes cross a street and do not run along it.
"""

from __future__ import annotations

import cv2
import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.geometry.grid import OccupancyGrid, surface, surface_kinds
from cosfly.runtime.compiled import njit

MARKED_M = GAP_M = 2.0
ACROSS_SHARE = 0.5

# Footings of a cell; ROAD + 1 + axis is carriageway that may be crossed along that axis.
PAVED, OPEN, CROSSING, ROAD = range(4)
AXES = np.array([[1, 0], [0, 1], [1, 1], [-1, 1]])  # in cells, in the order of the directions in astar.py
NUM_FOOTINGS = ROAD + 1 + len(AXES)
OF_KIND = np.full(256, OPEN, dtype=np.uint8)
OF_KIND[[KINDS["Sidewalks"], KINDS["Ground"]]] = PAVED
OF_KIND[[KINDS["Roads"], KINDS["RailTrack"]]] = ROAD
PAINT = KINDS["RoadLines"]


def footing_of(box_map: BoxMap, grid: OccupancyGrid) -> np.ndarray:
    """Return the footing of each cell of a grid, by its topmost ground, (ny, nx) uint8."""
    footing = OF_KIND[surface_kinds(box_map, GROUND_KINDS - {PAINT}, like=grid)]
    is_road = footing == ROAD
    if not is_road.any():
        return footing
    paint = surface(box_map, {PAINT}, like=grid)
    if paint is not None:
        marked = _morphed(_morphed(paint, cv2.MORPH_CLOSE, GAP_M, grid), cv2.MORPH_OPEN, MARKED_M, grid)
        if (marked & is_road).any():
            reaches_kerb = _morphed(marked | (footing == PAVED), cv2.MORPH_CLOSE, GAP_M, grid)
            footing[reaches_kerb & is_road] = CROSSING
            return footing
    _mark_ways_across(is_road, footing == PAVED, footing)
    return footing


def _morphed(mask: np.ndarray, operation: int, width_m: float, grid: OccupancyGrid) -> np.ndarray:
    """Apply a morphological operation with a disc of a width."""
    size = 2 * max(1, round(width_m / 2 / grid.resolution_m)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.morphologyEx(mask.view(np.uint8), operation, disc).view(bool)


@njit(cache=True)
def _mark_ways_across(is_road, is_paved, footing):  # pragma: no cover (compiled)
    """Mark carriageway that may be crossed along an axis in `footing`; all arrays are (ny, nx)."""
    num_y, num_x = is_road.shape
    widths = np.full((len(AXES), num_y, num_x), np.inf, dtype=np.float32)  # of the carriageway, in cells
    is_way = np.zeros((len(AXES), num_y, num_x), dtype=np.bool_)  # from pavement to pavement
    for axis in range(len(AXES)):
        dx, dy = AXES[axis]
        length = np.float32(np.sqrt(dx * dx + dy * dy))
        for y in range(num_y):
            for x in range(num_x):
                from_x, from_y = x - dx, y - dy
                is_inside = 0 <= from_x < num_x and 0 <= from_y < num_y
                if not is_road[y, x] or (is_inside and is_road[from_y, from_x]):
                    continue
                to_x, to_y, count = x, y, 0
                while 0 <= to_x < num_x and 0 <= to_y < num_y and is_road[to_y, to_x]:
                    to_x, to_y, count = to_x + dx, to_y + dy, count + 1
                ends = is_inside and 0 <= to_x < num_x and 0 <= to_y < num_y
                ends = ends and is_paved[from_y, from_x] and is_paved[to_y, to_x]
                for k in range(count):
                    widths[axis, y + k * dy, x + k * dx] = count * length
                    is_way[axis, y + k * dy, x + k * dx] = ends
    for y in range(num_y):
        for x in range(num_x):
            axis = int(np.argmin(widths[:, y, x]))
            if is_way[axis, y, x] and widths[axis, y, x] <= ACROSS_SHARE * widths[axis ^ 1, y, x]:
                footing[y, x] = ROAD + 1 + axis


def costs_of(open_cost: int, road_cost: int) -> np.ndarray:
    """Return the cost of a step of one cell on each footing along each axis, (NUM_FOOTINGS, axes) int64, at least 1."""
    costs = np.ones((NUM_FOOTINGS, len(AXES)), dtype=np.int64)
    costs[OPEN], costs[ROAD:] = open_cost, road_cost
    costs[ROAD + 1 + np.arange(len(AXES)), np.arange(len(AXES))] = 1
    return costs


def count_on_road(path: PedestrianTrajectory, footing: np.ndarray, grid: OccupancyGrid) -> tuple[int, int]:
    """Count a trajectory's points on carriageway away from crossings, and on crossings."""
    steps = np.diff(path.polyline_m, axis=0)
    middles = path.polyline_m[:-1] + steps / 2
    nearest = np.argmin(np.linalg.norm(path.positions_m[:, None, :2] - middles, axis=2), axis=1)
    x, y = grid.cells_at(path.positions_m).T
    under = footing[y, x].astype(np.int64)
    directions = np.round(np.degrees(np.arctan2(steps[:, 1], steps[:, 0])) / 45.0).astype(np.int64)[nearest] % 4
    is_across = under == ROAD + 1 + np.array([0, 2, 1, 3])[directions]
    is_crossing = is_across | (under == CROSSING)
    return int(np.count_nonzero((under >= ROAD) & ~is_across)), int(np.count_nonzero(is_crossing))
