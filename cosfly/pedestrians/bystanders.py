"""Who else moves while a walk lasts: people on routes of their own, and cars along lanes, all clear of the walker and
of each other.

One after the other is placed: the walker is there already, then the people, then the cars. People pass the walker, each
at a moment of its own that leads it near; the first is near from the start. Who would touch somebody waits a little way
before; whom waiting does not help is drawn anew, and after some tries left out. So there may be fewer than the settings
ask for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cosfly.formats.bystanders import Bystander, Bystanders
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.geometry.axes import headings_of
from cosfly.geometry.ground import Ground
from cosfly.pedestrians.lanes import Lane
from cosfly.pedestrians.speed_model import (
    PACES,
    STOP_GAP_MIN,
    Way,
    arrival_times,
    menger_curvature,
    sample,
    speeds_at,
    take_pace,
)
from cosfly.pedestrians.walkable import PedestriansConfig, WalkableGround, sample_goal
from cosfly.runtime.seeding import draw_by_share

MOST_WAITS, WAIT_S = 10, 3.0  # who meets somebody again after so many waits is drawn anew
KEEP_BACK_M = {"Pedestrians": 1.5, "Car": 7.0}  # way from where one waits to where one would have met
TURN_S = 2.0  # people who are at the end of their route stand so long, and walk back
PASS_M = (1.5, 7.0)  # how near to where the walker is then
OPPOSITE_TRIES = 6  # ends of a route that are tried for the one most opposite to the other end
GOLDEN = 0.618034  # moments k * GOLDEN % 1 are spread evenly, however many there are
OWN_SPEED = (0.8, 1.2)  # of a person's speeds, beside those of the same pace
CAR_SPEED_MPS = 8.0  # 30 km/h
CAR_SIDEWAYS_MPS2, CAR_FORWARD_MPS2 = 2.0, 2.0  # what is comfortable in a curve, and along the way
SHORTEST_DRIVE_M = 15.0
CHORD_M = 1.0  # a car's heading is that of a piece of its way, so long ahead and behind


@dataclass(frozen=True)
class Trip:
    """What one does: kind of BUILDS, way with its stops, limits_mps (k,): the speeds where nobody is in the way;
    head_start_s: how long one has been on the way when the walk begins."""

    kind: str
    way: Way
    limits_mps: np.ndarray
    head_start_s: float = 0.0

    def moved(self, time_s: np.ndarray, heights: Ground) -> Bystander:
        """Where the course leads at each time."""
        positions_m = self._at(self.along_m(time_s))
        if self.kind == "Car":
            ahead, behind = (self._at(self.along_m(time_s) + sign * CHORD_M) for sign in (1.0, -1.0))
            headings_rad = np.arctan2(*(ahead - behind).T[::-1])
        else:
            headings_rad = headings_of(positions_m, time_s)
        return Bystander(self.kind, np.column_stack([positions_m, heights.height_at(positions_m)]), headings_rad)

    def along_m(self, time_s: np.ndarray) -> np.ndarray:
        """How far along the way one is at each time, (n,) m."""
        speeds_mps = np.where(self.way.stops_s > 0, 0.0, self.limits_mps)
        if self.kind == "Car":
            speeds_mps = braked(speeds_mps, self.way.along_m)
        line = np.column_stack([self.way.along_m, np.zeros(len(speeds_mps))])
        return sample(line, speeds_mps, arrival_times(line, speeds_mps), self.way.stops_s, time_s + self.head_start_s)[
            0
        ][:, 0]

    def waiting(self, before_m: float) -> Trip:
        """Return the same with a stop of WAIT_S, or a longer one, at least KEEP_BACK_M before a place of the way."""
        at = max(0, int(np.searchsorted(self.way.along_m, before_m - KEEP_BACK_M[self.kind], side="right")) - 1)
        near = slice(max(0, at - STOP_GAP_MIN + 1), at + STOP_GAP_MIN)
        stops_s = self.way.stops_s.copy()
        stops_s[near.start + int(np.argmax(stops_s[near])) if stops_s[near].any() else at] += WAIT_S
        return replace(self, way=replace(self.way, stops_s=stops_s))

    def _at(self, along_m: np.ndarray) -> np.ndarray:
        known_m = self.way.along_m
        return np.column_stack([np.interp(along_m, known_m, self.way.polyline_m[:, k]) for k in (0, 1)])


def braked(limits_mps: np.ndarray, along_m: np.ndarray) -> np.ndarray:
    """Lower speeds at waypoints, (k,), so that none asks for more than CAR_FORWARD_MPS2 before or behind it."""
    speeds = limits_mps.copy()
    gains = 2.0 * CAR_FORWARD_MPS2 * np.diff(along_m)
    for k in range(len(gains)):
        speeds[k + 1] = min(speeds[k + 1], np.sqrt(speeds[k] ** 2 + gains[k]))
    for k in reversed(range(len(gains))):
        speeds[k] = min(speeds[k], np.sqrt(speeds[k + 1] ** 2 + gains[k]))
    return speeds


# --- one company ------------------------------------------------------------------------------------------------------


def bystanders_of(
    walk: PedestrianTrajectory,
    ground: WalkableGround,
    lanes: list[Lane],
    cfg: PedestriansConfig,
    rng: np.random.Generator,
) -> Bystanders:
    """Place the others of one walk."""
    there = [Bystander("Pedestrians", walk.positions_m, headings_of(walk.positions_m, walk.time_s))]
    for kind, wanted in (("Pedestrians", cfg.others), ("Car", cfg.traffic)):
        for number in range(wanted):
            for _ in range(cfg.num_retries + 1):
                is_car = kind == "Car"
                course = draw_drive(walk, lanes, cfg, rng) if is_car else draw_stroll(walk, number, ground, cfg, rng)
                other = None if course is None else without_meeting(course, walk.time_s, there, ground.heights)
                if other is not None:
                    there.append(replace(other, is_look_alike=not is_car and number < cfg.look_alikes))
                    break
    return Bystanders(walk.path_id, there[1:])


def without_meeting(course: Trip, time_s: np.ndarray, there: list[Bystander], heights: Ground) -> Bystander | None:
    """Move along a course and wait for those who are there already; None where that does not help."""
    for _ in range(MOST_WAITS + 1):
        other = course.moved(time_s, heights)
        met = np.flatnonzero(np.min([gaps_m(other, one) for one in there], axis=0) < 0.0)
        if len(met) == 0:
            return other
        before_m = float(course.along_m(time_s[met[:1] + 1])[0])
        if met[0] == 0 and before_m < KEEP_BACK_M[course.kind]:
            return None
        course = course.waiting(before_m)
    return None


def draw_stroll(
    walk: PedestrianTrajectory, number: int, ground: WalkableGround, cfg: PedestriansConfig, rng: np.random.Generator
) -> Trip | None:
    """Draw a person's route that passes the walker, there and back for as long as the walk lasts; None without one."""
    moment_s = number * GOLDEN % 1.0 * float(walk.time_s[-1])
    x, y = ground.grid.cells_at(walk.positions_m[int(np.searchsorted(walk.time_s, moment_s))])
    low, high = np.array(PASS_M) / cfg.resolution_m
    place = sample_goal(ground, (int(x), int(y)), low, high, rng)
    if place is None:
        return None
    reach = 0.5 * cfg.others_reach_m / cfg.resolution_m, cfg.others_reach_m / cfg.resolution_m
    drawn = [sample_goal(ground, place, *reach, rng) for _ in range(1 + OPPOSITE_TRIES)]
    ends = [np.subtract(end, place) for end in drawn if end is not None]
    if len(ends) < 2:
        return None
    pair = ends[0], min(ends[1:], key=lambda end: end @ ends[0] / np.linalg.norm(end))
    legs = [ground.route(place, (int(x), int(y))) for x, y in pair + np.array(place)]
    route = np.concatenate([legs[0][:0:-1], legs[1]])
    pace = PACES[draw_by_share(cfg.pace, rng)]
    way = take_pace(ground.grid.centers_of(route), pace, rng)
    course = Trip("Pedestrians", way, speeds_at(way, pace, cfg, rng) * rng.uniform(*OWN_SPEED))
    while course.along_m(3.0 * walk.time_s[-1:])[0] >= course.way.along_m[-1]:
        course = and_back(course)
    times_s = moment_s + np.arange(0.0, walk.time_s[-1], walk.time_s[1])
    apart_m = course.moved(times_s, ground.heights).positions_m[:, :2] - ground.grid.centers_of(np.array(place))
    away_m = np.linalg.norm(apart_m, axis=1)
    return replace(course, head_start_s=float(times_s[np.argmin(away_m)]) - moment_s)


