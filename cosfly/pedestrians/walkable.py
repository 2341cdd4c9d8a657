"""The settings of the pedestrian stage, the walkable ground of a map, and the sampling of ends (sec:step3).

Grid, projection, inflation and connectivity follow the paper; the arithmetic on cells is in geometry/grid.py.
"""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import cv2
import numpy as np
import shapely
from pydantic import Field, field_validator, model_validator

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import GROUND_KINDS, KINDS, PAVED_KINDS
from cosfly.formats.pedestrian_paths import PLAIN_PACE, PedestrianTrajectory
from cosfly.formats.roi import Roi
from cosfly.geometry import grid as grids
from cosfly.geometry.axes import DT_S
from cosfly.geometry.trajectory_metrics import distances_along_m
from cosfly.pedestrians.astar import corners_of, find_route
from cosfly.pedestrians.speed_model import PACES, SLOWEST_SPEED_MPS
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError, NoPathError, nearest

log = logging.getLogger(__name__)

# Least share of surfaces in the free cells of a map without paved ones; below, they are lawns between unnamed streets.
SURFACE_SHARE_MIN = 0.5
OFF_GROUND_SHARE_MAX = 0.1  # more ground boxes off the header's ground indicate a slope or a wrong height
ROI_SHARE_MIN = 0.5  # of a region of interest that lies on the map; below, it belongs to another map

# Footings of cells. In a map that marks crossings, a crossing is carriageway under stripes: after gaps below GAP_M are
# closed, its paint is MARKED_M wide in every direction, unlike dashes and edge lines. Where none is marked, the cost of
# carriageway alone makes routes cross a street on the shortest way and not run along it.
GAP_M = 2.0
MARKED_M = 2.0

NUM_FOOTINGS = 4
PAVED, OPEN, CROSSING, ROAD = range(NUM_FOOTINGS)  # those below CROSSING are off the carriageway
FOOTING_OF_KIND = np.full(256, OPEN, dtype=np.uint8)
FOOTING_OF_KIND[[KINDS["Sidewalks"], KINDS["Ground"]]] = PAVED
FOOTING_OF_KIND[[KINDS["Roads"], KINDS["RailTrack"]]] = ROAD
PAINT = KINDS["RoadLines"]

StepSeconds = defaultdict[str, float]  # duration of the steps of the stage


