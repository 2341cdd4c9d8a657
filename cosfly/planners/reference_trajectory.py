"""Reference trajectories: that of the paper, those of manoeuvre styles (joined without jumps), and those of searches.

A course is an (n, 3) array, one row per frame: azimuth of the drone from the target (world, radians), distance in the
plane (m) and altitude above the ground under the target (m).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.formats.segments import FOLLOW
from cosfly.geometry.axes import DT_S
from cosfly.planners.contract import PlanConfig, Scenario, TrackingReference
from cosfly.planners.gimbal import slew
from cosfly.planners.styles import REACQUIRE, Range, Style

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex

# Greatest speeds of the reference relative to the target between segments, within the drone's 10 m/s: change of the
# distance, motion around the target, climb.
APART_MPS, ROUND_MPS, CLIMB_MPS = 4.0, 6.5, 3.5
OVERSHOOT_M = 3.0  # altitude that a drone at full climb or sink rate covers until it stops
# Least and greatest rate of a distance and of an altitude that change throughout a segment.
EVEN_APART_MPS, EVEN_CLIMB_MPS = (0.8, 2.0), (1.0, 2.2)
ROUNDING_S = 1.0  # standard deviation of the smoothing of corners
STEADY_RAD = np.radians(20.0)  # the drone ignores smaller turns of the target

# Parameters of a segment are drawn at most DRAWS times, until the score of a course reaches GOOD_SCORE: its visibility
# less the share of its positions near boxes, less TURN_PENALTY times the turn from the previous segment in half turns.
DRAWS = 32
GOOD_SCORE = 0.99
TURN_PENALTY = 0.2


def reference_of(
    names: list[str], scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator
) -> TrackingReference:
    """Return the reference of equally long segments in these styles; that of `follow` is the scenario's own."""
    num = len(scenario.targets_m)
    paper = scenario.reference
    course = np.empty((num, 3))
    paces_mps = np.full(num, APART_MPS)
    cuts = np.linspace(0, num, len(names) + 1).round().astype(int).tolist()
    for name, begin, end in zip(names, cuts[:-1], cuts[1:], strict=True):
        part = slice(begin, end)
        if name == FOLLOW:
            azimuth = paper.heading_rad[part] + np.pi
            course[part] = np.column_stack([azimuth, paper.ground_distance_m[part], paper.altitude_m[part]])
            continue
        azimuth_before = float(course[begin - 1, 0]) if begin else None
        course[part] = _best_course(cfg.style(name), part, azimuth_before, scenario, obstacles, cfg, rng)
        paces_mps[part] = rng.uniform(*cfg.style(name).pace_mps)
    return without_jumps(course, scenario, cfg, paces_mps)


def without_jumps(
    course: np.ndarray, scenario: Scenario, cfg: PlanConfig, paces_mps: np.ndarray | float = APART_MPS
) -> TrackingReference:
    """Return the reference of a course, (n, 3): jumps become motion at the speeds above and `paces_mps`, smoothed."""
    num = len(course)
    dt_s = scenario.dt_s
    paper = scenario.reference

    def followed(values: np.ndarray, speeds_mps: np.ndarray | float) -> np.ndarray:
        slewed = slew(values, np.broadcast_to(np.asarray(speeds_mps) * dt_s, num))
        return gaussian_filter1d(slewed, ROUNDING_S / dt_s, mode="nearest")

    apart_m = followed(course[:, 1], paces_mps)
    altitude_m = followed(course[:, 2], CLIMB_MPS)
    azimuth = followed(np.unwrap(course[:, 0]), ROUND_MPS / np.maximum(apart_m, 1.0))
    over_hips_m = altitude_m - (scenario.targets_m[:, 2] - scenario.ground_m)
    return replace(
        paper, bearing_rad=azimuth - paper.heading_rad, distance_m=np.hypot(over_hips_m, apart_m),
        ground_distance_m=apart_m, pitch_rad=np.arctan2(over_hips_m, apart_m), altitude_m=altitude_m,
        altitude_min_m=np.full(num, cfg.styles_floor_m), any_bearing=False,
    )  # fmt: skip


