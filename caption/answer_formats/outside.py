"""What may not stand beside slots: numbers, amounts, and words for one side of an opposite. A slot says these.

What is no measurement stays free: frames (t0), counts of observed frames and seconds, "one person", "first", wishes and
hypotheses. Patterns are wide where a slot could have said it and narrow where the word means something else.
"""

from __future__ import annotations

import re
from functools import lru_cache

from caption.answer_formats.contract import Refused
from caption.verification.glossary import load_glossary
from caption.verification.numerals import read_numerals
from cosfly.formats.captions import ACTIONS, Language

SLOT_MARK = "¤"

_SMALL = "zero|one|two|three|four|five|six|seven|eight|nine|ten"
# Amounts that no numeral says.
_VAGUE: dict[Language, re.Pattern[str]] = {
    "en": re.compile(
        r"\b(?:couple|few|several|many|some|hundreds|thousands|dozens?)\s+(?:of\s+)?(?:\w+\s+)?"
        r"(?:k?met(?:re|er)s?|kilomet(?:re|er)s?|m/s|pixels?|px|degrees?|deg|percent|per\s?cent|feet|foot|yards?|knots?"
        r"|mph|miles?|km|times)\b|\bzero\b",
        re.IGNORECASE,
    ),
    "zh": re.compile(
        r"(?<!一)(?:[几数多半]|[十百千万]+[几多]?)\s*个?(?:米|公尺|像素|度(?!量)|倍|成|公里|千米|厘米|英尺)|百分之"
    ),
}
# Counts of frames and seconds are allowed up to what was observed.
_COUNT: dict[Language, re.Pattern[str]] = {
    "en": re.compile(
        rf"\b(\d+(?:\.\d+)?|{_SMALL}|half)(?:\s+an?|-)?[\s-]*(?:of\s+the\s+)?(?:last\s+|observed\s+|latest\s+"
        rf"|previous\s+|past\s+)*"
        r"(frames?|pictures?|images?|steps?|instants?|moments?|seconds?|s)\b",
        re.IGNORECASE,
    ),
    "zh": re.compile(r"(\d+(?:\.\d+)?|[一二两三四五六七八九十半])\s*个?(?:连续|观测|观察)*\s*(帧|秒|步|张|幅|个?时刻)"),
}
_VALUES = {word: float(value) for value, word in enumerate(_SMALL.split("|"))} | {"half": 0.5, "半": 0.5, "两": 2.0}
_VALUES |= {word: float(value) for value, word in enumerate("一二三四五六七八九十", 1)}
_FRAME = re.compile(r"(?<![A-Za-z0-9])t(\d{1,2})(?![\d.]*\d)", re.IGNORECASE)
_DIGIT_IDIOM = re.compile(r"\b[23]-?D\b|\b[23]\s*维")
_HAN = re.compile(r"[\u4e00-\u9fff]+")
_NUMBER = re.compile(r"[\d０-９][\d０-９.,]*")


def check_outside(text: str, language: Language, num_frames: int, step_s: float) -> Refused | None:
    """Return what of a text without its slots (each a SLOT_MARK) may not stand there; None where nothing is wrong."""
    for match in _FRAME.finditer(text):
        if int(match[1]) >= num_frames:
            fix = f"frames are t0 to t{num_frames - 1}"
            return Refused("slots_unobserved_frame", f'"{match[0]}" names a frame that was not observed; {fix}')
    rest = _DIGIT_IDIOM.sub(" ", _FRAME.sub(" ", text))
    rest = _COUNT[language].sub(lambda match: match[0] if _is_too_much(match, num_frames, step_s) else " ", rest)
    number = _NUMBER.search(rest) or _VAGUE[language].search(rest) or (_HAN.search(rest) if language == "en" else None)
    numerals = [numeral.text for numeral in read_numerals(rest, language) if numeral.kind != "one"]
    if number is not None or numerals:
        fix = "write no numbers and no amounts, only slots; leave out what no slot says"
        return Refused("slots_number_outside", f'"{number[0].strip() if number is not None else numerals[0]}": {fix}')
    glossary = load_glossary()
    poles = glossary.poles(glossary.without_idioms(text, language), language)
    if poles:
        _, _, at = poles[0]
        word = re.match(r"[\w'-]+(?: (?:up|down|of view|of sight|view|sight))?", text[at:])
        shown = text[at : at + 2] if language == "zh" or word is None else word[0]
        fix = (
            "say it with a slot ({side:...}, {trend:...}, {visibility}, {comparison:speed}, {decision}) or leave it out"
        )
        return Refused("slots_pole_outside", f'"{shown}": {fix}')
    return None