class PedestriansConfig(Config):
    """Settings of the pedestrian stage; the defaults are the paper's (tab:ped_params, eq:speed)."""

    num_paths: int = Field(20, ge=1, le=100_000, description="number of pedestrian trajectories")
    resolution_m: float = Field(0.5, gt=0, le=10, description="side of a grid cell, m")
    human_height_m: ClassVar[float] = 2.0  # boxes that reach between the ground and this height block, m
    safety_radius_m: float = Field(0.5, ge=0, le=50, description="distance to keep from obstacles, m; 0: none")
    min_distance_m: float = Field(50.0, gt=0, description="least straight distance from start to goal, m")
    max_distance_m: float = Field(100.0, gt=0, le=2000, description="greatest straight distance from start to goal, m")
    min_component_cells: int = Field(4000, ge=1, description="smallest connected free area that is used, cells")
    num_retries: int = Field(
        5, ge=0, description="number of further pairs of start and goal to try if the first is rejected"
    )
    max_detour: ClassVar[float] = 3.0  # largest ratio of route length to straight distance
    ground: Literal["anywhere", "surfaces", "paved"] = Field(
        "surfaces",
        description="walkable ground: anywhere; surfaces: ground boxes, if the map has them; paved: paved ones only",
    )
    route: Literal["straight", "cells"] = Field(
        "straight",
        description="straight: straight lines where the ground allows them; cells: from cell to cell as in the paper, "
        "where people almost stop at each turn, and streets that are not parallel to an axis are full of turns",
    )
    road_cost: int = Field(
        1, ge=1, le=100, description="cost of a metre of carriageway off crossings, in metres of pavement; 1: all "
        "ground costs the same, as in the paper; above 1 no trajectory starts or ends on it",
    )  # fmt: skip
    cruise_speed_mps: ClassVar[float] = 1.2  # speed on straight ground, m/s
    curvature_gain_m: ClassVar[float] = 5.0  # alpha of eq:speed, m
    speed_jitter: ClassVar[float] = 0.15  # beta of eq:speed: random share of the speed
    min_speed_mps: ClassVar[float] = 0.0  # least speed, m/s
    max_speed_mps: ClassVar[float] = 1.6  # greatest speed, m/s
    pace: dict[str, Annotated[float, Field(ge=0)]] = Field(
        {PLAIN_PACE: 1.0}, description=f"share of trajectories with each pace: {', '.join(PACES)}"
    )
    hurry_speed_mps: float = Field(1.6, ge=SLOWEST_SPEED_MPS, description="cruising speed of hurrying pedestrians, m/s")
    others: int = Field(0, ge=0, le=500, description="bystanders around each pedestrian trajectory")
    look_alikes: int = Field(
        0, ge=0, le=500, description="bystanders who wear the same as the target except for one item"
    )
    others_reach_m: ClassVar[float] = 40.0  # greatest distance of bystanders from the trajectory, m
    dt_s: float = Field(
        DT_S, ge=0.05, le=5, description="time step of trajectories, frames and windows (dt), s; counts of frames "
        "(caption.window) and the thresholds of labels are for 0.5",
    )  # fmt: skip

    @field_validator("pace")
    @classmethod
    def _paces_are_known(cls, pace: dict[str, float]) -> dict[str, float]:
        for name in pace.keys() - PACES.keys():
            raise ValueError(f"pace {name!r} does not exist{nearest(name, PACES)}; choose from {', '.join(PACES)}")
        if not sum(pace.values()) > 0:
            raise ValueError("the shares of the paces must add up to more than 0")
        return pace

    @model_validator(mode="after")
    def _ranges_are_ordered(self) -> PedestriansConfig:
        if self.min_distance_m >= self.max_distance_m:
            raise ValueError(
                f"min_distance_m ({self.min_distance_m}) must be below max_distance_m ({self.max_distance_m})"
            )
        if self.look_alikes > self.others:
            raise ValueError(f"look_alikes ({self.look_alikes}) must not be above others ({self.others})")
        return self


