"""Are the two languages of a caption one record?

`check_mirror` holds for any pair of texts: same decision, each in its own script, compatible numbers, no opposite
swapped. What was asked for as a translation must also have the same sentences and the glossary's terms
(`check_translation`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from caption.verification.facts import Facts
from caption.verification.glossary import load_glossary
from caption.verification.numerals import Numeral, read_numerals
from caption.verification.references import Series
from caption.verification.vocabulary import terms_in
from cosfly.formats.captions import Coc, Language
from cosfly.llm.answer_text import cut_sentences, is_in_script

TEXTS = ("critical_components", "reasoning_trace")


def check_script(coc: Coc, language: Language) -> bool:
    """Return whether every sentence of both texts is written in its language."""
    return all(is_in_script(part, language) for name in TEXTS for part in cut_sentences(getattr(coc, name)))


def flight_numbers(facts: Facts) -> dict[str, list[Series]]:
    """Return the window's flight data per unit, as the prompt prints it."""
    return {
        "mps": [(0.0, *facts.speed_mps[1:]), (facts.target_speed_mps,)],
        "m": [facts.altitude_m, facts.distance_m, facts.slant_m],
        "deg": [facts.yaw_deg, facts.pitch_deg, (facts.target_turn_deg,)],
        "px": [facts.box_width_px, facts.box_height_px, facts.offset_x_px, facts.offset_y_px],
    }


def check_mirror(english: Coc, chinese: Coc, flight: dict[str, list[Series]]) -> str | None:
    """Compare two languages of one sample; gives the reason of a mismatch, None where they agree.

    Each number of one language must occur in the other, in the flight data, or be a difference of two such numbers of
    the same unit. An opposite is flipped where one of its sides is lost and the other one gained in the translation.

    Args:
        flight: the window's numbers (`flight_numbers`).
    """
    if english.flight_decision != chinese.flight_decision:
        return "decision"
    if not (check_script(english, "en") and check_script(chinese, "zh")):
        return "script"
    numbers_en, numbers_zh = _numbers(english, "en"), _numbers(chinese, "zh")
    for ours, theirs in ((numbers_en, numbers_zh), (numbers_zh, numbers_en)):
        sizes = {(number.unit, abs(number.value)) for number in theirs}
        for number in ours:
            if (number.unit, abs(number.value)) not in sizes and not _is_shared(number, theirs, flight):
                return "number"
    counts_en, counts_zh = _pole_counts(english, "en"), _pole_counts(chinese, "zh")
    for pair in sorted({name for name, _ in counts_en.keys() | counts_zh.keys()}):
        for sign in (1, -1):
            lost = counts_zh[pair, sign] < counts_en[pair, sign]
            gained = counts_zh[pair, -sign] > counts_en[pair, -sign]
            if lost and gained:
                return f"polarity_{pair}"
    return None


def _numbers(coc: Coc, language: Language) -> list[Numeral]:
    """Return the numbers in digits; the other language may write one in words otherwise."""
    found = (numeral for name in TEXTS for numeral in read_numerals(getattr(coc, name), language))
    return [numeral for numeral in found if numeral.kind == "number" and any(map(str.isdigit, numeral.text))]


def _pole_counts(coc: Coc, language: Language) -> Counter[tuple[str, int]]:
    poles = (pole for name in TEXTS for pole in load_glossary().poles(getattr(coc, name), language))
    return Counter((pair, sign) for pair, sign, _ in poles)


def _is_shared(number: Numeral, theirs: list[Numeral], flight: dict[str, list[Series]]) -> bool:
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


def check_translation(english: Coc, chinese: Coc) -> tuple[str, str] | None:
    """Compare a translation with what it was made of; gives reason and what is missing, None where they agree."""
    for name in TEXTS:
        ours, theirs = (len(cut_sentences(getattr(coc, name))) for coc in (english, chinese))
        if ours != theirs:
            return "sentences", f"{name} has {ours} sentences in English and {theirs} in Chinese; write one for each"
    text = " ".join(getattr(english, name) for name in TEXTS)
    missing = lacking(terms_in(text), chinese)
    return ("glossary", missing) if missing else None


def lacking(terms: Iterable[tuple[str, str]], chinese: Coc) -> str:
    """Name those of some terms, with their translations, that Chinese texts lack; "" where none."""
    text = "\n".join(getattr(chinese, name) for name in TEXTS)
    missing = [(en, zh) for en, zh in terms if zh not in text]
    return "; ".join(f'write "{zh}" for "{en}"' for en, zh in missing)
