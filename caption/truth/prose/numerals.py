"""Numbers of a sentence: digits and number words with their units, lists, ranges and products.

A sentence is read with each run of digits written as one `#`, so that sentences that differ in their digits alone are read once.
Frame names (`t3`) and counts of seconds or frames keep theirs, because they decide how the rest is read.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache

from caption.truth.numerals import CHINESE_NUMBER, ENGLISH_NUMBER, chinese_number, english_number
from caption.truth.prose.lexicon import Lexicon, load_lexicon
from cosfly.products.captions import Language

_KEPT = r"(?:s|sec|secs|seconds?|frames?|steps?|images?)(?![a-z/])|秒|帧|步|张|幅"
_DIGITS = re.compile(
    rf"(?<![a-z0-9])t\s?_?\d{{1,2}}(?!\d)|\d+\.\d+(?=\s?(?:{_KEPT}))|(?<![\d.])\d+(?=\s?(?:{_KEPT}))|\d+"
)
_DASHES = str.maketrans({"−": "-", "–": "-", "—": ";", "’": "'", "‘": "'", "_": " ", "#": " ", "×": "x", "，": ",", "（": "(", "）": ")", "：": ":", "；": ";", "＝": "=", "～": "~", "／": "/", "％": "%", "＋": "+", "　": " ", "⟶": "→", "➜": "→", "➔": "→", "“": '"', "”": '"'})  # fmt: skip
_HYPHEN = re.compile(r"(?<=[a-z])-(?=[a-z])")
_ARROW = re.compile(r"\s*(?:-+>|=+>|→)\s*")
_OF_TIME = re.compile(r"(?<![a-z])([a-z]{1,5})\((t\d)\)")  # v(t4)
_GLOSSED = re.compile(r"第[一二三四五1-5][帧步]\s*\(\s*(t\d)\s*\)")  # 第二帧(t1)
_TELEGRAM = re.compile(r" STOP[\s.]*$")  # "SUBJECT VISIBLE STOP RANGE 20 M STOP"
_LAST_FEW = re.compile(r"\b(the (?:last|latest|newest|first) (?:two|three|four))(?=\s*(?:[.,;)]|$))")
_EQUALS = re.compile(r"\s*=\s*")


@dataclass(frozen=True, slots=True)
class Numeral:
    """A number of a sentence. whole, fraction: which runs of digits it is made of; None for number words, which have a `value`.

    unit: a key of the lexicon's units, "" where none is written. sign: +1 or -1 where one is written, else 0. group: numerals of one
    list, range or product have the same; joined: how it goes on from the one before it in its group (`,`, `-`, `x`, `→`). side: +1 for
    "12 px left", -1 for "右 12 像素", 0 where none stands right beside it.
    """

    start: int
    end: int
    unit: str = ""
    factor: float = 1.0
    sign: int = 0
    whole: int | None = None
    fraction: int | None = None
    value: float = 0.0
    group: int = 0
    joined: str = ""
    side: int = 0

    def read(self, runs: tuple[str, ...]) -> tuple[float, float]:
        """Give the number in its unit and half a unit of its last written digit, both without the sign."""
        if self.whole is None:
            return self.value * self.factor, (0.5 if self.value >= 1 else 0.1) * self.factor
        if self.fraction is None:
            return float(runs[self.whole]) * self.factor, 0.5 * self.factor
        places = runs[self.fraction]
        return float(f"{runs[self.whole]}.{places}") * self.factor, 0.5 * 10.0 ** -len(places) * self.factor


def masked(sentence: str, language: Language) -> tuple[str, tuple[str, ...]]:
    """Give a sentence in lower case with its runs of digits as `#`, and those runs."""
    if language == "en" and _TELEGRAM.search(sentence):
        sentence = sentence.replace(" STOP", ";")
    text = sentence.translate(_DASHES).lower()
    if "(t" in text:
        text = _OF_TIME.sub(r"\1 \2 ", _GLOSSED.sub(r"\1", text))
    if "-" in text or "→" in text or "=" in text:
        text = _EQUALS.sub(" = ", _ARROW.sub(" → ", _HYPHEN.sub(" ", text)))
    text = _QUOTED.sub(r" \1 ", text)
    if language == "en":
        text = _LAST_FEW.sub(r"\1 frames", text).replace(" decimal ", " point ")
        text = _SIDE_LETTER.sub(lambda match: " left" if match[1] in ("l", "left") else " right", text)
    runs: list[str] = []

    def hide(match: re.Match[str]) -> str:
        digits = match.group()
        if digits[0] == "t" or (match.end() != len(text) and _KEEPS.match(text, match.end())):
            return digits.replace(" ", "").replace("_", "") if digits[0] == "t" else digits
        runs.append(digits)
        return "#"

    return _DIGITS.sub(hide, text), tuple(runs)


_SIDE_LETTER = re.compile(r"(?<=[\dx°g])\s*\(?\b(left|right|l|r)\b\)?(?![/'])")  # "33 px L", "+21.4° (left)"
_QUOTED = re.compile(r"[\"“](\w+)[\"”]")  # a word in scare quotes begins no clause
_KEEPS = re.compile(rf"\s?(?:{_KEPT})")


@cache
def _pattern(language: Language) -> re.Pattern[str]:
    lexicon = load_lexicon(language)
    word = (
        rf"(?:{CHINESE_NUMBER}分之)?{CHINESE_NUMBER}半?|半"
        if language == "zh"
        else rf"(?<![a-z])(?:{ENGLISH_NUMBER}(?: and a half)?|half an?)(?![a-z])"
    )
    unit = rf"(?:\s*\(?|-)(?P<unit>{lexicon.unit_pattern})(?![a-z])"
    digits = r"(?P<sign>(?<![\w#)])[+-])?(?P<digits>#(?:\.#)?|(?<![\w#.])\d+(?:\.\d+)?)"
    return re.compile(rf"(?:{digits}|(?P<word>{word}))(?:{unit})?")


_JOIN = re.compile(
    r"\s*(?:(?:to the )?(?:left|right|up|down|l|r|low|high)\b|[降升减增落跌涨加缩](?=到|至))?\s*"  # "22 px right, 12 px left"; "1.27 down to 1.09"
    r"(?P<join>,|、|/|-|~|→|x|\*|;|and|to|then|and then|by|至|到|和|与|及|或|or|\.\.\.|…|,\s*and|,\s*then|再到|\|)"
    r"\s*(?:(?:now|finally|again|then|currently|lastly|and|又是|又|再|最后|然后|现在?|左|右|上|下|偏)\s*)*(?:t\d\s*[:=]?\s*)?$"
)


_BY_PIXELS = re.compile(r"\s+by\s+[a-z ]{3,24}(?:pixels|px)\b")  # "thirty-three by seventy-four pixels"
WAY = re.compile(r"[降升减增落跌涨加缩](?=[到至])|\b(?:up|down) to\b")  # "1.27 down to 1.09 m/s"


def numerals(text: str, language: Language) -> list[Numeral]:
    """Find the numbers of a masked sentence."""
    lexicon = load_lexicon(language)
    found: list[Numeral] = []
    runs = 0
    for match in _pattern(language).finditer(text):
        written = match["digits"]
        unit = lexicon.units.get(match["unit"] or "")
        if written is None and unit is None and not _BY_PIXELS.match(text, match.end()):
            continue  # "one", "two people"
        numeral = Numeral(match.start(), match.end(), unit.name if unit else "", unit.factor if unit else 1.0)
        if written is None:
            numeral = _in_words(numeral, match["word"], language)
        elif written[0] == "#":
            is_broken = "." in written
            sign = {"+": 1, "-": -1}.get(match["sign"] or "", 0)
            numeral = replace(numeral, sign=sign, whole=runs, fraction=runs + 1 if is_broken else None)
            runs += 2 if is_broken else 1
        else:
            numeral = replace(numeral, value=float(written))
        if unit is not None:
            numeral = _said_apart(numeral, text)
            side = _side_of(match, text, language)
            numeral = replace(numeral, side=side) if side else numeral
        if found and _is_rest_of(numeral, found[-1], text):
            found[-1] = _added_up(found[-1], numeral)
            continue
        found.append(_joined(numeral, found, text))
    return _with_units(found, text, lexicon)


_AND = re.compile(r"\s*(?:and|,)?\s*")


def _is_rest_of(numeral: Numeral, last: Numeral, text: str) -> bool:
    """Tell whether a number goes on from the one before in a smaller unit: "eleven metres and thirty centimetres"."""
    is_smaller = numeral.unit == last.unit == "m" and numeral.factor == 0.01 and last.factor == 1.0
    return is_smaller and _AND.fullmatch(text, last.end, numeral.start) is not None


def _added_up(last: Numeral, rest: Numeral) -> Numeral:
    """Add up two numbers in words; of digits nothing is said."""
    if last.whole is None and rest.whole is None:
        return replace(last, end=rest.end, value=last.value + rest.value * rest.factor)
    return replace(last, end=rest.end, unit="", whole=None, value=0.0)


_SIDE = {
    "en": re.compile(r"\s*(?:to (?:the )?|off )?(?P<left>left|port)?(?P<right>right|starboard)?\b"),
    "zh": re.compile(r"(?P<left>左)?(?P<right>右)?(?:侧|边|偏|转|移|摆|舷)*了?\s*(?:约|大约|近)?\s*$"),
}  # fmt: skip


def _side_of(match: re.Match[str], text: str, language: Language) -> int:
    found = (
        _SIDE["en"].match(text, match.end())
        if language == "en"
        else _SIDE["zh"].search(text[max(0, match.start() - 8) : match.start()])
    )
    return 0 if found is None else bool(found["left"]) - bool(found["right"])


EVERY_SECOND = re.compile(
    r"\s*(?:of \w+ |in (?!half)\w+ |in )?(?:every|each|a|per) second(?! (?:ago|earlier|before|later|back|and|or|into))"
)
_PER_HOUR = re.compile(r"(?:每小时|时速)(?:约|大约|近|将近|可达)?\s*$")
_PER_MINUTE = re.compile(r"每分钟?(?:约|大约|近|将近)?\s*$")
_PER_SECOND = re.compile(r"(?:每秒|一秒钟?(?=[能可]?[走飞跑移挪]))[^,#;。]*$")


def _said_apart(numeral: Numeral, text: str) -> Numeral:
    """Read "每秒 2 米" as a rate and "一米半" as one and a half."""
    if text.startswith("半", numeral.end) and numeral.whole is None:
        numeral = replace(numeral, value=numeral.value + 0.5, end=numeral.end + 1)
    rate = {"m": "mps", "deg": "dps"}.get(numeral.unit)
    if rate and EVERY_SECOND.match(text, numeral.end):
        numeral = replace(numeral, unit=rate)
    if numeral.unit == "m" and _PER_HOUR.search(text, 0, numeral.start):
        numeral = replace(numeral, unit="mps", factor=numeral.factor / 3600.0)
    if rate and _PER_MINUTE.search(text, 0, numeral.start):
        return replace(numeral, unit=rate, factor=numeral.factor / 60.0)
    if rate and _PER_SECOND.search(text[max(0, numeral.start - 14) : numeral.start]):
        numeral = replace(numeral, unit=rate)
    return numeral


def _joined(numeral: Numeral, before: list[Numeral], text: str) -> Numeral:
    if not before:
        return numeral
    last = before[-1]
    match = _JOIN.fullmatch(text[last.end : numeral.start])
    if match is None:
        return replace(numeral, group=last.group + 1)
    is_bare = not numeral.unit and match["join"] in ",、" and text.startswith((",", "、"), numeral.end)
    if last.unit and WAY.search(match.group()):
        return replace(numeral, group=last.group + 1)
    joins_units = not last.unit or last.unit == numeral.unit or match["join"] in ("→", "x", "-", "~") or is_bare
    if not joins_units:
        return replace(numeral, group=last.group + 1)
    return replace(numeral, group=last.group, joined=match["join"].replace(" ", "")[-3:])


def _with_units(found: list[Numeral], text: str, lexicon: Lexicon) -> list[Numeral]:
    """Give a unit that stands once, after a list or in brackets before it, to all of it."""
    for i in range(len(found) - 2, -1, -1):
        after = found[i + 1]
        spreads = after.unit not in ("s", "frames", "") and not (after.unit == "times" and after.joined == ",")
        if not found[i].unit and spreads and after.group == found[i].group:
            found[i] = replace(found[i], unit=after.unit, factor=after.factor)
    for i, numeral in enumerate(found):
        before = found[i - 1] if i else None
        if numeral.unit:
            continue
        if before and before.unit and before.group == numeral.group and before.unit not in ("s", "frames"):
            found[i] = replace(numeral, unit=before.unit, factor=before.factor)
        elif numeral.whole is not None and (bracket := list(_BRACKET.finditer(text, 0, numeral.start))):
            unit = lexicon.units.get(bracket[-1][1].strip())
            if unit is not None:
                found[i] = replace(numeral, unit=unit.name, factor=unit.factor)
    return found


_BRACKET = re.compile(r"[(\[]\s*(?:in |单位:?\s*)?([^()\[\]#]{1,12})\s*[)\]]")


def _in_words(numeral: Numeral, words: str, language: Language) -> Numeral:
    """Read "twenty-one and a half", 一点二, 一米半's 一, 百分之十, 十分之三."""
    if language == "en":
        whole, _, _ = words.partition(" and a half")
        value = 0.5 if whole.startswith("half a") and "dozen" not in whole else english_number(whole)
        return replace(numeral, value=value + (0.5 if words != whole else 0.0))
    parts, _, whole = words.rpartition("分之")
    value = chinese_number(whole.removesuffix("半")) + (0.5 if whole.endswith("半") else 0.0)
    if parts == "百":
        return replace(numeral, value=value, unit="percent", factor=1.0)
    return replace(numeral, value=value / ((chinese_number(parts) if parts else 0.0) or 1.0))