def positions_of(course: np.ndarray, targets_m: np.ndarray, ground_m: np.ndarray) -> np.ndarray:
    """Return the positions of a course with its jumps, (n, 3)."""
    away = course[:, 1:2] * np.column_stack([np.cos(course[:, 0]), np.sin(course[:, 0])])
    return np.column_stack([targets_m[:, :2] + away, ground_m + course[:, 2]])


def continued_reference(scenario: Scenario, cfg: PlanConfig) -> TrackingReference:
    """Return the reference from the drone's position (`past_m`) to the scenario's reference, as between two styles.

    The altitudes at its start are within the bounds.
    """
    paper = scenario.reference
    num_past = len(scenario.past_m)
    away = scenario.past_m[-1] - scenario.targets_m[num_past - 1]
    altitude_m = scenario.past_m[-1, 2] - scenario.ground_m[num_past - 1]
    course = np.column_stack([paper.heading_rad + paper.bearing_rad, paper.ground_distance_m, paper.altitude_m])
    course[:num_past] = [np.arctan2(away[1], away[0]), np.hypot(*away[:2]), altitude_m]
    since_s = np.maximum(np.arange(len(course)) - scenario.start, 0) * scenario.dt_s
    room_m = OVERSHOOT_M - CLIMB_MPS / 2.0 * since_s
    return replace(
        without_jumps(course, scenario, cfg),
        altitude_min_m=np.minimum(paper.altitude_min_m, altitude_m - room_m),
        altitude_max_m=np.maximum(paper.altitude_max_m, altitude_m + room_m),
        any_bearing=paper.any_bearing,
    )


