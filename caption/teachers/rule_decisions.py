"""The decision of the built-in rule teacher: the manoeuvre to which the observed motion leads.

The motion of drone and target is extrapolated and compared with what each manoeuvre takes. How much of the extrapolated
motion to expect is fitted on training towns, for tracks with and without perturbation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from caption.verification.facts import Facts

HORIZON_S = 2.5  # over which motion is extrapolated
# Less expected motion than this calls for no manoeuvre.
LEAST_TURN_DEG, LEAST_CLIMB_M, LEAST_ADVANCE_M = 3.0, 1.0, 1.0
HINT = 0.5  # share of an expected manoeuvre that suggests it, where flying straight on is no answer
ALMOST_STILL_MPS = 0.3  # a slower drone may hover
MOST_SPEED_UP, LEAST_SPEED_MPS = 2.0, 0.05  # bounds of the present speed as a share of the window's mean speed
SPEEDS = ("slow_down", "speed_up")  # which are not taken on a hint
SHAKEN_M, SHAKEN_GAP_M = 0.4, 1.0  # a larger second difference of altitude, of distance: the track is perturbed


@dataclass(frozen=True)
class Gains:
    """How much of the extrapolated motion is expected, fitted on training towns."""

    # Factors of what is extrapolated over HORIZON_S.
    last_turn: float  # the turn of the nose in the last step
    turn: float  # the turn of the nose, smoothed
    sight: float  # the turn of the line of sight to the target
    bearing: float  # the bearing of the target
    climb: float
    trend: float  # steps over which the last change of the drone's speed goes on; 0: speeds are of the whole window
    braking: float  # of the last loss of speed, which calls for slowing down
    # Extrapolated motion that calls for a manoeuvre.
    strafe_m: float
    retreat_m: float
    advance_m: float
    circle_m: float  # a circle is flown sideways so far,
    circle_turn_deg: float  # with so large a turn,
    circle_walk: float  # around a target that walks less than this share of it
    # Speeds.
    brisk_mps: float  # a faster drone slows down
    lag_mps: float  # a drone that is so much slower than the target speeds up
    hover_mps: float  # the drone hovers where it is slower
    hover_walk_mps: float  # and the target is slower


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
    strongest = decide(f)
    if f.mission is not None or not f.is_visible_now:
        return [strongest]
    sizes = expected_sizes(f)
    falling = sorted(sizes, key=sizes.__getitem__, reverse=True)
    expected = [token for token in falling if sizes[token] >= 1.0]
    hovers = ["hover"] if f.mean_speed_mps < ALMOST_STILL_MPS else []
    hinted: list[str] = []
    if not is_shaken(f):  # jitter is no hint
        hinted = [token for token in falling if HINT <= sizes[token] < 1.0 and token not in SPEEDS]
    return list(dict.fromkeys([strongest, *expected, "track_straight", *hovers, *hinted]))


def _strongest(sizes: dict[str, float]) -> str:
    """Return the decision with the largest size, if that is 1 or more; a hover and a circle go before their parts."""
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
    speed_mps, walk_mps = f.speed_mps[-1] or 0.0, f.target_speed_mps or 0.0
    ahead_mps, left_mps, _ = f.velocity_mps
    share, gain_mps = 1.0, 0.0  # of the window's velocity that lasts; the last change of speed
    if g.trend:
        share = min(MOST_SPEED_UP, speed_mps / max(LEAST_SPEED_MPS, f.mean_speed_mps))
        gain_mps = (f.step_speeds_mps[-1] or 0.0) - (f.step_speeds_mps[-2] or 0.0)
    ahead_m, left_m = share * (ahead_mps * HORIZON_S), share * (left_mps * HORIZON_S)
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
        keeps_nose = side * turn_deg > -LEAST_TURN_DEG
        turns_back = -side * turn_deg > g.circle_turn_deg
        hardly_walks = walk_mps * HORIZON_S < g.circle_walk * abs(left_m)
        sizes[f"strafe_{name}"] = side * left_m / g.strafe_m if is_sideways and keeps_nose else 0.0
        sizes[f"circle_{name}"] = side * left_m / g.circle_m if is_sideways and turns_back and hardly_walks else 0.0
    return sizes


def _expected_turn_deg(f: Facts, g: Gains) -> float:
    last_dps = (f.yaw_deg[-1] - f.yaw_deg[-2]) / f.step_s
    turn_dps = g.last_turn * last_dps + g.turn * (f.yaw_rate_dps[-1] or 0.0) + g.sight * f.sight_rate_dps
    return turn_dps * HORIZON_S + g.bearing * (f.bearing_deg[-1] or 0.0)


def _closing_m(f: Facts, ahead_m: float, left_m: float) -> float:
    """Return how much nearer the drone comes to the target, or would if that stood still, whichever is less; 0 if that is
    not known. ahead_m, left_m: the drone's expected displacement."""
    if f.place_m[-1] is None or f.target_velocity_mps is None:
        return 0.0
    x, y, _ = f.place_m[-1]
    walk_x, walk_y = [axis_mps * HORIZON_S for axis_mps in f.target_velocity_mps]
    now_m = math.hypot(x, y)
    if_standing_m = math.hypot(x - ahead_m, y - left_m)
    then_m = math.hypot(x - ahead_m + walk_x, y - left_m + walk_y)
    return min(now_m - if_standing_m, now_m - then_m)