def and_back(course: Trip) -> Trip:
    """Return the same, and back to its start after a stop: at its end, or where it stops just before."""
    way = course.way
    stops_s = np.concatenate([way.stops_s, way.stops_s[-2::-1]])
    end = len(way.stops_s) - 1
    if not stops_s[max(0, end - STOP_GAP_MIN + 1) : end].any():  # between two stops side by side nobody gets on
        stops_s[end] = TURN_S
    back = Way(np.concatenate([way.polyline_m, way.polyline_m[-2::-1]]), stops_s)
    return replace(course, way=back, limits_mps=np.concatenate([course.limits_mps, course.limits_mps[-2::-1]]))


def draw_drive(
    walk: PedestrianTrajectory, lanes: list[Lane], cfg: PedestriansConfig, rng: np.random.Generator
) -> Trip | None:
    """Draw a drive that begins near a walk and lasts as long, or up to a dead end; None where no lane is near."""
    place_m = walk.polyline_m[rng.integers(len(walk.polyline_m))]
    near = [k for k, lane in enumerate(lanes) if lane.distance_m(place_m) < cfg.others_reach_m]
    if not near:
        return None
    number = near[rng.integers(len(near))]
    begin = int(rng.integers(len(lanes[number].points_m) - 1))
    pieces = [lanes[number].points_m[begin:]]
    length_m, needed_m = 0.0, CAR_SPEED_MPS * float(walk.time_s[-1])
    while length_m < needed_m and lanes[number].onward:
        onward = lanes[number].onward
        # Who may turn stays near the walk: traffic that leaves the picture for good is of no use to it.
        weights = np.exp([-lanes[k].distance_m(place_m) / cfg.others_reach_m for k, _ in onward])
        number, curve = onward[int(rng.choice(len(onward), p=weights / weights.sum()))]
        pieces += [curve, lanes[number].points_m]
        length_m += len(curve) + len(lanes[number].points_m)  # a metre from point to point
    way = Way.without_stops(np.concatenate(pieces))
    if way.along_m[-1] < SHORTEST_DRIVE_M:
        return None
    curvatures = np.maximum(menger_curvature(way.polyline_m), 1e-6)
    limits_mps = np.minimum(CAR_SPEED_MPS * rng.uniform(*OWN_SPEED), np.sqrt(CAR_SIDEWAYS_MPS2 / curvatures))
    limits_mps[-1] = 0.0
    return Trip("Car", way, limits_mps)


def gaps_m(one: Bystander, two: Bystander) -> np.ndarray:
    """How far the discs of two are apart in each step of time, (n - 1,) m, negative where they overlap.

    Between two times both go straight on, so the nearest place within a step is that of the origin to a segment.
    """
    apart = one.discs_m[:, :, None] - two.discs_m[:, None]  # (n, d, e, 2)
    start, along = apart[:-1], np.diff(apart, axis=0)
    squared = np.maximum((along**2).sum(axis=-1), 1e-12)
    share = np.clip(-(start * along).sum(axis=-1) / squared, 0.0, 1.0)
    nearest = np.linalg.norm(start + share[..., None] * along, axis=-1)
    return nearest.min(axis=(1, 2)) - one.build.disc_radius_m - two.build.disc_radius_m
