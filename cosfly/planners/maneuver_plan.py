"""The manoeuvre plan of a trajectory: styles drawn from the shares of the settings, mission, camera, and checks.

A trajectory holds its style where the target sees the drone within HELD_DEG of the reference position and within
HELD_RATIO of its distance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.formats.segments import FOLLOW, MISSION_KINDS, Mission, MissionKind, Segment
from cosfly.geometry.axes import look_at
from cosfly.planners.contract import PlanConfig, Scenario, TrackingReference
from cosfly.planners.reference_trajectory import ROUNDING_S, finds_again, reacquire_reference, reference_of
from cosfly.planners.styles import OTHER_SIDE, REACQUIRE, RETURN_HOME, ROWS, WHOLE, suits
from cosfly.runtime.seeding import draw_to_quota

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex

HELD_DEG, HELD_RATIO, HELD_SHARE = 25.0, 1.4, 0.7
POINTS_LEAST = 4  # of a segment
NOT_HELD = "style_not_held"


@dataclass(frozen=True)
class ManeuverPlan:
    """The styles of one trajectory. segments: empty for the paper's `follow` from end to end.

    order: of the mission that ends the pursuit. impossible: why the map cannot hold the style; the reference is the
    paper's then."""

    reference: TrackingReference
    segments: tuple[Segment, ...] = ()
    mission: Mission | None = None
    order: MissionKind | None = None
    impossible: str | None = None

    @property
    def searches(self) -> bool:
        return any(part.style == REACQUIRE for part in self.segments)


