"""The manoeuvre plan of a trajectory: styles drawn from the shares of the settings, mission, camera, and checks.

A trajectory holds its style where the target sees the drone within HELD_DEG of the reference position, and the distance
in the plane is the requested one within HELD_M or HELD_SHARE_M, whichever is larger.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.formats.segments import FOLLOW, MISSION_KINDS, Mission, MissionKind, Segment
from cosfly.geometry.axes import look_at
from cosfly.geometry.trajectory_metrics import distances_along_m
from cosfly.planners.contract import PlanConfig, Scenario, TrackingReference
from cosfly.planners.gimbal import follow_direction, limit_yaw_rate
from cosfly.planners.reference_trajectory import ROUNDING_S, finds_again, reacquire_reference, reference_of
from cosfly.planners.styles import OTHER_SIDE, REACQUIRE, RETURN_HOME, ROWS, WHOLE, suits
from cosfly.runtime.seeding import draw_to_quota

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex

HELD_DEG, HELD_M, HELD_SHARE_M = 25.0, 2.0, 0.15
HELD_SHARE = 0.7  # of its frames at which a trajectory holds its styles
POINTS_LEAST = 4  # points of a segment
NOT_HELD = "style_not_held"


@dataclass(frozen=True)
class ManeuverPlan:
    """The styles of one trajectory."""

    reference: TrackingReference
    segments: tuple[Segment, ...] = ()  # empty for the paper's `follow` from end to end
    mission: Mission | None = None
    order: MissionKind | None = None  # of the mission that ends the pursuit
    impossible: str | None = None  # why the map cannot hold the style; the reference is then the paper's

    @property
    def searches(self) -> bool:
        return any(part.style == REACQUIRE for part in self.segments)


class _Stretch(NamedTuple):
    """A part of a pedestrian trajectory that becomes a segment with one style."""

    pedestrian_index: int
    pedestrian: PedestrianTrajectory
    points: np.ndarray  # (k,) indices


def draw_styles(
    pedestrians: Sequence[PedestrianTrajectory], cfg: PlanConfig, rng: np.random.Generator
) -> list[list[str]]:
    """Draw the styles of the segments of each trajectory of a run, so that their numbers follow the shares exactly.

    Styles of whole trajectories are drawn first; each is the only or the last style of its trajectory.
    """
    shares = {style: share for style, share in cfg.styles.items() if style not in WHOLE}
    whole_shares = {style: share for style, share in cfg.styles.items() if style in WHOLE}
    whole_rng, segments_rng = rng.spawn(2)
    last_styles = [*islice(draw_to_quota(whole_shares | {"": sum(shares.values())}, whole_rng), len(pedestrians))]
    stretches = list[_Stretch]()
    for index, (pedestrian, last_style) in enumerate(zip(pedestrians, last_styles, strict=True)):
        if last_style == REACQUIRE:
            continue
        num_points = len(pedestrian.time_s)
        num = round(float(pedestrian.time_s[-1]) / cfg.segment_s) if cfg.segment_s else 1
        num = max(1, min(num, num_points // POINTS_LEAST))
        stretches += [_Stretch(index, pedestrian, points) for points in np.array_split(np.arange(num_points), num)]
    drawn = [list[str]() for _ in pedestrians]
    if not sum(shares.values()):
        shares = {FOLLOW: 1.0}  # `follow` precedes `return_home`
    for stretch, style in zip(stretches, _draw_segment_styles(stretches, shares, segments_rng), strict=True):
        drawn[stretch.pedestrian_index].append(style)
    return [names + ([last] if last else []) for names, last in zip(drawn, last_styles, strict=True)]


def _draw_segment_styles(
    stretches: Sequence[_Stretch], shares: dict[str, float], rng: np.random.Generator
) -> list[str]:
    """Draw a style for each stretch, mirrored for half of those with two sides.

    Some styles suit a pedestrian with uneven speed or a straight path: they get the stretches with the greatest measure
    of that (MEASURES), up to their share of the time, so that the drone has a reason to change its pace.
    """
    shares = dict(shares)
    for style, mirror_style in zip([*shares], mirrored([*shares]), strict=True):
        if style != mirror_style:
            shares[mirror_style] = shares[style] / 2.0
            shares[style] = shares[mirror_style]
    unassigned = [*range(len(stretches))]
    unassigned_share = sum(shares.values())
    style_of = dict[int, str]()
    for motion, measure in MEASURES.items():
        suited_shares = {style: share for style, share in shares.items() if suits(style) == motion}
        share = sum(suited_shares.values())
        if not (unassigned and share):
            continue
        unassigned.sort(key=lambda k: (-measure(stretches[k].pedestrian, stretches[k].points), k))
        # The last stretch is rounded at random: it counts if a random point of it is within the share of the time.
        lengths = np.array([len(stretches[k].points) for k in unassigned])
        ends = np.cumsum(lengths) - rng.random() * lengths
        num = int((ends <= lengths.sum() * share / unassigned_share).sum())
        unassigned_share -= share
        style_of |= zip(sorted(unassigned[:num]), draw_to_quota(suited_shares, rng), strict=False)
        unassigned = unassigned[num:]
    return [style_of[k] for k in range(len(stretches))]


def _straightness(pedestrian: PedestrianTrajectory, points: np.ndarray) -> float:
    """Return the distance from the first to the last point over the length of the path between them."""
    steps_m = np.diff(pedestrian.positions_m[points, :2], axis=0)
    return float(np.hypot(*steps_m.sum(axis=0)) / max(float(np.hypot(*steps_m.T).sum()), 1e-9))


# Motion of the target that suits a style -> measure of it in a segment, in the order in which segments are assigned.
MEASURES: dict[str, Callable[[PedestrianTrajectory, np.ndarray], float]] = {
    "uneven": lambda pedestrian, points: float(np.std(pedestrian.speeds_mps[points])),
    "straight": _straightness,
    "": lambda pedestrian, points: 0.0,
}


def mirrored(names: Sequence[str]) -> list[str]:
    """Return the names with the other side for styles that have two sides."""
    two_sided = {name for name, row in ROWS.items() if row.either_side}
    mirror_of = {OTHER_SIDE + name: name for name in two_sided} | {name: OTHER_SIDE + name for name in two_sided}
    return [mirror_of.get(name, name) for name in names]


def draw_maneuvers(
    names: Sequence[str], scenario: Scenario, obstacles: BoxIndex, screens: BoxIndex, cfg: PlanConfig,
    rng: np.random.Generator,
) -> ManeuverPlan:  # fmt: skip
    """Draw the manoeuvre plan of a trajectory of these styles. screens: obstacles that certainly hide a person."""
    num = len(scenario.targets_m)
    if names[-1] == REACQUIRE:
        reference = reacquire_reference(scenario, obstacles, screens, cfg, rng)
        segment = Segment(REACQUIRE, 0, num, keeps_sight=False)
        impossible = None if reference else "no_hiding_place"
        return ManeuverPlan(reference or scenario.reference, (segment,), impossible=impossible)
    goes_home = names[-1] == RETURN_HOME
    names = [name for name in names if name != RETURN_HOME]
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
    """Return why a trajectory, (n, 3), does not hold its styles, None if it does.

    seen: (n,) five-ray visibility with only the screens as obstacles.
    """
    if maneuvers.impossible is not None or not maneuvers.segments:
        return maneuvers.impossible
    if maneuvers.searches:
        return None if finds_again(seen, scenario.dt_s) else "not_lost_and_found"
    pursuit_end = None if maneuvers.mission is None else maneuvers.mission.at_frame
    is_held = _is_held(maneuvers.reference, scenario, positions_m)[:pursuit_end]
    return None if is_held.mean() >= HELD_SHARE else NOT_HELD


def _is_held(reference: TrackingReference, scenario: Scenario, positions_m: np.ndarray) -> np.ndarray:
    """Return at which frames a trajectory is near its reference position, (n,) bool."""
    requested = reference.places_m(scenario.targets_m, scenario.ground_m) - scenario.targets_m
    planned = positions_m - scenario.targets_m
    lengths_m2 = np.linalg.norm(requested, axis=1) * np.linalg.norm(planned, axis=1)
    cosine = (requested * planned).sum(axis=1) / np.maximum(lengths_m2, 1e-9)
    requested_m = np.hypot(*requested[:, :2].T)  # in the plane
    planned_m = np.hypot(*planned[:, :2].T)
    is_near = np.abs(planned_m - requested_m) <= np.maximum(HELD_M, HELD_SHARE_M * requested_m)
    return (cosine >= np.cos(np.radians(HELD_DEG))) & is_near


def describe_not_held(maneuvers: ManeuverPlan, scenario: Scenario, positions_m: np.ndarray) -> str:
    """Describe the segment that is held least: its style, the requested positions and the planned ones."""
    reference = maneuvers.reference
    is_held = _is_held(reference, scenario, positions_m)
    judged = [segment for segment in maneuvers.segments if segment.keeps_sight]
    worst = min(judged, key=lambda segment: is_held[segment.begin : segment.end].mean())
    frames = np.arange(worst.begin, worst.end)
    not_held = frames[~is_held[frames]]

    def medians(positions: np.ndarray) -> str:
        away = (positions - scenario.targets_m)[not_held]
        bearing = np.degrees(_wrapped(np.arctan2(away[:, 1], away[:, 0]) - reference.heading_rad[not_held]))
        up_m = np.median((positions[:, 2] - scenario.ground_m)[not_held])
        apart_m = np.median(np.hypot(away[:, 0], away[:, 1]))
        return f"{up_m:.0f} m up, {apart_m:.0f} m away, at {np.median(bearing):.0f} deg"

    requested_m = reference.places_m(scenario.targets_m, scenario.ground_m)
    share = len(not_held) / len(frames)
    return f"{worst.style}, not held in {share:.0%}: requested {medians(requested_m)}; planned {medians(positions_m)}"


# --- mission ----------------------------------------------------------------------------------------------------------
# `return_home`: an order ends the pursuit; the drone breaks off, turns away and returns to its start.

LEAVES_MPS, HOME_MPS = 3.0, 6.0  # greatest speeds of the leg away from the target and of the leg home
HOME_MPS2 = 1.5  # acceleration to and from these speeds
LEAVES_M, CLIMBS_M = 6.0, 8.0  # length and climb of the leg away from the target, where there is room
HOLDS_S = 3.0  # time over home at the end
PURSUIT_LEAST = 1 / 3  # least share of the trajectory before the order


def end_with_order(
    maneuvers: ManeuverPlan, positions_m: np.ndarray, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig
) -> tuple[ManeuverPlan, np.ndarray]:
    """End a pursuit, (n, 3), with the way home, at the last frame that leaves enough time for it."""
    from cosfly.planners.smoothing import repair_to_limits

    assert maneuvers.order is not None
    num = len(positions_m)
    dt_s = scenario.dt_s
    first_frame = max(1, int(num * PURSUIT_LEAST))
    last_arrival = num - round(HOLDS_S / dt_s)
    order_frame = num - 1
    while True:  # earlier and earlier, until the drone arrives in time
        trail_m = positions_m[: order_frame + 1]
        leg_away, leg_home = _legs_home(trail_m, scenario.targets_m[order_frame], obstacles, cfg, dt_s)
        num_home = len(leg_away) + len(leg_home)
        if order_frame <= first_frame or order_frame + num_home <= last_arrival:
            break
        order_frame = max(first_frame, min(order_frame - 1, last_arrival - num_home))
    if order_frame + num_home > last_arrival:
        whole = Segment(RETURN_HOME, 0, num, keeps_sight=False)
        return replace(maneuvers, impossible="no_time_for_home", segments=(whole,)), positions_m
    flown = np.vstack([trail_m, leg_away, leg_home])
    positions = np.vstack([flown, np.tile(flown[-1], (num - len(flown), 1))])
    # Smooth the way home; the pursuit stays as it is.
    share = np.clip((np.arange(num) - order_frame) * dt_s / (2.0 * ROUNDING_S), 0.0, 1.0)[:, None]
    positions += share * (gaussian_filter1d(positions, ROUNDING_S / dt_s, axis=0, mode="nearest") - positions)
    home_m = np.round(positions_m[0], 4)
    mission = Mission(maneuvers.order, order_frame, order_frame + len(leg_away), tuple(home_m.tolist()))
    pursuit = tuple(
        Segment(segment.style, segment.begin, min(segment.end, order_frame))
        for segment in maneuvers.segments
        if segment.begin < order_frame
    )
    segments = (*pursuit, Segment(RETURN_HOME, order_frame, num, keeps_sight=False))
    keeps_sight = maneuvers.reference.keeps_sight & (np.arange(num) < order_frame)
    reference = replace(maneuvers.reference, keeps_sight=keeps_sight)
    maneuvers = replace(maneuvers, reference=reference, segments=segments, mission=mission)
    return maneuvers, repair_to_limits(positions, scenario, obstacles, cfg)


def _legs_home(
    trail_m: np.ndarray, target_m: np.ndarray, obstacles: BoxIndex, cfg: PlanConfig, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the leg from the end of a trail (k, 3) away from the target, and the leg home.

    The leg home goes back along the trail, with shortcuts where they are free.
    """
    from cosfly.geometry.kernels import segments_hit

    def are_free(start: np.ndarray, ends: np.ndarray) -> np.ndarray:
        return ~segments_hit(obstacles, np.broadcast_to(start, ends.shape), ends, cfg.safety_distance_m)

    here = trail_m[-1]
    away = (here - target_m) * [1.0, 1.0, 0.0]
    outwards = LEAVES_M * away / max(float(np.linalg.norm(away)), 1e-6)
    up = np.array([0.0, 0.0, CLIMBS_M])
    candidates = here + np.stack([outwards + up, outwards, up, 0.0 * up])  # the last is the drone's own position
    aside = candidates[int(np.argmax([*are_free(here, candidates[:3]), True]))]  # the first free one
    corners = [aside]
    trail_index = len(trail_m)
    while trail_index > 0:
        free = are_free(corners[-1], trail_m[:trail_index])
        trail_index = int(np.argmax(free)) if free.any() else trail_index - 1
        corners.append(trail_m[trail_index])
    leg_away = _positions_along(np.stack([here, aside]), LEAVES_MPS, dt_s)
    return leg_away, _positions_along(np.stack(corners), HOME_MPS, dt_s)


