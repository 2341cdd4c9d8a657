"""The 17 actions against geometry: one table that says how much of each action a motion shows.

The first group of `TABLE` in which an action is `implied` by the actual future gives the label: in it the action of which there is
most, in units of its own threshold. A decision of which the future shows next to nothing is contradicted. `break_off` and
`return_to_home` are orders of a mission: its metadata give them, geometry never does. Signs: left, up and forward are positive.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

from caption.schema import FutureMotion, LabelConfig
from cosfly.products.captions import ACTIONS, Verdict


@dataclass(frozen=True)
class Motion:
    """The future in numbers. A value that cannot be measured is NaN, with which no comparison holds."""

    yaw_deg: float  # positive to the left
    altitude_m: float
    mean_speed_mps: float
    speed_change_mps: float  # mean future speed less the speed of the last observed step
    forward_gain_mps: float  # the same of the future's forward part alone
    forward_m: float  # displacement in the body frame at the current frame
    left_m: float
    approach_m: float  # decrease of the horizontal distance to the target
    # The angle that the drone's bearing, seen from the target, turns clockwise: positive flies to the left.
    sweep_deg: float
    target_path_m: float
    visible_now: bool
    visible_share: float  # of the future frames
    order: str | None = None  # the decision that the mission orders at the current frame


def measure(future: FutureMotion) -> Motion:
    """Measure a future; invariant to translation, to rotation about z and to a shift in time."""
    positions, yaw_deg = future.positions_m.tolist(), future.yaw_deg.tolist()
    duration_s = float(future.time_s[-1] - future.time_s[0])
    mean_speed_mps = sum(math.dist(p, q) for p, q in pairwise(positions)) / duration_s
    first, last = positions[0], positions[-1]
    first_target, last_target = future.targets_m[0].tolist(), future.targets_m[-1].tolist()
    moved_x, moved_y = last[0] - first[0], last[1] - first[1]
    yaw_rad = math.radians(yaw_deg[0])
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    forward_m = moved_x * cos + moved_y * sin
    # Drone seen from the target, at both ends.
    x0, y0 = first[0] - first_target[0], first[1] - first_target[1]
    x1, y1 = last[0] - last_target[0], last[1] - last_target[1]
    visible = future.visible.tolist()
    return Motion(
        yaw_deg=sum((b - a + 180.0) % 360.0 - 180.0 for a, b in pairwise(yaw_deg)),
        altitude_m=last[2] - first[2],
        mean_speed_mps=mean_speed_mps,
        speed_change_mps=mean_speed_mps - future.speed_before_mps,
        forward_gain_mps=forward_m / duration_s - future.speed_before_mps,
        forward_m=forward_m,
        left_m=moved_y * cos - moved_x * sin,
        approach_m=math.hypot(x0, y0) - math.hypot(x1, y1),
        sweep_deg=-math.degrees(math.atan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1)),
        target_path_m=math.hypot(last_target[0] - first_target[0], last_target[1] - first_target[1]),
        visible_now=bool(visible[0]),
        visible_share=sum(map(bool, visible[1:])) / len(visible[1:]),
        order=future.order,
    )


Size = Callable[[Motion, LabelConfig], float]


@dataclass(frozen=True)
class Action:
    """One row. Sizes are in units of the action's own threshold; what holds or not is 1 or -1.

    shown: how much of the action the motion shows, negative for its opposite; less than `hard_below` contradicts it (None: than
    the setting `absent_share`). implied: how much there is of what makes it the label, from 1 on, where 1 is shown too.
    """

    token: str
    shown: Size
    implied: Size
    hard_below: float | None = None


def _yes(holds: bool) -> float:
    return 1.0 if holds else -1.0


def _yaw(side: int, m: Motion, c: LabelConfig) -> float:
    return side * m.yaw_deg / c.yaw_deg


def _climb(side: int, m: Motion, c: LabelConfig) -> float:
    return side * m.altitude_m / c.altitude_m


def _speed(side: int, m: Motion, c: LabelConfig) -> float:
    return side * m.speed_change_mps / c.speed_change_mps


def _forward_gain(m: Motion, c: LabelConfig) -> float:
    # Who leaves a hover backwards, sideways or upwards gains speed too, but not on the way.
    return m.forward_gain_mps / c.speed_change_mps


def _lateral(side: int, m: Motion, c: LabelConfig) -> float:
    return side * m.left_m / c.lateral_m


def _strafe(side: int, m: Motion, c: LabelConfig) -> float:
    # A drone that swings round the person shifts to one side and turns to the other to keep its aim. That is one motion, a turn
    # to follow: which of its parts is more thresholds only tells the distance (1 m is 3 degrees at 19 m).
    swings = -_yaw(side, m, c) >= 1.0
    return _lateral(side, m, c) if abs(m.left_m) > abs(m.forward_m) and not swings else 0.0


def _swept(side: int, m: Motion, c: LabelConfig) -> float:
    sideways, swept = _lateral(side, m, c), side * m.sweep_deg / c.circle_deg
    return swept if swept < sideways else sideways  # the angle is NaN where nobody knows the target


def _circle(side: int, m: Motion, c: LabelConfig) -> float:
    # Following a walker through a bend sweeps an angle too: a circle is flown round someone who moves less than the drone.
    is_round = abs(m.approach_m) < c.approach_m and m.target_path_m < 0.5 * abs(m.left_m)
    return _swept(side, m, c) if is_round else 0.0


def _forward(side: int, m: Motion, c: LabelConfig) -> float:
    return side * m.forward_m / c.forward_m


def _backward(m: Motion, c: LabelConfig) -> float:
    return _forward(-1, m, c) if abs(m.forward_m) >= abs(m.left_m) else 0.0


def _closing(m: Motion, c: LabelConfig) -> float:
    return m.approach_m / c.approach_m if _forward(1, m, c) >= 1.0 else 0.0


def _goes_straight(m: Motion, c: LabelConfig) -> float:
    return _yes(abs(m.yaw_deg) < c.hard_turn_deg and m.forward_m > -c.forward_m)


def _loses_target(m: Motion, c: LabelConfig) -> float:
    return _yes(not (m.visible_now and m.visible_share == 1.0 and m.approach_m > -c.approach_m))


def _ordered(token: str) -> Action:
    return Action(
        token,
        lambda m, c: _yes(m.order == token or _loses_target(m, c) > 0.0),
        lambda m, c: _yes(m.order == token),
    )


def _both_sides(left: str, right: str, shown: Callable, implied: Callable, **more: float) -> tuple[Action, Action]:
    return (
        Action(left, partial(shown, 1), partial(implied, 1), **more),
        Action(right, partial(shown, -1), partial(implied, -1), **more),
    )


# In order of precedence: orders, states, then a manoeuvre that has the following ones as its parts, then these, then the neutral one.
TABLE: tuple[tuple[Action, ...], ...] = (
    (_ordered("break_off"), _ordered("return_to_home")),
    (
        Action(
            "search_to_reacquire_target",
            lambda m, c: _yes(not (m.visible_now and m.visible_share == 1.0)),
            lambda m, c: _yes(not m.visible_now),
        ),
    ),
    (
        Action(
            "hover",
            lambda m, c: _yes(m.mean_speed_mps < c.moving_mps),
            lambda m, c: _yes(m.mean_speed_mps < c.hover_mps and abs(m.yaw_deg) < c.yaw_deg),
        ),
    ),
    _both_sides("circle_left", "circle_right", _swept, _circle),
    (
        # A turn that was not flown is the paper's example of a soft conflict: only a turn to the other side is a hard one.
        *_both_sides("yaw_left_to_follow", "yaw_right_to_follow", _yaw, _yaw, hard_below=-1.0),
        *_both_sides("ascend", "descend", _climb, _climb),
        Action("speed_up", partial(_speed, 1), _forward_gain),
        Action("slow_down", partial(_speed, -1), partial(_speed, -1)),
        *_both_sides("strafe_left", "strafe_right", _lateral, _strafe),
        Action("move_backward", partial(_forward, -1), _backward),
        Action("move_forward", partial(_forward, 1), _closing),
    ),
    (Action("track_straight", _goes_straight, partial(_forward, 1)),),
)
BY_TOKEN = {action.token: action for group in TABLE for action in group}
assert set(BY_TOKEN) == set(ACTIONS)


def label_of(motion: Motion, cfg: LabelConfig) -> str | None:
    """Give the ground-truth decision, None where neither an order nor geometry tells."""
    for group in TABLE:
        sizes = [(action.implied(motion, cfg), action.token) for action in group]
        found = [pair for pair in sizes if pair[0] >= 1.0]
        if found:
            return max(found, key=lambda pair: pair[0])[1]  # the earlier row of two equal ones
    return None


def is_contradicted(decision: str, motion: Motion, cfg: LabelConfig) -> bool:
    """Tell whether a motion shows too little of a decision, or its opposite."""
    action = BY_TOKEN[decision]
    limit = cfg.absent_share if action.hard_below is None else action.hard_below
    return action.shown(motion, cfg) < limit


def verdict_of(decision: str, motion: Motion, cfg: LabelConfig, label: str | None) -> Verdict:
    """Judge a decision against the actual future (the three classes of sec:appendix_e, and ABSTAIN)."""
    if decision == label:
        return "CONSISTENT"
    if is_contradicted(decision, motion, cfg):
        return "HARD_CONFLICT"
    return "ABSTAIN" if label is None else "SOFT_CONFLICT"


def contradicted_by(motion: Motion, cfg: LabelConfig, label: str | None) -> list[str]:
    """Give the decisions that the actual future contradicts: what a guess would have run into."""
    return [token for token in ACTIONS if token != label and is_contradicted(token, motion, cfg)]
