"""TA*+Smooth: a visibility search on a time-layered voxel grid, then smoothing (subsec:appendix_planner_tastar).

The search is the paper's; the smoothing is ours (smoothing.py), not the paper's shortcuts and elastic band. A state is
a voxel and a time. A layer lasts as many frames as the drone needs at its speed limit to reach all 26 neighbours of a
voxel (two, with the paper's settings), so that no direction is dearer than another. All states of a layer have the same
time left, so a best-first order by cost with a beam per layer needs no heuristic. The paper names the five weights but
not the terms; the terms are these, per layer:

    tracking    distance to the ring around the target at the reference distance and altitude, in voxels; to the
                reference position on it where the bearing counts
    visibility  1 - five-ray visibility
    path        length of the move, in voxels
    safety      (1 - clearance / influence)^2 below the influence distance; below the safety distance a voxel is closed
    smoothness  squared change of the move, in voxels

The move before a state is that of its cheapest predecessor: the smoothness term sees one past, not all.
"""

from typing import NamedTuple

import numpy as np

from cosfly.geometry.axes import DT_S
from cosfly.geometry.kernels import BoxIndex, collect_hits, nearest_box
from cosfly.planners.contract import Plan, PlanConfig, Scenario
from cosfly.planners.line_of_sight import five_ray_visibility, make_horizon
from cosfly.planners.smoothing import smooth_trajectory
from cosfly.runtime.compiled import njit
from cosfly.runtime.errors import NoPathError

MAX_CELLS = 4_000_000  # a pedestrian trajectory of 50-100 m needs about 50 000
ALTITUDE_ROUNDING_M = 1e-6
# The 26 neighbours of a voxel and itself.
MOVES = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], dtype=np.int64)
BENDS = ((MOVES[:, None] - MOVES) ** 2).sum(axis=2).astype(np.float64)  # squared change between each two, in voxels
STAY = 13
UNKNOWN, FREE, BLOCKED = range(3)  # edges between voxels

WEIGHTS = ("tracking", "visibility", "path", "safety", "smoothness")
TRACKING, VISIBILITY, PATH, SAFETY, SMOOTHNESS = range(5)

# --- search, compiled -------------------------------------------------------------------------------------------------
# A cell is the number of a voxel. Arrays that the functions of the search share: best: (cells,) cost of the cheapest
# move to a cell in this layer, infinite for others. came_from, came_by: (cells,) place of its source in the beam of the
# previous layer, and the move, as an index of MOVES. touched: (cells,) the cells reached in this layer.


class Voxels(NamedTuple):
    """The grid of one search, with caches of clearances and edges."""

    low: np.ndarray  # (3,) centre of voxel (0, 0, 0), m
    shape: np.ndarray  # (3,) number of voxels
    size: np.ndarray  # (3,) of a voxel, m
    lengths: np.ndarray  # of moves, m
    columns: np.ndarray  # (nx, ny) bool, inside the corridor
    clearances: np.ndarray  # (cells,) m; NaN if not computed yet
    edges: np.ndarray  # (cells, 27): UNKNOWN, FREE or BLOCKED


class Costs(NamedTuple):
    """Weights and lengths of the search; m time layers."""

    weights: np.ndarray  # (5,), in the order of WEIGHTS
    ring_m: np.ndarray  # (m,) preferred distance in the plane
    requested: np.ndarray  # (m, 2) reference position in the plane; NaN if every position on the ring is allowed
    sight: np.ndarray  # (m,) weight of the blocked part of the rays
    least_z: np.ndarray  # (m,)
    preferred_z: np.ndarray  # (m,)
    greatest_z: np.ndarray  # (m,)
    influence_m: float  # obstacles nearer than this add to the safety term
    safety_m: float  # a voxel nearer to an obstacle is closed
    start: np.ndarray  # (3,) reference position at the first layer


