"""The speed model of pedestrians: paces, stops, curvature, jitter, and sampling at equal times (sec:step3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from cosfly.formats.pedestrian_paths import PLAIN_PACE
from cosfly.geometry.trajectory_metrics import distances_along_m

if TYPE_CHECKING:
    from cosfly.pedestrians.walkable import PedestriansConfig


CURVATURE_EPSILON_M3 = 1e-6  # eq:menger: below this product of lengths three points have no curvature
SLOWEST_SPEED_MPS = 0.05  # eq:speed alone allows 0, with which a pedestrian would never arrive
STOP_GAP_MIN = 2  # waypoints from one stop to the next: a piece between two stops would have no speed


def menger_curvature(polyline_m: np.ndarray) -> np.ndarray:
    """Return the curvature at the waypoints of a polyline, (k, 2) m, in 1/m (eq:menger).

    It is 0 at both ends and where the product of the three distances is below CURVATURE_EPSILON_M3.
    """
    curvatures = np.zeros(len(polyline_m))
    if len(polyline_m) < 3:
        return curvatures
    ahead, behind = polyline_m[2:] - polyline_m[1:-1], polyline_m[:-2] - polyline_m[1:-1]
    cross = np.abs(ahead[:, 0] * behind[:, 1] - ahead[:, 1] * behind[:, 0])
    across = polyline_m[2:] - polyline_m[:-2]
    product = np.linalg.norm(ahead, axis=1) * np.linalg.norm(behind, axis=1) * np.linalg.norm(across, axis=1)
    is_safe = product >= CURVATURE_EPSILON_M3
    curvatures[1:-1][is_safe] = 2.0 * cross[is_safe] / product[is_safe]
    return curvatures


@dataclass(frozen=True)
class TimedRoute:
    """A polyline with a speed and a stop at each waypoint; a piece is the segment between two neighbours."""

    polyline_m: np.ndarray  # (k, 2) m, k at least 2, no two neighbours equal
    limits_mps: np.ndarray  # (k,) speeds, except at stops
    stops_s: np.ndarray  # (k,) duration of the stop, 0 for none

    @cached_property
    def along_m(self) -> np.ndarray:
        """Return the distance along the route to each waypoint, (k,) m."""
        return distances_along_m(self.polyline_m)

    @cached_property
    def speeds_mps(self) -> np.ndarray:
        """Return the speeds at the waypoints, (k,), 0 at stops."""
        return np.where(self.stops_s > 0, 0.0, self.limits_mps)

    @cached_property
    def times_s(self) -> np.ndarray:
        """Return the times at which the waypoints would be reached if no stop took time, (k,) s from 0.

        A piece takes its length over the mean of its two speeds.
        """
        means_mps = 0.5 * (self.speeds_mps[1:] + self.speeds_mps[:-1])
        if not (means_mps > 0).all():
            k = int(np.argmin(means_mps))
            raise ValueError(f"the pedestrian never leaves waypoint {k}: the speed is 0 at waypoints {k} and {k + 1}")
        return np.concatenate([[0.0], np.cumsum(np.diff(self.along_m) / means_mps)])

    def resample(self, step_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times (n,) s at equal steps from 0, positions (n, 2) m and speeds (n,) m/s; the last is the goal."""
        num_samples = int(np.ceil((self.times_s[-1] + self.stops_s.sum()) / step_s - 1e-9)) + 1
        time_s = np.arange(num_samples) * step_s
        along_m, speeds_mps = self.sample(time_s)
        return time_s, self.positions_at(along_m), speeds_mps

    def sample(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distances along the route (n,) m and speeds (n,) m/s at times (n,) s; the last waypoint after the end.

        Within a piece the speed changes evenly from one waypoint to the next.
        """
        times_s = self.times_s
        moving_s = np.minimum(time_s - standing_time_s(time_s, times_s, self.stops_s), times_s[-1])
        piece = np.clip(np.searchsorted(times_s, moving_s, side="right") - 1, 0, len(times_s) - 2)
        duration_s = times_s[piece + 1] - times_s[piece]
        elapsed_s = moving_s - times_s[piece]
        from_mps, to_mps = self.speeds_mps[piece], self.speeds_mps[piece + 1]
        moved_m = from_mps * elapsed_s + 0.5 * (to_mps - from_mps) / duration_s * elapsed_s**2
        along_m = np.clip(self.along_m[piece] + moved_m, self.along_m[piece], self.along_m[piece + 1])
        return along_m, from_mps + (to_mps - from_mps) * elapsed_s / duration_s

    def positions_at(self, along_m: np.ndarray) -> np.ndarray:
        """Return the positions at distances along the route, (n, 2) m."""
        return np.column_stack([np.interp(along_m, self.along_m, self.polyline_m[:, k]) for k in (0, 1)])


def standing_time_s(time_s: np.ndarray, times_s: np.ndarray, stops_s: np.ndarray) -> np.ndarray:
    """Return the total duration of stops until each time, (n,) s; times_s, stops_s: (k,) as in `TimedRoute`."""
    stops = np.flatnonzero(stops_s)
    begins_s = times_s[stops] + np.cumsum(stops_s[stops]) - stops_s[stops]
    return np.clip(time_s[:, None] - begins_s, 0.0, stops_s[stops]).sum(axis=1)


# --- paces ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pace:
    """One row of the table of paces; values are drawn uniformly from ranges."""

    hurries: bool = False  # cruises at `hurry_speed_mps`
    stop_every_m: tuple[float, float] | None = None  # distance between stops
    stop_s: tuple[float, float] = (0.0, 0.0)  # duration of a stop
    turn_at: tuple[float, float] | None = None  # where the pedestrian turns back, as a share of the route
    back: tuple[float, float] = (0.0, 0.0)  # share of the route so far that is walked back


# Stops are long enough for a drone to come to rest, with a window of five frames before and after.
PACES = {
    PLAIN_PACE: Pace(),
    "stop_and_look": Pace(stop_every_m=(15.0, 35.0), stop_s=(5.0, 12.0)),
    "hurry": Pace(hurries=True),
    # Makes a following drone slow down, hover and speed up.
    "fits_and_starts": Pace(hurries=True, stop_every_m=(8.0, 14.0), stop_s=(3.0, 5.0)),
    "turn_back": Pace(turn_at=(0.45, 0.75), back=(0.5, 0.9), stop_s=(1.0, 4.0)),
}


def take_pace(route_m: np.ndarray, pace: Pace, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Apply a pace to a route, (k, 2) m: return its waypoints, (m, 2) m, and the duration of the stop at each, (m,) s.

    There are no stops at its ends; a route of two points is unchanged.
    """
    if len(route_m) < 3:
        return route_m, np.zeros(len(route_m))
    polyline_m = route_m
    stops_s = np.zeros(len(route_m))
    if pace.turn_at is not None:
        last = len(route_m) - 1
        turn = int(np.clip(round(rng.uniform(*pace.turn_at) * last), 1, last))
        num_back = max(1, round(rng.uniform(*pace.back) * turn))
        polyline_m = np.concatenate([route_m[: turn + 1], route_m[turn - num_back : turn][::-1]])
        stops_s = np.zeros(len(polyline_m))
        stops_s[turn] = rng.uniform(*pace.stop_s)
    if pace.stop_every_m is not None:
        along_m = distances_along_m(polyline_m)
        next_m = rng.uniform(*pace.stop_every_m)
        first_allowed = 1
        while next_m < along_m[-1]:
            waypoint = max(int(np.searchsorted(along_m, next_m)), first_allowed)
            if waypoint >= len(polyline_m) - 1:
                break
            stops_s[waypoint] = rng.uniform(*pace.stop_s)
            next_m = along_m[waypoint] + rng.uniform(*pace.stop_every_m)
            first_allowed = waypoint + STOP_GAP_MIN
    return polyline_m, stops_s


def timed_route(route_m: np.ndarray, pace: Pace, cfg: PedestriansConfig, rng: np.random.Generator,
                pace_rng: np.random.Generator) -> TimedRoute:  # fmt: skip
    """Return a route, (k, 2) m, at a pace, with the speeds of eq:speed.

    No speed is below SLOWEST_SPEED_MPS. With the default settings eq:speed gives at least 0.067 m/s (a right angle of
    two 0.5 m steps), so that this bound has no effect.
    """
    polyline_m, stops_s = take_pace(route_m, pace, pace_rng)
    cruise_mps = cfg.cruise_speed_mps
    fastest_mps = cfg.max_speed_mps
    if pace.hurries:
        cruise_mps = cfg.hurry_speed_mps
        fastest_mps = max(cfg.max_speed_mps, cfg.hurry_speed_mps)
    jitter = 1.0 + cfg.speed_jitter * rng.uniform(-1.0, 1.0, size=len(polyline_m))
    limits_mps = cruise_mps / (1.0 + cfg.curvature_gain_m * menger_curvature(polyline_m)) * jitter
    limits_mps = np.clip(limits_mps, max(cfg.min_speed_mps, SLOWEST_SPEED_MPS), fastest_mps)
    return TimedRoute(polyline_m, limits_mps, stops_s)
