"""Numerals in running text: digits, numbers in words, shares and multiples, hours of the clock, in English and
Chinese."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

from caption.verification.glossary import Unit, written_units
from cosfly.formats.captions import Language

_UNIT_GROUPS = ("unit", "half_of", "word_of")
_NO_UNIT = Unit("", 1.0)
_NOT_MEASURED = ("s", "frames")  # counts and durations: no fact of the table
_ANNOUNCED = re.compile(r"^\s*in (knots|km/h|kph|mph|feet|ft|metres|meters|degrees|pixels)\b", re.I)
Kind = Literal["number", "ratio", "clock", "one"]


@dataclass(frozen=True, slots=True)
class Numeral:
    """A numeral of a text in our units. unit: a key of the lexicon's units, "" where none stands there.

    number: a measured size. ratio: a share or a multiple ("half", "two thirds", "seven times"). clock: an hour. one: "a
    metre".
    digits: after the point, as written. factor: from the unit that is written to ours, 1 where it is ours. is_negative:
    written with a minus. bound: 1 of "more than 20 m", -1 of "less than". is_about: written as approximate. about:
    drone | target, of whose speed a multiple of the other's is said ("twice the walker's": drone). start: in the
    sentence.
    """

    text: str
    value: float
    unit: str
    digits: int
    kind: Kind = "number"
    is_negative: bool = False
    bound: int = 0
    is_about: bool = False
    about: str = ""
    is_difference: bool = False
    start: int = 0
    factor: float = 1.0

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
_WORDS = {**_SMALL, **{word: 10 * number for number, word in enumerate(_TENS.split(), 2)}}
_WORDS |= {"hundred": 100, "a hundred": 100, "single": 1, "a single": 1, "an": 1, "a": 1}
_WORDS |= {"half a dozen": 6, "a dozen": 12, "two dozen": 24}
_PARTS = {
    "half": 0.5, "third": 1 / 3, "quarter": 0.25, "fourth": 0.25, "fifth": 0.2, "sixth": 1 / 6, "eighth": 0.125,
    "tenth": 0.1,
}  # fmt: skip
_TURNS = {
    "twice": 2.0, "double": 2.0, "doubled": 2.0, "doubles": 2.0, "doubling": 2.0, "thrice": 3.0, "triple": 3.0,
    "tripled": 3.0,
}  # fmt: skip
_TURNS |= {"halved": 0.5, "halves": 0.5, "halving": 0.5, "quadruple": 4.0, "quadrupled": 4.0}
_ZH_DIGITS = {character: value for value, character in enumerate("零一二三四五六七八九")} | {"两": 2, "〇": 0}
_ZH_TURNS = {
    "一半": 0.5, "减半": 0.5, "对半": 0.5, "翻倍": 2.0, "翻了一番": 2.0, "翻了一倍": 2.0, "翻一倍": 2.0, "增加了一倍": 2.0, "快了一倍": 2.0,
    "加倍": 2.0, "翻番": 2.0,
}  # fmt: skip

_ONE = "|".join(sorted(_SMALL, key=len, reverse=True))
_ENGLISH = (
    rf"(?:(?:{'|'.join(_TENS.split())})(?:[- ](?:{_ONE}))?|(?:(?:{_ONE}|a) hundred(?: (?:and "
    rf")?(?:(?:{'|'.join(_TENS.split())})"
    rf"(?:[- ](?:{_ONE}))?|{_ONE}))?)|half a dozen|(?:a|two) dozen|{_ONE}|a single|single)"
)
_CHINESE = "[零〇一二两三四五六七八九十百]"
# A number in words, as english_number and chinese_number read it.
ENGLISH_NUMBER = rf"{_ENGLISH}(?: point(?: (?:{_ONE}))+)?"
CHINESE_NUMBER = f"{_CHINESE}+(?:点{_CHINESE}+)?"


def english_number(text: str) -> float:
    """Read a number in words: "twenty-one", "one point two", "a hundred and five"."""
    whole, _, fraction = text.lower().partition(" point ")
    if whole in _WORDS:
        value = float(_WORDS[whole])
    else:
        value = 0.0
        for word in re.findall(r"[a-z]+", whole):
            value = value * 100 if word == "hundred" and value else value + _WORDS.get(word, 0)
    digits = "".join(str(_SMALL.get(word, "")) for word in fraction.split())
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
            last = _ZH_DIGITS.get(character, 0)
    digits = "".join(str(_ZH_DIGITS.get(character, "")) for character in fraction)
    return value + last + (float(f"0.{digits}") if digits else 0.0)


# --- in a sentence ----------------------------------------------------------------------------------------------------

_MORE: dict[str, tuple[re.Pattern[str], re.Pattern[str]]] = {
    "en": (
        re.compile(r"(?:more than|over|above|at least|upwards of|beyond|exceed\w*|>)\s*$", re.I),
        re.compile(r"\s*(?:or more|plus\b|\+)"),
    ),
    "zh": (re.compile(r"(?:超过|至少|逾|大于|不止|高于|>)\s*$"), re.compile(r"\s*(?:以上|多|有余|出头)")),
}
_LESS: dict[str, tuple[re.Pattern[str], re.Pattern[str]]] = {
    "en": (
        re.compile(
            r"(?:less than|under|below|at most|up to|within|nearly|almost|close to|not quite|short of|<)\s*$", re.I
        ),
        re.compile(r"\s*or less"),
    ),
    "zh": (re.compile(r"(?:不到|不足|将近|接近|近|至多|小于|低于|<)\s*$"), re.compile(r"\s*(?:以内|以下|之内)")),
}
_ABOUT = re.compile(
    r"(?:about|around|some|roughly|approximately|approx\.?|ca\.?|circa|nearly|almost|close to|just (?:under|over)|~|≈|约"
    r"|大约|大概|将近|接近|近)\s*$",
    re.IGNORECASE,
)
_OR_SO = re.compile(r"\s*(?:or so|or thereabouts|give or take|左右|上下|来)")
# After digits that are no part of the length before them.
_COUNTED = "零〇一二两三四五六七八九十百点个秒步帧米度像倍次人成"
_ANY_NUMBER: dict[Language, re.Pattern[str]] = {
    "en": re.compile(rf"\b{ENGLISH_NUMBER}\b", re.IGNORECASE),
    "zh": re.compile(CHINESE_NUMBER),
}
_BY = re.compile(
    r"\b(?:by|up|down) (?:about |around |roughly |some |nearly |almost |just |only |over |under |a )*$", re.IGNORECASE
)
_MORE_OR_LESS = re.compile(
    r"\s*(?:faster|slower|quicker|higher|lower|larger|smaller|bigger|taller|shorter|wider|narrower|longer|farther"
    r"|further|closer|nearer|more than|less than|increase|decrease|growth|drop|reduction)\b",
    re.IGNORECASE,
)
_ZH_BY = re.compile(
    r"(?:快|慢|高|低|升|降|增|减|增加|减少|减小|增大|缩小|缩短|涨|多|少|大|小)[了出]?(?:大约|约|近|将近|超过|不到)?\s*$"
)
_HOURLY = re.compile(r"(?:时速|每小时)[^，。；]{0,4}$")
_AND = re.compile(r"\s*(?:and|又|零)?\s*", re.IGNORECASE)
_SQUARED = re.compile(r"\s?(?:²|\^2|\*\*2|/s\b)")  # an acceleration
_DIGITS = r"(?:(?<![A-Za-z0-9_.])|(?<=\d[x×]))[-+−]?\d+(?:\.\d+)?(?!\d)"


@cache
def _pattern(language: Language) -> re.Pattern[str]:
    # A unit in letters ends where the word does: "3 m", but not "3 more".
    unit = "|".join(re.escape(spelling) for spelling in sorted(written_units(language), key=len, reverse=True))
    unit = f"(?:{unit})"
    groups = [f"(?P<{name}>{unit})(?:(?<=[^A-Za-z])|(?![A-Za-z]))" for name in _UNIT_GROUPS]
    return re.compile(_english_numerals(*groups) if language == "en" else _chinese_numerals(*groups), re.IGNORECASE)


def read_numerals(text: str, language: Language) -> list[Numeral]:
    """Find the numerals of a text that measure something: no durations, no counts of frames, no small counts without a
    unit."""
    units = written_units(language)
    announced = _ANNOUNCED.search(text)
    found: list[Numeral] = []
    for match in _pattern(language).finditer(text):
        spelling = next((match[name] for name in _UNIT_GROUPS if match[name]), announced[1] if announced else "")
        unit, factor = units.get(spelling.lower(), _NO_UNIT)
        before, after = text[: match.start()], text[match.end() :]
        if spelling in ("×", "x") and after.lstrip()[:1].isdigit():
            unit = ""  # of a product, "34 × 59 px"
        if unit in _NOT_MEASURED or _SQUARED.match(after):
            continue
        if language == "zh" and unit in ("m", "deg") and "每秒" in re.split("[，；。：、,;:]", before)[-1]:
            unit = {"m": "mps", "deg": "dps"}[unit]
        if language == "zh" and (unit, factor) == ("m", 1000.0) and _HOURLY.search(before):  # 时速 26 公里
            unit, factor = "mps", 1 / 3.6
        numeral = _numeral(match, unit, factor)
        if numeral is not None and found and _is_rest_of(numeral, found[-1], text[: match.start()]):
            found[-1] = _added(found[-1], numeral, text[found[-1].start : match.end()])
        elif numeral is not None:
            bound = _bound_of(before, after, language)
            is_difference = unit in ("percent", "") and _is_difference(before, after, language)
            found.append(
                replace(
                    numeral,
                    start=match.start(),
                    bound=bound,
                    is_about=_is_about(before, after),
                    is_difference=is_difference,
                )
            )
    return found


def numbers_in(text: str, language: Language) -> set[float]:
    """Return every number that a text names, counts, frames and durations too."""
    found = {numeral.value for numeral in read_numerals(text, language)} | {
        float(n) for n in re.findall(r"\d+(?:\.\d+)?", text)
    }
    for match in _ANY_NUMBER[language].finditer(text):
        found.add(english_number(match[0]) if language == "en" else chinese_number(match[0]))
    return found


def _is_rest_of(numeral: Numeral, last: Numeral, before: str) -> bool:
    """Return whether a numeral is the centimetres of the metres before it: "one metre and thirty centimetres"."""
    is_length = (last.unit, last.factor, last.digits, numeral.unit, numeral.factor) == ("m", 1.0, 0, "m", 0.01)
    between = before[last.start + len(last.text) :]
    return is_length and numeral.value < 1.0 and _AND.fullmatch(between) is not None


def _added(last: Numeral, numeral: Numeral, text: str) -> Numeral:
    return replace(last, text=text.strip(), value=round(last.value + numeral.value, 2), digits=2)


def _is_about(before: str, after: str) -> bool:
    return bool(_ABOUT.search(before) or _OR_SO.match(after))


def _is_difference(before: str, after: str, language: Language) -> bool:
    """Return whether a share is what something is more or less by, not what it is of something."""
    if language == "en":
        return bool(_BY.search(before) or _MORE_OR_LESS.match(after))
    return bool(_ZH_BY.search(before))


def _bound_of(before: str, after: str, language: Language) -> int:
    if _MORE[language][0].search(before) or _MORE[language][1].match(after):
        return 1
    return -1 if _LESS[language][0].search(before) or _LESS[language][1].match(after) else 0


def _english_numerals(unit: str, of_half: str, of_word: str) -> str:
    count = r"(?:of a second|second|frame|step|time|party|person|image|picture|view|one\b)"
    seen = r"[- ](?:hidden|occluded|covered|visible|obscured|concealed|blocked|screened)"
    part = r"(?:halfs?|halves|thirds?|quarters?|fourths?|fifths?|sixths?|eighths?|tenths?)"
    return (
        rf"(?P<clock>(?:\d{{1,2}}|{_ONE})) ?o['’]?clock|(?P<digits>{_DIGITS})(?:\s*[- ]?(?:{unit}))?"
        rf"|\b(?P<one>a|a single|single) (?:met(?:re|er)|degree|pixel)s?\b(?! and a half)"
        rf"|\b(?P<unit_and_half>a) (?:met(?:re|er)|degree|pixel) and a half"
        rf"|\bseconds? and a half\b|\bhalf[- ](?:a |an )?(?:second|step)s?\b|\b(?:first|second|last|latter|other|lower"
        rf"|upper|top|bottom|left|right|left-hand|right-hand) half\b"
        rf"|\bhalf (?:of )?the (?:picture|frame|image|window|clip|time)\b|\bdouble[- ]check\w*"
        rf"|\b(?P<half_unit>half an? )(?:{of_half})"
        rf"|\b(?P<word>{ENGLISH_NUMBER})(?P<and_half> and a half)?[- ]+(?:{of_word})(?: "
        rf"(?P<cents>(?:{'|'.join(_TENS.split())})(?:[- ](?:{_ONE}))?)(?=\s*(?:[,.;:)]|$)))?"
        rf"|\b(?<!and )(?P<part>(?:(?:a|one|two|three|four) )?{part})\b(?!\s+{count})(?!{seen})"
        rf"|\b(?P<turn>{'|'.join(sorted(_TURNS, key=len, reverse=True))})\b(?! (?:running|in a row|in succession"
        rf"|already|over)\b)"
    )


def _chinese_numerals(unit: str, of_half: str, of_word: str) -> str:
    return (
        rf"(?P<clock>\d{{1,2}}|{_CHINESE}+)\s*点(?:钟|方向|方位|位置)"
        rf"|(?P<digits>{_DIGITS})\s*(?:个)?(?:{unit})?(?P<and_half>半(?![秒步帧]))?"
        rf"|(?P<share>{_CHINESE}+分之{_CHINESE}+)|(?P<tenth>[一二两三四五六七八九])成(?![为像功员不了])"
        rf"|(?P<one>一)(?:个)?(?:像素|米|度)(?=都|也)|半[秒步帧]|(?P<half_unit>半)个?(?:{of_half})"
        rf"|(?<![住挡])(?P<turn>{'|'.join(_ZH_TURNS)})"
        rf"|(?<![第这那数几上])(?!(?<![到约仅了近有])一度)(?P<word>{CHINESE_NUMBER})个?(?:{of_word})(?:(?P<word_half>半(?![秒步帧]))"
        rf"|(?P<tenths>[一二三四五六七八九]{{1,2}})(?![{_COUNTED}]))?"
    )


def _numeral(match: re.Match[str], unit: str, factor: float) -> Numeral | None:
    groups = {name: text for name, text in match.groupdict().items() if text is not None}
    text = match.group().strip()
    if "clock" in groups:
        hour = groups["clock"]
        value = float(hour) if hour.isdigit() else chinese_number(hour) or english_number(hour)
        return Numeral(text, value, "", 0, "clock")
    kind: Kind = "ratio" if unit == "times" else "number"
    if "digits" in groups:
        written = groups["digits"].replace("−", "-")
        digits = len(written.partition(".")[2])
        value = abs(float(written)) + (0.5 if "and_half" in groups else 0.0)
        if not unit and digits == 0 and value < 10 and "and_half" not in groups and written[0] not in "+-":
            return None if value else Numeral(text, 0.0, "", 0)  # a count
        return Numeral(text, value * factor, unit, digits, kind, written[0] == "-", factor=factor)
    if "word" in groups:
        word = groups["word"]
        value = chinese_number(word) if word[0] > "一" or word[0] in _ZH_DIGITS else english_number(word)
        value += 0.5 if {"and_half", "word_half"} & groups.keys() else 0.0
        if "cents" in groups:  # "one metre sixty"
            value += english_number(groups["cents"]) / 100.0
        if "tenths" in groups:  # 一米三
            value += float("0." + "".join(str(_ZH_DIGITS[character]) for character in groups["tenths"]))
        return Numeral(text, value * factor, unit, _digits_of(value), kind, factor=factor)
    if "one" in groups:
        return Numeral(text, 1.0, "", 0, "one")
    if "half_unit" in groups:
        return Numeral(text, 0.5 * factor, unit, 1)
    if "unit_and_half" in groups:
        return Numeral(text, 1.5, "", 1)
    return _ratio_of(groups, text)


def _ratio_of(groups: dict[str, str], text: str) -> Numeral | None:
    if "turn" in groups:
        return Numeral(text, _TURNS.get(groups["turn"].lower(), 0.0) or _ZH_TURNS[groups["turn"]], "", 2, "ratio")
    if "tenth" in groups:
        return Numeral(text, chinese_number(groups["tenth"]) / 10.0, "", 2, "ratio")
    if "share" in groups:
        of, _, share = groups["share"].partition("分之")
        return Numeral(text, chinese_number(share) / (chinese_number(of) or 1.0), "", 2, "ratio")
    if "part" in groups:
        *count, name = groups["part"].lower().split()
        part = 0.5 if name.startswith("hal") else _PARTS[name.removesuffix("s")]
        return Numeral(text, (_WORDS[count[0]] if count else 1) * part, "", 2, "ratio")
    return None


def _digits_of(value: float) -> int:
    return len(f"{value:.2f}".rstrip("0").partition(".")[2])