@dataclass(frozen=True)
class WalkableGround:
    """The walkable ground of a map."""

    grid: grids.OccupancyGrid  # the obstacles before inflation
    inflated: grids.OccupancyGrid  # the obstacles after inflation
    # (ny, nx) int32, one number for cells with a route between them; 0 for cells that are not walkable: obstacles,
    # outside the region of interest, small components.
    parts: np.ndarray
    footing: np.ndarray  # (ny, nx) uint8: PAVED, OPEN, CROSSING or ROAD
    z_m: float  # height of the ground
    costs: np.ndarray  # (NUM_FOOTINGS,) int64, of a step of a route on each footing
    is_straight: bool  # whether waypoints lie on straight lines where the ground allows them, else on cells
    is_in_roi: np.ndarray | None = None  # (ny, nx) bool; None without a region of interest
    counts: dict[str, Any] = field(default_factory=dict)  # as in `pedestrians_report.json`

    @cached_property
    def walkable(self) -> np.ndarray:
        """Return the walkable cells, (ny, nx) bool."""
        return self.parts > 0

    @cached_property
    def may_end(self) -> np.ndarray:
        """Return the cells where trajectories may start and end, (ny, nx) bool: no carriageway of a higher cost."""
        return self.walkable & ((self.footing < CROSSING) | (self.costs[ROAD] == 1))

    @cached_property
    def row_ends(self) -> np.ndarray:
        """Return the number of cells of `may_end` up to each row's end, (ny,) int64."""
        return np.cumsum(np.count_nonzero(self.may_end, axis=1))

    def sample_start(self, rng: np.random.Generator) -> tuple[int, int]:
        """Draw one cell of `may_end`, (x index, y index), uniformly."""
        drawn = int(rng.integers(self.row_ends[-1]))  # in row-major order
        y = int(np.searchsorted(self.row_ends, drawn, side="right"))
        columns = np.flatnonzero(self.may_end[y])
        num_in_rows_above = self.row_ends[y] - len(columns)
        return int(columns[drawn - num_in_rows_above]), y

    def sample_goals(
        self, start: tuple[int, int], min_cells: float, max_cells: float, rng: np.random.Generator, num: int = 1
    ) -> list[tuple[int, int]]:
        """Draw cells of `may_end` in the start's part, (x index, y index), uniformly; none if there are none.

        min_cells, max_cells: bounds of their straight distance from the start, both included.
        """
        x, y = start
        reach = int(max_cells)
        first_x, first_y = max(0, x - reach), max(0, y - reach)
        near = np.s_[first_y : y + reach + 1, first_x : x + reach + 1]
        num_rows, num_columns = self.parts[near].shape
        rows, columns = np.arange(num_rows)[:, None], np.arange(num_columns)
        squared = (rows + first_y - y) ** 2 + (columns + first_x - x) ** 2
        fits = (self.parts[near] == self.parts[y, x]) & self.may_end[near]
        candidates = np.flatnonzero(fits & (squared >= min_cells**2) & (squared <= max_cells**2))
        goals = []
        for _ in range(num if len(candidates) else 0):
            row, column = divmod(int(candidates[rng.integers(len(candidates))]), num_columns)
            goals.append((column + first_x, row + first_y))
        return goals

    def route(self, start: tuple[int, int], goal: tuple[int, int]) -> np.ndarray:
        """Return the cells of a cheapest route between two cells of one part, (k, 2)."""
        cells = find_route(self.walkable, start, goal, self.footing, self.costs)
        assert cells is not None, "two cells of one part have no route between them"
        return cells

    def waypoints_m(self, cells: np.ndarray) -> np.ndarray:
        """Return waypoints along a route of cells, (k, 2), about a cell width apart, (m, 2) m."""
        if not self.is_straight:
            return self.grid.centers_of(cells)
        corners_m = self.grid.centers_of(corners_of(cells, self.walkable, self.footing, self.costs))
        along_m = distances_along_m(corners_m)
        counts = np.maximum(1, np.round(np.diff(along_m) / self.grid.resolution_m)).astype(int)
        at_m = np.interp(np.arange(counts.sum() + 1), np.concatenate([[0], np.cumsum(counts)]), along_m)
        return np.column_stack([np.interp(at_m, along_m, corners_m[:, axis]) for axis in (0, 1)])


@contextmanager
def timed(seconds: StepSeconds, step: str) -> Iterator[None]:
    """Add the time of a block to the seconds of a step."""
    start_s = time.perf_counter()
    yield
    seconds[step] += time.perf_counter() - start_s


