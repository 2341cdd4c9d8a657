"""Phases 3-4 beside structure and verdict: is a text true to the window's measurements, and are its two languages one record?

Evidence: each clause is read for quantities (distance, speed, altitude, box, offset, yaw), numbers with units and opposites
(left/right, climb/descend, increase/decrease, visible/occluded), and compared with `Facts`. What cannot be tied to a
measurement is left alone: the check finds contradictions, it does not prove a text.
Mirror: same decision, compatible numbers, no opposite swapped.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from caption.schema import EvidenceConfig
from caption.truth.facts import Facts
from caption.truth.glossary import LANGUAGES, Number, load_glossary
from cosfly.products.captions import Coc, Language

Series = Sequence[float | None]

# A comma between numbers is part of a list, a point before a digit part of a number.
_CLAUSES = re.compile(r"[;；。，！？!?\n]|,(?!\s*[-−\d])|\.(?!\d)")

# Keywords that say what a clause speaks of. One scan finds them all: the first alternative that fits at a place wins.
_KEYWORDS: dict[str, dict[Language, str]] = {
    "distance": {"en": r"\b(?:distance|gap|range|separation)\b", "zh": "距离|间距"},
    "horizontal": {"en": r"\bhorizontal", "zh": "水平"},
    "altitude": {"en": r"\b(?:altitude|climb\w*|descend\w*|ascend\w*)\b", "zh": "高度|爬升|上升|下降"},
    "target": {"en": r"\b(?:target|pedestrian|person|walk\w*|it|its)\b", "zh": "目标|行人|其"},
    "drone": {"en": r"\b(?:drone|uav)\b", "zh": "无人机"},
    "box": {"en": r"\bbox\b", "zh": "边界框"},
    "center": {"en": r"\b(?:cent(?:re|er)\w*|offset)\b", "zh": "中心|中央|居中"},
    "yaw": {"en": r"\b(?:yaw|heading)\b", "zh": "偏航|航向"},
    "pitch": {"en": r"\bpitch\b", "zh": "俯仰"},
    "bend": {"en": r"\bbend\w*\b", "zh": "转弯"},
    "decision": {
        "en": r"\b(?:should|must|decision|next step|correct action|proper action)\b",
        "zh": "应|决策|下一步",
    },
    "past": {
        "en": r"\b(?:was|were|earlier|previous\w*|before|briefly|first|had been)\b",
        "zh": "曾|先前|之前|此前|早先|一度",
    },
    "stable": {"en": r"\b(?:stable|steady|unchanged|constant)\b", "zh": "稳定|不变|恒定"},
}
_WORDS: dict[Language, re.Pattern[str]] = {
    language: re.compile("|".join(f"(?P<{name}>{words[language]})" for name, words in _KEYWORDS.items()), re.IGNORECASE)
    for language in LANGUAGES
}
_FROM_TO: dict[Language, re.Pattern[str]] = {
    "en": re.compile(r"\bfrom\b.*\bto\b", re.IGNORECASE),
    "zh": re.compile("从.*(?:到|至)"),
}
_PAIR = re.compile(r"(\d+)\s*[x×]\s*(\d+)")


@dataclass(frozen=True, slots=True)
class _Form:
    """What a clause says, its digits aside: most clauses of a data set differ from others in their numbers only.

    numbers: with the digit runs they are made of instead of a value. sign: +1 or -1 where the clause takes one side of an
    opposite; an opposite of which it takes none or both is not in it. sources: unit -> series that a number may come from.
    """

    numbers: tuple[_NumberForm, ...]
    poles: tuple[tuple[str, int], ...]
    words: frozenset[str]
    sign: dict[str, int]
    sources: dict[str, tuple[str, ...]]
    trend_of: str | None
    may_trend: bool
    is_silent: bool  # nothing in it can be compared with a measurement


@dataclass(frozen=True, slots=True)
class _NumberForm:
    unit: str
    is_negative: bool
    whole: int  # index of the run of digits before the point
    fraction: int | None  # and of the one after it


class _Clause(NamedTuple):
    text: str
    form: _Form
    numbers: list[Number]


_DIGITS = re.compile(r"\d+")


@lru_cache(maxsize=64)  # both checks read a text
def _clauses(text: str, language: Language) -> tuple[_Clause, ...]:
    return tuple([_read_clause(part, language) for part in _CLAUSES.split(text) if part and not part.isspace()])


@lru_cache(maxsize=4096)  # neighbouring windows share most clauses
def _read_clause(text: str, language: Language) -> _Clause:
    runs = _DIGITS.findall(text)
    if not runs:
        return _Clause(text, _read_form(text, language), [])
    form = _read_form(_DIGITS.sub("0", text), language)
    return _Clause(text, form, [_number(number, runs) for number in form.numbers])


def _number(form: _NumberForm, runs: list[str]) -> Number:
    digits = runs[form.whole]
    places = 0
    if form.fraction is not None:
        places = len(runs[form.fraction])
        digits = f"{digits}.{runs[form.fraction]}"
    return Number(-float(digits) if form.is_negative else float(digits), form.unit, places, form.whole)


@lru_cache(maxsize=65536)
def _read_form(text: str, language: Language) -> _Form:
    """Read a clause in which every run of digits is written as one "0"."""
    glossary = load_glossary()
    found = glossary.numbers(text, language) if "0" in text else []
    numbers = []
    for number in found:
        whole = text.count("0", 0, number.start)
        is_negative = text[number.start] in "-−"
        numbers.append(_NumberForm(number.unit, is_negative, whole, whole + 1 if number.digits else None))
    words = {str(match.lastgroup) for match in _WORDS[language].finditer(text)}
    if len(numbers) > 1 and _FROM_TO[language].search(text):
        words.add("from_to")
    poles = tuple((name, sign) for name, sign, _ in glossary.poles(text, language))
    sides: dict[str, set[int]] = {}
    for name, sign in poles:
        sides.setdefault(name, set()).add(sign)
    taken = {name: min(signs) for name, signs in sides.items() if len(signs) == 1}
    return _Form(
        numbers=tuple(numbers),
        poles=poles,
        words=frozenset(words),
        sign=taken,
        sources=_sources(words),
        trend_of=_trend_subject(words, {number.unit for number in numbers}),
        may_trend="stable" in words or not taken.keys().isdisjoint(("comparison", "trend", "vertical")),
        is_silent=not numbers and not poles and "stable" not in words,
    )


# --- evidence ---------------------------------------------------------------------------------------------------------


def check_evidence(coc: Coc, facts: Facts, cfg: EvidenceConfig, language: Language) -> list[str]:
    """Give the contradictions between a text and the measurements, each as "kind: clause"; empty where none was found."""
    found = []
    for text in (coc.critical_components, coc.reasoning_trace):
        for clause in _clauses(text, language):
            if not clause.form.is_silent:
                kinds = _clause_problems(clause, facts, cfg, coc.flight_decision)
                found += [f"{kind}: {clause.text.strip()[:120]}" for kind in kinds]
    return found


def _clause_problems(clause: _Clause, facts: Facts, cfg: EvidenceConfig, decision: str) -> list[str]:
    form = clause.form
    if "decision" in form.words:
        return ["decision"] if _decision_differs(form, decision) else []
    problems = []
    sizes = facts.sizes
    for number in clause.numbers:
        sources = form.sources.get(number.unit, ())
        claimed = abs(number.value)
        for name in sources:  # most numbers are copied: look before computing
            if claimed in sizes[name]:
                break
        else:
            if sources and not _number_holds(number, sources, facts, cfg):
                problems.append("number")
                break
    if "box" in form.words and clause.numbers and _pair_differs(clause, facts, cfg):
        problems.append("box")
    if form.may_trend and _trend_differs(clause, facts):
        problems.append("trend")
    if "side" in form.sign and _side_differs(clause, facts):
        problems.append("side")
    if "visibility" in form.sign and _visibility_differs(form, facts):
        problems.append("visibility")
    return problems


_DECISION_POLES = {
    "left": ("side", 1), "right": ("side", -1), "ascend": ("vertical", 1), "descend": ("vertical", -1),
    "speed_up": ("pace", 1), "slow_down": ("pace", -1),
}  # fmt: skip


def _decision_differs(form: _Form, decision: str) -> bool:
    """Tell whether a clause that states the decision names the opposite of it."""
    for word, (pair, sign) in _DECISION_POLES.items():
        if word in decision:
            return form.sign.get(pair) == -sign
    return False


def _sources(words: set[str]) -> dict[str, tuple[str, ...]]:
    """Give, per unit, the measured series that a number of a clause with these keywords may come from."""
    speed = ["target_speed_mps"] if "target" in words else []
    if "drone" in words or "target" not in words:
        speed.append("speed_mps")
    length: list[str] = []
    if "distance" in words:
        length += ["distance_m"] if "horizontal" in words else ["distance_m", "slant_m"]
    if "altitude" in words:
        length.append("altitude_m")
    pixels: list[str] = []
    if "box" in words:
        pixels += ["box_width_px", "box_height_px"]
    if "center" in words:
        pixels += ["offset_x_px", "offset_y_px"]
    angle = [f"{name}_deg" for name in ("yaw", "pitch") if name in words]
    return {
        "mps": tuple(speed),
        "m": tuple(length or ["distance_m", "slant_m", "altitude_m"]),
        "px": tuple(pixels or ["box_width_px", "box_height_px", "offset_x_px", "offset_y_px"]),
        "deg": tuple(angle or ["yaw_deg", "pitch_deg", "target_turn_deg"]),
    }


def _number_holds(number: Number, sources: tuple[str, ...], facts: Facts, cfg: EvidenceConfig) -> bool:
    """Tell whether a number is a measured value or the difference of two of one series; without such a series it holds."""
    claimed = abs(number.value)
    tolerance = {"m": cfg.tolerance_m, "mps": cfg.tolerance_mps, "deg": cfg.tolerance_deg, "px": cfg.tolerance_px}
    step = 0.5 * 10.0**-number.digits
    slack = tolerance[number.unit] + step
    any_known = False
    for name in sources:
        known = [value for value in facts.series(name) if value is not None]
        any_known = any_known or bool(known)
        if any(abs(claimed - abs(v)) <= max(slack, cfg.relative * abs(v)) for v in known):
            return True
        if any(abs(claimed - abs(a - b)) <= step + 1e-9 for a in known for b in known):
            return claimed > 0
    return not any_known


def _pair_differs(clause: _Clause, f: Facts, cfg: EvidenceConfig) -> bool:
    """Check "w x h px" as width and height of one and the same frame's box."""
    sizes = [(w, h) for w, h in zip(f.box_width_px, f.box_height_px, strict=True) if w is not None and h is not None]
    slack = cfg.tolerance_px
    return bool(sizes) and not all(
        any(abs(int(w) - bw) <= slack and abs(int(h) - bh) <= slack for bw, bh in sizes)
        for w, h in _PAIR.findall(clause.text)
    )


