"""TA*+Smooth: a search for sight on a time-layered voxel grid, then smoothing (subsec:appendix_planner_tastar).

The state is a voxel and a time. A layer lasts as many frames as the drone needs at its speed limit to reach all 26 neighbours of a
voxel (two, with the paper's settings), so that no direction is dearer than another; frames between layers are interpolated. All
states of a layer have the same way to go in time, so a best-first order by cost alone with a beam per layer is the whole search:
there is no heuristic to add. The paper names the five weights but not the terms; the terms are these, per layer:

    tracking    distance to the ring round the target at the behind distance and the preferred altitude, in voxels
    visibility  1 - five-ray visibility
    path        length of the move, in voxels
    safety      (1 - clearance / influence)^2 below the influence distance; below the safety distance a voxel is closed
    smoothness  squared change of the move, in voxels

The move before a state is that of its cheapest predecessor: the smoothness term sees one past, not all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosfly.compiled import njit
from cosfly.errors import NoPathError
from cosfly.geometry import DT_S
from cosfly.kernels import RAY_OFFSETS_M, RAY_SPREAD_M, BoxIndex, _clip, _in_box_frame, collect_hits, nearest_box
from cosfly.planners.smooth import smooth_flight
from cosfly.planners.stage import Plan, PlanConfig, Scenario
from cosfly.planners.start import behind, smoothed_headings

MAX_CELLS = 4_000_000  # a walk of 50-100 m needs about 50 000
NUM_SECTORS = 128  # of the horizon round a target

# The 26 neighbours of a voxel and itself.
MOVES = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], dtype=np.int64)
STAY = 13

# Feet of the five rays (RAY_OFFSETS_M): the lowest relative to the hip, and how far to the side.
FOOT_LOW_M, FOOT_SIDE_M = -0.6, 0.3
ALL_BLOCKED = 0b11111


class Voxels(NamedTuple):
    """The grid of one search. low: (3,) m, centre of voxel (0, 0, 0). shape: (3,). size: (3,) m.

    columns: (nx, ny) bool, inside the corridor. Caches, filled when first asked: clearances (cells,) m, NaN is unknown;
    edges (cells, 27): 0 unknown, 1 free, 2 blocked.
    """

    low: np.ndarray
    shape: np.ndarray
    size: np.ndarray
    columns: np.ndarray
    clearances: np.ndarray
    edges: np.ndarray


class Costs(NamedTuple):
    """Weights and lengths of the search; order of weights as in the module's docstring."""

    weights: np.ndarray
    behind_m: float
    preferred_z: float
    influence_m: float
    safety_m: float
    start: np.ndarray


class Horizon(NamedTuple):
    """What can hide one target, by direction. m boxes near it.

    counts: (NUM_SECTORS,), lists: (NUM_SECTORS, m) boxes that reach into each sector. near: (m,) m, horizontal distance less the
    rays' spread. slopes: (m,) a ray that rises more than this per horizontal metre passes above. steepest: (NUM_SECTORS,).
    """

    boxes: np.ndarray
    near: np.ndarray
    slopes: np.ndarray
    counts: np.ndarray
    lists: np.ndarray
    steepest: np.ndarray


# --- the planner ------------------------------------------------------------------------------------------------------


def plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan one flight (the signature of `planners.contract`); nothing here is random.

    Raises:
        NoPathError: the grid is too large, or no voxels lead along this walk.
    """
    for safety_m in (cfg.safety_distance_m, cfg.relaxed_safety_m):
        found = search_flight(scenario, obstacles, cfg, safety_m)
        if found is not None:
            raw, facts = found
            points, smoothing = smooth_flight(raw, scenario.targets_m, obstacles, cfg, safety_m, scenario.ground_m)
            return Plan(points, {"safety_m": safety_m, **facts, **smoothing})
    raise NoPathError(
        "no free voxels lead along this walk",
        where=scenario.path_id,
        expected=f"places from {cfg.altitude_min_m:g} to {cfg.altitude_max_m:g} m up, {cfg.relaxed_safety_m:g} m from all boxes",
        fix="is the walk roofed over? raise altitude_max_m or leave the path out",
    )


def search_flight(
    scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, safety_m: float
) -> tuple[np.ndarray, dict] | None:
    """Search the raw flight of one walk.

    Args:
        safety_m: least distance to obstacles of points and of the lines between them.
    Returns:
        (n, 3) one position per target, and facts of the search; None if there is no way.
    """
    settings, targets = cfg.track_astar, scenario.targets_m
    voxels = make_voxels(scenario, cfg)
    frames = np.unique(np.append(np.arange(0, len(targets), frames_per_layer(cfg)), len(targets) - 1))
    start = behind(targets[:1], smoothed_headings(targets, cfg.heading_smoothing_s)[:1], cfg.behind_distance_m, 0.0)[0]
    preferred_z = scenario.ground_m + cfg.altitude_preferred_m
    costs = Costs(
        weights=np.array([getattr(settings, f"weight_{name}") for name in ("tracking", "visibility", "path", "safety", "smoothness")]),
        behind_m=cfg.behind_distance_m, preferred_z=preferred_z, influence_m=settings.influence_m, safety_m=safety_m,
        start=np.array([start[0], start[1], preferred_z]),
    )  # fmt: skip
    reaches_m = np.diff(frames, prepend=frames[0]) * DT_S * cfg.speed_max_mps
    cells, cost, num_seen = _search(
        targets[frames], reaches_m, voxels, costs, obstacles, settings.beam, settings.corridor_m
    )
    if cells[0] < 0:
        return None
    places = voxels.low + np.stack(np.unravel_index(cells, tuple(voxels.shape)), axis=1) * voxels.size
    every = np.arange(len(targets))
    raw = np.stack([np.interp(every, frames, places[:, axis]) for axis in range(3)], axis=1)
    return raw, {
        "num_layers": len(frames),
        "num_cells": len(voxels.clearances),
        "states_seen": int(num_seen),
        "cost": float(cost),
    }


def frames_per_layer(cfg: PlanConfig) -> int:
    """Frames that the drone needs at most to reach a neighbouring voxel."""
    settings = cfg.track_astar
    diagonal_m = float(np.sqrt(2.0 * settings.voxel_m**2 + settings.voxel_height_m**2))
    return int(np.ceil(diagonal_m / (cfg.speed_max_mps * DT_S) - 1e-9))


def make_voxels(scenario: Scenario, cfg: PlanConfig) -> Voxels:
    """Lay the grid round a walk: the corridor in the plane, the altitude bounds above it.

    Raises:
        NoPathError: more than MAX_CELLS.
    """
    settings, flat = cfg.track_astar, scenario.targets_m[:, :2]
    low_xy = flat.min(axis=0) - settings.corridor_m
    num_xy = np.floor((np.ptp(flat, axis=0) + 2.0 * settings.corridor_m) / settings.voxel_m) + 1
    num_z = np.floor((cfg.altitude_max_m - cfg.altitude_min_m) / settings.voxel_height_m + 1e-9) + 1
    if num_xy.prod() * num_z > MAX_CELLS:
        raise NoPathError(
            "the walk is too long for the voxel grid", where=scenario.path_id, got=f"{num_xy.prod() * num_z:.0f} voxels",
            expected=f"at most {MAX_CELLS}", fix="raise track_astar.voxel_m",
        )  # fmt: skip
    shape = np.array([*num_xy, num_z], dtype=np.int64)
    size = np.array([settings.voxel_m, settings.voxel_m, settings.voxel_height_m])
    low = np.array([*low_xy, scenario.ground_m + cfg.altitude_min_m])
    num_cells = int(shape.prod())
    return Voxels(
        low, shape, size, _corridor(low, shape, size, np.ascontiguousarray(flat), settings.corridor_m),
        np.full(num_cells, np.nan), np.zeros((num_cells, len(MOVES)), dtype=np.int8),
    )  # fmt: skip


@njit(cache=True)
def _corridor(low, shape, size, flat, margin_m):
    """Tell which columns are within `margin_m` of a point of the walk."""
    inside = np.zeros((shape[0], shape[1]), dtype=np.bool_)
    for ix in range(shape[0]):
        for iy in range(shape[1]):
            x, y = low[0] + ix * size[0], low[1] + iy * size[1]
            for point in range(len(flat)):
                if (flat[point, 0] - x) ** 2 + (flat[point, 1] - y) ** 2 <= margin_m * margin_m:
                    inside[ix, iy] = True
                    break
    return inside


# --- search -----------------------------------------------------------------------------------------------------------


@njit(cache=True)
def _search(targets, reaches_m, voxels, costs, index, beam, corridor_m):
    """Give the cell of each layer, (m,), all -1 if there is no way; the cost of the way; the number of places looked from.

    targets: (m, 3) hip points of the layers. reaches_m: (m,) longest move into each layer.
    """
    num_layers, num_cells = len(targets), len(voxels.clearances)
    cells, parents = np.empty((num_layers, beam), dtype=np.int64), np.empty((num_layers, beam), dtype=np.int64)
    best = np.full(num_cells, np.inf)
    came_from, came_by = np.empty(num_cells, dtype=np.int64), np.empty(num_cells, dtype=np.int64)
    touched, num_seen = np.empty(num_cells, dtype=np.int64), 0
    lengths, bends = _move_tables(voxels.size)
    cost_before, move_before = np.empty(beam), np.empty(beam, dtype=np.int64)
    size = 0
    for layer in range(num_layers):
        if layer == 0:
            num = _first_layer(targets[0], voxels, costs, index, corridor_m, best, came_from, came_by, touched)
        else:
            num = _expand(
                cells[layer - 1, :size], cost_before, move_before, reaches_m[layer], lengths, bends, voxels, costs, index,
                best, came_from, came_by, touched,
            )  # fmt: skip
        chosen, total, seen = _choose(touched[:num], best, targets[layer], voxels, costs, index, beam)
        num_seen += seen
        size = len(chosen)
        if size == 0:
            return np.full(num_layers, -1, dtype=np.int64), np.inf, num_seen
        for b in range(size):
            cells[layer, b], parents[layer, b] = chosen[b], came_from[chosen[b]]
            cost_before[b], move_before[b] = total[b], came_by[chosen[b]]
        for place in range(num):
            best[touched[place]] = np.inf
    way, b = np.empty(num_layers, dtype=np.int64), int(np.argmin(cost_before[:size]))
    cost = cost_before[b]
    for layer in range(num_layers - 1, -1, -1):
        way[layer] = cells[layer, b]
        b = parents[layer, b]
    return way, cost, num_seen


@njit(cache=True)
def _move_tables(size):
    """Give the length of each move, m, and the squared change between each two, in voxels."""
    lengths, bends = np.empty(len(MOVES)), np.empty((len(MOVES), len(MOVES)))
    for m in range(len(MOVES)):
        lengths[m] = np.sqrt(((MOVES[m] * size) ** 2).sum())
        for k in range(len(MOVES)):
            bends[m, k] = ((MOVES[m] - MOVES[k]) ** 2).sum()
    return lengths, bends


@njit(cache=True)
def _first_layer(target, voxels, costs, index, corridor_m, best, came_from, came_by, touched):
    """Put the free cells within the corridor of the first target into `touched`; they cost the way from the plain start."""
    num_y, num_z, num = voxels.shape[1], voxels.shape[2], 0
    for ix in range(voxels.shape[0]):
        for iy in range(num_y):
            x, y = voxels.low[0] + ix * voxels.size[0], voxels.low[1] + iy * voxels.size[1]
            if (x - target[0]) ** 2 + (y - target[1]) ** 2 > corridor_m * corridor_m or not voxels.columns[ix, iy]:
                continue
            for iz in range(num_z):
                cell = (ix * num_y + iy) * num_z + iz
                if _clearance(cell, voxels, costs, index) < costs.safety_m:
                    continue
                z = voxels.low[2] + iz * voxels.size[2]
                away = np.sqrt((x - costs.start[0]) ** 2 + (y - costs.start[1]) ** 2 + (z - costs.start[2]) ** 2)
                best[cell] = costs.weights[2] * away / voxels.size[0]
                came_from[cell], came_by[cell], touched[num] = -1, STAY, cell
                num += 1
    return num


@njit(cache=True)
def _expand(
    sources, cost_before, move_before, reach_m, lengths, bends, voxels, costs, index, best, came_from, came_by, touched
):
    """Put the cells that can be reached into `touched`, the cheapest way there into `best`, `came_from` and `came_by`."""
    num_x, num_y, num_z, num = voxels.shape[0], voxels.shape[1], voxels.shape[2], 0
    for b in range(len(sources)):
        cell = sources[b]
        ix, iy, iz = cell // (num_y * num_z), (cell // num_z) % num_y, cell % num_z
        for move in range(len(MOVES)):
            jx, jy, jz = ix + MOVES[move, 0], iy + MOVES[move, 1], iz + MOVES[move, 2]
            if (
                lengths[move] > reach_m + 1e-9
                or jx < 0
                or jy < 0
                or jz < 0
                or jx >= num_x
                or jy >= num_y
                or jz >= num_z
            ):
                continue
            there = (jx * num_y + jy) * num_z + jz
            cost = (
                cost_before[b]
                + costs.weights[2] * lengths[move] / voxels.size[0]
                + costs.weights[4] * bends[move_before[b], move]
            )
            if cost >= best[there] or not voxels.columns[jx, jy]:
                continue
            if voxels.edges[cell, move] == 0:
                voxels.edges[cell, move] = 1 if _edge_is_free(cell, there, voxels, costs, index) else 2
            if voxels.edges[cell, move] == 2:
                continue
            if best[there] == np.inf:
                touched[num] = there
                num += 1
            best[there], came_from[there], came_by[there] = cost, b, move
    return num


@njit(cache=True)
def _choose(touched, best, target, voxels, costs, index, beam):
    """Add the cost of being there and give the `beam` cheapest cells, their costs, and how many were looked from.

    Visibility is asked only where the cost without it is within the beam.
    """
    bounds, reach_m = np.empty(len(touched)), 0.0
    for k in range(len(touched)):
        cell = touched[k]
        x, y, z = _place(cell, voxels)
        away = np.sqrt((x - target[0]) ** 2 + (y - target[1]) ** 2)
        reach_m, aside = max(reach_m, away), away - costs.behind_m
        climb, gap = z - costs.preferred_z, voxels.clearances[cell]  # known: the way here has asked for it
        near = max(0.0, 1.0 - gap / costs.influence_m)
        bounds[k] = (
            best[cell]
            + costs.weights[0] * np.sqrt(aside * aside + climb * climb) / voxels.size[0]
            + costs.weights[3] * near * near
        )
    horizon = make_horizon(index, target, reach_m)
    total, num = np.full(len(touched), np.inf), 0
    limit = np.partition(bounds, beam - 1)[beam - 1] if len(touched) > beam else np.inf
    for k in range(len(touched)):  # those that would stay if all saw everything
        if bounds[k] <= limit:
            total[k] = bounds[k] + costs.weights[1] * (1.0 - _look(touched[k], voxels, index, horizon, target))
            num += 1
    if num < len(touched):
        limit = np.partition(total, beam - 1)[beam - 1]
    for k in range(len(touched)):  # and those that are cheaper than what has turned out to be hidden
        if total[k] == np.inf and bounds[k] < limit:
            total[k] = bounds[k] + costs.weights[1] * (1.0 - _look(touched[k], voxels, index, horizon, target))
            num += 1
            if num % 256 == 0:
                limit = np.partition(total, beam - 1)[beam - 1]
    limit = np.partition(total, beam - 1)[beam - 1] if num > beam else np.inf
    chosen, kept, size = np.empty(min(num, beam), dtype=np.int64), np.empty(min(num, beam)), 0
    for k in range(len(touched)):
        if total[k] <= limit and total[k] < np.inf and size < beam:
            chosen[size], kept[size] = touched[k], total[k]
            size += 1
    return chosen[:size], kept[:size], num


@njit(cache=True, inline="always")
def _look(cell, voxels, index, horizon, target):
    x, y, z = _place(cell, voxels)
    return look(index, horizon, target, x, y, z)


@njit(cache=True, inline="always")
def _place(cell, voxels):
    num_y, num_z = voxels.shape[1], voxels.shape[2]
    return (
        voxels.low[0] + (cell // (num_y * num_z)) * voxels.size[0],
        voxels.low[1] + ((cell // num_z) % num_y) * voxels.size[1],
        voxels.low[2] + (cell % num_z) * voxels.size[2],
    )


@njit(cache=True)
def _clearance(cell, voxels, costs, index):
    """Signed distance of a cell's centre to the nearest box, m, at most what the costs ask for."""
    if np.isnan(voxels.clearances[cell]):
        x, y, z = _place(cell, voxels)
        # Farther than the influence matters to the edges alone: beyond this no edge needs a closer look.
        reach_m = max(costs.influence_m, costs.safety_m + np.sqrt((voxels.size**2).sum()) / 2.0)
        voxels.clearances[cell], _ = nearest_box(index, x, y, z, reach_m)
    return voxels.clearances[cell]


