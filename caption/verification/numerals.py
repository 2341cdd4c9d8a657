"""Numbers in running text, in digits and in words, with the units behind them, in English and Chinese."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

from caption.verification.glossary import Unit, stands_at, written_units
from cosfly.formats.captions import Language

_NO_UNIT = Unit("", 1.0)
_UNIT_GROUPS = ("unit", "half_of", "word_of")


@dataclass(frozen=True, slots=True)
class Numeral:
    """A number of a text in our units.

    Args:
        unit: a key of the glossary's units, "" where none stands behind the number.
        digits: after the point, as written. factor: from the unit that is written to ours.
        bound: 1 of "more than 20 m", -1 of "less than". is_about: written as approximate.
        start: position in the text. is_in_digits: not in words.
    """

    text: str
    value: float
    unit: str
    digits: int
    factor: float = 1.0
    bound: int = 0
    is_about: bool = False
    start: int = 0
    is_in_digits: bool = True

    @property
    def half(self) -> float:
        """Half a unit of the last digit, in our unit."""
        return 0.5 * 10.0**-self.digits * self.factor


# --- numbers in words -------------------------------------------------------------------------------------------------

_ONES = (
    "zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen "
    "seventeen eighteen nineteen"
)
_TENS = "twenty thirty forty fifty sixty seventy eighty ninety"
_SMALL = {word: number for number, word in enumerate(_ONES.split())}
_WORDS = {**_SMALL, **{word: 10 * number for number, word in enumerate(_TENS.split(), 2)}, "hundred": 100, "a": 1}
_ZH_DIGITS = {character: value for value, character in enumerate("零一二三四五六七八九")} | {"两": 2, "〇": 0}
_ONE = "|".join(sorted(_SMALL, key=len, reverse=True))
_TEN = rf"(?:{'|'.join(_TENS.split())})(?:[- ](?:{_ONE}))?"
_ENGLISH = rf"(?:{_TEN}|(?:{_ONE}|a) hundred(?: (?:and )?(?:{_TEN}|{_ONE}))?|{_ONE})(?: point(?: (?:{_ONE}))+)?"
_CHINESE = "[零〇一二两三四五六七八九十百]+(?:点[零〇一二两三四五六七八九]+)?"


def english_number(text: str) -> float:
    """Read a number in words: "twenty-one", "one point two", "a hundred and five"."""
    whole, _, fraction = text.lower().partition(" point ")
    value = 0.0
    for word in re.findall(r"[a-z]+", whole):
        value = value * 100 if word == "hundred" and value else value + _WORDS.get(word, 0)
    digits = "".join(str(_SMALL[word]) for word in fraction.split() if word in _SMALL)
    return value + (float(f"0.{digits}") if digits else 0.0)


def chinese_number(text: str) -> float:
    """Read a number in characters: 二十一, 一点二, 一百零五."""
    whole, _, fraction = text.partition("点")
    value = last = 0
    for character in whole:
        if character in "十百":
            value += (last or 1) * (10 if character == "十" else 100)
            last = 0
        else:
            last = _ZH_DIGITS[character]
    digits = "".join(str(_ZH_DIGITS[character]) for character in fraction)
    return value + last + (float(f"0.{digits}") if digits else 0.0)


# --- in a text --------------------------------------------------------------------------------------------------------

_HOURLY = re.compile(r"(?:时速|每小时)[^，。；]{0,4}$")
_SQUARED = re.compile(r"\s?(?:²|\^2|\*\*2|/s\b)")  # an acceleration
_DIGITS = r"(?:(?<![A-Za-z0-9_.])|(?<=\d[x×]))[-+−]?\d+(?:\.\d+)?(?!\d)"


@cache
def _pattern(language: Language) -> re.Pattern[str]:
    # A unit in letters ends where the word does: "3 m", but not "3 more".
    spellings = "|".join(re.escape(spelling) for spelling in sorted(written_units(language), key=len, reverse=True))
    unit, of_half, of_word = (f"(?P<{name}>{spellings})(?:(?<=[^A-Za-z])|(?![A-Za-z]))" for name in _UNIT_GROUPS)
    if language == "en":
        pattern = (
            rf"(?P<digits>{_DIGITS})(?:\s*[- ]?(?:{unit}))?|\bhalf an? (?:{of_half})"
            rf"|\b(?P<word>{_ENGLISH})(?P<and_half> and a half)?[- ]+(?:{of_word})"
        )
    else:
        pattern = (
            rf"(?P<digits>{_DIGITS})\s*个?(?:{unit})?(?P<and_half>半(?![秒步帧]))?|半个?(?:{of_half})"
            rf"|(?<![第这那数几上])(?!(?<![到约仅了近有])一度)(?P<word>{_CHINESE})个?(?:{of_word})(?P<word_half>半(?![秒步帧]))?"
        )
    return re.compile(pattern, re.IGNORECASE)


def read_numerals(text: str, language: Language) -> list[Numeral]:
    """Find the numbers of a text: those in digits, and those in words before a unit.

    A count without a unit ("5 frames", "two people") is none; a duration is one, in seconds.
    """
    units = written_units(language)
    found: list[Numeral] = []
    for match in _pattern(language).finditer(text):
        spelling = next((match[name] for name in _UNIT_GROUPS if match[name]), "")
        unit, factor = units.get(spelling.lower(), _NO_UNIT)
        before, after = text[: match.start()], text[match.end() :]
        if spelling in ("×", "x") and after.lstrip()[:1].isdigit():
            unit, factor = _NO_UNIT  # of a product, "34 × 59 px"
        if unit == "frames" or _SQUARED.match(after):
            continue
        if language == "zh" and unit in ("m", "deg") and "每秒" in re.split("[，；。：、,;:]", before)[-1]:
            unit = {"m": "mps", "deg": "dps"}[unit]
        if language == "zh" and (unit, factor) == ("m", 1000.0) and _HOURLY.search(before):  # 时速 26 公里
            unit, factor = "mps", 1 / 3.6
        number = _number_of(match, unit, language)
        if number is None:
            continue
        bounds = [bound for kind, bound in (("more", 1), ("less", -1)) if stands_at(kind, before, after, language)]
        found.append(Numeral(
            match.group().strip(), number[0] * factor, unit, number[1], factor, bound=bounds[0] if bounds else 0,
            is_about=stands_at("about", before, after, language), start=match.start(),
            is_in_digits=match["digits"] is not None,
        ))  # fmt: skip
    return found


def _number_of(match: re.Match[str], unit: str, language: Language) -> tuple[float, int] | None:
    """Return the value and its digits after the point; None of a count, and of "every metre", 一米."""
    groups = {name: text for name, text in match.groupdict().items() if text is not None}
    half = 0.5 if {"and_half", "word_half"} & groups.keys() else 0.0
    if "digits" in groups:
        written = groups["digits"].replace("−", "-")
        digits = len(written.partition(".")[2])
        value = abs(float(written)) + half
        is_count = not unit and digits == 0 and value < 10 and not half and written[0] not in "+-"
        return None if is_count else (value, digits)
    if "word" not in groups:
        return 0.5, 1
    value = half + (english_number(groups["word"]) if language == "en" else chinese_number(groups["word"]))
    return None if value == 1.0 else (value, len(f"{value:.2f}".rstrip("0").partition(".")[2]))