def draw_styles(
    pedestrians: Sequence[PedestrianTrajectory], cfg: PlanConfig, rng: np.random.Generator
) -> list[list[str]]:
    """Draw the styles of the segments of each trajectory of a run to the quota of the shares.

    It is drawn first which trajectories have a style of a whole trajectory. Of the other segments, styles that suit a
    pedestrian who stops and hurries, or who goes straight on, get the segments in which that is most so, up to their
    share of the time. So the drone has a cause to change its pace, and shares stay exact.
    """
    parts_of = {style: share for style, share in cfg.styles.items() if style not in WHOLE}
    parts_share = sum(parts_of.values())
    parts_of = parts_of if parts_share else {FOLLOW: 1.0}  # which precedes `return_home`
    for style, other in zip([*parts_of], mirrored([*parts_of]), strict=True):
        if style != other:
            parts_of[style] = parts_of[other] = parts_of[style] / 2.0
    whole = {style: share for style, share in cfg.styles.items() if style in WHOLE}
    whole_rng, parts_rng = rng.spawn(2)
    lasts = [*islice(draw_to_quota(whole | {"": parts_share}, whole_rng), len(pedestrians))]
    parts = list[tuple[int, np.ndarray]]()  # number of the pedestrian trajectory, and its points in the segment
    for number, (pedestrian, last) in enumerate(zip(pedestrians, lasts, strict=True)):
        num_points, duration_s = len(pedestrian.time_s), float(pedestrian.time_s[-1])
        num = round(duration_s / cfg.segment_s) if cfg.segment_s else 1
        num = 0 if last == REACQUIRE else max(1, min(num, num_points // POINTS_LEAST))
        parts += [(number, points) for points in np.array_split(np.arange(num_points), num)] if num else []
    free, left, of_part = [*range(len(parts))], sum(parts_of.values()), dict[int, str]()
    for kind, measure in MEASURES.items():
        styles = {style: share for style, share in parts_of.items() if suits(style) == kind}
        if not (free and (share := sum(styles.values()))):
            continue
        free.sort(key=lambda k: (-measure(pedestrians[parts[k][0]], parts[k][1]), k))
        lengths = np.array([len(parts[k][1]) for k in free])
        ends = np.cumsum(lengths) - parts_rng.random() * lengths
        num, left = int((ends <= lengths.sum() * share / left).sum()), left - share
        of_part |= zip(sorted(free[:num]), draw_to_quota(styles, parts_rng), strict=False)
        free = free[num:]
    drawn = [list[str]() for _ in pedestrians]
    for k, (number, _) in enumerate(parts):
        drawn[number].append(of_part[k])
    return [names + ([last] if last else []) for names, last in zip(drawn, lasts, strict=True)]


def _straightness(pedestrian: PedestrianTrajectory, points: np.ndarray) -> float:
    steps_m = np.diff(pedestrian.positions_m[points, :2], axis=0)
    return float(np.hypot(*steps_m.sum(axis=0)) / max(float(np.hypot(*steps_m.T).sum()), 1e-9))


# What suits a style -> its measure in a segment, in the order in which segments are assigned.
MEASURES: dict[str, Callable[[PedestrianTrajectory, np.ndarray], float]] = {
    "uneven": lambda pedestrian, points: float(np.std(pedestrian.speeds_mps[points])),
    "straight": _straightness,
    "": lambda pedestrian, points: 0.0,
}


def mirrored(names: Sequence[str]) -> list[str]:
    """Return names in which styles of either side are turned to the other side."""
    either = {name for name, row in ROWS.items() if row.either_side}
    others = {OTHER_SIDE + name: name for name in either} | {name: OTHER_SIDE + name for name in either}
    return [others.get(name, name) for name in names]


def draw_maneuvers(
    names: Sequence[str], scenario: Scenario, obstacles: BoxIndex, screens: BoxIndex, cfg: PlanConfig,
    rng: np.random.Generator,
) -> ManeuverPlan:  # fmt: skip
    """Draw the manoeuvre plan of a trajectory of these styles. screens: obstacles that certainly hide a person."""
    num = len(scenario.targets_m)
    if names[-1] == REACQUIRE:
        reference = reacquire_reference(scenario, obstacles, screens, cfg, rng)
        impossible, whole = None if reference else "no_hiding_place", Segment(REACQUIRE, 0, num, keeps_sight=False)
        return ManeuverPlan(reference or scenario.reference, (whole,), impossible=impossible)
    names, goes_home = [name for name in names if name != RETURN_HOME], names[-1] == RETURN_HOME
    cuts = np.linspace(0, num, len(names) + 1).round().astype(int).tolist()
    plain = [name.removeprefix(OTHER_SIDE) for name in names]
    segments = tuple(Segment(*part) for part in zip(plain, cuts[:-1], cuts[1:], strict=True))
    is_paper = not goes_home and set(names) == {FOLLOW}
    reference = scenario.reference if is_paper else reference_of(names, scenario, obstacles, cfg, rng)
    if not goes_home:
        return ManeuverPlan(reference, () if is_paper else segments)
    order = MISSION_KINDS[int(rng.integers(len(MISSION_KINDS)))]
    return ManeuverPlan(reference, (*segments, Segment(RETURN_HOME, num, num, keeps_sight=False)), order=order)


def why_not_held(maneuvers: ManeuverPlan, scenario: Scenario, positions_m: np.ndarray, seen: np.ndarray) -> str | None:
    """Return why a trajectory, (n, 3), does not hold its styles, None where it does. seen: (n,) past the screens."""
    if maneuvers.impossible is not None or not maneuvers.segments:
        return maneuvers.impossible
    if maneuvers.searches:
        return None if finds_again(seen, scenario.dt_s) else "not_lost_and_found"
    pursued = None if maneuvers.mission is None else maneuvers.mission.at_frame
    return None if _is_held(maneuvers.reference, scenario, positions_m)[:pursued].mean() >= HELD_SHARE else NOT_HELD


def _is_held(reference: TrackingReference, scenario: Scenario, positions_m: np.ndarray) -> np.ndarray:
    """Return at which frames a trajectory is near its reference position, (n,) bool."""
    requested = reference.places_m(scenario.targets_m, scenario.ground_m) - scenario.targets_m
    planned = positions_m - scenario.targets_m
    requested_m, planned_m = np.linalg.norm(requested, axis=1), np.linalg.norm(planned, axis=1)
    cosine = (requested * planned).sum(axis=1) / np.maximum(requested_m * planned_m, 1e-9)
    ratio = np.maximum(planned_m, 1e-9) / np.maximum(requested_m, 1e-9)
    return (cosine >= np.cos(np.radians(HELD_DEG))) & (ratio <= HELD_RATIO) & (ratio >= 1.0 / HELD_RATIO)


def describe_not_held(
    maneuvers: ManeuverPlan, scenario: Scenario, positions_m: np.ndarray, obstacles: BoxIndex, cfg: PlanConfig
) -> str:
    """Describe the segment that is held least: what was requested, what was planned, and what prevented it."""
    from cosfly.geometry.kernels import signed_distances, visibility

    targets, reference = scenario.targets_m, maneuvers.reference
    is_held = _is_held(reference, scenario, positions_m)
    judged = [one for one in maneuvers.segments if one.keeps_sight]
    part = min(judged, key=lambda one: is_held[one.begin : one.end].mean())
    span, places = slice(part.begin, part.end), reference.places_m(targets, scenario.ground_m)
    lost = ~is_held[span]

    def described(positions: np.ndarray) -> str:
        away = positions[span] - targets[span]
        bearing = np.degrees(_wrapped(np.arctan2(away[:, 1], away[:, 0]) - reference.heading_rad[span]))
        up_m = np.median((positions[:, 2] - scenario.ground_m)[span][lost])
        apart_m = np.median(np.hypot(away[:, 0], away[:, 1])[lost])
        return f"{up_m:.0f} m up, {apart_m:.0f} m away, at {np.median(bearing[lost]):.0f} deg"

    steps_m, safety_m = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=1), cfg.safety_distance_m
    causes = {
        f"nearer than {safety_m:g} m to a box": signed_distances(obstacles, places, safety_m)[0] < safety_m,
        "without line of sight": visibility(obstacles, places, targets) == 0,
        "too fast to reach": steps_m > cfg.speed_max_mps * scenario.dt_s,
    }
    why = [f"{found[span][lost].mean():.0%} {cause}" for cause, found in causes.items() if found[span][lost].any()]
    return (
        f"{part.style}, {lost.mean():.0%} of frames {part.begin} to {part.end - 1}: requested {described(places)}; "
        f"planned {described(positions_m)} (medians); of the requested positions are "
        f"{', '.join(why) or 'all free, in sight and within reach, but not on the way there'}"
    )


# --- mission ----------------------------------------------------------------------------------------------------------
# `return_home`: an order ends the pursuit; the drone breaks off, turns away and returns to its start.

LEAVES_MPS, HOME_MPS, HOME_MPS2 = 3.0, 6.0, 1.5  # greatest speeds, and the acceleration to and from them
LEAVES_M, CLIMBS_M = 6.0, 8.0  # away from the target and up before it turns for home, where there is room
HOLDS_S = 3.0  # over home, at the end
PURSUIT_LEAST = 1 / 3  # of the trajectory


def end_with_order(
    maneuvers: ManeuverPlan, positions_m: np.ndarray, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig
) -> tuple[ManeuverPlan, np.ndarray]:
    """End a pursuit, (n, 3), with the way home, at the last frame that leaves enough time for it."""
    from cosfly.planners.smoothing import repair_to_limits

    assert maneuvers.order is not None
    num, dt_s = len(positions_m), scenario.dt_s
    at, first, in_time = num - 1, max(1, int(num * PURSUIT_LEAST)), num - round(HOLDS_S / dt_s)
    legs = _legs_home(positions_m, scenario.targets_m[-1], obstacles, cfg, dt_s)
    while at > first and at + sum(map(len, legs)) > in_time:
        at = max(first, min(at - 1, in_time - sum(map(len, legs))))
        legs = _legs_home(positions_m[: at + 1], scenario.targets_m[at], obstacles, cfg, dt_s)
    if at + sum(map(len, legs)) > in_time:
        whole = Segment(RETURN_HOME, 0, num, keeps_sight=False)
        return replace(maneuvers, impossible="no_time_for_home", segments=(whole,)), positions_m
    way = np.vstack([positions_m[: at + 1], *legs])
    positions = np.vstack([way, np.tile(way[-1], (num - len(way), 1))])
    share = np.clip((np.arange(num) - at) * dt_s / (2.0 * ROUNDING_S), 0.0, 1.0)[:, None]  # the pursuit stays
    positions += share * (gaussian_filter1d(positions, ROUNDING_S / dt_s, axis=0, mode="nearest") - positions)
    home_m = np.round(positions_m[0], 4)
    mission = Mission(maneuvers.order, at, at + len(legs[0]), tuple(home_m.tolist()))
    before = tuple(Segment(p.style, p.begin, min(p.end, at)) for p in maneuvers.segments if p.begin < at)
    segments = (*before, Segment(RETURN_HOME, at, num, keeps_sight=False))
    reference = replace(maneuvers.reference, keeps_sight=maneuvers.reference.keeps_sight & (np.arange(num) < at))
    maneuvers = replace(maneuvers, reference=reference, segments=segments, mission=mission)
    return maneuvers, repair_to_limits(positions, scenario, obstacles, cfg)


def _legs_home(
    trail_m: np.ndarray, target_m: np.ndarray, obstacles: BoxIndex, cfg: PlanConfig, dt_s: float
) -> list[np.ndarray]:
    """Return the leg from the end of a trail (k, 3) away from the target, and the leg home along the trail, with
    shortcuts where they are free."""
    from cosfly.geometry.kernels import segments_hit

    def are_free(start: np.ndarray, ends: np.ndarray) -> np.ndarray:
        return ~segments_hit(obstacles, np.broadcast_to(start, ends.shape), ends, cfg.safety_distance_m)

    here, away = trail_m[-1], (trail_m[-1] - target_m) * [1.0, 1.0, 0.0]
    outwards, up = LEAVES_M * away / max(float(np.linalg.norm(away)), 1e-6), np.array([0.0, 0.0, CLIMBS_M])
    asides = here + np.stack([outwards + up, outwards, up, 0.0 * up])
    aside = asides[int(np.argmax([*are_free(here, asides[:3]), True]))]
    corners, left = [aside], len(trail_m)
    while left:
        free = are_free(corners[-1], trail_m[:left])
        left = int(np.argmax(free)) if free.any() else left - 1
        corners.append(trail_m[left])
    legs = ((np.stack([here, aside]), LEAVES_MPS), (np.stack(corners), HOME_MPS))
    return [_positions_along(leg, most_mps, dt_s) for leg, most_mps in legs]


def _positions_along(corners_m: np.ndarray, most_mps: float, dt_s: float) -> np.ndarray:
    """Return positions (k, 3), dt_s apart, along a polyline from rest to rest, without its first point."""
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners_m, axis=0), axis=1))])
    speed_mps = min(most_mps, np.sqrt(HOME_MPS2 * along_m[-1]))
    seconds = along_m[-1] / max(speed_mps, 1e-9) + speed_mps / HOME_MPS2
    times = dt_s * np.arange(1, max(1, int(np.ceil(seconds / dt_s))) + 1)
    ramp = np.minimum(times, speed_mps / HOME_MPS2), np.clip(seconds - times, 0.0, speed_mps / HOME_MPS2)
    gone_m = speed_mps * np.minimum(times, seconds) - 0.5 * speed_mps**2 / HOME_MPS2
    gone_m += 0.5 * HOME_MPS2 * ((speed_mps / HOME_MPS2 - ramp[0]) ** 2 - (speed_mps / HOME_MPS2 - ramp[1]) ** 2)
    return np.stack([np.interp(gone_m, along_m, corners_m[:, axis]) for axis in range(3)], axis=1)


