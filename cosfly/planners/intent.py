"""Which style a flight gets: drawn by seed from the shares of the settings, and judged when it is flown."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter1d

from cosfly.geometry import look_at
from cosfly.planners.contract import PlanConfig, Scenario, Wish
from cosfly.planners.courses import ROUNDING_S, wish_of
from cosfly.planners.reacquire import finds_again, wish_of_reacquire
from cosfly.planners.styles import ALTITUDE_LEAST_M, REACQUIRE, RETURN_HOME, WHOLE
from cosfly.products.segments import FOLLOW, MISSION_KINDS, Mission, Segment
from cosfly.work.chance import draw_by_share

if TYPE_CHECKING:
    from cosfly.space.kernels import BoxIndex


# A flight holds its style where the walker sees it within this angle of the wished place and within this ratio of its
# distance.
HELD_DEG, HELD_RATIO, HELD_SHARE = 25.0, 1.4, 0.7

POINTS_LEAST = 4  # of a part

NO_HIDING_PLACE, NOT_FOUND_AGAIN, NOT_HELD = "no_hiding_place", "not_lost_and_found", "style_not_held"


@dataclass(frozen=True)
class Intent:
    """What a flight is meant to be. segments: empty for the paper's flight from end to end.

    impossible: why the map cannot hold the style; the wish is the paper's then.
    """

    wish: Wish
    segments: tuple[Segment, ...] = ()
    mission: Mission | None = None
    impossible: str | None = None

    @property
    def styles(self) -> str:
        return ", ".join(part.style for part in self.segments)

    @property
    def searches(self) -> bool:
        return any(part.style == REACQUIRE for part in self.segments)


def draw_intent(
    scenario: Scenario, obstacles: BoxIndex, screens: BoxIndex, cfg: PlanConfig, rng: np.random.Generator
) -> Intent:
    """Draw the style or styles of a flight. screens: the obstacles that hide a person for certain."""
    name, num = draw_by_share(cfg.styles, rng), len(scenario.targets_m)
    if name == REACQUIRE:
        wish = wish_of_reacquire(scenario, obstacles, screens, cfg, rng)
        segment = Segment(name, 0, num, keeps_sight=False)
        if wish is None:
            return Intent(scenario.wish, (segment,), impossible=NO_HIDING_PLACE)
        return Intent(wish, (segment,))
    names = _parts(name, num, scenario.dt_s, cfg, rng)
    cuts = np.linspace(0, num, len(names) + 1).round().astype(int).tolist()
    segments = tuple(Segment(*part) for part in zip(names, cuts[:-1], cuts[1:], strict=True))
    is_paper = set(names) == {FOLLOW}
    wish = scenario.wish if is_paper else wish_of(names, scenario, obstacles, cfg, rng)
    if name != RETURN_HOME:
        return Intent(wish, () if is_paper else segments)
    wish, mission = wish_of_mission(wish, scenario, cfg, rng)
    at = mission.at_frame
    before = tuple(Segment(p.style, p.begin, min(p.end, at)) for p in segments if p.begin < at)
    return Intent(wish, (*before, Segment(RETURN_HOME, at, num, keeps_sight=False)), mission)


def _parts(name: str, num_points: int, dt_s: float, cfg: PlanConfig, rng: np.random.Generator) -> list[str]:
    """Give the styles of a flight's parts, of which the first is `name` if it takes parts at all."""
    shares = {style: share for style, share in cfg.styles.items() if style not in WHOLE and share > 0} or {FOLLOW: 1.0}
    num = round(num_points * dt_s / cfg.segment_s) if cfg.segment_s else 1
    num = max(1, min(num, num_points // POINTS_LEAST))
    return [name if k == 0 and name not in WHOLE else draw_by_share(shares, rng) for k in range(num)]


def why_not_held(intent: Intent, scenario: Scenario, positions_m: np.ndarray, seen: np.ndarray) -> str | None:
    """Say why a flight is not what it was meant to be, None where it is.

    Args:
        positions_m: (n, 3), as flown. seen: (n,) five-ray visibility past the screens.
    """
    if intent.impossible is not None or not intent.segments:
        return intent.impossible
    if intent.searches:
        return None if finds_again(seen, scenario.dt_s) else NOT_FOUND_AGAIN
    wished = intent.wish.places_m(scenario.targets_m, scenario.ground_m) - scenario.targets_m
    flown = positions_m - scenario.targets_m
    wished_m, flown_m = np.linalg.norm(wished, axis=1), np.linalg.norm(flown, axis=1)
    cosine = (wished * flown).sum(axis=1) / np.maximum(wished_m * flown_m, 1e-9)
    ratio = np.maximum(flown_m, 1e-9) / np.maximum(wished_m, 1e-9)
    held = (cosine >= np.cos(np.radians(HELD_DEG))) & (ratio <= HELD_RATIO) & (ratio >= 1.0 / HELD_RATIO)
    return None if held.mean() >= HELD_SHARE else NOT_HELD


# --- mission ----------------------------------------------------------------------------------------------------------
# `return_home`: an order of the mission ends the pursuit; the drone breaks off, turns away and flies to where it
# started.


BREAKS_OFF_S = 4.0
LEAVES_MPS, HOME_MPS = 2.5, 6.0
LEAVES_M, CLIMBS_M = 6.0, 8.0  # away from the walker and up, before it turns for home
PURSUIT_LEAST = 1 / 3  # of the flight


def wish_of_mission(wish: Wish, scenario: Scenario, cfg: PlanConfig, rng: np.random.Generator) -> tuple[Wish, Mission]:
    """End a flight's wish with the way home; the order comes so late that the rest of the walk is just enough."""
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
    """Give pitch and yaw of the camera, (n,) each, radians.

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
