"""The actions against geometry: how much of each a motion shows, by the rules of the set in use
(cosfly/products/actions.yaml).

The first line of its precedence in which an action is `implied` by the actual future gives the label: in it the action
of which there is most, in units of its own threshold. A decision of which the future shows next to nothing is
contradicted. `break_off` and
`return_to_home` are orders of a mission: its metadata give them, geometry never does. Signs: left, up and forward are
positive.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise

from caption.schema import FutureMotion, LabelConfig
from cosfly.products.actions import ActionSet, Condition, Rule, Size, Term
from cosfly.products.captions import Verdict


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
    positions, yaw_deg, targets = future.positions_m.tolist(), future.yaw_deg.tolist(), future.targets_m.tolist()
    times_s = future.time_s.tolist()
    duration_s = times_s[-1] - times_s[0]
    mean_speed_mps = sum(map(math.dist, positions, positions[1:])) / duration_s
    first, last = positions[0], positions[-1]
    first_target, last_target = targets[0], targets[-1]
    moved_x, moved_y = last[0] - first[0], last[1] - first[1]
    yaw_rad = math.radians(yaw_deg[0])
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    forward_m = moved_x * cos + moved_y * sin
    # Drone seen from the target, at both ends.
    x0, y0 = first[0] - first_target[0], first[1] - first_target[1]
    x1, y1 = last[0] - last_target[0], last[1] - last_target[1]
    visible = future.visible.tolist()
    return Motion(
        yaw_deg=sum([(b - a + 180.0) % 360.0 - 180.0 for a, b in pairwise(yaw_deg)]),
        altitude_m=last[2] - first[2],
        mean_speed_mps=mean_speed_mps,
        speed_change_mps=mean_speed_mps - future.speed_before_mps,
        forward_gain_mps=forward_m / duration_s - future.speed_before_mps,
        forward_m=forward_m,
        left_m=moved_y * cos - moved_x * sin,
        approach_m=math.hypot(x0, y0) - math.hypot(x1, y1),
        closing_m=math.hypot(x0, y0) - math.hypot(last[0] - first_target[0], last[1] - first_target[1]),
        sweep_deg=-math.degrees(math.atan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1)),
        target_path_m=math.hypot(last_target[0] - first_target[0], last_target[1] - first_target[1]),
        visible_now=visible[0],
        visible_share=sum(visible[1:]) / (len(visible) - 1),
        order=future.order,
    )


Measure = Callable[[Motion], float]


@dataclass(frozen=True)
class ActionTable:
    """The rules of a set of actions with their thresholds put in.

    implied: in order of precedence, groups of actions and how much there is of what makes each the label, from 1 on.
    shown: how much of an
    action a motion shows, negative for its opposite, and what it must not fall below: less contradicts it.
    """

    implied: tuple[tuple[tuple[str, Measure], ...], ...]
    shown: dict[str, tuple[Measure, float]]

    def label_of(self, motion: Motion) -> str | None:
        """Give the ground-truth decision, None where neither an order nor geometry tells."""
        for group in self.implied:
            sizes = [(size(motion), token) for token, size in group]
            found = [pair for pair in sizes if pair[0] >= 1.0]
            if found:
                return max(found, key=lambda pair: pair[0])[1]  # the earlier one of two equal ones
        return None

    def is_contradicted(self, decision: str, motion: Motion) -> bool:
        """Tell whether a motion shows too little of a decision, or its opposite."""
        shown, limit = self.shown[decision]
        return shown(motion) < limit

    def verdict_of(self, decision: str, motion: Motion, label: str | None) -> Verdict:
        """Judge a decision against the actual future (the three classes of sec:appendix_e, and ABSTAIN)."""
        if decision == label:
            return "CONSISTENT"
        if self.is_contradicted(decision, motion):
            return "HARD_CONFLICT"
        return "ABSTAIN" if label is None else "SOFT_CONFLICT"

    def contradicted_by(self, motion: Motion, label: str | None) -> list[str]:
        """Give the decisions that the actual future contradicts: what a guess would have run into."""
        return [token for token, (size, limit) in self.shown.items() if token != label and size(motion) < limit]


@lru_cache(maxsize=16)
def table_of(actions: ActionSet, cfg: LabelConfig) -> ActionTable:
    """Give the rules of a set of actions."""
    groups = [
        [(token, _rule(rule, token, cfg)) for token in line if (rule := actions.actions[token].implied) is not None]
        for line in actions.precedence
    ]
    shown = {
        token: (
            _rule(action.shown, token, cfg),
            cfg.absent_share if (limit := action.contradicted_below) is None else limit,
        )
        for token, action in actions.actions.items()
    }
    return ActionTable(tuple(map(tuple, groups)), shown)


_COMPARE = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}


def _rule(rule: Rule, token: str, cfg: LabelConfig) -> Measure:
    sizes = [_size(Size(text), token, cfg) for text in rule.size]
    where, unless = ([_condition(Condition(text), token, cfg) for text in texts] for texts in (rule.where, rule.unless))
    size = None if not sizes else sizes[0] if len(sizes) == 1 else partial(_least, sizes)
    if size is not None and not (where or unless):
        return size

    def measure_rule(motion: Motion) -> float:
        for check in where:
            if not check(motion):
                return -1.0 if size is None else 0.0
        for check in unless:
            if not check(motion):
                break
        else:
            if unless:
                return -1.0 if size is None else 0.0
        return 1.0 if size is None else size(motion)

    return measure_rule


def _least(sizes: list[Measure], motion: Motion) -> float:
    """Give the least size; one that cannot be measured is none (the angle round a target that nobody knows)."""
    least = math.nan
    for size in sizes:
        value = size(motion)
        if value < least or least != least:
            least = value
    return least


def _size(size: Size, token: str, cfg: LabelConfig) -> Measure:
    term, unit = size.term, size.unit.factor * _setting(size.unit, cfg)
    if term.name is None or term.setting is not None or term.is_size or abs(term.factor) != 1.0:
        value = _term(term, token, cfg)
        return lambda motion: value(motion) / unit
    read, unit = _read(term.name, token), unit * term.factor  # the same to the last digit, and a call less
    return lambda motion: read(motion) / unit


def _condition(condition: Condition, token: str, cfg: LabelConfig) -> Callable[[Motion], bool]:
    """A comparison does not hold where something cannot be measured."""
    left, right = _term(condition.left, token, cfg), _term(condition.right, token, cfg)
    compare = _COMPARE[condition.how]
    if condition.right.name is None or condition.right.setting is not None:
        limit = condition.right.factor * _setting(condition.right, cfg)
        return lambda motion: compare(left(motion), limit)
    return lambda motion: compare(left(motion), right(motion))


def _term(term: Term, token: str, cfg: LabelConfig) -> Measure:
    name, factor = term.name, term.factor
    if name is None or term.setting is not None:
        value = factor * _setting(term, cfg)
        return lambda motion: value
    read = _read(name, token)
    if term.is_size:
        return lambda motion: factor * abs(read(motion))
    return read if factor == 1.0 else lambda motion: factor * read(motion)


def _read(name: str, token: str) -> Measure:
    """Give how a measure is read; `ordered` is of the action itself."""
    return operator.attrgetter(name) if name != "ordered" else lambda motion: float(motion.order == token)


def _setting(term: Term, cfg: LabelConfig) -> float:
    return 1.0 if term.setting is None else float(getattr(cfg, term.setting))
