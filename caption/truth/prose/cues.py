"""Which series a word may mean, given a unit and whose it is; what is nearest to what; which frames are meant."""

from __future__ import annotations

import re
from dataclasses import dataclass

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.lexicon import Token
from caption.truth.prose.numerals import Numeral
from caption.truth.prose.statements import NOW

# unit -> cue -> series; {0: unknown owner's, ...} where the owner decides.
_LENGTHS = {
    "distance": ("distance",), "range": ("distance", "slant"), "slant": ("slant",), "altitude": ("altitude",), "height": ("altitude", "height_over_target"),
    "over": ("height_over_target",),
}  # fmt: skip
_PIXELS = {
    "width": ("box_width",), "tall": ("box_height",), "height": ("box_height",), "box": ("box_width", "box_height"),
    "centre": ("offset_x", "offset_y"), "altitude": ("box_height",),
}  # fmt: skip
_OWNED = {  # (unit, cue) -> drone's, target's
    ("mps", "speed"): (("speed",), ("target_speed", "target_mean")),
    ("m", "displacement"): (("displacement", "travelled"), ("target_travelled",)),
    ("m", "travelled"): (("travelled", "displacement"), ("target_travelled",)),
    ("deg", "heading"): (("heading", "yaw"), ("target_heading", "target_turn")),
    ("deg", "turn"): (("yaw", "heading"), ("target_turn", "target_heading")),
    ("dps", "turn"): (("rate:yaw",), ("rate:target_heading",)),
    ("dps", "heading"): (("rate:yaw",), ("rate:target_heading",)),
    ("dps", "yaw_rate"): (("rate:yaw",), ("rate:target_heading",)),
}
_RATES = {
    "climb_rate": ("climb_rate", "rate:altitude"), "altitude": ("climb_rate", "rate:altitude"),
    "height": ("climb_rate", "rate:altitude"),
    "distance": ("rate:distance", "speed_difference", "difference_mean"), "slant": ("rate:slant",),
    "difference": ("speed_difference", "difference_mean", "rate:distance"),
}  # fmt: skip
_ANGLES = {
    "yaw": ("yaw", "heading"), "yaw_rate": ("yaw",), "target_heading": ("target_heading", "target_turn"), "pitch": ("pitch",), "depression": ("depression", "pitch"), "bearing": ("bearing",),
}  # fmt: skip
_TABLES: dict[str, dict[str, tuple[str, ...]]] = {
    "m": _LENGTHS,
    "px": _PIXELS,
    "mps": _RATES,
    "deg": _ANGLES,
    "dps": {
        "yaw": ("rate:yaw",),
        "target_heading": ("rate:target_heading",),
        "bearing": ("rate:bearing",),
        "pitch": ("rate:pitch",),
    },
}
ANY = {
    "m": ("distance", "slant", "altitude", "height_over_target", "travelled", "displacement", "target_travelled"),
    "mps": (
        "speed",
        "target_speed",
        "target_mean",
        "climb_rate",
        "speed_difference",
        "difference_mean",
        "rate:distance",
        "rate:slant",
    ),
    "deg": ("yaw", "heading", "pitch", "bearing", "depression", "target_turn", "target_heading"),
    "dps": ("rate:yaw", "rate:heading", "rate:pitch", "rate:bearing", "rate:target_heading"),
    "px": ("box_width", "box_height", "offset_x", "offset_y", "picture"),
}
TREND_SERIES = {
    "distance": ("distance",), "range": ("distance", "slant"), "slant": ("slant",), "altitude": ("altitude",), "over": ("height_over_target", "altitude"),
    "box": ("box_area",), "width": ("box_width",), "tall": ("box_height",), "climb_rate": ("climb_rate",), "difference": ("speed_difference", "difference_mean"),
}  # fmt: skip


def names_of(cue: str, unit: str, owner: str) -> tuple[str, ...]:
    """Give the series that a cue may mean for a number of a unit; () where it means none."""
    owned = _OWNED.get((unit, cue))
    if owned is not None:
        if (unit, cue) == ("dps", "yaw_rate"):
            return owned[0] if owner != "target" else owned[0] + owned[1]
        return owned[0] if owner == "drone" else owned[1] if owner == "target" else owned[0] + owned[1]
    return _TABLES.get(unit, {}).get(cue, ())


@dataclass
class Context:
    """What the clauses before it leave to a clause: who is spoken of, and of what."""

    subject: str = ""
    is_carried: bool = True  # the subject is that of an earlier sentence
    latest: str = ""  # who was named last
    cue: str = ""
    told: str = ""  # what a verb told of since: "climbs"
    told_way: int = 0  # +1 of what went up there, -1 down
    people: tuple[str, ...] = ()  # named in the sentence so far
    has_past: bool = False
    has_frame: bool = False  # a frame before now was named


def gap(token: Token, start: int, end: int) -> int:
    """Give the letters between a token and a place; what stands behind counts half as much again."""
    return start - token.end if token.end <= start else int(1.5 * (token.start - end)) + 2


def crossing(sentence: Sentence, clause: Clause, token: Token, start: int, end: int) -> int:
    """Count the numbers between a token and a place."""
    low, high = (token.end, start) if token.end <= start else (end, token.start)
    return sum(low <= sentence.numerals[i].start < high for i in clause.numerals)


