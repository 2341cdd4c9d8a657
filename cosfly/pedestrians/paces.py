"""At which pace people go: one row a profile, and what it makes of a route: the way that is walked, and where it stands still.

Arithmetic on polylines; walking.py gives the way its times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from cosfly.pedestrians.walking import menger_curvature, speed_profile
from cosfly.products.walks import PLAIN_PACE

if TYPE_CHECKING:
    from cosfly.pedestrians.walkable import PedestriansConfig

STOP_GAP_MIN = 2  # waypoints from one stop to the next: between two neighbours that are both stops nobody gets on


@dataclass(frozen=True)
class Pace:
    """One profile; ranges are drawn from evenly.

    hurries: cruises at `hurry_speed_mps`. stop_every_m: way from one stop to the next, none without. stop_s: how long a stop is.
    turn_at: share of the route at which the person turns, never without; back: share of that way that is walked back.
    """

    hurries: bool = False
    stop_every_m: tuple[float, float] | None = None
    stop_s: tuple[float, float] = (0.0, 0.0)
    turn_at: tuple[float, float] | None = None
    back: tuple[float, float] = (0.0, 0.0)


# Stops are long enough for a drone to come to rest, and for a window of five frames before and after it did.
PACES = {
    PLAIN_PACE: Pace(),
    "stop_and_look": Pace(stop_every_m=(15.0, 35.0), stop_s=(5.0, 12.0)),
    "hurry": Pace(hurries=True),
    "turn_back": Pace(turn_at=(0.45, 0.75), back=(0.5, 0.9), stop_s=(1.0, 4.0)),
}


@dataclass(frozen=True)
class Way:
    """What a pace makes of a route: polyline_m (k, 2); stops_s (k,), how long the person stands at each waypoint, 0 at most."""

    polyline_m: np.ndarray
    stops_s: np.ndarray

    @cached_property
    def along_m(self) -> np.ndarray:
        """Length of the way to each waypoint, (k,) m."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.polyline_m, axis=0), axis=1))])

    @classmethod
    def without_stops(cls, polyline_m: np.ndarray) -> Way:
        return cls(polyline_m, np.zeros(len(polyline_m)))


def take_pace(route_m: np.ndarray, pace: Pace, rng: np.random.Generator) -> Way:
    """Go a route, (k, 2) m, at a pace. Nobody stops at its ends; a route without a waypoint between them is gone as it is."""
    if len(route_m) < 3:
        return Way.without_stops(route_m)
    turn = len(route_m) - 1
    way_m = route_m
    if pace.turn_at is not None:
        turn = int(np.clip(round(rng.uniform(*pace.turn_at) * turn), 1, turn))
        num_back = max(1, round(rng.uniform(*pace.back) * turn))
        way_m = np.concatenate([route_m[: turn + 1], route_m[turn - num_back : turn][::-1]])
    way = Way.without_stops(way_m)
    if pace.turn_at is not None:
        way.stops_s[turn] = rng.uniform(*pace.stop_s)
    if pace.stop_every_m is not None:
        _add_stops(way, pace.stop_every_m, pace.stop_s, rng)
    return way


def speeds_at(way: Way, pace: Pace, cfg: PedestriansConfig, rng: np.random.Generator) -> np.ndarray:
    """Speeds at the waypoints of a way that is gone at a pace, (k,) m/s, 0 where it stops."""
    speeds_mps = speed_profile(
        menger_curvature(way.polyline_m),
        rng,
        cruise_speed_mps=cfg.hurry_speed_mps if pace.hurries else cfg.cruise_speed_mps,
        curvature_gain_m=cfg.curvature_gain_m,
        jitter=cfg.speed_jitter,
        min_speed_mps=cfg.min_speed_mps,
        max_speed_mps=max(cfg.max_speed_mps, cfg.hurry_speed_mps) if pace.hurries else cfg.max_speed_mps,
    )
    speeds_mps[way.stops_s > 0] = 0.0
    return speeds_mps


def _add_stops(way: Way, every_m: tuple[float, float], stop_s: tuple[float, float], rng: np.random.Generator) -> None:
    """Put stops on a way, in place."""
    along_m = way.along_m
    next_m, first = rng.uniform(*every_m), 1
    while next_m < along_m[-1]:
        waypoint = max(int(np.searchsorted(along_m, next_m)), first)
        if waypoint >= len(along_m) - 1:
            return
        way.stops_s[waypoint] = rng.uniform(*stop_s)
        next_m, first = along_m[waypoint] + rng.uniform(*every_m), waypoint + STOP_GAP_MIN