@njit(cache=True)
def _edge_is_free(cell, there, voxels, costs, index):
    """Tell whether the line between two cells keeps the safety distance."""
    a, b = _clearance(cell, voxels, costs, index), _clearance(there, voxels, costs, index)
    if a < costs.safety_m or b < costs.safety_m:
        return False
    ax, ay, az = _place(cell, voxels)
    bx, by, bz = _place(there, voxels)
    length = np.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)
    if a + b - length >= 2.0 * costs.safety_m:  # distance changes by at most a metre per metre
        return True
    return collect_hits(index, ax, ay, az, bx, by, bz, costs.safety_m, np.empty(1, dtype=np.int64)) == 0


# --- sight ------------------------------------------------------------------------------------------------------------


@njit(cache=True)
def make_horizon(index, target, reach_m):
    """Sort the boxes round a target by direction, so that a look from above tests the few that can hide it.

    A ray that starts at height `low` or above and ends d away at p_z has risen to low + (p_z - low) t at the share t of its way,
    and it is no nearer to a box at horizontal distance r than t = (r - FOOT_SIDE_M) / d.
    """
    boxes, near, slopes, spans = _boxes_round(index, target, reach_m)
    counts = np.zeros(NUM_SECTORS, dtype=np.int64)
    lists = np.empty((NUM_SECTORS, len(boxes)), dtype=np.int64)
    steepest = np.full(NUM_SECTORS, -np.inf)
    for k in range(len(boxes)):
        first = int(np.floor(spans[k, 0] / (2.0 * np.pi) * NUM_SECTORS))
        last = int(np.floor(spans[k, 1] / (2.0 * np.pi) * NUM_SECTORS))
        for step in range(min(last - first + 1, NUM_SECTORS)):
            sector = (first + step) % NUM_SECTORS
            lists[sector, counts[sector]] = k
            counts[sector] += 1
            steepest[sector] = max(steepest[sector], slopes[k])
    return Horizon(boxes, near, slopes, counts, lists, steepest)


