"""Are the two languages of a caption one record?

`check_mirror` holds for any pair of texts: same decision, each in its own script, compatible numbers, no opposite
swapped. A text that was asked for as a translation must also have the same sentences and the glossary's terms
(`check_translation`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from caption.verification.facts import Facts, Series
from caption.verification.glossary import load_glossary
from caption.verification.numerals import Numeral, read_numerals
from caption.verification.vocabulary import terms_in
from cosfly.formats.captions import Coc, Language
from cosfly.llm.answer_text import cut_sentences, is_in_script

TEXTS = ("critical_components", "reasoning_trace")


def check_script(coc: Coc, language: Language) -> bool:
    """Return whether every sentence of both texts is written in its language."""
    return all(is_in_script(part, language) for name in TEXTS for part in cut_sentences(getattr(coc, name)))


def track_numbers(facts: Facts) -> dict[str, list[Series]]:
    """Return the window's measured series per unit."""
    return {
        "mps": [facts.speed_mps, facts.step_speeds_mps, facts.target_speeds_mps, (facts.target_speed_mps,)],
        "m": [facts.altitude_m, facts.distance_m, facts.slant_m],
        "deg": [facts.yaw_deg, facts.pitch_deg, (facts.target_turn_deg,)],
        "px": [facts.box_width_px, facts.box_height_px, facts.offset_x_px, facts.offset_y_px],
    }


def check_mirror(english: Coc, chinese: Coc, measured: dict[str, list[Series]]) -> str | None:
    """Compare two languages of one sample; return the reason of a mismatch, None where they agree.

    Each number of one language must occur in the other, in the measured series, or be a difference of two such numbers
    of the same unit. An opposite is swapped where one of its sides is lost and the other one gained in the translation.

    Args:
        measured: the window's numbers (`track_numbers`).
    """
    if english.flight_decision != chinese.flight_decision:
        return "decision"
    if not (check_script(english, "en") and check_script(chinese, "zh")):
        return "script"
    numbers_en, numbers_zh = _numbers(english, "en"), _numbers(chinese, "zh")
    for numbers, others in ((numbers_en, numbers_zh), (numbers_zh, numbers_en)):
        if any(not _is_shared(number, others, measured) for number in numbers):
            return "number"
    texts = ["".join(getattr(coc, name) for name in TEXTS) for coc in (english, chinese)]
    swapped = load_glossary().swapped(*texts)
    return f"polarity_{swapped}" if swapped else None


def _numbers(coc: Coc, language: Language) -> list[Numeral]:
    """Return the numbers in digits, durations aside; the other language may write one in words."""
    found = (numeral for name in TEXTS for numeral in read_numerals(getattr(coc, name), language))
    return [numeral for numeral in found if numeral.is_in_digits and numeral.unit not in ("s", "times")]


def _is_shared(number: Numeral, others: Sequence[Numeral], measured: dict[str, list[Series]]) -> bool:
    """Return whether a number stands in the other language, or is measured or a difference of two such numbers."""
    same_unit = [other.value for other in others if not number.unit or other.unit in ("", number.unit)]
    if number.value in same_unit or (not number.unit and number.digits == 0 and number.value < 10):
        return True  # the latter is a count ("5 frames"), which the other language may write as a word
    pools: list[Iterable[float | None]] = [same_unit]
    for unit, series in measured.items():
        if number.unit in ("", unit):
            pools += series
    step = 0.5 * 10.0**-number.digits + 1e-9
    for pool in pools:
        known = [abs(value) for value in pool if value is not None]
        if any(abs(number.value - value) < 1e-9 for value in known):
            return True
        if number.value > 0 and any(abs(number.value - (a - b)) < step for a in known for b in known):
            return True
    return False


def check_translation(english: Coc, chinese: Coc) -> tuple[str, str] | None:
    """Compare a translation with its source; return the reason and what is missing, None where they agree."""
    for name in TEXTS:
        count_en, count_zh = (len(cut_sentences(getattr(coc, name))) for coc in (english, chinese))
        if count_en != count_zh:
            return (
                "sentences",
                f"{name} has {count_en} sentences in English and {count_zh} in Chinese; write one for each",
            )
    text = " ".join(getattr(english, name) for name in TEXTS)
    missing = lacking(terms_in(text), chinese)
    return ("glossary", missing) if missing else None


def lacking(terms: Iterable[tuple[str, str]], chinese: Coc) -> str:
    """Name those of some terms, with their translations, that Chinese texts lack; "" where none."""
    text = "\n".join(getattr(chinese, name) for name in TEXTS)
    return "; ".join(f'write "{zh}" for "{en}"' for en, zh in terms if zh not in text)
