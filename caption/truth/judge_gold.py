"""The gold set of `judge-check`: conflicts as a teacher makes them, with the judgement of a careful reader.

Balanced: each judgement is right for a third of the cases. A case is (flight, decision, label, right judgement, critical
components, reasoning).
"""

from __future__ import annotations

from caption.schema import Judgement
from caption.truth.judge import Case
from cosfly.products.captions import Coc

_FLIGHTS = {
    "straight": (
        "Velocity: [0.0, 1.42, 1.38, 1.40, 1.41] m/s.\n"
        "Altitude: [20.6, 20.6, 20.6, 20.6, 20.6] m.\n"
        "Yaw against the first frame: [0.0, 0.2, 0.1, 0.3, 0.2] deg (positive to the left).\n"
        "Target ground speed: 1.40 m/s.\n"
        "Visibility: [visible, visible, visible, visible, visible]."
    ),
    "left": (
        "Velocity: [0.0, 1.60, 1.72, 1.81, 1.90] m/s.\n"
        "Altitude: [18.2, 18.2, 18.3, 18.2, 18.2] m.\n"
        "Yaw against the first frame: [0.0, 1.1, 2.9, 5.2, 8.0] deg (positive to the left).\n"
        "Target ground speed: 1.30 m/s.\n"
        "Visibility: [visible, visible, visible, visible, visible]."
    ),
    "climb": (
        "Velocity: [0.0, 1.10, 1.22, 1.31, 1.36] m/s.\n"
        "Altitude: [15.0, 15.3, 15.7, 16.2, 16.8] m.\n"
        "Yaw against the first frame: [0.0, 0.1, 0.0, 0.2, 0.1] deg (positive to the left).\n"
        "Target ground speed: 1.10 m/s.\n"
        "Visibility: [visible, visible, partly occluded, partly occluded, partly occluded]."
    ),
    "lost": (
        "Velocity: [0.0, 1.50, 1.48, 1.52, 1.49] m/s.\n"
        "Altitude: [19.0, 19.0, 19.1, 19.0, 19.0] m.\n"
        "Yaw against the first frame: [0.0, -0.4, -0.9, -1.2, -1.4] deg (positive to the left).\n"
        "Target ground speed: 1.45 m/s.\n"
        "Visibility: [visible, visible, partly occluded, occluded, occluded]."
    ),
    "slow": (
        "Velocity: [0.0, 2.40, 2.10, 1.70, 1.30] m/s.\n"
        "Altitude: [17.5, 17.5, 17.5, 17.4, 17.5] m.\n"
        "Yaw against the first frame: [0.0, 0.3, 0.4, 0.2, 0.3] deg (positive to the left).\n"
        "Target ground speed: 0.60 m/s.\n"
        "Visibility: [visible, visible, visible, visible, visible]."
    ),
    "still": (
        "Velocity: [0.0, 0.20, 0.12, 0.06, 0.04] m/s.\n"
        "Altitude: [16.0, 16.0, 16.0, 16.0, 16.0] m.\n"
        "Yaw against the first frame: [0.0, 0.1, 0.1, 0.0, 0.1] deg (positive to the left).\n"
        "Target ground speed: 0.05 m/s.\n"
        "Visibility: [visible, visible, visible, visible, visible]."
    ),
}