@njit(cache=True)
def _boxes_round(index, target, reach_m):
    """Give the boxes within `reach_m`, their horizontal distance, slope, and span of azimuth (2,), first <= last."""
    boxes = np.empty(len(index.rows), dtype=np.int64)
    near, slopes, spans, num = np.empty(len(boxes)), np.empty(len(boxes)), np.empty((len(boxes), 2)), 0
    if len(index.rows) == 0:
        return boxes, near, slopes, spans
    cell, num_x, num_y = index.grid[2], index.shape[0], index.shape[1]
    first_x = min(max(int(np.floor((target[0] - reach_m - index.grid[0]) / cell)), 0), num_x)
    last_x = min(int(np.floor((target[0] + reach_m - index.grid[0]) / cell)), num_x - 1)
    first_y = min(max(int(np.floor((target[1] - reach_m - index.grid[1]) / cell)), 0), num_y)
    last_y = min(int(np.floor((target[1] + reach_m - index.grid[1]) / cell)), num_y - 1)
    known, low = np.zeros(len(index.rows), dtype=np.bool_), target[2] + FOOT_LOW_M
    for ix in range(first_x, last_x + 1):
        for iy in range(first_y, last_y + 1):
            for place in range(index.starts[ix * num_y + iy], index.starts[ix * num_y + iy + 1]):
                box = index.members[place]
                if known[box]:
                    continue
                known[box] = True
                rows = index.rows[box]
                dx = max(rows[15] - target[0], 0.0, target[0] - rows[18])
                dy = max(rows[16] - target[1], 0.0, target[1] - rows[19])
                distance = np.sqrt(dx * dx + dy * dy)
                if distance > reach_m + FOOT_SIDE_M or rows[20] < low:
                    continue
                boxes[num], near[num] = box, max(distance - FOOT_SIDE_M, 0.0)
                slopes[num] = (rows[20] - low) / near[num] if near[num] > 1e-6 else np.inf
                spans[num, 0], spans[num, 1] = _span(rows, target, distance)
                num += 1
    return boxes[:num], near[:num], slopes[:num], spans[:num]