def _is_too_much(match: re.Match[str], num_frames: int, step_s: float) -> bool:
    word = match[1].lower()
    value = _VALUES[word] if word in _VALUES else float(word)
    is_time = match[2].lower() in ("s", "second", "seconds", "秒")
    return value > ((num_frames - 1) * step_s + 0.01 if is_time else num_frames)


def states_beside(text: str, language: Language) -> tuple[str, ...]:
    """Return the words of a text for what a slot could have said: they may stand there, but nobody compared them."""
    glossary = load_glossary()
    return tuple(glossary.states(glossary.without_idioms(text, language), language))


# What a text asks for -> how, and the decisions that say the opposite.
_ASKED = {
    "slow": (r"slow(?:ing)?(?: down)?|brak(?:e|ing)|decelerat(?:e|ing)", ("speed_up",)),
    "fast": (r"speed(?:ing)? up|accelerat(?:e|ing)|(?:fly|flying|go|going) faster", ("slow_down", "hover")),
    "ascend": (r"ascend(?:ing)?|climb(?:ing)?", ("descend",)),
    "descend": (r"descend(?:ing)?|sink(?:ing)?", ("ascend",)),
    "forward": (r"(?:move|moving|fly|flying|push|pushing) (?:forwards?|ahead)|advanc(?:e|ing)", ("move_backward",)),
    "backward": (r"(?:back|backing|move|moving) (?:away|off|backwards?)|retreat(?:ing)?", ("move_forward",)),
    "hover": (r"hover(?:ing)?|hold(?:ing)? (?:its )?position", ("speed_up",)),
}
_UNASKED = re.compile(
    r"\b(?:if|unless|instead|rather|without|not|no|never|before|until|would|could|may|might)\b|n't\b", re.I
)


def decisions_opposed(text: str) -> tuple[str, ...]:
    """Return the decisions that an English sentence of a reasoning plainly argues against: "braking is the safe choice"
    against speed_up."""
    if _UNASKED.search(text):
        return ()
    asked = (
        r"\b(?:should|must|shall|ought to|needs? to|best to)(?: \w+)? (?:{0})\b|^(?:{0})\b[^,;.]{{0,20}} is (?:the "
        r")?(?:safe|best|right|wise|only)"
    )
    return tuple(
        decision
        for words, against in _ASKED.values()
        if re.search(asked.format(words), text.strip(), re.I)
        for decision in against
    )


def decisions_named(text: str) -> tuple[str, ...]:
    """Return the actions, in words or as tokens, that an English text says to take."""
    return tuple((match["words"] or match["token"]).lower() for match in _named().finditer(text))


@lru_cache
def _named() -> re.Pattern[str]:
    words = "|".join(re.escape(action.en) for action in ACTIONS.values())
    tokens = "|".join(token for token in ACTIONS if "_" in token)
    return re.compile(
        r"\b(?:should|must|shall|needs? to|has to|have to|best to|decision (?:is|that follows is)(?: to)?"
        r"|therefore,?)\s+(?:now\s+)?"
        rf"(?P<words>{words})\b|\b(?P<token>{tokens})\b",
        re.IGNORECASE,
    )