_CASES: tuple[tuple[str, str, str, Judgement, str, str], ...] = (
    (
        "straight",
        "yaw_left_to_follow",
        "track_straight",
        "ACCEPT_ALTERNATIVE",
        "The target is visible and sits 42 px to the left of the image centre; its speed is 1.40 m/s.",
        "The target drifts to the left side of the image while the pace fits, so a small yaw to the left brings it back to the centre early.",
    ),
    (
        "straight",
        "yaw_left_to_follow",
        "track_straight",
        "FIX_LABEL",
        "The target is visible near the image centre and the yaw has been steady.",
        "The target walks straight ahead at our own pace and stays centred, so nothing has to change: keep tracking straight ahead.",
    ),
    (
        "straight",
        "descend",
        "track_straight",
        "REJECT_REGEN",
        "The target is occluded and the altitude falls quickly from 30.0 m.",
        "Because the target cannot be seen, the drone has to sink through the cloud.",
    ),
    (
        "left",
        "track_straight",
        "yaw_left_to_follow",
        "FIX_LABEL",
        "The yaw has turned 8.0 deg to the left and the target bends to the left.",
        "The turn to the left goes on and the target leaves the middle to the left, so the drone should yaw left to follow.",
    ),
    (
        "left",
        "circle_left",
        "yaw_left_to_follow",
        "ACCEPT_ALTERNATIVE",
        "The yaw has turned 8.0 deg to the left; the speed rises to 1.90 m/s while the target walks at 1.30 m/s.",
        "The drone already swings round the target to the left and is faster than it, so going on round it keeps it framed.",
    ),
    (
        "left",
        "yaw_right_to_follow",
        "yaw_left_to_follow",
        "REJECT_REGEN",
        "The yaw has turned to the right by 8.0 deg.",
        "The target moves out of the image to the right, so the drone has to yaw right.",
    ),
    (
        "climb",
        "track_straight",
        "ascend",
        "ACCEPT_ALTERNATIVE",
        "The altitude has risen to 16.8 m; the target is still partly visible at 1.10 m/s.",
        "The climb has almost cleared the obstacle and the course fits the target's path, so holding the course keeps it in view.",
    ),
    (
        "climb",
        "move_forward",
        "ascend",
        "FIX_LABEL",
        "The target is partly occluded and the drone climbs from 15.0 m to 16.8 m.",
        "An obstacle hides part of the target and only a higher viewpoint clears it, so the drone should go on to climb.",
    ),
    (
        "climb",
        "hover",
        "ascend",
        "REJECT_REGEN",
        "The drone stands still at 15.0 m and the target is fully visible.",
        "Nothing moves and nothing hides the target, so there is no reason to do anything.",
    ),
    (
        "lost",
        "track_straight",
        "search_to_reacquire_target",
        "ACCEPT_ALTERNATIVE",
        "The target has been occluded for two frames; before that it walked straight on at 1.45 m/s.",
        "A short occlusion on a straight walk usually ends within a second, so keeping the course is the shortest way to see it again.",
    ),
    (
        "lost",
        "hover",
        "search_to_reacquire_target",
        "FIX_LABEL",
        "The target is occluded in the last two frames.",
        "Contact is lost behind an obstacle and must be secured again, so the drone has to search for the target.",
    ),
    (
        "lost",
        "speed_up",
        "search_to_reacquire_target",
        "REJECT_REGEN",
        "The target is clearly visible in every frame.",
        "As the target can be seen in all frames, the drone should race past it.",
    ),
    (
        "slow",
        "track_straight",
        "slow_down",
        "ACCEPT_ALTERNATIVE",
        "The drone has slowed from 2.40 m/s to 1.30 m/s; the target walks at 0.60 m/s.",
        "Most of the braking is done and the target is centred, so holding the course ends the approach smoothly.",
    ),
    (
        "slow",
        "move_forward",
        "slow_down",
        "FIX_LABEL",
        "The drone at 1.30 m/s is faster than the target at 0.60 m/s.",
        "The gap closes faster than it should, so the drone has to reduce its speed further.",
    ),
    (
        "slow",
        "speed_up",
        "slow_down",
        "REJECT_REGEN",
        "The target runs at 6.00 m/s and the drone falls behind.",
        "The target pulls away, so the drone has to accelerate.",
    ),
    (
        "still",
        "track_straight",
        "hover",
        "ACCEPT_ALTERNATIVE",
        "Target and drone have almost stopped; the target is visible and centred.",
        "The target may walk on at any moment in the same direction, so staying aligned with its path at this pace loses nothing.",
    ),
    (
        "still",
        "slow_down",
        "hover",
        "FIX_LABEL",
        "The target stands almost still at 0.05 m/s and the drone moves at 0.04 m/s.",
        "There is nothing to follow at the moment and the view is good, so the drone should stay in place.",
    ),
    (
        "still",
        "return_to_home",
        "hover",
        "REJECT_REGEN",
        "The battery is empty and a storm comes up.",
        "With no energy left the drone has to go home at once.",
    ),
)


def read_gold() -> list[tuple[Case, Judgement]]:
    """Give the cases with their right judgements."""
    found = []
    for number, (flight, decision, label, right, components, reasoning) in enumerate(_CASES):
        answer = Coc(critical_components=components, reasoning_trace=reasoning, flight_decision=decision)
        found.append((Case(f"gold_{number:02d}_frame_00000", _FLIGHTS[flight], answer, label), right))
    return found
