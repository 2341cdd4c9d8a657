"""Checks that the two languages of a caption say the same.

`check_mirror` is for any pair of texts: same decision, each in its own script, compatible numbers, no opposite swapped.
`check_translation` is for a text that was asked for as a translation: same sentences, and the glossary's terms.
"""

from collections.abc import Sequence
from itertools import product

from caption.verification.facts import Facts, Series
from caption.verification.glossary import swapped_opposite, terms_in
from caption.verification.numerals import Numeral, read_numerals
from cosfly.formats.captions import Coc, Language
from cosfly.llm.answer_text import cut_sentences, is_in_script

TEXTS = ("critical_components", "reasoning_trace")


def check_mirror(english: Coc, chinese: Coc, facts: Facts) -> str | None:
    """Compare two languages of one sample; return the reason of a mismatch, None where they agree. Each number of one
    language must occur in the other, in the measured series, or be a difference of two such numbers of its unit."""
    if english.flight_decision != chinese.flight_decision:
        return "decision"
    texts_en, texts_zh = _texts(english), _texts(chinese)
    parts: dict[Language, list[str]] = {"en": texts_en, "zh": texts_zh}
    if not all(
        is_in_script(part, name) for name, texts in parts.items() for text in texts for part in cut_sentences(text)
    ):
        return "script"
    numbers_en, numbers_zh = _numbers(texts_en, "en"), _numbers(texts_zh, "zh")
    series = _measured_series(facts)
    for numbers, others in ((numbers_en, numbers_zh), (numbers_zh, numbers_en)):
        if not all(_is_shared(number, others, series) for number in numbers):
            return "number"
    swapped = swapped_opposite("".join(texts_en), "".join(texts_zh))
    return f"polarity_{swapped}" if swapped else None


def _texts(coc: Coc) -> list[str]:
    return [coc.critical_components, coc.reasoning_trace]


def _measured_series(f: Facts) -> dict[str, list[Series]]:
    """Return the series of a window in which a number of each unit may stand."""
    return {
        "mps": [f.speed_mps, f.step_speeds_mps, f.target_speeds_mps, (f.target_speed_mps,)],
        "m": [f.altitude_m, f.distance_m, f.slant_m],
        "deg": [f.yaw_deg, f.pitch_deg, (f.target_turn_deg,)],
        "px": [f.box_width_px, f.box_height_px, f.offset_x_px, f.offset_y_px],
    }


def _numbers(texts: Sequence[str], language: Language) -> list[Numeral]:
    """Return the numbers of texts without durations and factors."""
    numerals = (numeral for text in texts for numeral in read_numerals(text, language))
    return [numeral for numeral in numerals if numeral.unit not in ("s", "times")]


def _is_shared(number: Numeral, others: Sequence[Numeral], measured: dict[str, list[Series]]) -> bool:
    """Return whether a number is in the other language or measured, or the difference of two such numbers."""
    if not number.unit and number.digits == 0 and number.value < 10:
        return True  # a count ("5 frames"), which the other language may write as a word
    candidates: list[Series] = [[other.value for other in others if not number.unit or other.unit in ("", number.unit)]]
    for unit, all_series in measured.items():
        if number.unit in ("", unit):
            candidates += all_series
    rounding = 0.5 * 10.0**-number.digits + 1e-9
    for series in candidates:
        known = [abs(value) for value in series if value is not None]
        if any(abs(number.value - value) < 1e-9 for value in known):
            return True
        if number.value > 0 and any(abs(number.value - (a - b)) < rounding for a, b in product(known, known)):
            return True
    return False


def check_translation(english: Coc, chinese: Coc) -> tuple[str, str] | None:
    """Compare a translation with its source; return the reason and what is missing, None where they agree."""
    for name in TEXTS:
        count_en = len(cut_sentences(getattr(english, name)))
        count_zh = len(cut_sentences(getattr(chinese, name)))
        if count_en != count_zh:
            counts = f"{count_en} sentences in English and {count_zh} in Chinese"
            return "sentences", f"{name} has {counts}; write one for each"
    missing = lacking(" ".join(_texts(english)), chinese)
    return ("glossary", missing) if missing else None


def lacking(english: str, chinese: Coc) -> str:
    """Name the terms of an English text, with their translations, that the Chinese lacks; "" where none."""
    text = "\n".join(_texts(chinese))
    return "; ".join(f'write "{zh}" for "{en}"' for en, zh in terms_in(english).items() if zh not in text)
