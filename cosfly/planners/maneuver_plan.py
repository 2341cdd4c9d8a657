"""Which style a flight gets: drawn by seed from the shares of the settings, and judged when it is flown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.formats.segments import FOLLOW, MISSION_KINDS, Mission, MissionKind, Segment
from cosfly.geometry.axes import look_at
from cosfly.planners.contract import PlanConfig, Scenario, TrackingReference
from cosfly.planners.reference_trajectory import ROUNDING_S, reference_of
from cosfly.planners.reacquire import finds_again, reference_of_reacquire
from cosfly.planners.styles import OTHER_SIDE, REACQUIRE, RETURN_HOME, ROWS, WHOLE, suits
from cosfly.runtime.seeding import draw_to_quota

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex


# A flight holds its style where the walker sees it within this angle of the wished place and within this ratio of its
# distance.
HELD_DEG, HELD_RATIO, HELD_SHARE = 25.0, 1.4, 0.7

POINTS_LEAST = 4  # of a part

NO_HIDING_PLACE, NOT_FOUND_AGAIN, NOT_HELD = "no_hiding_place", "not_lost_and_found", "style_not_held"
NO_TIME = "no_time_for_home"


@dataclass(frozen=True)
class Intent:
    """What a flight is meant to be. segments: empty for the paper's flight from end to end.

    order: kind of the mission that is to end the pursuit. impossible: why the map cannot hold the style; the wish is
    the paper's then.
    """

    reference: TrackingReference
    segments: tuple[Segment, ...] = ()
    mission: Mission | None = None
    order: MissionKind | None = None
    impossible: str | None = None

    @property
    def styles(self) -> str:
        return ", ".join(part.style for part in self.segments)

    @property
    def searches(self) -> bool:
        return any(part.style == REACQUIRE for part in self.segments)


def draw_styles(walks: Sequence[PedestrianTrajectory], cfg: PlanConfig, rng: np.random.Generator) -> list[list[str]]:
    """Draw the styles of the parts of each flight of a run to the quota of the settings' shares.

    Flights draw among themselves which takes a style that is of a whole flight, parts which styles they have. Styles
    that suit somebody who stops and hurries, or who goes straight on, have their share of the time in the parts with
    most of it. So a drone that changes its pace has cause to, and shares stay what they are.
    """
    others = {style: share for style, share in cfg.styles.items() if style not in WHOLE}
    parts_share = sum(others.values())
    if parts_share == 0:
        others = {FOLLOW: 1.0}  # what comes before a flight home
    for style, other in zip([*others], mirrored([*others]), strict=True):
        if style != other:
            others[style] = others[other] = others[style] / 2.0
    whole = {style: share for style, share in cfg.styles.items() if style in WHOLE}
    flights_rng, parts_rng = rng.spawn(2)
    lasts = [*islice(draw_to_quota(whole | {"": parts_share}, flights_rng), len(walks))]
    parts = list[tuple[int, np.ndarray]]()  # flight, and points of its walk
    for flight, (walk, last) in enumerate(zip(walks, lasts, strict=True)):
        num_points, duration_s = len(walk.time_s), float(walk.time_s[-1])
        num = round(duration_s / cfg.segment_s) if cfg.segment_s else 1
        num = 0 if last == REACQUIRE else max(1, min(num, num_points // POINTS_LEAST))
        parts += [(flight, points) for points in np.array_split(np.arange(num_points), num)] if num else []
    free, left, of_part = [*range(len(parts))], sum(others.values()), dict[int, str]()
    for kind, measure in MEASURES.items():
        styles = {style: share for style, share in others.items() if suits(style) == kind}
        if not (free and (share := sum(styles.values()))):
            continue
        free.sort(key=lambda k: (-measure(walks[parts[k][0]], parts[k][1]), k))
        lengths = np.array([len(parts[k][1]) for k in free])
        ends = np.cumsum(lengths) - parts_rng.random() * lengths
        num, left = int((ends <= lengths.sum() * share / left).sum()), left - share
        of_part |= zip(sorted(free[:num]), draw_to_quota(styles, parts_rng), strict=False)
        free = free[num:]
    drawn = [list[str]() for _ in walks]
    for k, (flight, _) in enumerate(parts):
        drawn[flight].append(of_part[k])
    return [names + ([last] if last else []) for names, last in zip(drawn, lasts, strict=True)]


def _unevenness_mps(walk: PedestrianTrajectory, points: np.ndarray) -> float:
    return float(np.std(walk.speeds_mps[points]))


def _straightness(walk: PedestrianTrajectory, points: np.ndarray) -> float:
    steps_m = np.diff(walk.positions_m[points, :2], axis=0)
    return float(np.hypot(*steps_m.sum(axis=0)) / max(float(np.hypot(*steps_m.T).sum()), 1e-9))


# How much of what suits a style a walker does in a part of the way, in the order in which parts are given away.
MEASURES = {"uneven": _unevenness_mps, "straight": _straightness, "": lambda walk, points: 0.0}


def mirrored(names: Sequence[str]) -> list[str]:
    """Turn styles of either side to the other one."""
    either = {name for name, row in ROWS.items() if row.either_side}
    others = {OTHER_SIDE + name: name for name in either} | {name: OTHER_SIDE + name for name in either}
    return [others.get(name, name) for name in names]


def draw_intent(
    names: Sequence[str], scenario: Scenario, obstacles: BoxIndex, screens: BoxIndex, cfg: PlanConfig,
    rng: np.random.Generator,
) -> Intent:  # fmt: skip
    """Draw how a flight of these styles is flown. screens: the obstacles that hide a person for certain."""
    num = len(scenario.targets_m)
    if names[-1] == REACQUIRE:
        reference = reference_of_reacquire(scenario, obstacles, screens, cfg, rng)
        segment = Segment(REACQUIRE, 0, num, keeps_sight=False)
        if reference is None:
            return Intent(scenario.reference, (segment,), impossible=NO_HIDING_PLACE)
        return Intent(reference, (segment,))
    names, goes_home = [name for name in names if name != RETURN_HOME], names[-1] == RETURN_HOME
    cuts = np.linspace(0, num, len(names) + 1).round().astype(int).tolist()
    plain = [name.removeprefix(OTHER_SIDE) for name in names]
    segments = tuple(Segment(*part) for part in zip(plain, cuts[:-1], cuts[1:], strict=True))
    is_paper = not goes_home and set(names) == {FOLLOW}
    reference = scenario.reference if is_paper else reference_of(names, scenario, obstacles, cfg, rng)
    if not goes_home:
        return Intent(reference, () if is_paper else segments)
    order = MISSION_KINDS[int(rng.integers(len(MISSION_KINDS)))]
    return Intent(reference, (*segments, Segment(RETURN_HOME, num, num, keeps_sight=False)), order=order)


def why_not_held(intent: Intent, scenario: Scenario, positions_m: np.ndarray, seen: np.ndarray) -> str | None:
    """Return why a flight is not what it was meant to be, None where it is.

    Args:
        positions_m: (n, 3), as flown. seen: (n,) five-ray visibility past the screens.
    """
    if intent.impossible is not None or not intent.segments:
        return intent.impossible
    if intent.searches:
        return None if finds_again(seen, scenario.dt_s) else NOT_FOUND_AGAIN
    pursued = None if intent.mission is None else intent.mission.at_frame
    return None if _is_held(intent.reference, scenario, positions_m)[:pursued].mean() >= HELD_SHARE else NOT_HELD


def _is_held(reference: TrackingReference, scenario: Scenario, positions_m: np.ndarray) -> np.ndarray:
    """Tell at which frames a flight is about where it is wished, (n,) bool."""
    requested = reference.places_m(scenario.targets_m, scenario.ground_m) - scenario.targets_m
    flown = positions_m - scenario.targets_m
    wished_m, flown_m = np.linalg.norm(requested, axis=1), np.linalg.norm(flown, axis=1)
    cosine = (requested * flown).sum(axis=1) / np.maximum(wished_m * flown_m, 1e-9)
    ratio = np.maximum(flown_m, 1e-9) / np.maximum(wished_m, 1e-9)
    return (cosine >= np.cos(np.radians(HELD_DEG))) & (ratio <= HELD_RATIO) & (ratio >= 1.0 / HELD_RATIO)


def tell_not_held(
    intent: Intent, scenario: Scenario, positions_m: np.ndarray, obstacles: BoxIndex, cfg: PlanConfig
) -> str:
    """Say of the part that is held least what was asked, what was flown, and what was in the way."""
    from cosfly.geometry.kernels import signed_distances, visibility

    is_held, targets, reference = (
        _is_held(intent.reference, scenario, positions_m),
        scenario.targets_m,
        intent.reference,
    )
    part = min(
        (part for part in intent.segments if part.keeps_sight), key=lambda part: is_held[part.begin : part.end].mean()
    )
    span, places = slice(part.begin, part.end), reference.places_m(targets, scenario.ground_m)
    lost = ~is_held[span]

    def told(flown: np.ndarray) -> str:
        away = flown[span] - targets[span]
        bearing = np.degrees(_wrapped(np.arctan2(away[:, 1], away[:, 0]) - reference.heading_rad[span]))
        up_m = np.median((flown[:, 2] - scenario.ground_m)[span][lost])
        apart_m = np.median(np.hypot(away[:, 0], away[:, 1])[lost])
        return f"{up_m:.0f} m up, {apart_m:.0f} m away, at {np.median(bearing[lost]):.0f} deg"

    near = signed_distances(obstacles, places, cfg.safety_distance_m)[0] < cfg.safety_distance_m
    unseen, fast = visibility(obstacles, places, targets) == 0, np.zeros(len(places), dtype=bool)
    fast[1:] = np.linalg.norm(np.diff(places, axis=0), axis=1) > cfg.speed_max_mps * scenario.dt_s
    causes = {f"nearer than {cfg.safety_distance_m:g} m to a box": near, "without sight": unseen, "too fast": fast}
    why = [f"{found[span][lost].mean():.0%} {cause}" for cause, found in causes.items() if found[span][lost].any()]
    return (
        f"{part.style}, {lost.mean():.0%} of frames {part.begin} to {part.end - 1}: asked {told(places)}; "
        f"flown {told(positions_m)} (medians); because the places asked are "
        f"{', '.join(why) or 'free, in sight and within reach, but not all the way there'}"
    )


# --- mission ----------------------------------------------------------------------------------------------------------
# `return_home`: an order of the mission ends the pursuit; the drone breaks off, turns away and flies to where it
# started.


LEAVES_MPS, HOME_MPS, HOME_MPS2 = 3.0, 6.0, 1.5  # greatest speeds, and how fast they are reached and lost
LEAVES_M, CLIMBS_M = 6.0, 8.0  # away from the walker and up, before it turns for home, as far as there is room
HOLDS_S = 3.0  # over home, at the end
PURSUIT_LEAST = 1 / 3  # of the flight


def ended_by_order(
    intent: Intent, positions_m: np.ndarray, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig
) -> tuple[Intent, np.ndarray]:
    """End a pursuit as it was flown, (n, 3), with the way home, where the rest of the walk is just enough for it."""
    from cosfly.planners.smoothing import within_limits

    assert intent.order is not None
    num, dt_s = len(positions_m), scenario.dt_s
    at, first, in_time = num - 1, max(1, int(num * PURSUIT_LEAST)), num - round(HOLDS_S / dt_s)
    legs = _legs_home(positions_m, scenario.targets_m[-1], obstacles, cfg, dt_s)
    while at > first and at + sum(map(len, legs)) > in_time:
        at = max(first, min(at - 1, in_time - sum(map(len, legs))))
        legs = _legs_home(positions_m[: at + 1], scenario.targets_m[at], obstacles, cfg, dt_s)
    if at + sum(map(len, legs)) > in_time:
        whole = Segment(RETURN_HOME, 0, num, keeps_sight=False)
        return replace(intent, impossible=NO_TIME, segments=(whole,)), positions_m
    way = np.vstack([positions_m[: at + 1], *legs])
    flown = np.vstack([way, np.tile(way[-1], (num - len(way), 1))])
    share = np.clip((np.arange(num) - at) * dt_s / (2.0 * ROUNDING_S), 0.0, 1.0)[:, None]  # the pursuit stays
    flown += share * (gaussian_filter1d(flown, ROUNDING_S / dt_s, axis=0, mode="nearest") - flown)
    home_m = np.round(positions_m[0], 4)
    mission = Mission(intent.order, at, at + len(legs[0]), (float(home_m[0]), float(home_m[1]), float(home_m[2])))
    before = tuple(Segment(p.style, p.begin, min(p.end, at)) for p in intent.segments if p.begin < at)
    segments = (*before, Segment(RETURN_HOME, at, num, keeps_sight=False))
    reference = replace(intent.reference, keeps_sight=intent.reference.keeps_sight & (np.arange(num) < at))
    return replace(intent, reference=reference, segments=segments, mission=mission), within_limits(
        flown, scenario, obstacles, cfg
    )


def _legs_home(
    trail_m: np.ndarray, target_m: np.ndarray, obstacles: BoxIndex, cfg: PlanConfig, dt_s: float
) -> list[np.ndarray]:
    """Return the way from the end of a trail (k, 3) away from the target, and then home: along the trail, but straight
    where that is free."""
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
    return [
        _flown_along(np.stack([here, aside]), LEAVES_MPS, dt_s),
        _flown_along(np.stack(corners), HOME_MPS, dt_s),
    ]


def _flown_along(corners_m: np.ndarray, most_mps: float, dt_s: float) -> np.ndarray:
    """Return the places (k, 3), dt_s apart, of a drone that starts and stops at the ends of a polyline, without its
    first."""
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners_m, axis=0), axis=1))])
    speed_mps = min(most_mps, np.sqrt(HOME_MPS2 * along_m[-1]))
    seconds = along_m[-1] / max(speed_mps, 1e-9) + speed_mps / HOME_MPS2
    times = dt_s * np.arange(1, max(1, int(np.ceil(seconds / dt_s))) + 1)
    ramp = np.minimum(times, speed_mps / HOME_MPS2), np.clip(seconds - times, 0.0, speed_mps / HOME_MPS2)
    gone_m = speed_mps * np.minimum(times, seconds) - 0.5 * speed_mps**2 / HOME_MPS2
    gone_m += 0.5 * HOME_MPS2 * ((speed_mps / HOME_MPS2 - ramp[0]) ** 2 - (speed_mps / HOME_MPS2 - ramp[1]) ** 2)
    return np.stack([np.interp(gone_m, along_m, corners_m[:, axis]) for axis in range(3)], axis=1)


# --- camera -----------------------------------------------------------------------------------------------------------
# Where the camera looks: at the target; on the way home where the drone flies; and where nobody is seen, where it was
# lost.


TURNS_S = 0.8  # standard deviation of the smoothing of a turn while it searches
HOME_PITCH_DEG, HOME_TURN_DPS = -15.0, 45.0  # how fast the view turns at most, on the way home
STANDING_MPS = 0.5  # slower than this the direction of flight says nothing
# While it searches the camera looks where the target would be had it gone on for a while, and to both sides of that.
GOES_ON_S, SWEEP_DEG, SWEEP_S = 2.0, 18.0, 6.0


def view_of(
    intent: Intent, positions_m: np.ndarray, targets_m: np.ndarray, seen: np.ndarray, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return pitch and yaw of the camera, (n,) each, radians.

    Args:
        positions_m, targets_m: (n, 3). seen: (n,) five-ray visibility.
    """
    pitch, yaw = look_at(positions_m, targets_m)
    if intent.mission is not None:
        return _turned_home(pitch, yaw, positions_m, intent.mission.at_frame, dt_s)
    if intent.searches:
        return _searching(pitch, yaw, positions_m, targets_m, seen, dt_s)
    return pitch, yaw


