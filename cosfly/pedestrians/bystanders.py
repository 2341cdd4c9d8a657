"""Bystanders and cars around a pedestrian trajectory, clear of the target and of each other.

They are placed one after the other. Each bystander passes the target at a different time, the first at the start. A new
one that would collide waits a little before that place. If waiting does not help, it is drawn again, and skipped after
some tries, so there may be fewer than requested.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cosfly.formats.bystanders import Bystander, Bystanders
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.geometry.axes import headings_of
from cosfly.pedestrians.lanes import Lane
from cosfly.pedestrians.speed_model import (
    PACES,
    STOP_GAP_MIN,
    PacedRoute,
    TimedRoute,
    menger_curvature,
    speeds_at,
    take_pace,
)
from cosfly.pedestrians.walkable import PedestriansConfig, WalkableGround
from cosfly.runtime.seeding import draw_by_share

MOST_WAITS = 10  # after this many waits a bystander is drawn again
WAIT_S = 3.0  # duration of one wait
KEEP_BACK_M = {"Pedestrians": 1.5, "Car": 7.0}  # distance from the place of waiting to that of the collision
TURN_S = 2.0  # stop of bystanders at the end of their route, before they walk back
PASS_M = (1.5, 7.0)  # distance from the target when it is passed
OPPOSITE_TRIES = 6  # second ends of a route that are drawn, for the one most opposite to the first end
GOLDEN = 0.618034  # moments k * GOLDEN % 1 are spread evenly for any number of them
SPEED_FACTORS = (0.8, 1.2)  # bounds of the factor on the speeds of a pace, or of cars
CAR_SPEED_MPS = 8.0  # 30 km/h
CAR_SIDEWAYS_MPS2, CAR_FORWARD_MPS2 = 2.0, 2.0  # comfortable accelerations in a curve, and along the route
SHORTEST_DRIVE_M = 15.0
CHORD_M = 1.0  # a car's heading is that of the chord from this far behind to this far ahead


@dataclass(frozen=True)
class Trip:
    """The route of a bystander or car with its stops.

    kind: a key of BUILDS. route: its k waypoints. limits_mps: (k,) speeds there, apart from stops. head_start_s: time
    on the route before the pedestrian trajectory begins.
    """

    kind: str
    route: PacedRoute
    limits_mps: np.ndarray
    head_start_s: float = 0.0

    def motion(self, along_m: np.ndarray, time_s: np.ndarray, ground_z_m: float) -> Bystander:
        """Return the positions and headings at distances along the route, (n,) m, which are reached at times (n,)."""
        positions_m = self.positions_at(along_m)
        if self.kind == "Car":
            chords_m = self.positions_at(along_m + CHORD_M) - self.positions_at(along_m - CHORD_M)
            headings_rad = np.arctan2(chords_m[:, 1], chords_m[:, 0])
        else:
            headings_rad = headings_of(positions_m, time_s)
        return Bystander(self.kind, np.insert(positions_m, 2, ground_z_m, axis=1), headings_rad)

    @cached_property
    def timed_distances(self) -> TimedRoute:
        """Return the distances along the route as a route of one dimension, with the speeds at its waypoints."""
        speeds_mps = np.where(self.route.stops_s > 0, 0.0, self.limits_mps)
        if self.kind == "Car":
            speeds_mps = braked(speeds_mps, self.route.along_m)
        return TimedRoute(self.route.along_m[:, None], speeds_mps, self.route.stops_s)

    def distances_at(self, time_s: np.ndarray) -> np.ndarray:
        """Return the distance along the route at each time, (n,) m."""
        return self.timed_distances.sample(time_s + self.head_start_s)[0][:, 0]

    def waiting(self, before_m: float) -> Trip:
        """Return the trip with a stop of WAIT_S, or a longer one, at least KEEP_BACK_M before a place of the route."""
        stop_m = before_m - KEEP_BACK_M[self.kind]
        waypoint = max(0, int(np.searchsorted(self.route.along_m, stop_m, side="right")) - 1)
        first_near = max(0, waypoint - STOP_GAP_MIN + 1)
        stops_s = self.route.stops_s.copy()
        # Stops need STOP_GAP_MIN waypoints between them, so that a stop nearby becomes longer instead.
        stops_near_s = stops_s[first_near : waypoint + STOP_GAP_MIN]
        if stops_near_s.any():
            waypoint = first_near + int(np.argmax(stops_near_s))
        stops_s[waypoint] += WAIT_S
        return replace(self, route=replace(self.route, stops_s=stops_s))

    def positions_at(self, along_m: np.ndarray) -> np.ndarray:
        """Return the positions at distances along the route, (n, 2) m."""
        route = self.route
        return np.column_stack([np.interp(along_m, route.along_m, route.polyline_m[:, k]) for k in (0, 1)])


def braked(limits_mps: np.ndarray, along_m: np.ndarray) -> np.ndarray:
    """Lower speeds at waypoints, (k,), so that accelerations along the route are at most CAR_FORWARD_MPS2."""
    speeds = limits_mps.tolist()  # single numbers of a list are faster than those of an array
    gains = (2.0 * CAR_FORWARD_MPS2 * np.diff(along_m)).tolist()
    for k in range(len(gains)):
        speeds[k + 1] = min(speeds[k + 1], math.sqrt(speeds[k] ** 2 + gains[k]))
    for k in reversed(range(len(gains))):
        speeds[k] = min(speeds[k], math.sqrt(speeds[k + 1] ** 2 + gains[k]))
    return np.array(speeds)


def bystanders_of(
    target: PedestrianTrajectory, ground: WalkableGround, lanes: list[Lane], cfg: PedestriansConfig,
    rng: np.random.Generator,
) -> Bystanders:  # fmt: skip
    """Place the bystanders and cars around one pedestrian trajectory."""
    placed = [Bystander("Pedestrians", target.positions_m, headings_of(target.positions_m, target.time_s))]
    for kind, num_wanted in (("Pedestrians", cfg.others), ("Car", cfg.traffic)):
        for number in range(num_wanted):
            for _ in range(cfg.num_retries + 1):
                is_car = kind == "Car"
                if is_car:
                    trip = _draw_car(target, lanes, cfg, rng)
                else:
                    trip = _draw_pedestrian(target, number, ground, cfg, rng)
                bystander = None if trip is None else avoid_collisions(trip, target.time_s, placed, ground.z_m)
                if bystander is not None:
                    placed.append(replace(bystander, is_look_alike=not is_car and number < cfg.look_alikes))
                    break
    return Bystanders(target.path_id, placed[1:])


def avoid_collisions(trip: Trip, time_s: np.ndarray, placed: list[Bystander], ground_z_m: float) -> Bystander | None:
    """Return the motion of a trip that waits for those already placed; None where waiting does not help."""
    for _ in range(MOST_WAITS + 1):
        along_m = trip.distances_at(time_s)
        bystander = trip.motion(along_m, time_s, ground_z_m)
        collisions = np.flatnonzero(gaps_m(bystander, placed) < 0.0)
        if len(collisions) == 0:
            return bystander
        before_m = float(along_m[collisions[0] + 1])
        if collisions[0] == 0 and before_m < KEEP_BACK_M[trip.kind]:
            return None
        trip = trip.waiting(before_m)
    return None


def _draw_pedestrian(
    target: PedestrianTrajectory, number: int, ground: WalkableGround, cfg: PedestriansConfig, rng: np.random.Generator
) -> Trip | None:
    """Draw a bystander's route that passes the target, back and forth for the duration; None if there is none."""
    pass_time_s = number * GOLDEN % 1.0 * float(target.time_s[-1])
    x, y = ground.grid.cells_at(target.positions_m[int(np.searchsorted(target.time_s, pass_time_s))])
    low_cells, high_cells = np.array(PASS_M) / cfg.resolution_m
    places = ground.sample_goals((int(x), int(y)), low_cells, high_cells, rng)
    if not places:
        return None
    place = places[0]
    reach_cells = cfg.others_reach_m / cfg.resolution_m
    goals = ground.sample_goals(place, 0.5 * reach_cells, reach_cells, rng, 1 + OPPOSITE_TRIES)
    if not goals:
        return None
    offsets = np.subtract(goals, place)
    cosines = offsets[1:] @ offsets[0] / np.linalg.norm(offsets[1:], axis=1)  # to the first, up to a constant factor
    leg_back = ground.route(place, goals[0])
    leg_ahead = ground.route(place, goals[1 + int(np.argmin(cosines))])
    cells = np.concatenate([leg_back[:0:-1], leg_ahead])
    pace = PACES[draw_by_share(cfg.pace, rng)]
    route = take_pace(ground.grid.centers_of(cells), pace, rng)
    trip = Trip("Pedestrians", route, speeds_at(route, pace, cfg, rng) * rng.uniform(*SPEED_FACTORS))
    # Long enough for the trajectory after a head start of at most its duration; 3 durations are more than the two.
    while trip.distances_at(3.0 * target.time_s[-1:])[0] >= trip.route.along_m[-1]:
        trip = _with_return(trip)
    # The head start moves the nearest pass to the time of this bystander.
    times_s = pass_time_s + np.arange(0.0, target.time_s[-1], target.time_s[1])  # time_s[1] is the step
    offsets_m = trip.positions_at(trip.distances_at(times_s)) - ground.grid.centers_of(np.array(place))
    nearest = np.argmin(np.linalg.norm(offsets_m, axis=1))
    return replace(trip, head_start_s=float(times_s[nearest]) - pass_time_s)


