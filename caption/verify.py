"""Phases 3-4 beside structure and verdict: is a text true to the window's measurements, and are its two languages one record?

Evidence: each clause is read for quantities (distance, speed, altitude, box, offset, yaw), numbers with units and opposites
(left/right, climb/descend, increase/decrease, visible/occluded), and compared with `Facts`. What cannot be tied to a
measurement is left alone: the check finds contradictions, it does not prove a text.
Mirror: same decision, compatible numbers, no opposite swapped.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

from caption.facts import Facts
from caption.glossary import Number, load_glossary
from caption.schema import EvidenceConfig
from cosfly.coc import Coc, Language

Series = Sequence[float | None]

# A comma between numbers is part of a list, a point before a digit part of a number.
_CLAUSES = re.compile(r"[;；。，！？!?\n]|,(?!\s*[-−\d])|\.(?!\d)")

# Keywords that say what a clause speaks of. One scan finds them all: the first alternative that fits at a place wins.
_WORDS: dict[str, re.Pattern[str]] = {
    language: re.compile("|".join(f"(?P<{name}>{pattern})" for name, pattern in words.items()), re.IGNORECASE)
    for language, words in (
        (
            "en",
            {
                "distance": r"\b(?:distance|gap|range|separation)\b",
                "horizontal": r"\bhorizontal",
                "altitude": r"\b(?:altitude|climb\w*|descend\w*|ascend\w*)\b",
                "target": r"\b(?:target|pedestrian|person|walk\w*|it|its)\b",
                "drone": r"\b(?:drone|uav)\b",
                "box": r"\bbox\b",
                "center": r"\b(?:cent(?:re|er)\w*|offset)\b",
                "yaw": r"\b(?:yaw|heading)\b",
                "pitch": r"\bpitch\b",
                "bend": r"\bbend\w*\b",
                "decision": r"\b(?:should|must|decision|next step|correct action|proper action)\b",
                "past": r"\b(?:was|were|earlier|previous\w*|before|briefly|first|had been)\b",
                "stable": r"\b(?:stable|steady|unchanged|constant)\b",
            },
        ),
        (
            "zh",
            {
                "distance": "距离|间距",
                "horizontal": "水平",
                "altitude": "高度|爬升|上升|下降",
                "target": "目标|行人|其",
                "drone": "无人机",
                "box": "边界框",
                "center": "中心|中央|居中",
                "yaw": "偏航|航向",
                "pitch": "俯仰",
                "bend": "转弯",
                "decision": "应|决策|下一步",
                "past": "曾|先前|之前|此前|早先|一度",
                "stable": "稳定|不变|恒定",
            },
        ),
    )
}
_FROM_TO: dict[Language, re.Pattern[str]] = {
    "en": re.compile(r"\bfrom\b.*\bto\b", re.IGNORECASE),
    "zh": re.compile("从.*(?:到|至)"),
}
_PAIR = re.compile(r"(\d+)\s*[x×]\s*(\d+)")


@dataclass(frozen=True)
class _Clause:
    """One clause with its numbers, opposites and keywords."""

    text: str
    numbers: tuple[Number, ...]
    poles: tuple[tuple[str, int, int], ...]
    words: frozenset[str]

    def has(self, name: str) -> bool:
        return name in self.words

    def sign(self, name: str) -> int:
        """+1 or -1 where the clause takes one side of an opposite, 0 where none or both."""
        signs = {sign for pair, sign, _ in self.poles if pair == name}
        return signs.pop() if len(signs) == 1 else 0


def _clauses(text: str, language: Language) -> list[_Clause]:
    return [_parse_clause(part, language) for part in _CLAUSES.split(text) if part and not part.isspace()]


@lru_cache(maxsize=8192)  # neighbouring windows and both checks share most clauses
def _parse_clause(text: str, language: Language) -> _Clause:
    glossary = load_glossary()
    numbers = glossary.numbers(text, language) if any(c.isdigit() for c in text) else []
    words = {str(match.lastgroup) for match in _WORDS[language].finditer(text)}
    if len(numbers) > 1 and _FROM_TO[language].search(text):
        words.add("from_to")
    return _Clause(text.strip(), tuple(numbers), tuple(glossary.poles(text, language)), frozenset(words))


# --- evidence ---------------------------------------------------------------------------------------------------------


def check_evidence(coc: Coc, facts: Facts, cfg: EvidenceConfig, language: Language) -> list[str]:
    """Give the contradictions between a text and the measurements, each as "kind: clause"; empty where none was found."""
    found = []
    for text in (coc.critical_components, coc.reasoning_trace):
        for clause in _clauses(text, language):
            kinds = _clause_problems(clause, facts, cfg, coc.flight_decision)
            found += [f"{kind}: {clause.text[:120]}" for kind in kinds]
    return found


def _clause_problems(clause: _Clause, facts: Facts, cfg: EvidenceConfig, decision: str) -> list[str]:
    if not clause.numbers and not clause.poles and not clause.has("stable"):
        return []
    if clause.has("decision"):
        return ["decision"] if _decision_differs(clause, decision) else []
    series = _quantities(clause, facts)
    problems = []
    if any(not _number_holds(number, series, cfg) for number in clause.numbers):
        problems.append("number")
    if _pair_differs(clause, facts, cfg):
        problems.append("box")
    if _trend_differs(clause, series, facts):
        problems.append("trend")
    if _side_differs(clause, facts):
        problems.append("side")
    if _visibility_differs(clause, facts):
        problems.append("visibility")
    return problems


_DECISION_POLES = {
    "left": ("side", 1), "right": ("side", -1), "ascend": ("vertical", 1), "descend": ("vertical", -1),
    "speed_up": ("pace", 1), "slow_down": ("pace", -1),
}  # fmt: skip


def _decision_differs(clause: _Clause, decision: str) -> bool:
    """Tell whether a clause that states the decision names the opposite of it."""
    for word, (pair, sign) in _DECISION_POLES.items():
        if word in decision:
            return clause.sign(pair) == -sign
    return False


def _quantities(clause: _Clause, f: Facts) -> dict[str, list[Series]]:
    """Give, per unit, the measured series that a number of this clause may come from."""
    target = clause.has("target")
    speed: list[Series] = [(f.target_speed_mps,)] if target else []
    if clause.has("drone") or not target:
        speed.append(f.speed_mps)
    length: list[Series] = []
    if clause.has("distance"):
        length += [f.distance_m] if clause.has("horizontal") else [f.distance_m, f.slant_m]
    if clause.has("altitude"):
        length.append(f.altitude_m)
    pixels: list[Series] = []
    if clause.has("box"):
        pixels += [f.box_width_px, f.box_height_px]
    if clause.has("center"):
        pixels += [f.offset_x_px, f.offset_y_px]
    angle: list[Series] = []
    if clause.has("yaw"):
        angle.append(f.yaw_deg)
    if clause.has("pitch"):
        angle.append(f.pitch_deg)
    return {
        "mps": speed,
        "m": length or [f.distance_m, f.slant_m, f.altitude_m],
        "px": pixels or [f.box_width_px, f.box_height_px, f.offset_x_px, f.offset_y_px],
        "deg": angle or [f.yaw_deg, f.pitch_deg, (f.target_turn_deg,)],
    }


def _number_holds(number: Number, series: dict[str, list[Series]], cfg: EvidenceConfig) -> bool:
    """Tell whether a number is a measured value or the difference of two of one series; without such a series it holds."""
    if number.unit not in series:
        return True
    tolerance = {"m": cfg.tolerance_m, "mps": cfg.tolerance_mps, "deg": cfg.tolerance_deg, "px": cfg.tolerance_px}
    slack = tolerance[number.unit] + 0.5 * 10.0**-number.digits
    claimed = abs(number.value)
    any_known = False
    for values in series[number.unit]:
        known = [value for value in values if value is not None]
        any_known = any_known or bool(known)
        if any(abs(claimed - abs(v)) <= max(slack, cfg.relative * abs(v)) for v in known):
            return True
        if any(abs(claimed - abs(a - b)) <= 0.5 * 10.0**-number.digits + 1e-9 for a in known for b in known):
            return claimed > 0
    return not any_known


def _pair_differs(clause: _Clause, f: Facts, cfg: EvidenceConfig) -> bool:
    """Check "w x h px" as width and height of one and the same frame's box."""
    if not clause.has("box"):
        return False
    sizes = [(w, h) for w, h in zip(f.box_width_px, f.box_height_px, strict=True) if w is not None and h is not None]
    slack = cfg.tolerance_px
    return bool(sizes) and not all(
        any(abs(int(w) - bw) <= slack and abs(int(h) - bh) <= slack for bw, bh in sizes)
        for w, h in _PAIR.findall(clause.text)
    )


