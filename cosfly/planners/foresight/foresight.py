"""Foresight: choose for the whole walk at once the places that see it, then smooth without losing sight.

MuCO improves a flight where it is, so it stays on the blind side of a row of trees; TA*+Smooth sees both sides, but flies from voxel
to voxel. Here dynamic programming over rings round the wished place finds the sides, with a tenth of the places (`search.py`), and a
least-squares flight follows them as closely as sight and safety ask for (`smooth.py`).
"""

from __future__ import annotations

import numpy as np

from cosfly.errors import NoPathError
from cosfly.planners.contract import Plan, PlanConfig, Scenario
from cosfly.planners.foresight.lattice import make_lattice
from cosfly.planners.foresight.search import SPEED_SHARE, search_flight
from cosfly.planners.foresight.smooth import smooth_flight, unsafe
from cosfly.space.kernels import BoxIndex, visibility


def plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan:
    """Plan one flight (the signature of `planners.contract`); nothing here is random.

    Raises:
        NoPathError: no places lead along this walk.
    """
    raw, start, clearance_m = raw_flight(scenario, obstacles, cfg)
    points, facts = smooth_flight(raw, scenario, obstacles, cfg, clearance_m)
    return Plan(points, {"start": start, "clearance_m": clearance_m, **facts})


def raw_flight(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig) -> tuple[np.ndarray, str, float]:
    """Give the flight to be smoothed, its kind (`wished`, `search` or `climbing search`), and the clearance that it keeps, m.

    Where the wished places are free and see all that they are to see, nothing is searched.

    Raises:
        NoPathError: no places lead along this walk.
    """
    wished, step_m = scenario.wish.places_m(scenario.targets_m, scenario.ground_m), cfg.speed_max_mps * scenario.dt_s
    safety_m, relaxed_m = cfg.safety_distance_m, cfg.relaxed_safety_m
    sees_all = bool((~scenario.wish.keeps_sight | (visibility(obstacles, wished, scenario.targets_m) == 1.0)).all())
    if sees_all and not unsafe(wished, obstacles, safety_m, SPEED_SHARE * step_m).any():
        return wished, "wished", safety_m
    for climbing, clearance_m in ((False, safety_m), (True, safety_m), (True, relaxed_m)):
        found = search_flight(scenario, make_lattice(scenario, climbing=climbing), obstacles, cfg, clearance_m)
        if found is not None:
            return found, "climbing search" if climbing else "search", clearance_m
    low_m, high_m = scenario.wish.altitude_min_m.min(), scenario.wish.altitude_max_m.max()
    raise NoPathError(
        "no free places lead along this walk",
        where=scenario.path_id,
        expected=f"places from {low_m:g} to {high_m:g} m up, {relaxed_m:g} m from all boxes",
        fix="is the walk roofed over? raise altitude_max_m or leave the path out",
    )