@njit(cache=True)
def _span(rows, target, distance_m):
    """Give the azimuths under which rays to a target may touch a box: those of its bounds, and the feet's spread."""
    if distance_m < 1.0:
        return 0.0, 2.0 * np.pi
    middle = np.arctan2(0.5 * (rows[16] + rows[19]) - target[1], 0.5 * (rows[15] + rows[18]) - target[0])
    left, right = 0.0, 0.0
    for corner in range(4):
        x, y = rows[15 + 3 * (corner % 2)], rows[16 + 3 * (corner // 2)]
        turn = np.arctan2(y - target[1], x - target[0]) - middle
        turn -= 2.0 * np.pi * np.floor((turn + np.pi) / (2.0 * np.pi))
        left, right = min(left, turn), max(right, turn)
    spread = np.arcsin(FOOT_SIDE_M / distance_m) + 1e-9
    return middle + left - spread, middle + right + spread


@njit(cache=True, inline="always")
def look(index, horizon, target, x, y, z):
    """Give the five-ray visibility of the horizon's target from a point above it: that of `kernels.visibility`, sooner."""
    dx, dy = x - target[0], y - target[1]
    away, rise = np.sqrt(dx * dx + dy * dy), z - target[2] - FOOT_LOW_M
    sector = int(np.floor(np.arctan2(dy, dx) / (2.0 * np.pi) * NUM_SECTORS)) % NUM_SECTORS
    # In products, so that straight above needs no division; a box round the target itself is infinitely steep.
    if horizon.counts[sector] == 0 or rise > horizon.steepest[sector] * away + 1e-9:
        return 1.0
    blocked = 0
    for place in range(horizon.counts[sector]):
        k = horizon.lists[sector, place]
        if horizon.near[k] <= away + 1e-9 and not rise > horizon.slopes[k] * away + 1e-9:
            blocked = _blocked_rays(index.rows, horizon.boxes[k], x, y, z, target, blocked)
            if blocked == ALL_BLOCKED:
                break
    num_free = 5
    for ray in range(5):
        num_free -= (blocked >> ray) & 1
    return num_free / 5.0


@njit(cache=True)
def _blocked_rays(rows, box, x, y, z, target, blocked):
    """Add to the bits of `blocked` the rays to a target that touch a box: the point and the hip turned into its frame once."""
    tx, ty, tz = target[0], target[1], target[2]
    if min(x, tx - FOOT_SIDE_M) > rows[box, 18] or max(x, tx + FOOT_SIDE_M) < rows[box, 15]:
        return blocked
    if min(y, ty) > rows[box, 19] or max(y, ty) < rows[box, 16] or tz + FOOT_LOW_M > rows[box, 20]:
        return blocked
    u, v, w = _in_box_frame(rows, box, x, y, z)
    hip_u, hip_v, hip_w = _in_box_frame(rows, box, tx, ty, tz)
    # Every ray is within RAY_SPREAD_M of the middle one: far outside the box none is blocked, deep inside all are.
    if not _touches(rows, box, hip_u, hip_v, hip_w, u, v, w, RAY_SPREAD_M):
        return blocked
    if _touches(rows, box, hip_u, hip_v, hip_w, u, v, w, -RAY_SPREAD_M):
        return ALL_BLOCKED
    for ray in range(5):
        if (blocked >> ray) & 1:
            continue
        a, b, c = RAY_OFFSETS_M[ray, 0], RAY_OFFSETS_M[ray, 1], RAY_OFFSETS_M[ray, 2]
        foot_u = hip_u + rows[box, 6] * a + rows[box, 9] * b + rows[box, 12] * c
        foot_v = hip_v + rows[box, 7] * a + rows[box, 10] * b + rows[box, 13] * c
        foot_w = hip_w + rows[box, 8] * a + rows[box, 11] * b + rows[box, 14] * c
        enter, leave = _clip(foot_u, u - foot_u, rows[box, 3], 0.0, 1.0)
        enter, leave = _clip(foot_v, v - foot_v, rows[box, 4], enter, leave)
        enter, leave = _clip(foot_w, w - foot_w, rows[box, 5], enter, leave)
        if enter <= leave:
            blocked |= 1 << ray
    return blocked


@njit(cache=True, inline="always")
def _touches(rows, box, a, b, c, u, v, w, inflate_m):
    """Tell whether a segment in a box's frame touches the box grown (or shrunk) on every side; a box shrunk away never is."""
    enter, leave = _clip(a, u - a, rows[box, 3] + inflate_m, 0.0, 1.0)
    enter, leave = _clip(b, v - b, rows[box, 4] + inflate_m, enter, leave)
    enter, leave = _clip(c, w - c, rows[box, 5] + inflate_m, enter, leave)
    least = min(rows[box, 3], rows[box, 4], rows[box, 5]) + inflate_m
    return enter <= leave and least >= 0.0
