"""The action table against hand-made futures, and its invariances."""

import dataclasses
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tables import each

from caption.schema import FutureMotion
from caption.verification.actions import TABLE, Thresholds, measure
from cosfly.formats.captions import TOKENS, verdict_on

THRESHOLDS = Thresholds()

MIRRORED = {
    token: token.replace("left", "right") if "left" in token else token.replace("right", "left") for token in TOKENS
}


def future(
    forward=0.0, left=0.0, up=0.0, turn_deg=0.0, before_mps=None, target=(20.0, 0.0), target_step=(0.0, 0.0), visible=1
) -> FutureMotion:
    """A straight future along +x: total displacement and turn over five steps; target at `target`, moving by steps."""
    k = np.arange(6)[:, None] / 5.0
    positions = k * np.array([forward, left, up]) + np.array([0.0, 0.0, 15.0])
    speed = float(np.linalg.norm([forward, left, up]) / 2.5)
    steps = np.arange(6)[:, None] * np.array([*target_step, 0.0])
    return FutureMotion(
        indices=(5, 6, 7, 8, 9), time_s=np.arange(6) * 0.5, positions_m=positions, yaw_deg=k[:, 0] * turn_deg,
        targets_m=np.array([*target, 0.9]) + steps, visible=np.full(6, bool(visible)),
        speed_before_mps=speed if before_mps is None else before_mps,
    )  # fmt: skip


LABELS = [
    ({"forward": 3.0, "target_step": (0.6, 0.0)}, "track_straight"),
    ({"forward": 3.0, "turn_deg": 3.01, "target_step": (0.6, 0)}, "yaw_left_to_follow"),
    ({"forward": 3.0, "turn_deg": 2.9, "target_step": (0.6, 0)}, "track_straight"),
    ({"forward": 3.0, "turn_deg": -8.0, "target_step": (0.6, 0)}, "yaw_right_to_follow"),
    ({"forward": 3.0, "turn_deg": -8.0}, "move_forward"),  # 3 times 1 m closer, 2.7 times 3 degrees
    # The larger part of a motion, each in units of its threshold, gives the label.
    ({"forward": 3.0, "up": 1.2, "turn_deg": 8.0, "target_step": (0.6, 0)}, "yaw_left_to_follow"),
    ({"forward": 3.0, "up": 3.0, "turn_deg": 4.0, "target_step": (0.6, 0)}, "ascend"),
    ({"forward": 3.0, "up": -3.0, "turn_deg": -8.9, "target_step": (0.6, 0)}, "descend"),
    ({"forward": 3.0, "up": -3.0, "turn_deg": -9.1, "target_step": (0.6, 0)}, "yaw_right_to_follow"),
    # Speed is gained on the way, or it is no speed_up.
    ({"forward": 2.5, "before_mps": 0.0, "target_step": (0.5, 0)}, "speed_up"),
    ({"forward": -2.5, "before_mps": 0.0}, "move_backward"),
    (
        {"forward": -2.5, "left": 3.0, "turn_deg": -7.0, "target": (30.0, 0.0)},
        "yaw_right_to_follow",
    ),  # more aside than back
    ({"left": -2.5, "before_mps": 0.0}, "strafe_right"),
    ({"up": 2.5, "before_mps": 0.0}, "ascend"),
    ({"forward": 1.0, "left": 0.9, "before_mps": 2.0, "target_step": (0.2, 0)}, "slow_down"),
    # A shift with a turn that keeps the aim is one swing round the walker: a turn to follow. With a turn away it is a
    # shift.
    ({"left": 3.0, "turn_deg": -7.0, "target_step": (0.5, 0.1)}, "yaw_right_to_follow"),
    ({"left": -3.0, "turn_deg": 7.0, "target_step": (0.5, -0.1)}, "yaw_left_to_follow"),
    ({"left": 3.0, "turn_deg": 4.0, "target_step": (0.5, 0.1)}, "strafe_left"),
    ({"left": 3.0, "turn_deg": -2.9, "target_step": (0.5, 0.1)}, "strafe_left"),
    ({"forward": 3.0, "up": 1.2, "target_step": (0.6, 0)}, "ascend"),
    ({"up": -1.5}, "descend"),
    ({"forward": 4.0, "before_mps": 0.5, "target_step": (0.8, 0)}, "speed_up"),
    ({"forward": 2.0, "before_mps": 2.0, "target_step": (0.4, 0)}, "slow_down"),
    ({"left": 2.0}, "strafe_left"),
    ({"left": -2.0}, "strafe_right"),
    ({"forward": -2.0}, "move_backward"),
    ({"forward": 2.0}, "move_forward"),  # closes in on a standing target
    # A gap that the walker closes is not of the drone's doing, nor one that the walker opens.
    ({"forward": 0.9, "target_step": (-0.6, 0)}, "track_straight"),
    ({"forward": -3.0, "target_step": (0.2, 0)}, "move_backward"),
    (
        {"forward": 1.5, "turn_deg": 4.0, "target_step": (-0.6, 0)},
        "move_forward",
    ),  # 1.5 m of its own, 1.3 times 3 degrees
    ({"forward": 1.2, "turn_deg": 4.0, "target_step": (-0.6, 0)}, "yaw_left_to_follow"),  # 4.2 m closer, 1.2 of its own
    ({}, "hover"),
    ({"forward": 3.0, "visible": 0}, "search_to_reacquire_target"),
    ({"left": 5.0, "turn_deg": -15.0, "target": (12.0, 2.5)}, "circle_left"),
    ({"left": -5.0, "turn_deg": 15.0, "target": (12.0, -2.5)}, "circle_right"),
    ({"left": 0.9}, None),  # it moves, but no manoeuvre stands out
]


