"""The actions against geometry: how much of each a motion shows, in units of its own threshold.

The first group of rules in which an action reaches 1 gives the label: in it the action of which there is most. A
decision of which the future shows next to nothing is contradicted. `break_off` and `return_to_home` are orders of a
mission: its metadata give them, geometry never does. Signs: left, up and forward are positive.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from caption.schema import FutureMotion
from cosfly.formats.captions import TOKENS


@dataclass(frozen=True)
class Thresholds:
    """Sizes of the motion over the whole future (2.5 s by default)."""

    yaw_deg: float = 3.0  # makes a turn
    hard_turn_deg: float = 10.0  # contradicts track_straight
    altitude_m: float = 1.0
    speed_change_mps: float = 0.8
    hover_mps: float = 0.3  # mean speed below which the drone hovers
    moving_mps: float = 0.5  # mean speed that contradicts hover
    forward_m: float = 0.5  # displacement in the body frame
    lateral_m: float = 1.0
    approach_m: float = 1.0  # change of the horizontal distance to the target
    circle_deg: float = 15.0  # angle swept round the target
    absent_share: float = 0.25  # a decision is contradicted if less than this share of its threshold is shown


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
    closing_m: float  # what of it is the drone's own doing: the decrease, had the target stood still
    # The angle that the drone's bearing, seen from the target, turns clockwise: positive flies to the left.
    sweep_deg: float
    target_path_m: float
    visible_now: bool
    visible_share: float  # of the future frames
    order: str | None = None  # the decision that the mission orders at the current frame


def measure(future: FutureMotion) -> Motion:
    """Measure a future; invariant to translation, to rotation about z and to a shift in time."""
    # As lists: numpy takes several times as long for a few numbers.
    positions = future.positions_m.tolist()
    yaw_deg = future.yaw_deg.tolist()
    times_s = future.time_s.tolist()
    visible = future.visible.tolist()
    first_x, first_y, first_z = positions[0]
    last_x, last_y, last_z = positions[-1]
    (first_target_x, first_target_y, _), *_, (last_target_x, last_target_y, _) = future.targets_m.tolist()
    duration_s = times_s[-1] - times_s[0]
    mean_speed_mps = sum(map(math.dist, positions, positions[1:])) / duration_s
    moved_x, moved_y = last_x - first_x, last_y - first_y
    yaw_rad = math.radians(yaw_deg[0])
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    forward_m = moved_x * cos + moved_y * sin
    # The drone seen from the target, at both ends.
    x0, y0 = first_x - first_target_x, first_y - first_target_y
    x1, y1 = last_x - last_target_x, last_y - last_target_y
    return Motion(
        yaw_deg=sum([(b - a + 180.0) % 360.0 - 180.0 for a, b in pairwise(yaw_deg)]), altitude_m=last_z - first_z,
        mean_speed_mps=mean_speed_mps, speed_change_mps=mean_speed_mps - future.speed_before_mps,
        forward_gain_mps=forward_m / duration_s - future.speed_before_mps, forward_m=forward_m,
        left_m=moved_y * cos - moved_x * sin, approach_m=math.hypot(x0, y0) - math.hypot(x1, y1),
        closing_m=math.hypot(x0, y0) - math.hypot(last_x - first_target_x, last_y - first_target_y),
        sweep_deg=-math.degrees(math.atan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1)),
        target_path_m=math.hypot(last_target_x - first_target_x, last_target_y - first_target_y),
        visible_now=visible[0], visible_share=sum(visible[1:]) / (len(visible) - 1), order=future.order,
    )  # fmt: skip


Measure = Callable[[Motion], float]


def _least(*sizes: float) -> float:
    """Return the least size, without those that cannot be measured (NaN), as around a target at an unknown place."""
    return min((size for size in sizes if not math.isnan(size)), default=math.nan)


def _holds(fact: bool) -> float:
    """Return the size of a fact that holds or not."""
    return 1.0 if fact else -1.0


class Rule(NamedTuple):
    """How much there is of an action in a motion."""

    implied: Measure  # makes the action the label, from 1 on
    shown: Measure  # speaks for the action, or, if negative, for its opposite
    least: float  # less shown than this contradicts the action


def _rules(t: Thresholds) -> tuple[dict[str, Rule], ...]:
    """Return the rules in groups in order of precedence: orders, states, a manoeuvre that has the following ones as
    its parts, these, and the neutral one."""

    def rule(implied: Measure, shown: Measure | None = None, least: float = t.absent_share) -> Rule:
        return Rule(implied, shown or implied, least)

    def order(token: str) -> Rule:
        """Return the rule of an order: it was given, or the motion at least leaves the person."""
        return rule(
            lambda m: _holds(m.order == token),
            lambda m: _holds(
                m.order == token or not m.visible_now or m.visible_share < 1.0 or not m.approach_m > -t.approach_m
            ),
        )

    def circle(side: int) -> Rule:
        def shown(m: Motion) -> float:
            return _least(m.left_m / (side * t.lateral_m), m.sweep_deg / (side * t.circle_deg))

        def implied(m: Motion) -> float:
            keeps_distance = abs(m.approach_m) < t.approach_m
            hardly_walks = m.target_path_m < 0.5 * abs(m.left_m)  # to follow it through a bend is no circle
            return shown(m) if keeps_distance and hardly_walks else 0.0

        return rule(implied, shown)

    def turn(side: int) -> Rule:
        # One that was not flown is the paper's example of a soft conflict: only a turn to the other side is a hard one.
        return rule(lambda m: m.yaw_deg / (side * t.yaw_deg), least=-1.0)

    def strafe(side: int) -> Rule:
        """Return the rule of a shift to one side. With a turn to the other side, as of a drone that swings around the
        person, it is one motion, a turn to follow."""

        def shown(m: Motion) -> float:
            return m.left_m / (side * t.lateral_m)

        def implied(m: Motion) -> float:
            is_shift = abs(m.left_m) > abs(m.forward_m) and side * m.yaw_deg > -t.yaw_deg
            return shown(m) if is_shift else 0.0

        return rule(implied, shown)

    def closes_in(m: Motion) -> float:
        """Measure the drone's own part of a gap that closes."""
        if not m.forward_m >= t.forward_m:
            return 0.0
        return _least(m.approach_m / t.approach_m, m.closing_m / t.approach_m)

    def backs_off(m: Motion) -> float:
        if not abs(m.forward_m) >= abs(m.left_m):
            return 0.0
        return _least(-m.forward_m / t.forward_m, -m.closing_m / t.forward_m)

    return (
        {"break_off": order("break_off"), "return_to_home": order("return_to_home")},
        {"search_to_reacquire_target": rule(
            lambda m: _holds(not m.visible_now), lambda m: _holds(not (m.visible_now and m.visible_share >= 1.0))
        )},
        {"hover": rule(
            lambda m: _holds(m.mean_speed_mps < t.hover_mps and abs(m.yaw_deg) < t.yaw_deg),
            lambda m: _holds(m.mean_speed_mps < t.moving_mps),
        )},
        {"circle_left": circle(1), "circle_right": circle(-1)},
        {
            "yaw_left_to_follow": turn(1),
            "yaw_right_to_follow": turn(-1),
            "ascend": rule(lambda m: m.altitude_m / t.altitude_m),
            "descend": rule(lambda m: -m.altitude_m / t.altitude_m),
            # A drone that leaves a hover backwards, sideways or upwards gains speed too, but not on the way.
            "speed_up": rule(
                lambda m: m.forward_gain_mps / t.speed_change_mps, lambda m: m.speed_change_mps / t.speed_change_mps
            ),
            "slow_down": rule(lambda m: -m.speed_change_mps / t.speed_change_mps),
            "strafe_left": strafe(1),
            "strafe_right": strafe(-1),
            "move_backward": rule(backs_off, lambda m: -m.forward_m / t.forward_m),
            "move_forward": rule(closes_in, lambda m: m.forward_m / t.forward_m),
        },
        {"track_straight": rule(
            lambda m: m.forward_m / t.forward_m,
            lambda m: _holds(abs(m.yaw_deg) < t.hard_turn_deg and m.forward_m > -t.forward_m),
        )},
    )  # fmt: skip


class ActionTable:
    """The rules of all actions with their thresholds put in."""

    def __init__(self, thresholds: Thresholds = Thresholds()) -> None:
        self.groups = _rules(thresholds)
        rules = {token: rule for group in self.groups for token, rule in group.items()}
        self.rules = {token: rules[token] for token in TOKENS}

    def label_of(self, motion: Motion) -> str | None:
        """Return the ground-truth decision, None if neither an order nor geometry implies one."""
        for group in self.groups:
            sizes = {token: rule.implied(motion) for token, rule in group.items()}
            implied = [token for token, size in sizes.items() if size >= 1.0]
            if implied:
                return max(implied, key=sizes.__getitem__)  # the earlier one of two equal ones
        return None

    def contradicted_by(self, motion: Motion, label: str | None) -> list[str]:
        """Return the decisions of which the actual future shows too little, or the opposite."""
        return [token for token, rule in self.rules.items() if token != label and rule.shown(motion) < rule.least]


TABLE = ActionTable()