def _positions_along(corners_m: np.ndarray, most_mps: float, dt_s: float) -> np.ndarray:
    """Return positions (k, 3), dt_s apart, along a polyline from rest to rest, without its first point."""
    along_m = distances_along_m(corners_m)
    speed_mps = min(most_mps, np.sqrt(HOME_MPS2 * along_m[-1]))
    ramp_s = speed_mps / HOME_MPS2  # of speeding up, and of slowing down
    duration_s = along_m[-1] / max(speed_mps, 1e-9) + ramp_s
    times_s = dt_s * np.arange(1, max(1, int(np.ceil(duration_s / dt_s))) + 1)
    since_start_s = np.minimum(times_s, ramp_s)
    until_end_s = np.clip(duration_s - times_s, 0.0, ramp_s)
    gone_m = speed_mps * np.minimum(times_s, duration_s) - 0.5 * speed_mps**2 / HOME_MPS2
    gone_m += 0.5 * HOME_MPS2 * ((ramp_s - since_start_s) ** 2 - (ramp_s - until_end_s) ** 2)
    return np.stack([np.interp(gone_m, along_m, corners_m[:, axis]) for axis in range(3)], axis=1)


# --- camera -----------------------------------------------------------------------------------------------------------
# The camera looks at the target; on the way home, in the direction of motion; while the target is hidden, where it was
# lost.

