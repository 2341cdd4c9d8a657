"""The ground as cells: occupancy, surfaces, inflation, regions and connected components.

Boxes become occupied cells (Step 3 of the paper), occupied cells grow by a safety radius, a region of interest selects
free cells, and connected components of them are labelled. Arrays are indexed [y_index, x_index]; cell
(x_index, y_index) covers one square of `resolution_m`.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import cv2
import numpy as np
import shapely

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import GROUND_KINDS, KINDS, LAYERS
from cosfly.formats.roi import Roi
from cosfly.geometry.axes import rotation_matrices
from cosfly.runtime.compiled import njit
from cosfly.runtime.errors import InputError

RESOLUTION_M = 0.5  # tab:ped_params
HUMAN_HEIGHT_M = 2.0  # tab:ped_params
TOUCH_M = 1e-6  # maps are written to a micrometre: a smaller overlap is no overlap
MIN_HALF_EXTENT_M = 2 * TOUCH_M  # so that a wall without thickness blocks its cells
SURFACE_REACH_M = 1.0  # kerbs, lawns and carriageways differ by less; a flyover lies higher
MAX_CELLS = 400_000_000  # 10 km x 10 km at 0.5 m; more indicates a stray box, or a resolution too fine for the memory

WATER = KINDS["Water"]
_LAYER_OF = np.zeros(256, dtype=np.int64)
_LAYER_OF[[KINDS[name] for name in LAYERS]] = list(LAYERS.values())
_CORNER_SIGNS = np.array([[x, y, z] for z in (-1.0, 1.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


@dataclass(frozen=True)
class OccupancyGrid:
    """Cells over the ground plane."""

    x_min_m: float  # low corner of cell (0, 0), world
    y_min_m: float
    resolution_m: float
    occupied: np.ndarray  # (ny, nx) bool

    @property
    def size(self) -> tuple[int, int]:
        """Return the numbers of cells along x and along y, as in "a 1238 x 1013 grid"."""
        return self.occupied.shape[1], self.occupied.shape[0]

    def cells_at(self, points_m: np.ndarray) -> np.ndarray:
        """Return (..., 2) int64 x and y indices of (..., 2) world points, which may lie outside."""
        away_m = np.asarray(points_m, dtype=np.float64)[..., :2] - [self.x_min_m, self.y_min_m]
        return np.floor(away_m / self.resolution_m).astype(np.int64)

    def centers_of(self, cells: np.ndarray) -> np.ndarray:
        """Return (..., 2) world points in the middle of (..., 2) cells (x index, y index)."""
        return (np.asarray(cells, dtype=np.float64) + 0.5) * self.resolution_m + [self.x_min_m, self.y_min_m]


# --- boxes to cells ---------------------------------------------------------------------------------------------------


def empty_grid(box_map: BoxMap, resolution_m: float = RESOLUTION_M) -> OccupancyGrid:
    """Return a free grid over the bounds of all boxes of any kind."""
    low, high = box_map.bounds()
    num_x, num_y = (max(1, math.ceil((high[k] - low[k] - TOUCH_M) / resolution_m)) for k in (0, 1))
    if num_x * num_y > MAX_CELLS:
        what = "the map is too large for an occupancy grid"
        got = f"{num_x} x {num_y} cells of {resolution_m} m"
        expected = f"at most {MAX_CELLS} cells"
        fix = "remove boxes that lie far outside, or set a larger resolution_m"
        raise InputError(what, where=box_map.name, got=got, expected=expected, fix=fix)
    return OccupancyGrid(float(low[0]), float(low[1]), resolution_m, np.zeros((num_y, num_x), dtype=bool))


def blocks_walking(box_map: BoxMap, *, height_m: float = HUMAN_HEIGHT_M) -> np.ndarray:
    """Return which boxes block a person, (n,) bool.

    A box blocks if it reaches into the interval from the ground to `height_m` above it; touching an end of the interval
    does not count. Surfaces (GROUND_KINDS) never block; water always does.
    """
    is_under_head = box_map.mins[:, 2] < box_map.ground_z_m + height_m - TOUCH_M
    is_in_interval = is_under_head & (box_map.maxs[:, 2] > box_map.ground_z_m + TOUCH_M)
    return (is_in_interval & ~box_map.is_any_of(GROUND_KINDS)) | (box_map.kinds == WATER)


def occupancy(box_map: BoxMap, *, height_m: float = HUMAN_HEIGHT_M, like: OccupancyGrid | None = None) -> OccupancyGrid:
    """Return the grid whose cells under the boxes of `blocks_walking` are occupied.

    A cell is occupied if a box, seen from above, overlaps it by more than TOUCH_M. Boxes are rasterised exactly with
    their rotation, not as their axis-aligned bounds.

    Args:
        like: Use this grid's cells, not those of `empty_grid`, so that two maps can be compared; boxes outside are
            ignored.
    Source: Step 3 of the paper (sec:step3).
    """
    grid = empty_grid(box_map) if like is None else replace(like, occupied=np.zeros_like(like.occupied))
    boxes = box_map.select(blocks_walking(box_map, height_m=height_m))
    _mark(boxes, grid, grid.occupied, np.ones(len(boxes), bool))
    return grid


def lies_off_ground(box_map: BoxMap, kinds: Collection[int]) -> np.ndarray:
    """Return which boxes of some kinds have their top more than SURFACE_REACH_M off the ground, (n,) bool."""
    over_m = box_map.maxs[:, 2] - box_map.ground_z_m
    return box_map.is_any_of(kinds) & (np.abs(over_m) > SURFACE_REACH_M)


def _surfaces(box_map: BoxMap, kinds: Collection[int]) -> BoxMap:
    """Return the boxes of some kinds whose tops lie within SURFACE_REACH_M of the ground."""
    return box_map.select(box_map.is_any_of(kinds) & ~lies_off_ground(box_map, kinds))


def surface(box_map: BoxMap, kinds: Collection[int] = GROUND_KINDS, *, like: OccupancyGrid) -> np.ndarray | None:
    """Return over which cells of a grid the map has ground.

    Args:
        kinds: of ground; a box counts if its top lies within SURFACE_REACH_M of the ground.
    Returns:
        (ny, nx) bool, cells that such a box overlaps; None if the map has no such box.
    """
    boxes = _surfaces(box_map, kinds)
    has_ground = np.zeros_like(like.occupied)
    _mark(boxes, like, has_ground, np.ones(len(boxes), bool))
    return has_ground if len(boxes) else None


def surface_kinds(box_map: BoxMap, kinds: Collection[int], *, like: OccupancyGrid) -> np.ndarray:
    """Return the kind of the topmost ground of each cell, (ny, nx) uint8; 0 where there is none.

    The ground in the middle of a cell counts, and at the edge of all ground that in any part of the cell.

    kinds: as for `surface`; of kinds in one plane, to a centimetre, the higher layer counts.
    """
    boxes = _surfaces(box_map, kinds)
    boxes = boxes.select(upward_order(boxes))
    in_middle, in_any_part = np.zeros((2, *like.occupied.shape), dtype=np.uint8)
    _mark(boxes, like, in_middle, boxes.kinds, touch=0.5 - TOUCH_M)
    _mark(boxes, like, in_any_part, boxes.kinds)
    return np.where(in_middle, in_middle, in_any_part)


def upward_order(box_map: BoxMap) -> np.ndarray:
    """Return the rows of boxes by their tops to a centimetre, and in one plane by the layer of their kinds, (n,)."""
    return np.lexsort((_LAYER_OF[box_map.kinds], np.round(box_map.maxs[:, 2] - box_map.ground_z_m, 2)))


def _mark(
    boxes: BoxMap, grid: OccupancyGrid, cells: np.ndarray, marks: np.ndarray, *, touch: float | None = None
) -> None:
    """Set the cells, (ny, nx), under boxes to the marks, (n,), of the boxes.

    touch: cells, how deep a box must reach into a cell; TOUCH_M where None.
    """
    turns = rotation_matrices(np.radians(boxes.rotations_deg))
    extents = np.maximum(boxes.half_extents, MIN_HALF_EXTENT_M)
    corners = np.einsum("nij,nkj->nki", turns[:, :2], _CORNER_SIGNS * extents[:, None]) + boxes.centers[:, None, :2]
    corners = (corners - [grid.x_min_m, grid.y_min_m]) / grid.resolution_m
    # The four corners of the top of an upright box lie over those of its bottom.
    counts = np.where(np.abs(turns[:, 2, 2]) > 1.0 - 1e-12, 4, 8)
    touch = TOUCH_M / grid.resolution_m if touch is None else touch
    # As bytes, so that masks and kinds share one compiled function.
    mark_hulls(corners, counts, touch, marks.view(np.uint8), cells.view(np.uint8))


@njit(cache=True)
def mark_hulls(corners, counts, touch, marks, cells):  # pragma: no cover (compiled)
    """Mark the cells, (ny, nx), under the hulls of the first `counts`, (n,), of points, (n, k, 2) in cells, in order.

    touch: cells, how deep a hull must reach into a cell: 0.5 or a little less for hulls that hold its centre.
    """
    for hull in range(len(corners)):
        _fill_hull(corners[hull], counts[hull], touch, marks[hull], cells)


@njit(cache=True)
def _fill_hull(points, count, touch, mark, cells):  # pragma: no cover (compiled)
    """Mark the cells that the convex hull of the first `count` points (k, 2), in cells, overlaps.

    The part of a convex shape inside one row of cells spans one interval of x, and exactly the cells that meet the
    interval overlap the shape. The ends of the interval lie on points or on lines between two points, so the least and
    the greatest x of these are enough, and the hull is never built.
    """
    num_y = len(cells)
    bottom, top = np.inf, -np.inf
    for i in range(count):
        bottom, top = min(bottom, points[i, 1]), max(top, points[i, 1])
    # Limits are clipped as floats: far points do not fit an integer.
    first_row = int(max(0.0, np.floor(bottom + touch)))
    stop_row = int(max(0.0, min(float(num_y), np.ceil(top - touch))))
    for row in range(first_row, stop_row):
        low, high = row + touch, row + 1.0 - touch
        left, right = np.inf, -np.inf
        for i in range(count):
            xi, yi = points[i, 0], points[i, 1]
            if low <= yi <= high:
                left, right = min(left, xi), max(right, xi)
            for j in range(i):
                xj, yj = points[j, 0], points[j, 1]
                for end in range(2):
                    y = low if end == 0 else high
                    if (yi < y) != (yj < y):
                        x = xi + (y - yi) / (yj - yi) * (xj - xi)
                        left, right = min(left, x), max(right, x)
        if left <= right:
            stop = int(max(0.0, min(float(cells.shape[1]), np.ceil(right - touch))))
            for column in range(int(max(0.0, np.floor(left + touch))), stop):
                cells[row, column] = mark


# --- cells to walkable ground -----------------------------------------------------------------------------------------


def inflate(grid: OccupancyGrid, radius_m: float) -> OccupancyGrid:
    """Return the grid whose occupied cells are grown by an exact disc.

    A cell becomes occupied if its centre lies within `radius_m` of the centre of an occupied one: at 0.5 m cells, 0.5 m
    adds the four straight neighbours, and 1.0 m is the circular element of two cells of app:simworld:step4.
    """
    radius = radius_m / grid.resolution_m + 1e-9
    reach = int(radius)
    if reach == 0:
        return grid
    offsets = np.arange(-reach, reach + 1)
    disc = (offsets[:, None] ** 2 + offsets**2 <= radius**2).astype(np.uint8)
    return replace(grid, occupied=cv2.dilate(grid.occupied.view(np.uint8), disc).view(bool))


def roi_mask(grid: OccupancyGrid, roi: Roi) -> np.ndarray:
    """Return which cells have their centre in a region of interest, (ny, nx) bool."""
    region = roi.region()
    cells = np.arange(max(grid.size))
    shapely.prepare(region)
    x, y = grid.centers_of(np.stack([cells, cells], axis=1)).T
    return np.stack([shapely.contains_xy(region, x[: grid.size[0]], row) for row in y[: grid.size[1]]])


def connected_parts(free: np.ndarray, connectivity: int) -> tuple[np.ndarray, np.ndarray]:
    """Label connected free cells.

    Args:
        free: (ny, nx) bool.
        connectivity: 8 (the paper's components) or 4. A search that never cuts a corner moves exactly within
            4-connected parts: each of its diagonal steps has two straight neighbours.
    Returns:
        labels (ny, nx) int32, 0 where not free; sizes (num_labels,) int64 in cells, sizes[0] = 0.
    """
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(
        np.ascontiguousarray(free).view(np.uint8), connectivity=connectivity, ltype=cv2.CV_32S
    )
    sizes = statistics[:, cv2.CC_STAT_AREA].astype(np.int64)
    sizes[0] = 0
    return labels, sizes