@njit(cache=True)
def search_layers(targets, reaches_m, voxels, costs, index, beam, corridor_m):
    """Return the cell of each layer, (m,), all -1 if there is no path; its cost; the number of visibility queries.

    targets: (m, 3) hip points of the layers. reaches_m: (m,) longest move into each layer.
    """
    num_layers, num_cells = len(targets), len(voxels.clearances)
    cells = np.empty((num_layers, beam), dtype=np.int64)  # the beam of each layer
    parents = np.empty((num_layers, beam), dtype=np.int64)  # places in the beam of the previous layer
    size = 0  # of the beam of the previous layer
    cost_before = np.empty(beam)  # of each cell in that beam
    move_before = np.empty(beam, dtype=np.int64)  # that led to each cell in that beam
    best = np.full(num_cells, np.inf)
    came_from = np.empty(num_cells, dtype=np.int64)
    came_by = np.empty(num_cells, dtype=np.int64)
    touched = np.empty(num_cells, dtype=np.int64)
    num_seen = 0
    for layer in range(num_layers):
        if layer == 0:
            num_touched = _first_layer(targets[0], voxels, costs, index, corridor_m, best, came_from, came_by, touched)
        else:
            num_touched = _expand(
                cells[layer - 1, :size], cost_before, move_before, layer, reaches_m[layer], voxels, costs, index, best,
                came_from, came_by, touched,
            )  # fmt: skip
        chosen, total, seen = _choose(touched[:num_touched], best, targets[layer], layer, voxels, costs, index, beam)
        num_seen += seen
        size = len(chosen)
        if size == 0:
            return np.full(num_layers, -1, dtype=np.int64), np.inf, num_seen
        for place in range(size):
            cells[layer, place] = chosen[place]
            parents[layer, place] = came_from[chosen[place]]
            cost_before[place] = total[place]
            move_before[place] = came_by[chosen[place]]
        for k in range(num_touched):
            best[touched[k]] = np.inf
    way = np.empty(num_layers, dtype=np.int64)
    place = int(np.argmin(cost_before[:size]))
    cost = cost_before[place]
    for layer in range(num_layers - 1, -1, -1):
        way[layer] = cells[layer, place]
        place = parents[layer, place]
    return way, cost, num_seen


@njit(cache=True)
def _first_layer(target, voxels, costs, index, corridor_m, best, came_from, came_by, touched):
    """Put the free cells around the first target into `touched`; they cost the distance from the reference start."""
    num_y, num_z = voxels.shape[1], voxels.shape[2]
    num_touched = 0
    for ix in range(voxels.shape[0]):
        for iy in range(num_y):
            x = voxels.low[0] + ix * voxels.size[0]
            y = voxels.low[1] + iy * voxels.size[1]
            if (x - target[0]) ** 2 + (y - target[1]) ** 2 > corridor_m * corridor_m or not voxels.columns[ix, iy]:
                continue
            for iz in range(num_z):
                cell = (ix * num_y + iy) * num_z + iz
                z = voxels.low[2] + iz * voxels.size[2]
                if not _is_in_bounds(z, costs, 0) or _clearance(cell, voxels, costs, index) < costs.safety_m:
                    continue
                away = np.sqrt((x - costs.start[0]) ** 2 + (y - costs.start[1]) ** 2 + (z - costs.start[2]) ** 2)
                best[cell] = costs.weights[PATH] * away / voxels.size[0]
                came_from[cell] = -1
                came_by[cell] = STAY
                touched[num_touched] = cell
                num_touched += 1
    return num_touched


@njit(cache=True)
def _expand(sources, cost_before, moved, layer, reach_m, voxels, costs, index, best, came_from, came_by, touched):
    """Put the reachable cells into `touched`, the cheapest move there into `best`, `came_from` and `came_by`."""
    lengths = voxels.lengths
    num_x, num_y, num_z = voxels.shape[0], voxels.shape[1], voxels.shape[2]
    num_touched = 0
    for place in range(len(sources)):
        cell = sources[place]
        ix, iy, iz = cell // (num_y * num_z), (cell // num_z) % num_y, cell % num_z
        for move in range(len(MOVES)):
            jx, jy, jz = ix + MOVES[move, 0], iy + MOVES[move, 1], iz + MOVES[move, 2]
            if lengths[move] > reach_m + 1e-9 or not (0 <= jx < num_x and 0 <= jy < num_y and 0 <= jz < num_z):
                continue
            there = (jx * num_y + jy) * num_z + jz
            cost = cost_before[place] + costs.weights[PATH] * lengths[move] / voxels.size[0]
            cost += costs.weights[SMOOTHNESS] * BENDS[moved[place], move]
            if cost >= best[there] or not voxels.columns[jx, jy]:
                continue
            if not _is_in_bounds(voxels.low[2] + jz * voxels.size[2], costs, layer):
                continue
            if voxels.edges[cell, move] == UNKNOWN:
                voxels.edges[cell, move] = FREE if _edge_is_free(cell, there, voxels, costs, index) else BLOCKED
            if voxels.edges[cell, move] == BLOCKED:
                continue
            if best[there] == np.inf:
                touched[num_touched] = there
                num_touched += 1
            best[there] = cost
            came_from[there] = place
            came_by[there] = move
    return num_touched