def _turned_home(
    pitch: np.ndarray, yaw: np.ndarray, positions_m: np.ndarray, at: int, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Turn into the direction of flight from frame `at` on, no faster than a drone turns."""
    flown, step = np.gradient(positions_m[:, :2], dt_s, axis=0), np.radians(HOME_TURN_DPS) * dt_s
    pitch, yaw = pitch.copy(), yaw.copy()
    for i in range(at + 1, len(yaw)):
        is_flying = np.hypot(*flown[i]) >= STANDING_MPS
        wanted = np.arctan2(flown[i, 1], flown[i, 0]) if is_flying else yaw[i - 1]
        yaw[i] = yaw[i - 1] + np.clip(_wrapped(wanted - yaw[i - 1]), -step, step)
        pitch[i] = pitch[i - 1] + np.clip(np.radians(HOME_PITCH_DEG) - pitch[i - 1], -step, step)
    return pitch, _wrapped(yaw)


def _searching(
    pitch: np.ndarray, yaw: np.ndarray, positions_m: np.ndarray, targets_m: np.ndarray, seen: np.ndarray, dt_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Look where the target was lost while nobody sees it: what the drone does not see it does not know."""
    aims, since, last = targets_m.copy(), np.zeros(len(seen)), 0
    speeds = np.gradient(targets_m, dt_s, axis=0) if len(targets_m) > 1 else np.zeros_like(targets_m)
    for i in range(len(seen)):
        last = i if seen[i] > 0 else last
        since[i] = (i - last) * dt_s
        aims[i] = targets_m[last] + speeds[last] * min(since[i], GOES_ON_S)
    pitch, yaw = look_at(positions_m, aims)
    sweep = np.radians(SWEEP_DEG) * np.sin(2.0 * np.pi * np.maximum(since - GOES_ON_S, 0.0) / SWEEP_S)
    return _eased(pitch, since > 0, dt_s), _wrapped(_eased(np.unwrap(yaw) + sweep, since > 0, dt_s))


def _wrapped(angles: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angles), np.cos(angles))


def _eased(angles: np.ndarray, where: np.ndarray, dt_s: float) -> np.ndarray:
    """Smooth angles (n,) where a view is not the plain one, up to the frames before and after."""
    return np.where(where, gaussian_filter1d(angles, TURNS_S / dt_s, mode="nearest"), angles)