def _best_course(
    style: Style, part: slice, azimuth_before: float | None, scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Draw courses of a segment, (k, 3), until one reaches GOOD_SCORE; return the best of at most DRAWS."""
    from cosfly.geometry.kernels import signed_distances, visibility

    targets_m = scenario.targets_m[part]
    safety_m = cfg.safety_distance_m
    best = np.empty(0)
    best_score = -np.inf
    for _ in range(DRAWS):
        course = _course(style, scenario, part, azimuth_before, rng)
        places = positions_of(course, targets_m, scenario.ground_m[part])
        is_near = signed_distances(obstacles, places, safety_m)[0] < safety_m
        score = float(visibility(obstacles, places, targets_m).mean()) - float(is_near.mean())
        if azimuth_before is not None:
            score -= TURN_PENALTY * abs(np.angle(np.exp(1j * (course[0, 0] - azimuth_before)))) / np.pi
        if score > best_score:
            best, best_score = course, score
        if score >= GOOD_SCORE:
            break
    return best


def _course(
    style: Style, scenario: Scenario, part: slice, azimuth_before: float | None, rng: np.random.Generator
) -> np.ndarray:
    """Draw the course of one segment, (k, 3). azimuth_before: at the end of the previous segment."""
    targets_m = scenario.targets_m[part]
    heading_rad = scenario.reference.heading_rad[part]
    dt_s = scenario.dt_s
    seconds = np.arange(len(targets_m)) * dt_s
    distance_m = _even(style.ground_distance_m, style.ground_distance_end_m, EVEN_APART_MPS, seconds, rng)
    altitude_m = _even(style.altitude_m, style.altitude_end_m, EVEN_CLIMB_MPS, seconds, rng)
    if style.bearing_deg is None:
        bearing = rng.uniform(-np.pi, np.pi) if azimuth_before is None else azimuth_before - heading_rad[0]
    else:
        bearing = np.radians(rng.uniform(*style.bearing_deg))
    if style.hop_s is None:
        azimuth = _steady(heading_rad) + bearing + rng.uniform(*style.round_mps) * seconds / distance_m
        return np.column_stack([azimuth, distance_m, altitude_m])
    # The drone hovers from halt to halt. At each, the distance is the drawn one at one moment: at the end if the target
    # approaches, at the start if it leaves.
    share = 0.5 * (1.0 + np.cos(bearing))
    halts_m = np.empty((len(targets_m), 2))
    begin = 0
    while begin < len(targets_m):
        end = min(begin + max(2, round(rng.uniform(*style.hop_s) / dt_s)), len(targets_m))
        moment = begin + round(share * (end - 1 - begin))
        azimuth = heading_rad[moment] + bearing
        halts_m[begin:end] = targets_m[moment, :2] + distance_m[moment] * np.array([np.cos(azimuth), np.sin(azimuth)])
        begin = end
    away = halts_m - targets_m[:, :2]
    return np.column_stack([np.arctan2(away[:, 1], away[:, 0]), np.hypot(away[:, 0], away[:, 1]), altitude_m])


def _even(start: Range, end: Range | None, rates: Range, seconds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw a value of `start` and one of `end`; return the even change between them, (k,), at a rate within `rates`."""
    first = rng.uniform(*start)
    if end is None:
        return np.full(len(seconds), first)
    change = rng.uniform(*end) - first
    rate = np.clip(abs(change) / max(float(seconds[-1]), 1e-9), *rates)
    return first + np.sign(change) * np.minimum(rate * seconds, abs(change))


def _steady(heading_rad: np.ndarray) -> np.ndarray:
    """Keep a heading until the target's differs by more than STEADY_RAD, then take the target's."""
    return np.array([*accumulate(heading_rad.tolist(), lambda now, new: new if abs(new - now) > STEADY_RAD else now)])


# --- reacquire --------------------------------------------------------------------------------------------------------
# The drone starts low and away, at a random place from which the map hides the target for a while. After the loss it
# goes on for a moment, then it climbs and moves behind the target until it sees the target again. The trajectory is
# judged by this outcome, not by its mean visibility.

HIDING_TRIES = 120
LOST_LEAST_S, LOST_MOST_S = 1.5, 15.0  # bounds of the longest time without line of sight
BEFORE_S, AFTER_S = 2.0, 3.0  # the target is seen at least this long before the loss, and at the end
SEEN = 0.5  # mean visibility that counts as seen
WAITS_S = 4.0  # time from the loss to the search
DEEP_LOSS_S = 5.0  # least loss in the drawn course, so that small changes by the planner keep the target hidden
PATH_SHARE = 0.5  # share of the tries that follow the path of the target


def reacquire_reference(
    scenario: Scenario, obstacles: BoxIndex, screens: BoxIndex, cfg: PlanConfig, rng: np.random.Generator
) -> TrackingReference | None:
    """Return a reference that loses the target and finds it again; None where the map does not hide the target."""
    from cosfly.geometry.kernels import signed_distances, visibility

    targets = scenario.targets_m
    ground = scenario.ground_m
    dt_s = scenario.dt_s
    style = cfg.style(REACQUIRE)
    for _ in range(HIDING_TRIES):
        course = _watching(style, scenario, rng)
        climb_m = rng.uniform(*style.climb_m)
        search_distance_m = rng.uniform(*(style.ground_distance_end_m or style.ground_distance_m))
        seen = visibility(screens, positions_of(course, targets, ground), targets)
        lost = first_loss(seen, dt_s, DEEP_LOSS_S)
        if lost is None:
            continue
        searching = np.arange(len(course)) >= lost + round(WAITS_S / dt_s)
        course[searching, 0] = scenario.reference.heading_rad[searching] + np.pi
        course[searching, 1:] = search_distance_m, course[lost, 2] + climb_m
        reference = without_jumps(course, scenario, cfg)
        places = reference.places_m(targets, ground)
        gaps_m, _ = signed_distances(obstacles, places, cfg.safety_distance_m)
        is_free = (gaps_m >= cfg.safety_distance_m).all()
        if is_free and finds_again(visibility(screens, places, targets), dt_s):
            return replace(reference, keeps_sight=np.zeros(len(course), dtype=bool))
    return None


def _watching(style: Style, scenario: Scenario, rng: np.random.Generator) -> np.ndarray:
    """Draw a course, (n, 3), before the loss: at a bearing from the target, or behind it along its path."""
    targets = scenario.targets_m
    heading_rad = scenario.reference.heading_rad
    drawn_m = rng.uniform(*style.ground_distance_m)
    altitude_m = rng.uniform(*style.altitude_m)
    bearing = rng.uniform(-np.pi, np.pi)
    follows_path = rng.random() < PATH_SHARE
    azimuth = heading_rad + bearing
    distance_m = np.full(len(targets), drawn_m)
    if follows_path:
        # Where the target was `drawn_m` earlier on its path; at first, on the straight line behind its start.
        along_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(targets[:, :2], axis=0).T))])
        start = -drawn_m * np.array([np.cos(heading_rad[0]), np.sin(heading_rad[0])])
        away = np.stack([np.interp(along_m - drawn_m, along_m, targets[:, k]) for k in (0, 1)], axis=1)
        away += np.clip(1.0 - along_m / drawn_m, 0.0, 1.0)[:, None] * start - targets[:, :2]
        azimuth = np.arctan2(away[:, 1], away[:, 0])
        distance_m = np.hypot(away[:, 0], away[:, 1])
    return np.column_stack([azimuth, distance_m, np.full(len(targets), altitude_m)])


