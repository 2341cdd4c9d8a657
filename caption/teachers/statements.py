"""Statements about a window in both languages: the critical components of the rule teacher.

Each statement is a choice of wordings (statements.yaml), each a sentence in English and in Chinese, templates with the
same slots. A wording is offered only where the facts of its slots are known.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from caption.truth.facts import Facts
from caption.truth.references import QUANTITIES, Fact, find_fact, parse_reference
from cosfly.work.config import read_yaml

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
    if f.is_legible_now:
        parts += [_box(f), _position(f)]
    parts += [_walk(f), _distance(f), _speed(f), _pace(f), _altitude(f), _yaw(f), _others(f), _more(f)]
    return [part for part in parts if part]


@cache
def _wordings() -> dict[str, tuple[Both, ...]]:
    table = read_yaml(Path(__file__).with_suffix(".yaml"))
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


def _pace(f: Facts) -> tuple[Both, ...]:
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
    """Give statements of which a caption makes one."""
    is_walking = word_of(f, "target_motion") == "walking" and word_of(f, "target_travelled") is not None
    known = {
        "flown": bool(f.travelled_m),
        "heading": bool(f.travelled_m),
        "target_walked": is_walking,
        "depression": bool(f.depression_deg and f.depression_deg[-1] is not None),
        "slant": f.slant_m[-1] is not None,
    }
    return tuple(_wordings()[name][0] for name, is_known in known.items() if is_known)