def walkable_ground(
    box_map: BoxMap, cfg: PedestriansConfig, roi: Roi | None = None, *, where: str | Path = "map",
    roi_where: str | Path = "region of interest", seconds: StepSeconds | None = None,
) -> WalkableGround:  # fmt: skip
    """Return the walkable ground of a map.

    Components are 8-connected, as in the paper, and those below `min_component_cells` are not used. A route that never
    cuts a corner cannot pass between two cells that touch at a corner only, so an 8-connected component may hold
    several parts; both ends of a route are drawn from one part, so that it exists.

    Args:
        where, roi_where: Files of the map and of the region, for errors.
        seconds: The durations of the steps are added to it.
    """
    seconds = StepSeconds(float) if seconds is None else seconds
    with timed(seconds, "grid"):
        empty = grids.empty_grid(box_map, cfg.resolution_m)
    with timed(seconds, "project"):
        grid = grids.occupancy(box_map, height_m=cfg.human_height_m, like=empty)
        is_in_roi = None if roi is None else grids.roi_mask(grid, roi)
    if roi is not None:
        check_roi(roi, box_map, roi_where)
    with timed(seconds, "inflate"):
        inflated = grids.inflate(grid, cfg.safety_radius_m)
        free = ~inflated.occupied
        has_surface = _surface(box_map, cfg.ground, grid, free)
        walkable = free.copy()
        for mask in (has_surface, is_in_roi):
            if mask is not None:
                walkable &= mask
    counts: dict[str, Any] = {
        "boxes": len(box_map),
        "boxes_in_the_way": _count(grids.blocks_walking(box_map, height_m=cfg.human_height_m)),
        "grid": list(grid.size),
        "cells": free.size,
        "cells_occupied": _count(grid.occupied),
        "cells_inflated": _count(inflated.occupied),
        "cells_free": _count(free),
        "ground": cfg.ground if has_surface is not None else "anywhere",
        "cells_with_surface": None if has_surface is None else _count(has_surface),
        "cells_in_roi": None if is_in_roi is None else _count(is_in_roi),
        "cells_walkable": _count(walkable),
    }
    _check_walkable(counts, where, roi_where)
    with timed(seconds, "connectivity"):
        parts, component_counts = _parts_of_large_components(walkable, cfg, where if roi is None else roi_where)
    with timed(seconds, "footing"):
        costs = costs_of(cfg.road_cost)
        footing = footing_of(box_map, grid)
    counts |= component_counts
    is_straight = cfg.route == "straight"
    ground = WalkableGround(grid, inflated, parts, footing, box_map.ground_z_m, costs, is_straight, is_in_roi, counts)
    if not ground.may_end.any():
        what = "all walkable ground is road, but pedestrian trajectories must start and end off the road"
        got = f"{counts['cells_used']} walkable cells, all Roads"
        fix = "add boxes of type Sidewalks or Ground, or allow starts on roads with pedestrians.road_cost=1"
        raise NoPathError(what, where=where, got=got, expected="pavements, squares or paths", fix=fix)
    return ground


def _count(mask: np.ndarray) -> int:
    return int(np.count_nonzero(mask))


def _surface(box_map: BoxMap, ground: str, grid: grids.OccupancyGrid, free: np.ndarray) -> np.ndarray | None:
    """Return the cells with the ground that the settings require, (ny, nx) bool; None for all cells.

    It is None too where the map's ground is unknown: the map has no ground boxes, or no paved ones and others under a
    small part of the free cells. Without ground boxes the land outside a city model's data looks like a square, because
    it has no obstacles either.
    """
    if ground == "anywhere":
        return None
    has_ground = grids.surface(box_map, GROUND_KINDS, like=grid)
    num_off = _count(grids.lies_off_ground(box_map, GROUND_KINDS))
    num_all = _count(box_map.is_any_of(GROUND_KINDS))
    if num_off > OFF_GROUND_SHARE_MAX * num_all:
        log.warning(
            "%s: %d of %d ground boxes lie more than %g m off ground_z_m of its header and are not walkable",
            box_map.name, num_off, num_all, grids.SURFACE_REACH_M,
        )  # fmt: skip
    if has_ground is None:
        log.warning("%s has no ground boxes: people walk wherever there is no obstacle", box_map.name)
        return None
    is_paved = grids.surface(box_map, PAVED_KINDS, like=grid)
    if ground == "paved":
        return np.zeros_like(has_ground) if is_paved is None else is_paved
    num_ground = _count(has_ground & free)
    num_free = _count(free)
    if is_paved is None and num_ground < SURFACE_SHARE_MIN * num_free:
        log.warning(
            "%s has no boxes of Roads, Sidewalks or Ground, and other ground under %d of %d free cells only: people "
            "walk wherever there is no obstacle", box_map.name, num_ground, num_free,
        )  # fmt: skip
        return None
    return has_ground


def _parts_of_large_components(
    walkable: np.ndarray, cfg: PedestriansConfig, where: str | Path
) -> tuple[np.ndarray, dict[str, Any]]:
    """Label the parts of the large components; return them and the counts of components."""
    components, sizes = grids.connected_parts(walkable, 8)
    is_large = sizes >= cfg.min_component_cells
    if not is_large.any():
        raise NoPathError(
            "no connected walkable area is large enough", where=where,
            got=f"{int(sizes.max())} cells of {cfg.resolution_m:g} m in the largest of {len(sizes) - 1} areas",
            expected=f"at least {cfg.min_component_cells} cells (pedestrians.min_component_cells)",
            fix="lower pedestrians.min_component_cells or pedestrians.safety_radius_m, or widen the region of interest",
        )  # fmt: skip
    parts, part_sizes = grids.connected_parts(is_large[components], 4)
    used = sorted(sizes[is_large].tolist(), reverse=True)
    return parts, {
        "components": len(sizes) - 1, "components_used": len(used), "component_sizes_used": used,
        "cells_used": sum(used), "parts": len(part_sizes) - 1,
    }  # fmt: skip