@njit(cache=True)
def _choose(touched, best, target, layer, voxels, costs, index, beam):
    """Add the cost of each cell; return the `beam` cheapest cells, their costs, and the number of visibility queries.

    Visibility is computed only where the cost without it is within the beam.
    """
    bounds, reach_m = _costs_if_visible(touched, best, target, layer, voxels, costs)
    horizon = make_horizon(index, target, reach_m, 0.0)
    total = np.full(len(touched), np.inf)
    num = 0
    limit = np.partition(bounds, beam - 1)[beam - 1] if len(touched) > beam else np.inf
    for k in range(len(touched)):  # those within the beam if all cells saw everything
        if bounds[k] <= limit:
            total[k] = bounds[k] + costs.sight[layer] * (1.0 - _look(touched[k], voxels, index, horizon, target))
            num += 1
    if num < len(touched):
        limit = np.partition(total, beam - 1)[beam - 1]
    for k in range(len(touched)):  # and those cheaper than cells that turned out to be hidden
        if total[k] == np.inf and bounds[k] < limit:
            total[k] = bounds[k] + costs.sight[layer] * (1.0 - _look(touched[k], voxels, index, horizon, target))
            num += 1
            if num % 256 == 0:
                limit = np.partition(total, beam - 1)[beam - 1]
    limit = np.partition(total, beam - 1)[beam - 1] if num > beam else np.inf
    chosen = np.empty(min(num, beam), dtype=np.int64)
    chosen_costs = np.empty(min(num, beam))
    size = 0
    for k in range(len(touched)):
        if total[k] <= limit and total[k] < np.inf and size < beam:
            chosen[size] = touched[k]
            chosen_costs[size] = total[k]
            size += 1
    return chosen[:size], chosen_costs[:size], num


@njit(cache=True)
def _costs_if_visible(touched, best, target, layer, voxels, costs):
    """Return the cost of each cell from which the target is visible, and the largest distance to the target, m."""
    totals = np.empty(len(touched))
    reach_m = 0.0
    for k in range(len(touched)):
        cell = touched[k]
        x, y, z = _place(cell, voxels)
        away = np.sqrt((x - target[0]) ** 2 + (y - target[1]) ** 2)
        reach_m = max(reach_m, away)
        aside = away - costs.ring_m[layer]
        requested_x, requested_y = costs.requested[layer, 0], costs.requested[layer, 1]
        if not np.isnan(requested_x):
            aside = np.sqrt((x - requested_x) ** 2 + (y - requested_y) ** 2)
        climb = z - costs.preferred_z[layer]
        gap = voxels.clearances[cell]  # computed by the expansion
        near = max(0.0, 1.0 - gap / costs.influence_m)
        off = costs.weights[TRACKING] * np.sqrt(aside * aside + climb * climb) / voxels.size[0]
        totals[k] = best[cell] + off + costs.weights[SAFETY] * near * near
    return totals, reach_m


@njit(cache=True, inline="always")
def _is_in_bounds(z, costs, layer):
    """Return whether a height keeps the altitudes of a layer."""
    return costs.least_z[layer] - ALTITUDE_ROUNDING_M <= z <= costs.greatest_z[layer] + ALTITUDE_ROUNDING_M


@njit(cache=True, inline="always")
def _look(cell, voxels, index, horizon, target):
    """Return the five-ray visibility of the target from a cell."""
    x, y, z = _place(cell, voxels)
    return five_ray_visibility(index, horizon, target, x, y, z)


