"""The embedded rule teacher: deterministic, looks only at the facts measured on the observed frames.

It decides from pixel offset, distances, speeds and visibility, and writes English and Chinese templates, filled as any
other teacher's are. Wording varies with the sample. Its records say `kind: rules`; it is no model and sees no picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from caption.verification.facts import Facts
from caption.verification.references import QUANTITIES, Fact, find_fact, parse_reference
from cosfly.runtime.config import read_yaml

Both = tuple[str, str]  # English, Chinese

CENTERED_SHARE = 0.02  # of the image width: nearer than this to the middle counts as centred
BEND_DEG = 15.0  # a change of the walker's heading that is worth a word


def word_of(f: Facts, address: str) -> str | None:
    """Return the word that is true at an address, None where none is known."""
    fact = f.found.get(address)
    if fact is None:
        reference = parse_reference(address)
        assert reference is not None
        fact = f.found[address] = find_fact(reference, f)
    return str(fact.value) if isinstance(fact, Fact) else None


def describe(f: Facts) -> list[tuple[Both, ...]]:
    """Return the statements about a window, each as a tuple of wordings; those of the last state different facts."""
    parts = [_seen(f)]
    if f.is_legible_now:
        parts += [_box(f), _position(f)]
    parts += [_walk(f), _distance(f), _speed(f), _keeping_pace(f), _altitude(f), _yaw(f), _others(f), _more(f)]
    return [part for part in parts if part]


@cache
def _wordings() -> dict[str, tuple[Both, ...]]:
    table = read_yaml(Path(__file__).with_name("statements.yaml"))
    return {name: tuple((en, zh) for en, zh in pairs) for name, pairs in table.items()}


def _seen(f: Facts) -> tuple[Both, ...]:
    return _wordings()["seen" if f.visibility[0] == f.visibility[-1] else "seen_otherwise"]


def _walk(f: Facts) -> tuple[Both, ...]:
    if f.target_speed_mps is None:
        return ()
    if word_of(f, "target_motion") == "standing":
        return _wordings()["stands"]
    is_bend = f.target_turn_deg is not None and abs(f.target_turn_deg) >= BEND_DEG
    return _wordings()["bends" if is_bend else "walks"]


def _box(f: Facts) -> tuple[Both, ...]:
    if f.box_width_px[-1] is None or f.box_height_px[-1] is None:
        return ()
    changes = (
        f.box_width_px[0] and f.box_height_px[0] and word_of(f, "trend:box_height") in ("increasing", "decreasing")
    )
    return _wordings()["box_changes" if changes else "box"]


def _position(f: Facts) -> tuple[Both, ...]:
    side = word_of(f, "side:offset_x")
    return () if side is None else _wordings()["centred" if side == "centred" else "beside"]


def _course(f: Facts, name: str, en: str, zh: str, first: int = 0) -> tuple[Both, ...]:
    """State how a quantity went; what it is where it stayed, or where its first value is not known."""
    trend, values = word_of(f, f"trend:{name}"), QUANTITIES[name].read(f)
    is_back = trend == "mixed" and values[first] == values[-1]  # "varies, from 20.0 m at t0 to 20.0 m now" says nothing
    if trend in (None, "steady") or values[first] is None or is_back:
        return _wordings()[name]
    return _courses("mixed" if trend == "mixed" else "directed", name, en, zh, first)


@cache
def _courses(course: str, name: str, en: str, zh: str, first: int) -> tuple[Both, ...]:
    given = {"name": name, "en": en, "zh": zh, "first": first}
    return tuple((one.format(**given), other.format(**given)) for one, other in _wordings()[course])


def _distance(f: Facts) -> tuple[Both, ...]:
    return () if f.distance_m[-1] is None else _course(f, "distance", "The horizontal distance", "水平距离")


def _speed(f: Facts) -> tuple[Both, ...]:
    return _course(f, "speed", "The drone speed", "无人机速度", first=1)


def _keeping_pace(f: Facts) -> tuple[Both, ...]:
    word = word_of(f, "comparison:speed")
    if word is None or word_of(f, f"comparison:speed@t{len(f) - 1}") != word:
        return ()  # the slot compares with the target's last step, and the sentence before it gives the target's mean
    return _wordings()["pace"]


def _altitude(f: Facts) -> tuple[Both, ...]:
    return _course(f, "altitude", "The altitude", "高度")


def _yaw(f: Facts) -> tuple[Both, ...]:
    return _wordings()["yaw_straight" if word_of(f, "side:yaw") == "straight" else "yaw"]


def _others(f: Facts) -> tuple[Both, ...]:
    """Tell of other people, where there are some."""
    if not f.others_in_view or not f.others_in_view[-1]:
        return ()
    alike = () if f.alike_differences[-1] is None else _wordings()["most_alike"]
    return _wordings()["nearest_other"] + alike + (_wordings()["others"] if f.others_in_view[-1] > 1 else ())


def _more(f: Facts) -> tuple[Both, ...]:
    """Return statements of which a caption makes one."""
    is_walking = word_of(f, "target_motion") == "walking" and word_of(f, "target_travelled") is not None
    known = {
        "flown": bool(f.travelled_m),
        "heading": bool(f.travelled_m),
        "target_walked": is_walking,
        "depression": bool(f.depression_deg and f.depression_deg[-1] is not None),
        "slant": f.slant_m[-1] is not None,
    }
    return tuple(_wordings()[name][0] for name, is_known in known.items() if is_known)


MODEL = "rules-7"  # its name in the records; counts changes of decisions and wording
STEPS_AHEAD = 5.0  # the observed trend is taken to hold for the next 2.5 s
DEGREES_PER_IMAGE_WIDTH = 60.0  # a typical field of view: turns a pixel offset into a bearing
MIN_TURN_DEG, MIN_CLIMB_M, MIN_GAP_M, MIN_PACE_MPS, STILL_MPS = 3.0, 1.0, 1.0, 0.3, 0.3


@dataclass(frozen=True)
class Cues:
    """Trends derived from facts; 0.0 where a fact is missing."""

    offset_share: float  # of the image width, positive to the right
    last_turn_deg: float
    last_climb_m: float
    turn_deg: float  # expected of the next steps, positive to the left
    climb_m: float
    gap_m: float  # change of the horizontal distance over the window
    pace_mps: float  # drone speed less target speed
    speed_now_mps: float


def find_cues(facts: Facts) -> Cues:
    """Measure what the rules decide by, on the observed frames alone."""
    dx = facts.offset_x_px[-1] if facts.is_visible_now else None
    first, last = facts.distance_m[0], facts.distance_m[-1]
    # The camera follows the line of sight, which is the heading less the target's place in the picture: one shaky frame
    # moves both and leaves their difference as it is.
    offsets = facts.offset_x_px if None not in facts.offset_x_px else [0] * len(facts.yaw_deg)
    degrees = DEGREES_PER_IMAGE_WIDTH / facts.width_px
    sight_deg = [yaw_deg - degrees * (offset or 0) for yaw_deg, offset in zip(facts.yaw_deg, offsets, strict=True)]
    speed = facts.speed_mps[-1] or 0.0
    return Cues(
        offset_share=0.0 if dx is None else dx / facts.width_px,
        last_turn_deg=facts.yaw_deg[-1] - facts.yaw_deg[-2],
        last_climb_m=facts.altitude_m[-1] - facts.altitude_m[-2],
        turn_deg=STEPS_AHEAD * _slope(sight_deg) - degrees * (dx or 0),
        climb_m=STEPS_AHEAD * _slope(facts.altitude_m),
        gap_m=0.0 if first is None or last is None else last - first,
        pace_mps=0.0 if facts.target_speed_mps is None else speed - facts.target_speed_mps,
        speed_now_mps=speed,
    )


def _slope(values: Sequence[float]) -> float:
    """Return the change per step of the straight line nearest to a series."""
    weights, norm = _slope_weights(len(values))
    return sum([w * v for w, v in zip(weights, values, strict=True)]) / norm


@cache
def _slope_weights(count: int) -> tuple[list[float], float]:
    middle = (count - 1) / 2.0
    weights = [i - middle for i in range(count)]
    return weights, sum(w * w for w in weights)


def decide(facts: Facts) -> str:
    """Choose an action from the observed frames alone."""
    return _decided(facts, find_cues(facts))


def _decided(facts: Facts, cues: Cues) -> str:
    # A shaken camera goes up and down, near and far; who climbs or closes in goes one way.
    turn_deg, climb_m = cues.turn_deg, cues.climb_m if _goes_one_way(facts.altitude_m) else 0.0
    gap_m = cues.gap_m if _goes_one_way(facts.distance_m) else 0.0
    if facts.mission is not None:  # who has turned away already is on the way home
        return "return_to_home" if facts.visibility[-1] == "out_of_view" else "break_off"
    if not facts.is_visible_now:
        return "search_to_reacquire_target"
    if cues.speed_now_mps < STILL_MPS and abs(turn_deg) < MIN_TURN_DEG and abs(climb_m) < MIN_CLIMB_M:
        return "hover"
    if abs(turn_deg) >= MIN_TURN_DEG:
        return "yaw_left_to_follow" if turn_deg > 0 else "yaw_right_to_follow"
    if abs(climb_m) >= MIN_CLIMB_M:
        return "ascend" if climb_m > 0 else "descend"
    if gap_m >= MIN_GAP_M and cues.pace_mps <= -MIN_PACE_MPS:
        return "speed_up"
    if gap_m <= -MIN_GAP_M and cues.pace_mps >= MIN_PACE_MPS:
        return "slow_down"
    return "track_straight"


def _goes_one_way(values: Sequence[float | None]) -> bool:
    """Return whether a series never turns back; not where a value is unknown."""
    known = [value for value in values if value is not None]
    return len(known) == len(values) and known in (sorted(known), sorted(known, reverse=True))


def write_templates(facts: Facts, draws: bytes, decision: str | None = None) -> tuple[dict[str, str], dict[str, str]]:
    """Write the English and the Chinese answer, with slots for the facts.

    Args:
        draws: random, one for each sentence (random_bytes).
        decision: the decision to justify (anchored); None decides freely.
    """
    cues = find_cues(facts)
    token = decision or _decided(facts, cues)
    *statements, conclusion = [
        options[draw % len(options)] for options, draw in zip([*describe(facts), _CONCLUSIONS], draws, strict=False)
    ]
    causes = [*_causes(facts, cues, token), conclusion]
    texts = [(" ".join([en for en, _ in both]), "".join([zh for _, zh in both])) for both in (statements, causes)]
    english, chinese = [
        {"critical_components": critical, "reasoning_trace": reasons, "flight_decision": token}
        for critical, reasons in zip(*texts, strict=True)
    ]
    return english, chinese


_CONCLUSIONS: tuple[Both, ...] = (
    ("Therefore the drone should {decision}.", "因此无人机应{decision}。"),
    ("The decision that follows is to {decision}.", "由此得出的决策是{decision}。"),
    ("For this reason the next step is to {decision}.", "基于此，下一步应{decision}。"),
)


# --- causes -----------------------------------------------------------------------------------------------------------


def _causes(f: Facts, cues: Cues, token: str) -> list[Both]:
    """Return the reasons for a decision that the facts hold, else its general reason, which claims nothing measurable."""
    found = [wording for wording in (cause(f, cues) for cause in _EVIDENCE.get(token, ())) if wording]
    return found[:2] or [_GENERAL[token]]


# Of a decision for which the facts hold no reason; claims nothing measurable.
_GENERAL: dict[str, Both] = {
    "track_straight": ("The present course keeps the target in frame.", "当前航向可使目标保持在画面内。"),
    **dict.fromkeys(("yaw_left_to_follow", "yaw_right_to_follow"), ("The line of sight to the target calls for a correction of the heading.", "对准目标的视线需要修正航向。")),
    **dict.fromkeys(("circle_left", "circle_right"), ("A view from another side of the target keeps it well in frame.", "换一侧观察目标有利于将其保持在画面内。")),
    "ascend": ("A higher viewpoint keeps a free line of sight to the target.", "更高的视点可保持对目标的通畅视线。"),
    "descend": ("A lower viewpoint shows the target at a better scale.", "更低的视点可让目标尺度更合适。"),
    "move_forward": ("Closing in keeps the target at a useful scale.", "靠近目标可保持合适的尺度。"),
    "move_backward": ("More room keeps the target and its surroundings in frame.", "留出更多空间可将目标与周围环境保持在画面内。"),
    **dict.fromkeys(("strafe_left", "strafe_right"), ("A sideways shift keeps the target framed without a turn.", "侧向移动可在不转向的情况下保持目标构图。")),
    **dict.fromkeys(("slow_down", "speed_up"), ("The pace has to fit that of the target.", "飞行节奏需要与目标相适应。")),
    "search_to_reacquire_target": ("Contact with the target has to be secured.", "需要确保与目标保持联系。"),
    "hover": ("Holding the present position keeps the target in frame.", "保持当前位置可使目标留在画面内。"),
    "break_off": ("The mission ends the pursuit here.", "任务要求在此结束跟踪。"),
    "return_to_home": ("The mission calls the drone back.", "任务要求无人机返回。"),
}  # fmt: skip

Cause = Callable[[Facts, Cues], Both | None]
_TREND = {1: "increasing", -1: "decreasing"}


def _offset(side: int, f: Facts, c: Cues) -> Both | None:
    if -side * c.offset_share < CENTERED_SHARE:
        return None
    return (
        "The target lies {offset_x} {side:offset_x} of the image centre.",
        "目标在画面中心{side:offset_x}侧 {offset_x}处。",
    )


def _turn(side: int, f: Facts, c: Cues) -> Both | None:
    if side * c.last_turn_deg < 0.5 or side * f.yaw_deg[-1] < 1.0:
        return None
    return (
        "To keep the target in the image, the nose has turned {yaw} to the {side:yaw}.",
        "为跟踪目标，机头已向{side:yaw}转动 {yaw}。",
    )


def _bend(side: int, f: Facts, c: Cues) -> Both | None:
    if f.target_turn_deg is None or side * f.target_turn_deg < BEND_DEG:
        return None
    return (
        "The target bends to the {side:target_heading}, and the nose should follow.",
        "目标向{side:target_heading}转弯，机头应跟踪。",
    )


def _climb(side: int, f: Facts, c: Cues) -> Both | None:
    if word_of(f, "trend:altitude") != _TREND[side] or side * c.last_climb_m <= 0:
        return None
    return (
        "The altitude {trend:altitude} to {altitude} over the observed frames.",
        "观测期间高度{trend:altitude}到 {altitude}。",
    )


def _gap(side: int, f: Facts, c: Cues) -> Both | None:
    if side * c.gap_m < 0.5 or word_of(f, "trend:distance") != _TREND[side]:
        return None
    return (
        "The horizontal distance has {trend:distance} to {distance} over the observed frames.",
        "观测期间水平距离已{trend:distance}到 {distance}。",
    )


def _pace(side: int, f: Facts, c: Cues) -> Both | None:
    if side * c.pace_mps < MIN_PACE_MPS or word_of(f, "comparison:speed") != ("faster" if side > 0 else "slower"):
        return None
    return (
        "With {speed} the drone is {comparison:speed} the target with {mean:target_speed}.",
        "无人机速度 {speed}，{comparison:speed}目标的 {mean:target_speed}。",
    )


def _steady(f: Facts, c: Cues) -> Both | None:
    if not f.is_legible_now or word_of(f, "side:offset_x") != "centred" or abs(c.last_turn_deg) >= 1.0:
        return None
    return ("The target is {side:offset_x} in the image.", "目标在画面中{side:offset_x}。")


def _lost(f: Facts, c: Cues) -> Both | None:
    if f.is_visible_now:
        return None
    return ("The target is {visibility}, so the tracking needs a change.", "目标{visibility}，因此需要应对。")


def _standing(f: Facts, c: Cues) -> Both | None:
    if word_of(f, "target_motion") != "standing":
        return None
    return ("The target {target_motion}, so there is nothing to follow.", "目标{target_motion}，因此不需跟踪。")


_ORDERS: dict[str, Both] = {
    "geofence": ("The border of the permitted area ends the pursuit here.", "允许飞行区域的边界使跟踪到此为止。"),
    "battery": ("The battery is down to the reserve for the way home.", "电池电量已降至返航储备。"),
    "time_over": ("The time of the mission is over.", "任务时间已到。"),
}


def _order(f: Facts, c: Cues) -> Both | None:
    return None if f.mission is None else _ORDERS[f.mission]


_EVIDENCE: dict[str, tuple[Cause, ...]] = {
    "track_straight": (_steady,),
    "yaw_left_to_follow": (partial(_offset, 1), partial(_turn, 1), partial(_bend, 1)),
    "yaw_right_to_follow": (partial(_offset, -1), partial(_turn, -1), partial(_bend, -1)),
    "ascend": (partial(_climb, 1),),
    "descend": (partial(_climb, -1),),
    "speed_up": (partial(_gap, 1), partial(_pace, -1)),
    "slow_down": (partial(_gap, -1), partial(_pace, 1)),
    "move_forward": (partial(_gap, 1),),
    "move_backward": (partial(_gap, -1),),
    "strafe_left": (partial(_offset, 1), partial(_bend, 1)),
    "strafe_right": (partial(_offset, -1), partial(_bend, -1)),
    "hover": (_standing,),
    "search_to_reacquire_target": (_lost,),
    "break_off": (_order,),
    "return_to_home": (_order,),
}
