"""Statements about a window in both languages: the critical components of the rule teacher.

Each statement is a choice of wordings, each wording a sentence in English and in Chinese, templates with the same
slots. A wording is offered only where the facts of its slots are known.
"""

from __future__ import annotations

from functools import cache

from caption.truth.facts import Facts
from caption.truth.references import QUANTITIES, Fact, find_fact, parse_reference

Both = tuple[str, str]  # English, Chinese

CENTERED_SHARE = 0.02  # of the image width: nearer than this to the middle counts as centred
BEND_DEG = 15.0  # a change of the walker's heading that is worth a word


def word_of(f: Facts, address: str) -> str | None:
    """Give the word that is true at an address, None where none is known."""
    fact = f.found.get(address)
    if fact is None:
        reference = parse_reference(address)
        assert reference is not None
        fact = f.found[address] = find_fact(reference, f)
    return str(fact.value) if isinstance(fact, Fact) else None


def describe(f: Facts) -> list[tuple[Both, ...]]:
    """Give the statements about a window, each as a tuple of wordings; those of the last state different facts."""
    parts = [_seen(f)]
    if f.is_visible_now:
        parts += [_box(f), _position(f)]
    parts += [_walk(f), _distance(f), _speed(f), _pace(f), _altitude(f), _yaw(f), _more(f)]
    return [part for part in parts if part]


def _seen(f: Facts) -> tuple[Both, ...]:
    if f.visibility[0] != f.visibility[-1]:
        return (
            (
                "The target pedestrian was {visibility@t0} at t0 and is {visibility} now.",
                "目标行人在 t0 时{visibility@t0}，现在{visibility}。",
            ),
        )
    return (
        ("The target pedestrian is {visibility}.", "目标行人{visibility}。"),
        ("The pedestrian is {visibility} in the current frame.", "行人在当前帧中{visibility}。"),
    )


def _walk(f: Facts) -> tuple[Both, ...]:
    if f.target_speed_mps is None:
        return ()
    if word_of(f, "target_motion") == "standing":
        return (("The target {target_motion} ({mean:target_speed}).", "目标{target_motion}（{mean:target_speed}）。"),)
    if f.target_turn_deg is not None and abs(f.target_turn_deg) >= BEND_DEG:
        return (
            (
                "The target {target_motion} at {mean:target_speed} and bends to the {side:target_heading}.",
                "目标以 {mean:target_speed}的速度{target_motion}并向{side:target_heading}转弯。",
            ),
            (
                "The target {target_motion} at {mean:target_speed}, bending {change:target_heading} to the "
                "{side:target_heading}.",
                "目标以 {mean:target_speed}的速度{target_motion}，并向{side:target_heading}转弯 {change:target_heading}。",
            ),
        )
    return (
        ("The target {target_motion} at {mean:target_speed}.", "目标以 {mean:target_speed}的速度{target_motion}。"),
        ("The target's speed is {mean:target_speed}.", "目标的速度为 {mean:target_speed}。"),
    )


def _box(f: Facts) -> tuple[Both, ...]:
    if f.box_width_px[-1] is None or f.box_height_px[-1] is None:
        return ()
    if f.box_width_px[0] and f.box_height_px[0] and word_of(f, "trend:box_height") in ("increasing", "decreasing"):
        return (
            (
                "The bounding box {trend:box_height} from {box@t0} to {box}.",
                "边界框从 {box@t0}{trend:box_height}到 {box}。",
            ),
            (
                "The box height {trend:box_height} by {growth:box_height} over the window.",
                "观测期间边界框高度{trend:box_height} {growth:box_height}。",
            ),
        )
    return (
        ("The bounding box measures about {box}.", "边界框约为 {box}。"),
        ("Its bounding box is about {box}.", "其边界框大小约 {box}。"),
    )


def _position(f: Facts) -> tuple[Both, ...]:
    side = word_of(f, "side:offset_x")
    if side is None:
        return ()
    if side == "centred":
        return (
            ("It is {side:offset_x} in the image.", "其在画面中{side:offset_x}。"),
            ("In the image it is {side:offset_x}.", "在画面中其位置{side:offset_x}。"),
        )
    return (
        (
            "It lies {offset_x} to the {side:offset_x} of the image centre.",
            "其位于画面中心{side:offset_x}侧 {offset_x}处。",
        ),
        ("It sits {offset_x} {side:offset_x} of the image centre.", "其在画面中心偏{side:offset_x} {offset_x}处。"),
    )


