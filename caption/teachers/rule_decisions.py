"""The decision of the embedded rule teacher: the manoeuvre to which the observed motion leads.

The motion of drone and target is extrapolated and compared with what each manoeuvre takes. How much of the extrapolated
motion to expect is fitted on training towns, for tracks with and without perturbation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from caption.verification.facts import Facts

HORIZON_S = 2.5  # over which motion is extrapolated
LEAST_TURN_DEG, LEAST_CLIMB_M, LEAST_ADVANCE_M = 3.0, 1.0, 1.0  # that call for a manoeuvre
HINT = 0.5  # share of an expected manoeuvre that suggests it, where flying straight on is no answer
ALMOST_STILL_MPS = 0.3  # a slower drone may hover
SPEEDS = ("slow_down", "speed_up")  # which are not taken on a hint
SHAKEN_M, SHAKEN_GAP_M = 0.4, 1.0  # a larger second difference of altitude, of distance: the track is perturbed


@dataclass(frozen=True)
class Gains:
    """How much of the extrapolated motion is expected, fitted on training towns.

    Attributes:
        last_turn, turn, sight: of the turn of the nose in the last step and over its neighbours, and of the turn of the
            line of sight to the target. bearing: of the target's bearing. climb: of the climb.
        trend: steps over which the last change of the drone's speed goes on; 0: speeds are those of the whole window.
        braking: of the last loss of speed, which calls for slowing down.
        strafe_m, retreat_m, advance_m: extrapolated motion that calls for a strafe, a move backward, a move forward.
        circle_m, circle_turn_deg, circle_walk: a circle is flown sideways so far and turned so much, round a target
            that walks less than this share of it.
        brisk_mps, lag_mps: a drone that flies so fast slows down; one that is so much slower than the target speeds up.
        hover_mps, hover_walk_mps: the drone hovers where it and the target are slower.
    """

    last_turn: float
    turn: float
    sight: float
    bearing: float
    climb: float
    trend: float
    braking: float
    strafe_m: float
    retreat_m: float
    advance_m: float
    circle_m: float
    circle_turn_deg: float
    circle_walk: float
    brisk_mps: float
    lag_mps: float
    hover_mps: float
    hover_walk_mps: float


SMOOTH = Gains(
    last_turn=1.1, turn=0.35, sight=-0.75, bearing=0.0, climb=0.85, trend=2.8, braking=2.5, strafe_m=1.2, retreat_m=1.5,
    advance_m=1.8, circle_m=7.0, circle_turn_deg=25.0, circle_walk=0.85, brisk_mps=2.8, lag_mps=1.3, hover_mps=0.16,
    hover_walk_mps=2.5,
)  # fmt: skip
SHAKEN = Gains(
    last_turn=0.0, turn=0.22, sight=0.3, bearing=0.2, climb=0.3, trend=0.0, braking=0.0, strafe_m=2.5, retreat_m=3.0,
    advance_m=4.0, circle_m=7.0, circle_turn_deg=15.0, circle_walk=1.5, brisk_mps=2.7, lag_mps=3.2, hover_mps=0.28,
    hover_walk_mps=0.28,
)  # fmt: skip


def is_shaken(f: Facts) -> bool:
    """Return whether positions jitter from frame to frame, as on the perturbed track."""
    if "shaken" not in f.found:
        distances = [distance for distance in f.distance_m if distance is not None]
        f.found["shaken"] = _jerk(f.altitude_m) > SHAKEN_M or _jerk(distances) > SHAKEN_GAP_M
    return bool(f.found["shaken"])


def _jerk(values: Sequence[float]) -> float:
    """Return the largest second difference of a series."""
    return max([abs(a - 2.0 * b + c) for a, b, c in zip(values, values[1:], values[2:], strict=False)], default=0.0)


def decide(f: Facts) -> str:
    """Choose a decision from the observed frames alone."""
    if f.mission is not None:  # a drone that has turned away already is on the way home
        return "return_to_home" if f.visibility[-1] == "out_of_view" else "break_off"
    if not f.is_visible_now:
        return "search_to_reacquire_target"
    if "decision" not in f.found:
        f.found["decision"] = _strongest(expected_sizes(f))
    return str(f.found["decision"])


def ranked(f: Facts) -> list[str]:
    """Return the decisions that the observed frames lead to, that of `decide` first, then those that they suggest."""
    first = decide(f)
    if f.mission is not None or not f.is_visible_now:
        return [first]
    sizes = expected_sizes(f)
    others = sorted((token for token in sizes if sizes[token] >= 1.0), key=sizes.__getitem__, reverse=True)
    is_hinted = not is_shaken(f)  # jitter is no hint
    hinted = [token for token in sizes if is_hinted and HINT <= sizes[token] < 1.0 and token not in SPEEDS]
    hinted.sort(key=sizes.__getitem__, reverse=True)
    hovers = ["hover"] if f.mean_speed_mps < ALMOST_STILL_MPS else []
    return list(dict.fromkeys([first, *others, "track_straight", *hovers, *hinted]))


def _strongest(sizes: dict[str, float]) -> str:
    for tokens in (("hover",), ("circle_left", "circle_right"), tuple(sizes)):
        token = max(tokens, key=sizes.__getitem__)
        if sizes[token] >= 1.0:
            return token
    return "track_straight"


def expected_sizes(f: Facts) -> dict[str, float]:
    """Return how much of each manoeuvre the smoothed motion leads to expect; 1.0 is enough to decide for it."""
    if "sizes" not in f.found:
        f.found["sizes"] = _expect(f, SHAKEN if is_shaken(f) else SMOOTH)
    return f.found["sizes"]  # type: ignore[no-any-return]


def _expect(f: Facts, g: Gains) -> dict[str, float]:
    speed_mps, walk_mps, gain_mps = f.speed_mps[-1] or 0.0, f.target_speed_mps or 0.0, 0.0
    ahead_m, left_m, _ = [axis_mps * HORIZON_S for axis_mps in f.velocity_mps]
    if g.trend:
        share = min(2.0, speed_mps / max(0.05, f.mean_speed_mps))
        ahead_m, left_m = share * ahead_m, share * left_m
        gain_mps = (f.step_speeds_mps[-1] or 0.0) - (f.step_speeds_mps[-2] or 0.0)
    turn_deg = _expected_turn_deg(f, g)
    climb_m = g.climb * (f.climb_mps[-1] or 0.0) * HORIZON_S
    is_sideways = abs(left_m) > abs(ahead_m)
    is_calm = abs(turn_deg) < LEAST_TURN_DEG and abs(climb_m) < LEAST_CLIMB_M and walk_mps < g.hover_walk_mps
    sizes = {
        "yaw_left_to_follow": turn_deg / LEAST_TURN_DEG,
        "yaw_right_to_follow": -turn_deg / LEAST_TURN_DEG,
        "ascend": climb_m / LEAST_CLIMB_M,
        "descend": -climb_m / LEAST_CLIMB_M,
        "slow_down": speed_mps / g.brisk_mps - g.braking * min(0.0, gain_mps),
        "speed_up": (walk_mps - speed_mps) / g.lag_mps,
        "move_backward": 0.0 if is_sideways else -ahead_m / g.retreat_m,
        "move_forward": _closing_m(f, ahead_m, left_m) / g.advance_m if ahead_m > LEAST_ADVANCE_M else 0.0,
        "hover": float(is_calm and speed_mps + g.trend * gain_mps < g.hover_mps),
    }
    for side, name in ((1, "left"), (-1, "right")):
        # A strafe keeps the nose still; a circle turns it back to a target that hardly walks.
        is_held = is_sideways and side * turn_deg > -LEAST_TURN_DEG
        is_round = is_sideways and walk_mps * HORIZON_S < g.circle_walk * abs(left_m)
        is_round = is_round and -side * turn_deg > g.circle_turn_deg
        sizes[f"strafe_{name}"] = side * left_m / g.strafe_m if is_held else 0.0
        sizes[f"circle_{name}"] = side * left_m / g.circle_m if is_round else 0.0
    return sizes


def _expected_turn_deg(f: Facts, g: Gains) -> float:
    last_dps = (f.yaw_deg[-1] - f.yaw_deg[-2]) / f.step_s
    turn_dps = g.last_turn * last_dps + g.turn * (f.yaw_rate_dps[-1] or 0.0) + g.sight * sight_rate_dps(f)
    return turn_dps * HORIZON_S + g.bearing * (f.bearing_deg[-1] or 0.0)


def sight_rate_dps(f: Facts) -> float:
    """Return how fast the line of sight to the target turns to the left; 0 where it is not known."""
    pairs = zip(f.yaw_deg, f.bearing_deg, strict=True)
    sight = [(i, yaw + bearing) for i, (yaw, bearing) in enumerate(pairs) if bearing is not None]
    return _slope(sight) / f.step_s if len(sight) > 2 else 0.0


def _slope(points: Sequence[tuple[float, float]]) -> float:
    """Return the slope of the straight line that fits points best."""
    middle = sum([x for x, _ in points]) / len(points)
    return sum([(x - middle) * y for x, y in points]) / sum([(x - middle) ** 2 for x, _ in points])


def _closing_m(f: Facts, ahead_m: float, left_m: float) -> float:
    """Return how much nearer the drone comes to the target, as much as is its own doing; 0 where it is not known."""
    place, walk = f.place_m[-1], f.target_velocity_mps
    if place is None or walk is None:
        return 0.0
    now_m, x, y = math.hypot(place[0], place[1]), place[0] - ahead_m, place[1] - left_m
    then_m = math.hypot(x + walk[0] * HORIZON_S, y + walk[1] * HORIZON_S)
    return min(now_m - math.hypot(x, y), now_m - then_m)