@each(("motion", "label"), LABELS)
def test_label_of_a_known_future(motion, label):
    assert TABLE.label_of(measure(future(**motion))) == label


STEADY = {"forward": 3.0, "target_step": (0.6, 0.0)}  # straight and level behind a walker

HARD = [  # the opposite, then what is plainly not there
    ("yaw_left_to_follow", {"forward": 3.0, "turn_deg": -4.0}),
    ("yaw_right_to_follow", {"forward": 3.0, "turn_deg": 4.0}),
    ("track_straight", {"forward": 3.0, "turn_deg": 12.0}),
    ("ascend", {"forward": 3.0, "up": -0.6}),
    ("descend", {"forward": 3.0, "up": 0.6}),
    ("speed_up", {"forward": 2.0, "before_mps": 2.0}),
    ("slow_down", {"forward": 4.0, "before_mps": 0.5}),
    ("strafe_left", {"left": -0.8}),
    ("strafe_right", {"left": 0.8}),
    ("move_forward", {"forward": -1.0}),
    ("move_backward", {"forward": 1.0}),
    ("circle_left", {"left": -1.5}),
    ("circle_right", {"left": 1.5}),
    ("break_off", STEADY),
    ("return_to_home", STEADY),
    ("search_to_reacquire_target", STEADY),
    ("hover", STEADY),
    ("hover", {"forward": 2.25}),  # 0.9 m/s
    ("ascend", {**STEADY, "up": 0.24}),
    ("descend", STEADY),
    ("speed_up", STEADY),
    ("slow_down", STEADY),
    ("strafe_left", {**STEADY, "left": 0.24}),
    ("strafe_right", STEADY),
    ("circle_left", STEADY),
    ("circle_right", {**STEADY, "left": -2.0, "target_step": (0.6, -0.4)}),  # both move aside, and no angle is swept
    ("move_forward", {"left": 2.0}),
    ("move_backward", {}),
]


@each(("decision", "motion"), HARD)
def test_contradiction_of_each_action(decision, motion):
    measured = measure(future(**motion))
    label = TABLE.label_of(measured)
    assert verdict_on(decision, label, TABLE.contradicted_by(measured, label)) == "HARD_CONFLICT"