def _trend_differs(clause: _Clause, series: dict[str, list[Series]], f: Facts) -> bool:
    numbers = [n for n in clause.numbers if n.unit]
    comparison = clause.sign("comparison")
    if comparison and len(numbers) == 2 and numbers[0].unit == numbers[1].unit:
        return comparison * (numbers[0].value - numbers[1].value) < 0
    subject = _trend_subject(clause, series, f)
    if subject is None:
        return False
    known = [v for v in subject if v is not None]
    if len(known) < 2:
        return False
    sign = clause.sign("vertical") if subject is f.altitude_m and clause.sign("vertical") else clause.sign("trend")
    if clause.has("from_to") and len(numbers) in (2, 4) and len({n.unit for n in numbers}) == 1:
        first, last = numbers[len(numbers) // 2 - 1].value, numbers[-1].value
        if sign:
            return sign * (last - first) < 0 or (last == first and known[-1] != known[0])
        return False
    if sign:
        # A trend may be the window's or the last step's; it is wrong where neither goes its way.
        return sign * (known[-1] - known[0]) <= 0 and sign * (known[-1] - known[-2]) <= 0
    if clause.has("stable") and not clause.has("past"):
        recent = known[-3:]
        allowed = {"speed": 0.5, "yaw": 3.0}.get(_subject_name(subject, f), max(1.0, 0.1 * abs(recent[-1])))
        return max(recent) - min(recent) > allowed
    return False


def _subject_name(subject: Series, f: Facts) -> str:
    return "speed" if subject is f.speed_mps else "yaw" if subject is f.yaw_deg else "length"


def _trend_subject(clause: _Clause, series: dict[str, list[Series]], f: Facts) -> Series | None:
    """Give the one series that a trend word of this clause speaks of, None where that is not plain."""
    candidates: list[Series] = []
    if clause.has("distance"):
        candidates.append(f.distance_m)
    if clause.has("altitude"):
        candidates.append(f.altitude_m)
    if clause.has("box"):
        candidates.append(f.box_height_px)
    if clause.has("yaw"):
        candidates.append(f.yaw_deg)
    if any(number.unit == "mps" for number in clause.numbers) and not clause.has("target"):
        candidates.append(f.speed_mps)
    return candidates[0] if len(candidates) == 1 else None


def _side_differs(clause: _Clause, f: Facts) -> bool:
    sign = clause.sign("side")  # +1 left
    if not sign or clause.has("past"):
        return False
    if clause.has("center"):
        dx = f.offset_x_px[-1]
        return dx is not None and abs(dx) >= 2 and sign * dx > 0
    if clause.has("yaw"):
        turned = [n.value for n in clause.numbers if n.unit == "deg"]
        if len(turned) == 1:  # "12.9 deg to the left": the yaw of that size must lie on that side
            sized = [v for v in f.yaw_deg if abs(abs(v) - abs(turned[0])) < 0.1]
            return bool(sized) and not any(sign * v >= 0 for v in sized)
        recent = f.yaw_deg[-1] - f.yaw_deg[-2]
        return sign * f.yaw_deg[-1] < 0 and sign * recent <= 0
    if clause.has("bend") and not clause.has("drone"):
        return f.target_turn_deg is not None and sign * f.target_turn_deg < 0
    return False


def _visibility_differs(clause: _Clause, f: Facts) -> bool:
    if clause.has("past") or not clause.has("target"):
        return False
    sign = clause.sign("visibility")
    now = f.visibility[-1]
    if sign > 0:
        return not f.is_visible_now
    return sign < 0 and now == "visible"


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
    en = _clauses(f"{english.critical_components}\n{english.reasoning_trace}", "en")
    zh = _clauses(f"{chinese.critical_components}\n{chinese.reasoning_trace}", "zh")
    numbers_en, numbers_zh = [n for c in en for n in c.numbers], [n for c in zh for n in c.numbers]
    for ours, theirs in ((numbers_en, numbers_zh), (numbers_zh, numbers_en)):
        for number in ours:
            if not _is_shared(number, theirs, flight):
                return "number"
    counts_en, counts_zh = _pole_counts(en), _pole_counts(zh)
    for pair in sorted({name for name, _ in counts_en.keys() | counts_zh.keys()}):
        for sign in (1, -1):
            lost = counts_zh[pair, sign] < counts_en[pair, sign]
            gained = counts_zh[pair, -sign] > counts_en[pair, -sign]
            if lost and gained:
                return f"polarity_{pair}"
    return None


def _pole_counts(clauses: list[_Clause]) -> Counter[tuple[str, int]]:
    return Counter((name, sign) for clause in clauses for name, sign, _ in clause.poles)


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
