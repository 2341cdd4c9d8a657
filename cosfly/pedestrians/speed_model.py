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
    """A polyline with a speed and a stop at each waypoint.

    polyline_m: (k, d) m, k at least 2, no two neighbours equal. speeds_mps: (k,), 0 at stops. stops_s: (k,) duration of
    the stop, 0 for none.
    """

    polyline_m: np.ndarray
    speeds_mps: np.ndarray
    stops_s: np.ndarray

    @cached_property
    def lengths_m(self) -> np.ndarray:
        """Return the lengths of the pieces, (k - 1,) m."""
        return np.linalg.norm(np.diff(self.polyline_m, axis=0), axis=1)

    @cached_property
    def times_s(self) -> np.ndarray:
        """Return the times at waypoints without stops, (k,) s from 0.

        A piece takes its length over the mean of its two speeds.
        """
        means_mps = 0.5 * (self.speeds_mps[1:] + self.speeds_mps[:-1])
        if not (means_mps > 0).all():
            k = int(np.argmin(means_mps))
            raise ValueError(f"the pedestrian never leaves waypoint {k}: the speed is 0 at waypoints {k} and {k + 1}")
        return np.concatenate([[0.0], np.cumsum(self.lengths_m / means_mps)])

    def resample(self, step_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times (n,) s at equal steps from 0, positions (n, d) m and speeds (n,) m/s; the last is the goal."""
        num_samples = int(np.ceil((self.times_s[-1] + self.stops_s.sum()) / step_s - 1e-9)) + 1
        time_s = np.arange(num_samples) * step_s
        return time_s, *self.sample(time_s)

    def sample(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (n, d) m and speeds (n,) m/s at times (n,) s; the last waypoint after the end.

        Within a piece the speed changes evenly from one waypoint to the next.
        """
        times_s = self.times_s
        moving_s = np.minimum(time_s - standing_time_s(time_s, times_s, self.stops_s), times_s[-1])
        piece = np.clip(np.searchsorted(times_s, moving_s, side="right") - 1, 0, len(times_s) - 2)
        duration_s = times_s[piece + 1] - times_s[piece]
        elapsed_s = moving_s - times_s[piece]
        from_mps, to_mps = self.speeds_mps[piece], self.speeds_mps[piece + 1]
        moved_m = from_mps * elapsed_s + 0.5 * (to_mps - from_mps) / duration_s * elapsed_s**2
        share = np.clip(moved_m / self.lengths_m[piece], 0.0, 1.0)
        start_m = self.polyline_m[piece]
        positions_m = start_m + share[:, None] * (self.polyline_m[piece + 1] - start_m)
        return positions_m, from_mps + (to_mps - from_mps) * elapsed_s / duration_s


def standing_time_s(time_s: np.ndarray, times_s: np.ndarray, stops_s: np.ndarray) -> np.ndarray:
    """Return the total duration of stops until each time, (n,) s; times_s, stops_s: (k,) as in `TimedRoute`."""
    stops = np.flatnonzero(stops_s)
    begins_s = times_s[stops] + np.cumsum(stops_s[stops]) - stops_s[stops]
    return np.clip(time_s[:, None] - begins_s, 0.0, stops_s[stops]).sum(axis=1)


# --- paces ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pace:
    """One row of the table of paces; values are drawn uniformly from ranges.

    hurries: cruises at `hurry_speed_mps`. stop_every_m: distance between stops. stop_s: duration of a stop. turn_at:
    where the pedestrian turns back, as a share of the route. back: share of the route so far that is walked back.
    """

    hurries: bool = False
    stop_every_m: tuple[float, float] | None = None
    stop_s: tuple[float, float] = (0.0, 0.0)
    turn_at: tuple[float, float] | None = None
    back: tuple[float, float] = (0.0, 0.0)


# Stops are long enough for a drone to come to rest, with a window of five frames before and after.
PACES = {
    PLAIN_PACE: Pace(),
    "stop_and_look": Pace(stop_every_m=(15.0, 35.0), stop_s=(5.0, 12.0)),
    "hurry": Pace(hurries=True),
    # Makes a following drone slow down, hover and speed up.
    "fits_and_starts": Pace(hurries=True, stop_every_m=(8.0, 14.0), stop_s=(3.0, 5.0)),
    "turn_back": Pace(turn_at=(0.45, 0.75), back=(0.5, 0.9), stop_s=(1.0, 4.0)),
}


@dataclass(frozen=True)
class PacedRoute:
    """A route after a pace is applied: polyline_m (k, 2); stops_s (k,), duration of the stop at each waypoint."""

    polyline_m: np.ndarray
    stops_s: np.ndarray

    @classmethod
    def without_stops(cls, polyline_m: np.ndarray) -> PacedRoute:
        return cls(polyline_m, np.zeros(len(polyline_m)))

    @cached_property
    def along_m(self) -> np.ndarray:
        """Return the distance along the route to each waypoint, (k,) m."""
        return distances_along_m(self.polyline_m)


def take_pace(route_m: np.ndarray, pace: Pace, rng: np.random.Generator) -> PacedRoute:
    """Apply a pace to a route, (k, 2) m. There are no stops at its ends; a route of two points is unchanged."""
    if len(route_m) < 3:
        return PacedRoute.without_stops(route_m)
    polyline_m = route_m
    turn = len(route_m) - 1
    if pace.turn_at is not None:
        turn = int(np.clip(round(rng.uniform(*pace.turn_at) * turn), 1, turn))
        num_back = max(1, round(rng.uniform(*pace.back) * turn))
        polyline_m = np.concatenate([route_m[: turn + 1], route_m[turn - num_back : turn][::-1]])
    route = PacedRoute.without_stops(polyline_m)
    if pace.turn_at is not None:
        route.stops_s[turn] = rng.uniform(*pace.stop_s)
    if pace.stop_every_m is not None:
        next_m = rng.uniform(*pace.stop_every_m)
        first_allowed = 1
        while next_m < route.along_m[-1]:
            waypoint = max(int(np.searchsorted(route.along_m, next_m)), first_allowed)
            if waypoint >= len(polyline_m) - 1:
                break
            route.stops_s[waypoint] = rng.uniform(*pace.stop_s)
            next_m = route.along_m[waypoint] + rng.uniform(*pace.stop_every_m)
            first_allowed = waypoint + STOP_GAP_MIN
    return route


def speeds_at(route: PacedRoute, pace: Pace, cfg: PedestriansConfig, rng: np.random.Generator) -> np.ndarray:
    """Return the speeds at the waypoints of a paced route, (k,) m/s, 0 at stops (eq:speed).

    No other speed is below SLOWEST_SPEED_MPS. With the default settings eq:speed gives at least 0.067 m/s (a right
    angle of two 0.5 m steps), so that this bound has no effect.
    """
    cruise_mps = cfg.cruise_speed_mps
    fastest_mps = cfg.max_speed_mps
    if pace.hurries:
        cruise_mps = cfg.hurry_speed_mps
        fastest_mps = max(cfg.max_speed_mps, cfg.hurry_speed_mps)
    jitter = 1.0 + cfg.speed_jitter * rng.uniform(-1.0, 1.0, size=len(route.polyline_m))
    speeds_mps = cruise_mps / (1.0 + cfg.curvature_gain_m * menger_curvature(route.polyline_m)) * jitter
    speeds_mps = np.clip(speeds_mps, max(cfg.min_speed_mps, SLOWEST_SPEED_MPS), fastest_mps)
    speeds_mps[route.stops_s > 0] = 0.0
    return speeds_mps