def first_loss(seen: np.ndarray, dt_s: float, least_s: float = LOST_LEAST_S) -> int | None:
    """Return the first frame of a loss of at least `least_s` after visible frames; None where there is none."""
    before = max(1, round(BEFORE_S / dt_s))
    for begin, end in _hidden_runs(seen):
        if begin >= before and (end - begin) * dt_s >= least_s and seen[begin - before : begin].mean() >= SEEN:
            return begin
    return None


def finds_again(seen: np.ndarray, dt_s: float) -> bool:
    """Return whether the target is visible, lost, and visible at the end; seen: (n,) five-ray visibility."""
    if first_loss(seen, dt_s) is None:
        return False
    longest_s = max(end - begin for begin, end in _hidden_runs(seen)) * dt_s
    return bool(longest_s <= LOST_MOST_S and seen[-max(1, round(AFTER_S / dt_s)) :].mean() >= SEEN and seen[-1] > 0)


def _hidden_runs(seen: np.ndarray) -> list[tuple[int, int]]:
    """Return begin and end of each run of frames in which the target is hidden."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], seen == 0, [0]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


# --- the paper's reference --------------------------------------------------------------------------------------------


def follow(targets_m: np.ndarray, cfg: PlanConfig, dt_s: float = DT_S) -> TrackingReference:
    """Return the paper's reference: behind the target, at the settings' altitude, distance and pitch.

    Args:
        targets_m: (n, 3), n >= 2. dt_s: between points.
    """
    num = len(targets_m)
    muco = cfg.muco
    constants = {
        "bearing_rad": np.pi, "distance_m": muco.track_distance_m, "ground_distance_m": cfg.behind_distance_m,
        "pitch_rad": np.radians(muco.pitch_deg), "altitude_m": cfg.altitude_preferred_m,
        "altitude_min_m": cfg.altitude_min_m, "altitude_max_m": cfg.altitude_max_m, "keeps_sight": True,
    }  # fmt: skip
    arrays = {name: np.full(num, value) for name, value in constants.items()}
    return TrackingReference(smoothed_headings(targets_m, cfg.heading_smoothing_s, dt_s), **arrays, any_bearing=True)


def smoothed_headings(targets_m: np.ndarray, smoothing_s: float, dt_s: float = DT_S) -> np.ndarray:
    """Return the target's heading at each point, (n,) radians, continuous, smoothed over time by a Gaussian.

    A target that stops keeps its heading; one that never moves faces east.

    Args:
        targets_m: (n, 3), n >= 2. smoothing_s: standard deviation; 0: none. dt_s: between points.
    """
    steps = np.diff(targets_m[:, :2], axis=0)
    moves = np.flatnonzero(np.hypot(steps[:, 0], steps[:, 1]) > 1e-6)
    if len(moves) == 0:
        return np.zeros(len(targets_m))
    yaws = np.unwrap(np.arctan2(steps[moves, 1], steps[moves, 0]))
    before = np.searchsorted(moves, np.arange(len(targets_m)), side="right") - 1
    yaws = yaws[np.maximum(before, 0)]
    return gaussian_filter1d(yaws, smoothing_s / dt_s, mode="nearest") if smoothing_s > 0 else yaws