# --- camera -----------------------------------------------------------------------------------------------------------
# The camera looks at the target; on the way home, in the direction of motion; while the target is hidden, where it was
# lost.

TURNS_S = 0.8  # standard deviation of the smoothing of a turn during a search
HOME_PITCH_DEG, HOME_TURN_DPS = -15.0, 45.0  # on the way home; the greatest turn rate of the view
STANDING_MPS = 0.5  # below this the direction of motion is undefined
# During a search the camera looks where the target would be if it went on for a while, and to both sides of that.
GOES_ON_S, SWEEP_DEG, SWEEP_S = 2.0, 18.0, 6.0


def view_of(
    maneuvers: ManeuverPlan, positions_m: np.ndarray, targets_m: np.ndarray, seen: np.ndarray, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return pitch and yaw of the camera, (n,) each, radians.

    Args:
        positions_m, targets_m: (n, 3). seen: (n,) five-ray visibility.
    """
    if maneuvers.mission is not None:
        return _turned_home(positions_m, targets_m, maneuvers.mission.at_frame, dt_s)
    if maneuvers.searches:
        return _searching(positions_m, targets_m, seen, dt_s)
    return look_at(positions_m, targets_m)


def _turned_home(positions_m: np.ndarray, targets_m: np.ndarray, at: int, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Turn into the direction of motion from frame `at` on, at most at HOME_TURN_DPS."""
    velocity, step = np.gradient(positions_m[:, :2], dt_s, axis=0), np.radians(HOME_TURN_DPS) * dt_s
    pitch, yaw = look_at(positions_m, targets_m)
    for i in range(at + 1, len(yaw)):
        moves = np.hypot(*velocity[i]) >= STANDING_MPS
        wanted = np.arctan2(velocity[i, 1], velocity[i, 0]) if moves else yaw[i - 1]
        yaw[i] = yaw[i - 1] + np.clip(_wrapped(wanted - yaw[i - 1]), -step, step)
        pitch[i] = pitch[i - 1] + np.clip(np.radians(HOME_PITCH_DEG) - pitch[i - 1], -step, step)
    return pitch, _wrapped(yaw)


def _searching(
    positions_m: np.ndarray, targets_m: np.ndarray, seen: np.ndarray, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Look where the target was lost while it is hidden: the drone does not know what it does not see."""
    frames = np.arange(len(seen))
    last = np.maximum.accumulate(np.where(seen > 0, frames, 0))
    since_s = (frames - last) * dt_s
    speeds = np.gradient(targets_m, dt_s, axis=0)
    pitch, yaw = look_at(positions_m, targets_m[last] + speeds[last] * np.minimum(since_s, GOES_ON_S)[:, None])
    sweep = np.radians(SWEEP_DEG) * np.sin(2.0 * np.pi * np.maximum(since_s - GOES_ON_S, 0.0) / SWEEP_S)

    def eased(angles: np.ndarray) -> np.ndarray:
        return np.where(since_s > 0, gaussian_filter1d(angles, TURNS_S / dt_s, mode="nearest"), angles)

    return eased(pitch), _wrapped(eased(np.unwrap(yaw) + sweep))


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angles), np.cos(angles))