def check_roi(roi: Roi, box_map: BoxMap, where: str | Path, *, refuse: bool = False) -> None:
    """Warn if most of a region lies outside the map; raise InputError instead where `refuse`."""
    roi.check_map(box_map, where)
    low, high = box_map.bounds()
    region = roi.region()
    inside = shapely.intersection(region, shapely.box(*low[:2], *high[:2])).area / max(region.area, 1e-9)
    if refuse and inside < ROI_SHARE_MIN:
        what = "most of the region of interest lies outside the map"
        expected = f"at least {ROI_SHARE_MIN:.0%} on the map"
        fix = "draw the region on this map, in world metres: x is east, y is north"
        raise InputError(what, where=where, got=f"{inside:.0%} of the region on the map", expected=expected, fix=fix)
    if 0.0 < inside < ROI_SHARE_MIN:
        log.warning("%s: %.0f %% of the region of interest lies outside the map", where, 100 * (1 - inside))


def _check_walkable(counts: dict[str, Any], where: str | Path, roi_where: str | Path) -> None:
    """Raise NoPathError if no cell is walkable."""
    if counts["cells_walkable"]:
        return
    in_region = "" if counts["cells_in_roi"] is None else f", {counts['cells_in_roi']} in the region of interest"
    raise NoPathError(
        "the map has no walkable cell",
        where=roi_where if in_region else where,
        got=f"of {counts['cells']} cells {counts['cells_free']} away from obstacles{in_region}, and none of these on "
        "the ground of pedestrians.ground",
        expected="free ground between the boxes, and a region in world metres of this map",
        fix="lower pedestrians.safety_radius_m, give ground boxes a type such as Roads or Terrain, set "
        "pedestrians.ground to `anywhere`, or draw the region over free ground",
    )


# --- footing ----------------------------------------------------------------------------------------------------------


def footing_of(box_map: BoxMap, grid: grids.OccupancyGrid) -> np.ndarray:
    """Return the footing of each cell of a grid, by its topmost ground, (ny, nx) uint8."""
    footing = FOOTING_OF_KIND[grids.surface_kinds(box_map, GROUND_KINDS - {PAINT}, like=grid)]
    is_road = footing == ROAD
    paint = grids.surface(box_map, {PAINT}, like=grid) if is_road.any() else None
    if paint is not None:
        closed = _morphed(paint, cv2.MORPH_CLOSE, GAP_M, grid)
        marked = _morphed(closed, cv2.MORPH_OPEN, MARKED_M, grid)
        if (marked & is_road).any():
            reaches_kerb = _morphed(marked | (footing == PAVED), cv2.MORPH_CLOSE, GAP_M, grid)
            footing[reaches_kerb & is_road] = CROSSING
    return footing


def _morphed(mask: np.ndarray, operation: int, width_m: float, grid: grids.OccupancyGrid) -> np.ndarray:
    """Apply a morphological operation with a disc of a width."""
    size = 2 * max(1, round(width_m / 2 / grid.resolution_m)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.morphologyEx(mask.view(np.uint8), operation, disc).view(bool)


def costs_of(road_cost: int) -> np.ndarray:
    """Return the cost of a step of one cell on each footing, (NUM_FOOTINGS,) int64, at least 1."""
    return np.where(np.arange(NUM_FOOTINGS) == ROAD, road_cost, 1)


def count_on_road(path: PedestrianTrajectory, footing: np.ndarray, grid: grids.OccupancyGrid) -> tuple[int, int]:
    """Count a trajectory's points on carriageway away from crossings, and on crossings."""
    x, y = grid.cells_at(path.positions_m).T
    under = footing[y, x]
    return _count(under == ROAD), _count(under == CROSSING)