def _trend_differs(clause: _Clause, f: Facts) -> bool:
    form = clause.form
    numbers = [n for n in clause.numbers if n.unit]
    comparison = form.sign.get("comparison")
    if comparison and len(numbers) == 2 and numbers[0].unit == numbers[1].unit:
        return comparison * (numbers[0].value - numbers[1].value) < 0
    if form.trend_of is None:
        return False
    known = [v for v in f.series(form.trend_of) if v is not None]
    if len(known) < 2:
        return False
    sign = form.sign.get("trend", 0)
    if form.trend_of == "altitude_m":
        sign = form.sign.get("vertical", sign)
    if "from_to" in form.words and len(numbers) in (2, 4) and len({n.unit for n in numbers}) == 1:
        first, last = numbers[len(numbers) // 2 - 1].value, numbers[-1].value
        if sign:
            return sign * (last - first) < 0 or (last == first and known[-1] != known[0])
        return False
    if sign:
        # A trend may be the window's or the last step's; it is wrong where neither goes its way.
        return sign * (known[-1] - known[0]) <= 0 and sign * (known[-1] - known[-2]) <= 0
    if "stable" in form.words and "past" not in form.words:
        recent = known[-3:]
        allowed = _STABLE.get(form.trend_of, max(1.0, 0.1 * abs(recent[-1])))
        return max(recent) - min(recent) > allowed
    return False


_STABLE = {"speed_mps": 0.5, "yaw_deg": 3.0}  # widest spread of "stable"; other series: a tenth of the value


def _trend_subject(words: set[str], units: set[str]) -> str | None:
    """Give the one series that a trend word of a clause speaks of, None where that is not plain."""
    pairs = {"distance": "distance_m", "altitude": "altitude_m", "box": "box_height_px", "yaw": "yaw_deg"}
    candidates = [series for word, series in pairs.items() if word in words]
    if "mps" in units and "target" not in words:
        candidates.append("speed_mps")
    return candidates[0] if len(candidates) == 1 else None


def _side_differs(clause: _Clause, f: Facts) -> bool:
    sign, words = clause.form.sign["side"], clause.form.words  # +1 left
    if "past" in words:
        return False
    if "center" in words:
        dx = f.offset_x_px[-1]
        return dx is not None and abs(dx) >= 2 and sign * dx > 0
    if "yaw" in words:
        turned = [n.value for n in clause.numbers if n.unit == "deg"]
        if len(turned) == 1:  # "12.9 deg to the left": the yaw of that size must lie on that side
            sized = [v for v in f.yaw_deg if abs(abs(v) - abs(turned[0])) < 0.1]
            return bool(sized) and not any(sign * v >= 0 for v in sized)
        recent = f.yaw_deg[-1] - f.yaw_deg[-2]
        return sign * f.yaw_deg[-1] < 0 and sign * recent <= 0
    if "bend" in words and "drone" not in words:
        return f.target_turn_deg is not None and sign * f.target_turn_deg < 0
    return False


def _visibility_differs(form: _Form, f: Facts) -> bool:
    if "past" in form.words or "target" not in form.words:
        return False
    if form.sign["visibility"] > 0:
        return not f.is_visible_now
    return f.visibility[-1] == "visible"


# --- the two languages ------------------------------------------------------------------------------------------------


def flight_numbers(facts: Facts) -> dict[str, list[Series]]:
    """Give the window's flight data per unit, as the prompt prints it."""
    return {
        "mps": [(0.0, *facts.speed_mps[1:]), (facts.target_speed_mps,)],
        "m": [facts.altitude_m, facts.distance_m, facts.slant_m],
        "deg": [facts.yaw_deg, facts.pitch_deg, (facts.target_turn_deg,)],
        "px": [facts.box_width_px, facts.box_height_px, facts.offset_x_px, facts.offset_y_px],
    }


def check_mirror(english: Coc, chinese: Coc, flight: dict[str, list[Series]]) -> str | None:
    """Compare the two languages of one sample; gives the reason of a mismatch, None where they agree.

    Each number of one language must occur in the other, in the flight data, or be a difference of two such numbers of the
    same unit. An opposite is flipped where one of its sides is lost and the other one gained in the translation.
    """
    if english.flight_decision != chinese.flight_decision:
        return "decision"
    en = (*_clauses(english.critical_components, "en"), *_clauses(english.reasoning_trace, "en"))
    zh = (*_clauses(chinese.critical_components, "zh"), *_clauses(chinese.reasoning_trace, "zh"))
    numbers_en, numbers_zh = [n for c in en for n in c.numbers], [n for c in zh for n in c.numbers]
    for ours, theirs in ((numbers_en, numbers_zh), (numbers_zh, numbers_en)):
        sizes = {(number.unit, abs(number.value)) for number in theirs}
        for number in ours:
            if (number.unit, abs(number.value)) not in sizes and not _is_shared(number, theirs, flight):
                return "number"
    counts_en, counts_zh = _pole_counts(en), _pole_counts(zh)
    if counts_en == counts_zh:
        return None
    for pair in sorted({name for name, _ in counts_en.keys() | counts_zh.keys()}):
        for sign in (1, -1):
            lost = counts_zh.get((pair, sign), 0) < counts_en.get((pair, sign), 0)
            gained = counts_zh.get((pair, -sign), 0) > counts_en.get((pair, -sign), 0)
            if lost and gained:
                return f"polarity_{pair}"
    return None


def _pole_counts(clauses: tuple[_Clause, ...]) -> dict[tuple[str, int], int]:
    counts: dict[tuple[str, int], int] = {}
    for clause in clauses:
        for pole in clause.form.poles:
            counts[pole] = counts.get(pole, 0) + 1
    return counts


def _is_shared(number: Number, theirs: list[Number], flight: dict[str, list[Series]]) -> bool:
    value = abs(number.value)
    if not number.unit and number.digits == 0 and value < 10:
        return True  # a count ("5 frames"), which the other language may write as a word
    same_unit = [abs(other.value) for other in theirs if not number.unit or other.unit in ("", number.unit)]
    if value in same_unit:
        return True
    pools: list[Iterable[float | None]] = [same_unit]
    for unit, series in flight.items():
        if number.unit in ("", unit):
            pools += series
    for pool in pools:
        known = [abs(v) for v in pool if v is not None]
        if any(abs(value - v) < 1e-9 for v in known):
            return True
        step = 0.5 * 10.0**-number.digits + 1e-9
        if value > 0 and any(abs(value - (a - b)) < step for a in known for b in known):
            return True
    return False