def _with_return(trip: Trip) -> Trip:
    """Return the trip with the route back to its start, after a stop at its end or just before."""
    route = trip.route
    stops_s = np.concatenate([route.stops_s, route.stops_s[-2::-1]])
    end = len(route.stops_s) - 1
    if not stops_s[max(0, end - STOP_GAP_MIN + 1) : end].any():  # a piece between two stops would have no speed
        stops_s[end] = TURN_S
    back = PacedRoute(np.concatenate([route.polyline_m, route.polyline_m[-2::-1]]), stops_s)
    return replace(trip, route=back, limits_mps=np.concatenate([trip.limits_mps, trip.limits_mps[-2::-1]]))


def _draw_car(
    target: PedestrianTrajectory, lanes: list[Lane], cfg: PedestriansConfig, rng: np.random.Generator
) -> Trip | None:
    """Draw a car's route that starts nearby and lasts as long, or up to a dead end; None where no lane is near."""
    place_m = target.polyline_m[rng.integers(len(target.polyline_m))]
    away_m = np.array([lane.distance_m(place_m) for lane in lanes])
    near = np.flatnonzero(away_m < cfg.others_reach_m)
    if len(near) == 0:
        return None
    number = int(near[rng.integers(len(near))])
    begin = int(rng.integers(len(lanes[number].points_m) - 1))
    pieces = [lanes[number].points_m[begin:]]
    length_m = 0.0
    needed_m = CAR_SPEED_MPS * float(target.time_s[-1])
    while length_m < needed_m and lanes[number].onward:
        onward = lanes[number].onward
        # Turns prefer lanes near the trajectory, because traffic that leaves the view is of no use.
        weights = np.exp(-away_m[[k for k, _ in onward]] / cfg.others_reach_m)
        number, curve = onward[int(rng.choice(len(onward), p=weights / weights.sum()))]
        pieces += [curve, lanes[number].points_m]
        length_m += len(curve) + len(lanes[number].points_m)  # a metre from point to point
    route = PacedRoute.without_stops(np.concatenate(pieces))
    if route.along_m[-1] < SHORTEST_DRIVE_M:
        return None
    curvatures = np.maximum(menger_curvature(route.polyline_m), 1e-6)
    limits_mps = np.minimum(CAR_SPEED_MPS * rng.uniform(*SPEED_FACTORS), np.sqrt(CAR_SIDEWAYS_MPS2 / curvatures))
    limits_mps[-1] = 0.0
    return Trip("Car", route, limits_mps)


def gaps_m(bystander: Bystander, placed: Sequence[Bystander]) -> np.ndarray:
    """Return the least gap between the discs of a bystander and of others in each time step, (n - 1,) m.

    It is negative where they overlap. All move straight within a step, so a distance of two discs is that of the origin
    from a segment of offsets.
    """
    discs_m = np.concatenate([other.discs_m for other in placed], axis=1)
    radii_m = np.repeat([other.build.disc_radius_m for other in placed], [other.discs_m.shape[1] for other in placed])
    # (2, e, d, n): e discs of the others, d of the bystander, n times. Time is last, because reductions over an axis of
    # two numbers are slow where it is the last.
    offsets_m = np.ascontiguousarray((bystander.discs_m[:, :, None] - discs_m[:, None]).T)
    start, along = offsets_m[..., :-1], np.diff(offsets_m)
    squared = np.maximum((along**2).sum(axis=0), 1e-12)
    share = np.clip(-(start * along).sum(axis=0) / squared, 0.0, 1.0)
    distances_m = np.linalg.norm(start + share * along, axis=0)  # (e, d, n - 1)
    nearest_m = distances_m.min(axis=1) - bystander.build.disc_radius_m
    return (nearest_m - radii_m[:, None]).min(axis=0)