TURNS_S = 0.8  # standard deviation of the smoothing of a turn during a search
HOME_PITCH_DEG = -15.0  # on the way home
HOME_TURN_DPS = 45.0  # greatest turn rate of the view on the way home
STANDING_MPS = 0.5  # below this the direction of motion is undefined
# During a search the camera follows the last velocity of the target for a while, then sweeps to both sides.
GOES_ON_S = 2.0
SWEEP_DEG, SWEEP_S = 18.0, 6.0  # amplitude and period


def view_of(
    maneuvers: ManeuverPlan, positions_m: np.ndarray, targets_m: np.ndarray, seen: np.ndarray, dt_s: float,
    cfg: PlanConfig, rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return pitch and yaw of the camera, (n,) each, radians.

    Args:
        positions_m, targets_m: (n, 3). seen: (n,) five-ray visibility. rng: Draws the aiming error of the gimbal.
    """
    if maneuvers.mission is not None:
        direction = _turned_home(positions_m, targets_m, maneuvers.mission.at_frame, dt_s)
    elif maneuvers.searches:
        direction = _searching(positions_m, targets_m, seen, dt_s)
    else:
        direction = look_at(positions_m, targets_m)
    direction = limit_yaw_rate(*direction, cfg.yaw_rate_max_degps, dt_s)
    if cfg.gimbal.bandwidth_hz == 0:
        return direction
    return follow_direction(*direction, cfg.gimbal, cfg.yaw_rate_max_degps, dt_s, rng)


def _turned_home(
    positions_m: np.ndarray, targets_m: np.ndarray, order_frame: int, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Turn into the direction of motion after the order, at most at HOME_TURN_DPS."""
    velocity = np.gradient(positions_m[:, :2], dt_s, axis=0)
    step = np.radians(HOME_TURN_DPS) * dt_s
    pitch, yaw = look_at(positions_m, targets_m)
    for i in range(order_frame + 1, len(yaw)):
        moves = np.hypot(*velocity[i]) >= STANDING_MPS
        direction = np.arctan2(velocity[i, 1], velocity[i, 0]) if moves else yaw[i - 1]
        yaw[i] = yaw[i - 1] + np.clip(_wrapped(direction - yaw[i - 1]), -step, step)
        pitch[i] = pitch[i - 1] + np.clip(np.radians(HOME_PITCH_DEG) - pitch[i - 1], -step, step)
    return pitch, _wrapped(yaw)


def _searching(
    positions_m: np.ndarray, targets_m: np.ndarray, seen: np.ndarray, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Look where the target was lost while it is hidden: the drone does not know the position of a hidden target."""
    frames = np.arange(len(seen))
    last_seen = np.maximum.accumulate(np.where(seen > 0, frames, 0))
    since_s = (frames - last_seen) * dt_s
    velocity = np.gradient(targets_m, dt_s, axis=0)[last_seen]
    expected_m = targets_m[last_seen] + velocity * np.minimum(since_s, GOES_ON_S)[:, None]
    pitch, yaw = look_at(positions_m, expected_m)
    sweep = np.radians(SWEEP_DEG) * np.sin(2.0 * np.pi * np.maximum(since_s - GOES_ON_S, 0.0) / SWEEP_S)

    def eased(angles: np.ndarray) -> np.ndarray:
        return np.where(since_s > 0, gaussian_filter1d(angles, TURNS_S / dt_s, mode="nearest"), angles)

    return eased(pitch), _wrapped(eased(np.unwrap(yaw) + sweep))


def _wrapped(angles: np.ndarray) -> np.ndarray:
    """Return angles from -pi to pi."""
    return np.arctan2(np.sin(angles), np.cos(angles))
