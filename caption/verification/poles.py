"""The opposites that claims stand for: dimension and value, as glossary.yaml names them for the words of a text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

from caption.verification.references import TURNED
from cosfly.formats.captions import Claim

Pair = tuple[str, str]  # dimension, value

_SIDED = {"yaw": 1, "heading": 1, "yaw_rate": 1, "bearing": 1, "target_heading": 1, "offset_x": -1}  # sign of left
_SPEEDS = ("speed", "target_speed", "speed_ratio", "speed_difference", "travelled", "displacement", "target_travelled")
_NEAR = {"distance": -1, "slant": -1, "box_width": 1, "box_height": 1, "depression": 1}  # sign of coming nearer
_DECISIONS: dict[str, tuple[Pair, ...]] = {
    "ascend": (("trend", "increasing"), ("level", "above")),
    "descend": (("trend", "decreasing"), ("level", "below")),
    "slow_down": (
        ("pace", "slower"),
        ("paced", "slower"),
        ("pace", "matching"),
        ("gap", "far"),
        ("trend", "decreasing"),
        ("trend", "increasing"),
    ),
    "speed_up": (
        ("pace", "faster"),
        ("paced", "faster"),
        ("pace", "matching"),
        ("gap", "near"),
        ("trend", "increasing"),
        ("trend", "decreasing"),
    ),
    "hover": (("paced", "slower"), ("motion", "standing"), ("trend", "steady"), ("pace", "slower")),
    "move_forward": (("gap", "near"), ("trend", "decreasing"), ("motion", "walking"), ("bend", "straight")),
    "move_backward": (("gap", "far"), ("trend", "increasing")),
    "track_straight": (("bend", "straight"), ("trend", "steady"), ("centre", "centred"), ("pace", "matching")),
    "search_to_reacquire_target": (("visibility", "hidden"), ("visibility", "gone"), ("visibility", "visible")),
}
ACTION_WORDS = {
    "track_straight": "straight", "yaw_left_to_follow": "yaw", "yaw_right_to_follow": "yaw", "circle_left": "circle",
    "circle_right": "circle", "ascend": "ascend", "descend": "descend", "move_forward": "forward",
    "move_backward": "backward", "strafe_left": "strafe", "strafe_right": "strafe", "slow_down": "slow",
    "speed_up": "fast",
    "search_to_reacquire_target": "search", "hover": "hover", "break_off": "leave", "return_to_home": "home",
}  # fmt: skip


def poles_of(claim: Claim) -> set[Pair]:
    """Return the opposites that a claim stands for."""
    aspect, _, name = claim.quantity.rpartition(":")
    value = claim.value
    if name == "decision":
        return set(_decision_poles(str(value)))
    if name == "framing":
        return {("centre", "centred" if value == "centred" else "off_centre")}
    if name == "walking":
        return {("gap", "near" if value == "towards" else "far")} if value != "across" else set()
    if name == "visibility":
        return {
            "visible": {("visibility", "visible"), ("visibility", "full"), ("visibility", "glimpsed")},
            "partly_occluded": {
                ("visibility", "partly"),
                ("visibility", "visible"),
                ("visibility", "hidden"),
                ("visibility", "glimpsed"),
            },
            "illegible": {("visibility", "illegible")},
        }.get(str(value), {("visibility", "hidden"), ("visibility", "gone")})
    if name in ("target_motion", "drone_motion"):
        is_still = value in ("standing", "hovering")
        still: set[Pair] = {("motion", "standing"), ("trend", "steady"), ("pace", "slower")}
        return still if is_still else {("motion", "walking"), ("pace", "faster")}
    if aspect == "compared":  # of the target against the drone
        value = TURNED.get(str(value), value)
    if aspect in ("comparison", "compared"):
        return {("pace", str(value)), ("compared", str(value))}
    if aspect == "side":
        return _side_poles(str(value))
    if aspect == "trend":
        signs = {"increasing": (1,), "decreasing": (-1,), "mixed": (1, -1)}.get(str(value), ())
        found = {pole for sign in signs for pole in _course_poles(name, sign)}
        if value == "mixed":
            found.add(("trend", "mixed"))
        return found or {("trend", "steady"), ("bend", "straight"), ("pace", "matching")}
    return number_poles(aspect, name, float(value)) if isinstance(value, float) else set()


def _decision_poles(action: str) -> Iterator[Pair]:
    yield from _DECISIONS.get(action, ())
    for side in ("left", "right"):
        if side in action:
            yield "side", side


def _side_poles(value: str) -> set[Pair]:
    if value in ("centred", "straight"):
        return {("centre", "centred"), ("trend", "steady"), ("bend", "straight")}
    if value in ("above", "below"):
        return {
            ("level", value),
            ("trend", "increasing" if value == "above" else "decreasing"),
            ("centre", "off_centre"),
        }
    return {("side", value), ("centre", "off_centre"), ("bend", "turning")}


def side_word(name: str, value: float) -> str:
    """Name the side of a value of a quantity that has sides."""
    return "centred" if not value else "left" if value * _SIDED[name] > 0 else "right"


def number_poles(aspect: str, name: str, value: float) -> set[Pair]:
    """Return the opposites that a number of a quantity stands for; of 0 those of rest."""
    found: set[Pair] = set()
    sign = (value > 0) - (value < 0)
    if not sign:
        still: set[Pair] = {("motion", "standing")} if name in ("speed", "target_speed") else set()
        return still | {("trend", "steady"), ("centre", "centred"), ("pace", "matching")}
    if name in _SIDED and aspect in ("", "change", "rate", "mean", "min", "max"):
        found.update({("side", "left" if sign == _SIDED[name] else "right"), ("bend", "turning")})
    if name == "offset_y":
        found.add(("level", "below" if sign > 0 else "above"))
    if aspect in ("change", "rate", "growth"):
        found.update(_course_poles(name, sign))
    elif name == "climb_rate":
        found.add(("trend", "increasing" if sign > 0 else "decreasing"))
    elif name == "speed_ratio":
        faster = "faster" if value > 1 else "slower" if value < 1 else "matching"
        found.update({("pace", faster), ("compared", faster)})
    elif name == "speed_difference":
        found.update({("pace", "faster" if sign > 0 else "slower"), ("compared", "faster" if sign > 0 else "slower")})
    elif name in ("speed", "target_speed"):
        found.add(("motion", "standing" if abs(value) < 0.6 else "walking"))
    elif name in ("height_over_target", "altitude"):
        found.add(("level", "above"))
        if name == "height_over_target":
            found.add(("trend", "increasing"))  # "20 m higher than the person"
    elif name in ("pitch", "depression"):
        found.add(("level", "below"))
    return found


def _course_poles(name: str, sign: int) -> set[Pair]:
    """Return the opposites of a quantity that grows or falls. Where its sign is a side, "grows" may mean its size."""
    found: set[Pair] = {("trend", "increasing" if sign > 0 else "decreasing")}
    if name in _SIDED or name in ("offset_y", "pitch", "climb_rate", "speed_difference"):
        found.add(("trend", "decreasing" if sign > 0 else "increasing"))
    if name in _SIDED:
        found.add(("side", "left" if sign == _SIDED[name] else "right"))
    if name in ("altitude", "height_over_target"):  # "2 m beneath the last frame"
        found.add(("level", "above" if sign > 0 else "below"))
    if name in _SPEEDS or name in ("yaw_rate", "climb_rate"):
        word = "faster" if sign > 0 else "slower"
        found.update({("pace", word), ("paced", word), ("pace", "matching")})
    if name in _NEAR:
        found.add(("gap", "near" if sign == _NEAR[name] else "far"))
    if name in ("offset_x", "offset_y"):
        found.update({("gap", "near"), ("gap", "far"), ("centre", "off_centre")})
    return found


def poles_between(numbers: Sequence[Claim]) -> Iterator[Pair]:
    """Yield the courses between two values of one quantity, and the comparison of the two speeds."""
    for one, other in combinations(numbers, 2):
        a, b = float(one.value), float(other.value)
        if one.quantity == other.quantity and one.at and other.at and one.at != other.at and a != b:
            yield from _course_poles(one.quantity.rpartition(":")[2], 1 if (b > a) == (other.at > one.at) else -1)
        if {one.quantity, other.quantity} == {"speed", "target_speed"} and one.at == other.at:
            ours, theirs = (a, b) if one.quantity == "speed" else (b, a)
            word = "faster" if ours > theirs else "slower" if ours < theirs else "matching"
            yield from (("pace", word), ("compared", word), ("trend", "increasing"), ("trend", "decreasing"))
        if one.quantity.rpartition(":")[0] in ("min", "max"):
            yield from (("trend", "mixed"), ("trend", "increasing"), ("trend", "decreasing"))