coordinate = st.floats(-6.0, 6.0, allow_nan=False, width=32)
rows = st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=6, max_size=6)
angles = st.lists(st.floats(-20.0, 20.0, allow_nan=False, width=32), min_size=6, max_size=6)


@st.composite
def futures(draw) -> FutureMotion:
    targets = np.array(draw(rows)) + np.array([15.0, 0.0, 0.0])
    return FutureMotion(
        indices=(5, 6, 7, 8, 9), time_s=np.arange(6) * 0.5, positions_m=np.array(draw(rows)),
        yaw_deg=np.array(draw(angles)), targets_m=targets,
        visible=np.array(draw(st.lists(st.booleans(), min_size=6, max_size=6))),
        speed_before_mps=draw(st.floats(0.0, 5.0)),
    )  # fmt: skip


def judged(motion) -> tuple[str | None, dict[str, str]]:
    label = TABLE.label_of(motion)
    contradicted = TABLE.contradicted_by(motion, label)
    return label, {token: verdict_on(token, label, contradicted) for token in TOKENS}


def is_near_a_threshold(motion) -> bool:
    """Rounding may move a value that sits on a threshold; such draws say nothing about invariance."""
    values = dataclasses.asdict(motion)
    limits = [*list(vars(THRESHOLDS).values()), 0.0]
    numbers = [v for v in values.values() if isinstance(v, float)] + [0.5 * abs(motion.left_m) - motion.target_path_m]
    numbers += [abs(motion.left_m) - abs(motion.forward_m)]
    if any(abs(abs(number) - limit) < 1e-6 for number in numbers for limit in limits if limit or number):
        return True
    for group in TABLE.groups:
        shown = [rule.shown(motion) for rule in group.values()]
        implied = [rule.implied(motion) for rule in group.values()]
        ranks = sorted(size for size in implied if size >= 0.99)
        if any(
            abs(size - limit) < 1e-6
            for size in [*shown, *implied]
            for limit in (THRESHOLDS.absent_share, 1.0, -1.0)
            if abs(size) != 1.0
        ):
            return True
        if any(after - before < 1e-6 for before, after in pairwise(ranks)):
            return True
    return False


@given(futures())
def test_mirroring_swaps_sides_and_keeps_verdicts(drawn):
    flip = np.array([1.0, -1.0, 1.0])
    mirrored = dataclasses.replace(
        drawn, positions_m=drawn.positions_m * flip, targets_m=drawn.targets_m * flip, yaw_deg=-drawn.yaw_deg
    )
    (label, verdicts), (other, others) = judged(measure(drawn)), judged(measure(mirrored))
    if is_near_a_threshold(measure(drawn)):
        return
    assert other == (None if label is None else MIRRORED[label])
    assert {MIRRORED[token]: verdict for token, verdict in verdicts.items()} == others


@given(futures(), st.floats(-180, 180), st.tuples(coordinate, coordinate, coordinate), st.floats(0, 1e4))
def test_moving_the_world_and_the_clock_changes_nothing(drawn, turn_deg, shift, later_s):
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = dataclasses.replace(
        drawn, positions_m=drawn.positions_m @ turn.T + shift, targets_m=drawn.targets_m @ turn.T + shift,
        yaw_deg=(drawn.yaw_deg + turn_deg + 180.0) % 360.0 - 180.0, time_s=drawn.time_s + later_s,
    )  # fmt: skip
    if not is_near_a_threshold(measure(drawn)):
        assert judged(measure(drawn)) == judged(measure(moved))


@given(futures())
def test_what_is_implied_is_never_contradicted(drawn):
    motion = measure(drawn)
    label = TABLE.label_of(motion)
    if label is not None:
        assert label not in TABLE.contradicted_by(motion, None)
        assert TABLE.rules[label].shown(motion) >= 1.0