@njit(cache=True, inline="always")
def _place(cell, voxels):
    """Return the centre of a cell, x, y, z in m."""
    num_y, num_z = voxels.shape[1], voxels.shape[2]
    return (
        voxels.low[0] + (cell // (num_y * num_z)) * voxels.size[0],
        voxels.low[1] + ((cell // num_z) % num_y) * voxels.size[1],
        voxels.low[2] + (cell % num_z) * voxels.size[2],
    )


@njit(cache=True)
def _clearance(cell, voxels, costs, index):
    """Return the signed distance of a cell's centre to the nearest box, m, at most what the costs need."""
    if np.isnan(voxels.clearances[cell]):
        x, y, z = _place(cell, voxels)
        # Beyond the influence, clearance matters to the edges only, and beyond this not even to them.
        reach_m = max(costs.influence_m, costs.safety_m + np.sqrt((voxels.size**2).sum()) / 2.0)
        voxels.clearances[cell], _ = nearest_box(index, x, y, z, reach_m)
    return voxels.clearances[cell]


@njit(cache=True)
def _edge_is_free(cell, there, voxels, costs, index):
    """Return whether the line between two cells keeps the safety distance."""
    a, b = _clearance(cell, voxels, costs, index), _clearance(there, voxels, costs, index)
    if a < costs.safety_m or b < costs.safety_m:
        return False
    ax, ay, az = _place(cell, voxels)
    bx, by, bz = _place(there, voxels)
    length = np.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)
    if a + b - length >= 2.0 * costs.safety_m:  # distance changes by at most a metre per metre
        return True
    return collect_hits(index, ax, ay, az, bx, by, bz, costs.safety_m, np.empty(1, dtype=np.int64)) == 0


# --- planner ----------------------------------------------------------------------------------------------------------


def plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan one trajectory (the signature of `planners.contract`); nothing here is random."""
    for safety_m in (cfg.safety_distance_m, cfg.relaxed_safety_m):
        result = search_trajectory(scenario, obstacles, cfg, safety_m)
        if result is not None:
            raw, facts = result
            points, smoothing = smooth_trajectory(raw, scenario, obstacles, cfg, safety_m)
            return Plan(points, {"safety_m": safety_m, **facts, **smoothing})
    raise scenario.no_path_error("no free voxels connect start and end", cfg.relaxed_safety_m)


def search_trajectory(
    scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, safety_m: float
) -> tuple[np.ndarray, dict] | None:
    """Search the raw trajectory.

    Args:
        safety_m: least distance to obstacles of points and of the lines between them.
    Returns:
        (n, 3) one position per target, and facts of the search; None if there is no path.
    """
    settings = cfg.track_astar
    targets = scenario.targets_m
    reference = scenario.reference
    voxels = make_voxels(scenario, cfg)
    frames, least_z, preferred_z, greatest_z = scenario.key_frames(frames_per_layer(cfg, scenario.dt_s))
    places = reference.places_m(targets, scenario.ground_m)[frames, :2]
    costs = Costs(
        weights=np.array([getattr(settings, f"weight_{name}") for name in WEIGHTS]),
        ring_m=reference.ground_distance_m[frames],
        requested=np.full_like(places, np.nan) if reference.any_bearing else places,
        sight=settings.weight_visibility * reference.keeps_sight[frames],
        least_z=least_z, preferred_z=preferred_z, greatest_z=greatest_z,
        influence_m=settings.influence_m, safety_m=safety_m, start=np.array([*places[0], preferred_z[0]]),
    )  # fmt: skip
    reaches_m = np.diff(frames, prepend=frames[0]) * scenario.dt_s * cfg.speed_max_mps
    beam = settings.beam
    corridor_m = settings.corridor_m
    cells, cost, num_seen = search_layers(targets[frames], reaches_m, voxels, costs, obstacles, beam, corridor_m)
    if cells[0] < 0:
        return None
    places = voxels.low + np.stack(np.unravel_index(cells, tuple(voxels.shape)), axis=1) * voxels.size
    sizes = {"num_layers": len(frames), "num_cells": len(voxels.clearances), "states_seen": int(num_seen)}
    return scenario.between(frames, places), {**sizes, "cost": float(cost)}


def frames_per_layer(cfg: PlanConfig, dt_s: float = DT_S) -> int:
    """Return the frames that the drone needs at most to reach a neighbouring voxel."""
    settings = cfg.track_astar
    diagonal_m = float(np.sqrt(2.0 * settings.voxel_m**2 + settings.voxel_height_m**2))
    return int(np.ceil(diagonal_m / (cfg.speed_max_mps * dt_s) - 1e-9))


def make_voxels(scenario: Scenario, cfg: PlanConfig) -> Voxels:
    """Return the grid around a pedestrian trajectory: the corridor in the plane, between the altitude bounds."""
    settings = cfg.track_astar
    flat = scenario.targets_m[:, :2]
    reference = scenario.reference
    low_xy = flat.min(axis=0) - settings.corridor_m
    num_xy = np.floor((np.ptp(flat, axis=0) + 2.0 * settings.corridor_m) / settings.voxel_m) + 1
    least_z, greatest_z = (scenario.ground_m + bound for bound in (reference.altitude_min_m, reference.altitude_max_m))
    num_z = np.floor((greatest_z.max() - least_z.min()) / settings.voxel_height_m + 1e-9) + 1
    if num_xy.prod() * num_z > MAX_CELLS:
        raise NoPathError(
            "the pedestrian trajectory covers too large an area for the voxel grid",
            where=scenario.path_id,
            got=f"{num_xy.prod() * num_z:.0f} voxels",
            expected=f"at most {MAX_CELLS} voxels",
            fix="choose another plan.planner, or make shorter pedestrian trajectories",
        )
    shape = np.array([*num_xy, num_z], dtype=np.int64)
    size = np.array([settings.voxel_m, settings.voxel_m, settings.voxel_height_m])
    low = np.array([*low_xy, least_z.min()])
    num_cells = int(shape.prod())
    lengths_m = np.sqrt(((MOVES * size) ** 2).sum(axis=1))
    x, y = (low[axis] + np.arange(shape[axis]) * size[axis] for axis in range(2))
    columns = np.zeros(shape[:2], dtype=np.bool_)
    for point in flat:
        columns |= (point[0] - x[:, None]) ** 2 + (point[1] - y) ** 2 <= settings.corridor_m**2
    edges = np.zeros((num_cells, len(MOVES)), dtype=np.int8)
    return Voxels(low, shape, size, lengths_m, columns, np.full(num_cells, np.nan), edges)
