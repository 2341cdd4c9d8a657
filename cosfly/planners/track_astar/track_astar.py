"""TA*+Smooth: a search for sight on a time-layered voxel grid, then smoothing (subsec:appendix_planner_tastar).

The state is a voxel and a time. A layer lasts as many frames as the drone needs at its speed limit to reach all 26 neighbours of a
voxel (two, with the paper's settings), so that no direction is dearer than another; frames between layers are interpolated. All
states of a layer have the same way to go in time, so a best-first order by cost alone with a beam per layer is the whole search:
there is no heuristic to add. The paper names the five weights but not the terms; the terms are these, per layer:

    tracking    distance to the ring round the target at the wished distance and altitude, in voxels; to the wished place on it
                where the wish is not that of the paper, to which any bearing will do
    visibility  1 - five-ray visibility
    path        length of the move, in voxels
    safety      (1 - clearance / influence)^2 below the influence distance; below the safety distance a voxel is closed
    smoothness  squared change of the move, in voxels

The move before a state is that of its cheapest predecessor: the smoothness term sees one past, not all.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from cosfly.errors import NoPathError
from cosfly.geometry import DT_S
from cosfly.planners.contract import Plan, PlanConfig, Scenario
from cosfly.planners.track_astar.search import MOVES, WEIGHTS, Costs, Voxels, search_layers
from cosfly.planners.track_astar.smooth import smooth_flight
from cosfly.space.kernels import BoxIndex
from cosfly.work.compiled import njit

MAX_CELLS = 4_000_000  # a walk of 50-100 m needs about 50 000


def plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan one flight (the signature of `planners.contract`); nothing here is random.

    Raises:
        NoPathError: the grid is too large, or no voxels lead along this walk.
    """
    for safety_m in (cfg.safety_distance_m, cfg.relaxed_safety_m):
        found = search_flight(scenario, obstacles, cfg, safety_m)
        if found is not None:
            raw, facts = found
            points, smoothing = smooth_flight(raw, scenario, obstacles, cfg, safety_m)
            return Plan(points, {"safety_m": safety_m, **facts, **smoothing})
    low_m, high_m = scenario.wish.altitude_min_m.min(), scenario.wish.altitude_max_m.max()
    raise NoPathError(
        "no free voxels lead along this walk",
        where=scenario.path_id,
        expected=f"places from {low_m:g} to {high_m:g} m up, {cfg.relaxed_safety_m:g} m from all boxes",
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
    settings, targets, wish = cfg.track_astar, scenario.targets_m, scenario.wish
    voxels = make_voxels(scenario, cfg)
    stride = frames_per_layer(cfg, scenario.dt_s)
    frames = np.unique(np.append(np.arange(0, len(targets), stride), len(targets) - 1))
    # Between layers the flight is straight while the ground may rise and fall: a layer keeps the bounds of all frames around it.
    around, ground_m = 2 * stride + 1, scenario.ground_m

    def highest(altitudes_m: np.ndarray) -> np.ndarray:
        return maximum_filter1d(ground_m + altitudes_m, around, mode="nearest")[frames]

    preferred_z, places = highest(wish.altitude_m), wish.places_m(targets, ground_m)[frames, :2]
    costs = Costs(
        weights=np.array([getattr(settings, f"weight_{name}") for name in WEIGHTS]),
        ring_m=wish.ground_distance_m[frames], wished=np.full_like(places, np.nan) if wish.any_bearing else places,
        sight=settings.weight_visibility * wish.keeps_sight[frames],
        least_z=highest(wish.altitude_min_m), preferred_z=preferred_z,
        greatest_z=minimum_filter1d(ground_m + wish.altitude_max_m, around, mode="nearest")[frames],
        influence_m=settings.influence_m, safety_m=safety_m, start=np.array([*places[0], preferred_z[0]]),
    )  # fmt: skip
    reaches_m = np.diff(frames, prepend=frames[0]) * scenario.dt_s * cfg.speed_max_mps
    cells, cost, num_seen = search_layers(
        targets[frames], reaches_m, voxels, costs, obstacles, settings.beam, settings.corridor_m
    )
    if cells[0] < 0:
        return None
    places = voxels.low + np.stack(np.unravel_index(cells, tuple(voxels.shape)), axis=1) * voxels.size
    every = np.arange(len(targets))
    raw = np.stack([np.interp(every, frames, places[:, axis]) for axis in range(3)], axis=1)
    sizes = {"num_layers": len(frames), "num_cells": len(voxels.clearances), "states_seen": int(num_seen)}
    return raw, {**sizes, "cost": float(cost)}


def frames_per_layer(cfg: PlanConfig, dt_s: float = DT_S) -> int:
    """Frames that the drone needs at most to reach a neighbouring voxel."""
    settings = cfg.track_astar
    diagonal_m = float(np.sqrt(2.0 * settings.voxel_m**2 + settings.voxel_height_m**2))
    return int(np.ceil(diagonal_m / (cfg.speed_max_mps * dt_s) - 1e-9))


def make_voxels(scenario: Scenario, cfg: PlanConfig) -> Voxels:
    """Lay the grid round a walk: the corridor in the plane, the altitude bounds above it.

    Raises:
        NoPathError: more than MAX_CELLS.
    """
    settings, flat, wish = cfg.track_astar, scenario.targets_m[:, :2], scenario.wish
    low_xy = flat.min(axis=0) - settings.corridor_m
    num_xy = np.floor((np.ptp(flat, axis=0) + 2.0 * settings.corridor_m) / settings.voxel_m) + 1
    least_z, greatest_z = (scenario.ground_m + bound for bound in (wish.altitude_min_m, wish.altitude_max_m))
    num_z = np.floor((greatest_z.max() - least_z.min()) / settings.voxel_height_m + 1e-9) + 1
    if num_xy.prod() * num_z > MAX_CELLS:
        raise NoPathError(
            "the walk is too long for the voxel grid", where=scenario.path_id, got=f"{num_xy.prod() * num_z:.0f} voxels",
            expected=f"at most {MAX_CELLS}", fix="raise track_astar.voxel_m",
        )  # fmt: skip
    shape = np.array([*num_xy, num_z], dtype=np.int64)
    size = np.array([settings.voxel_m, settings.voxel_m, settings.voxel_height_m])
    low = np.array([*low_xy, least_z.min()])
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