def _course(f: Facts, name: str, en: str, zh: str, plain: tuple[Both, ...], first: int = 0) -> tuple[Both, ...]:
    """State how a quantity went; `plain` where it stayed, or where its first value is not known."""
    trend, values = word_of(f, f"trend:{name}"), QUANTITIES[name].read(f)
    is_back = trend == "mixed" and values[first] == values[-1]  # "varies, from 20.0 m at t0 to 20.0 m now" says nothing
    if trend in (None, "steady") or values[first] is None or is_back:
        return plain
    mixed, directed = _courses(name, en, zh, first)
    return mixed if trend == "mixed" else directed


@cache
def _courses(name: str, en: str, zh: str, first: int) -> tuple[tuple[Both, ...], tuple[Both, ...]]:
    """Give the wordings of a course that is mixed, and of one that has a direction."""
    mixed = (
        (
            f"{en} {{trend:{name}}}, from {{{name}@t{first}}} at t{first} to {{{name}}} now.",
            f"{zh}{{trend:{name}}}，t{first} 时为 {{{name}@t{first}}}，现为 {{{name}}}。",
        ),
    )
    directed = (
        (
            f"{en} {{trend:{name}}} from {{{name}@t{first}}} to {{{name}}}.",
            f"{zh}从 {{{name}@t{first}}}{{trend:{name}}}到 {{{name}}}。",
        ),
        (
            f"{en} {{trend:{name}}} by {{change:{name}}} and is now {{{name}}}.",
            f"{zh}{{trend:{name}}} {{change:{name}}}，现为 {{{name}}}。",
        ),
    )
    return mixed, directed


def _distance(f: Facts) -> tuple[Both, ...]:
    if f.distance_m[-1] is None:
        return ()
    plain = (
        ("The horizontal distance is about {distance}.", "水平距离约为 {distance}。"),
        ("The horizontal distance is now {distance}.", "当前水平距离为 {distance}。"),
    )
    return _course(f, "distance", "The horizontal distance", "水平距离", plain)


def _speed(f: Facts) -> tuple[Both, ...]:
    plain = (
        ("The drone speed is {speed}.", "无人机速度为 {speed}。"),
        ("The drone flies at {speed}.", "无人机以 {speed}飞行。"),
    )
    return _course(f, "speed", "The drone speed", "无人机速度", plain, first=1)


def _pace(f: Facts) -> tuple[Both, ...]:
    word = word_of(f, "comparison:speed")
    if word is None or word_of(f, f"comparison:speed@t{len(f) - 1}") != word:
        return ()  # the slot compares with the target's last step, and the sentence before it gives the target's mean
    return (
        ("The drone is {comparison:speed} the target.", "无人机{comparison:speed}目标。"),
        ("At present the drone moves {comparison:speed} the target.", "当前无人机{comparison:speed}目标。"),
    )


def _altitude(f: Facts) -> tuple[Both, ...]:
    plain = (
        ("The altitude is about {altitude}.", "高度约为 {altitude}。"),
        ("The drone flies at an altitude near {altitude}.", "无人机飞行高度约为 {altitude}。"),
    )
    return _course(f, "altitude", "The altitude", "高度", plain)


def _yaw(f: Facts) -> tuple[Both, ...]:
    if word_of(f, "side:yaw") == "straight":
        return (
            ("The yaw {trend:yaw}.", "偏航角{trend:yaw}。"),
            ("Over the window the yaw {trend:yaw}.", "在观测窗口内偏航角{trend:yaw}。"),
        )
    return (
        ("The yaw has turned {yaw} to the {side:yaw}.", "偏航角已向{side:yaw}转动 {yaw}。"),
        ("Since t0 the nose has swung {yaw} to the {side:yaw}.", "自 t0 起机头已向{side:yaw}转动 {yaw}。"),
    )


def _more(f: Facts) -> tuple[Both, ...]:
    """Give statements of which a caption makes one."""
    found: list[Both] = []
    if f.travelled_m:
        found.append(("Over the window the drone has flown {travelled}.", "在观测窗口内无人机飞行了 {travelled}。"))
        found.append(("The drone's heading is {heading}.", "无人机的航向为 {heading}。"))
    if word_of(f, "target_motion") == "walking" and word_of(f, "target_travelled") is not None:
        found.append(
            ("Over the window the target has walked {target_travelled}.", "在观测窗口内目标行进了 {target_travelled}。")
        )
    if f.depression_deg and f.depression_deg[-1] is not None:
        found.append(("The camera looks at it with a depression of {depression}.", "视线俯角为 {depression}。"))
    if f.slant_m[-1] is not None:
        found.append(("The slant range is {slant}.", "沿视线的直线距离为 {slant}。"))
    return tuple(found)
