"""`return_home`: an order of the mission ends the pursuit; the drone breaks off, turns away and flies to where it started."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.planners.contract import PlanConfig, Scenario, Wish
from cosfly.planners.courses import ROUNDING_S
from cosfly.planners.styles import ALTITUDE_LEAST_M
from cosfly.products.segments import MISSION_KINDS, Mission

BREAKS_OFF_S = 4.0
LEAVES_MPS, HOME_MPS = 2.5, 6.0
LEAVES_M, CLIMBS_M = 6.0, 8.0  # away from the walker and up, before it turns for home
PURSUIT_LEAST = 1 / 3  # of the flight


def wish_of_mission(wish: Wish, scenario: Scenario, cfg: PlanConfig, rng: np.random.Generator) -> tuple[Wish, Mission]:
    """End a flight's wish with the way home. The order comes so late that the rest of the walk is just enough for it."""
    places, dt_s = wish.places_m(scenario.targets_m, scenario.ground_m), scenario.dt_s
    home_m, breaks_off = places[0], round(BREAKS_OFF_S / dt_s)
    first = int(len(places) * PURSUIT_LEAST)
    ways = np.linalg.norm(places[:, :2] - home_m[:2], axis=1) / (HOME_MPS * dt_s) + breaks_off + LEAVES_M / HOME_MPS
    in_time = np.flatnonzero(np.arange(len(places)) + ways <= len(places) - 1)
    at = max(first, int(in_time[-1]) if len(in_time) else first)
    flown = _way_home(places, scenario.targets_m, at, breaks_off, home_m, dt_s)
    kind = MISSION_KINDS[int(rng.integers(len(MISSION_KINDS)))]
    mission = Mission(kind, at, min(at + breaks_off, len(places) - 1), tuple(np.round(home_m, 4).tolist()))
    return _seen_from_the_walker(wish, scenario, flown, at, cfg), mission


def _way_home(
    places: np.ndarray, targets_m: np.ndarray, at: int, breaks_off: int, home_m: np.ndarray, dt_s: float
) -> np.ndarray:
    """Give the wished places with the way home from frame `at` on, (n, 3)."""
    flown, here = places.copy(), places[at].copy()
    away = here - targets_m[at]
    away[2] = 0.0
    aside = here + away / max(float(np.linalg.norm(away)), 1e-6) * LEAVES_M + [0.0, 0.0, CLIMBS_M]
    over_home = np.array([home_m[0], home_m[1], max(home_m[2], here[2]) + CLIMBS_M])
    for i in range(at + 1, len(places)):
        goal, speed_mps = (aside, LEAVES_MPS) if i <= at + breaks_off else (over_home, HOME_MPS)
        way = goal - here
        here = here + way * min(1.0, speed_mps * dt_s / max(float(np.linalg.norm(way)), 1e-9))
        flown[i] = here
    return gaussian_filter1d(flown, ROUNDING_S / dt_s, axis=0, mode="nearest")


def _seen_from_the_walker(wish: Wish, scenario: Scenario, places: np.ndarray, at: int, cfg: PlanConfig) -> Wish:
    """Give the wish whose places these are."""
    away, num = places - scenario.targets_m, len(places)
    apart_m = np.hypot(away[:, 0], away[:, 1])
    return replace(
        wish,
        bearing_rad=np.unwrap(np.arctan2(away[:, 1], away[:, 0])) - wish.heading_rad,
        distance_m=np.linalg.norm(away, axis=1),
        ground_distance_m=apart_m,
        pitch_rad=np.arctan2(away[:, 2], apart_m),
        altitude_m=places[:, 2] - scenario.ground_m,
        altitude_min_m=np.full(num, min(ALTITUDE_LEAST_M, cfg.altitude_min_m)),
        keeps_sight=np.arange(num) < at,
        any_bearing=False,
    )