def owner_of(sentence: Sentence, clause: Clause, start: int, end: int, context: Context) -> str:
    """Say whose a number or a side at a place is: `drone`, `target`, or "" where that is not plain."""
    ranked = sorted(
        (
            gap(t, start, end)
            + 14 * crossing(sentence, clause, t, start, end)
            - (6 if _belongs(sentence, t, end) else 0),
            t.value,
        )
        for t in clause.of("who", "drone", "target")
        if sentence.text[t.start : t.end] not in OBJECTS
        and not is_aimed_at(sentence, clause, t)
        and not _is_verb_of_other(clause, t)
    )
    if not ranked and _ITS.search(sentence.text, clause.start, clause.end):
        return ""
    if not ranked:
        return (
            context.latest
            if sentence.text[clause.start - 1 : clause.start] == "(" and context.latest
            else context.subject
        )
    best, owner = ranked[0]
    others = [cost for cost, value in ranked if value != owner]
    if others and others[0] - best < (5 if sentence.language == "en" else 2):
        return ""
    return owner


def _is_verb_of_other(clause: Clause, token: Token) -> bool:
    """Tell whether what tells of one is said of the other, who stands right before it: "the drone dawdles"."""
    return any(t.value != token.value and 0 <= token.start - t.end <= 1 for t in clause.of("who", "drone", "target"))


_TOWARDS = re.compile(r"\b(?:towards?|away from|after|past|behind|around|round) (?:the |our )?$|(?:朝着?|朝向|远离)$")


def is_aimed_at(sentence: Sentence, clause: Clause, token: Token) -> bool:
    """Tell whether somebody is only where another goes: "walks towards the camera at 1.2 m/s"."""
    others = [t for t in clause.of("who", "drone", "target") if t.value != token.value and t.end <= token.start]
    return bool(others) and _TOWARDS.search(sentence.text, clause.start, token.start) is not None


_ITS = re.compile(r"\bits?\b|其")
OBJECTS = ("him", "them", "us", "me")  # have no speed or distance: "flies round him at 2 m/s"
_OF = {"en": re.compile(r"\s*(?:for |of |by )?(?:the |a |our |its )?"), "zh": re.compile(r"\s*的?\s*")}


def _belongs(sentence: Sentence, token: Token, end: int) -> bool:
    """Tell whether a person is named right after a number as its owner: "1.2 m/s of the walker"."""
    return token.start >= end and _OF[sentence.language].fullmatch(sentence.text, end, token.start) is not None


# From the first step to the last.
OVERALL = re.compile(
    r"\b(?:overall|altogether|in all|in total|between the first|(?:from|the) first (?:step )?to (?:the )?last)\b|总体|首末|首尾|首步到末步"
)
GOES_TO = re.compile(r"\b(?:to|at|back|up|down|in)\b|到|至|在")


def cues_of(sentence: Sentence, clause: Clause, numeral: Numeral, owner: str) -> list[Token]:
    """Give the quantity words that a number may belong to, nearest first, without those much farther off."""
    ranked = []
    for token in clause.of("quantity"):
        if not names_of(token.value, numeral.unit, owner) or (
            token.start >= numeral.start and token.end <= numeral.end - 3
        ):
            continue
        if token.value == "travelled" and GOES_TO.search(sentence.text[token.end : numeral.start]):
            continue
        cost = gap(token, numeral.start, numeral.end) + 25 * crossing(
            sentence, clause, token, numeral.start, numeral.end
        )
        ranked.append((max(cost, 0), token))
    ranked.sort(key=lambda pair: (pair[0], -len(pair[1].value)))
    reach = 5 if sentence.language == "en" else 2
    return [token for cost, token in ranked if cost <= ranked[0][0] + reach]


_AT_SOME_STEP = ("now", "last_step", "prev1", "prev2", "f1", "f2", "f3")


def tells_step(sentence: Sentence, clause: Clause) -> bool:
    """Tell whether a clause tells of one step: "in the final half second they fell back to 1.2 m/s"."""
    at = sentence.clauses.index(clause)
    near = [
        clause,
        *(c for c in sentence.clauses[max(0, at - 1) : at] if not c.numerals and len(c.tokens) == len(c.of("time"))),
    ]
    return any(c.has("time", *_AT_SOME_STEP) for c in near) and not clause.has("time", "mean", "window")


_STEPS = {
    "now": (NOW,),
    "prev1": (-2,),
    "prev2": (-3,),
    "f1": (1,),
    "f2": (2,),
    "f3": (3,),
    "start": (0, 1),
    "last_step": (NOW,),
}


def frames_of_time(value: str, step_s: float = 0.5) -> tuple[int, ...] | None:
    """Give the frames of a time word that means certain ones; None for one that does not."""
    if value in _STEPS:
        return _STEPS[value]
    if value[0] == "t" and value[1:].isdigit():
        return (int(value[1:]),)
    name, _, count = value.partition(":")
    if name == "ago":
        back = float(count) / step_s
        return (-1 - round(back),)
    if name == "back":
        return (-1 - int(count),)
    return None


def times_of(clause: Clause) -> list[tuple[Token, tuple[int, ...]]]:
    found = []
    for token in clause.of("time"):
        frames = frames_of_time(token.value)
        if frames is not None:
            found.append((token, frames))
    return found


WIDENING = ("some", "window", "past", "last_step", "last_second", "since", "until", "last", "last_s", "first")


def is_wide(clause: Clause) -> bool:
    """Tell whether a clause speaks of more than one moment."""
    return any(t.value.partition(":")[0] in WIDENING for t in clause.of("time"))
