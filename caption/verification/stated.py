"""What a sentence states in its words: the numerals that measure something, and its words of side, course and state.

Claims must cover all of it (claims.py). The words stand in glossary.yaml. Nothing here knows facts or claims.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache, lru_cache

from caption.verification.glossary import GlossaryFile, glossary_file
from caption.verification.numerals import Numeral, read_numerals
from cosfly.formats.captions import Language


@dataclass(frozen=True, slots=True)
class Pole:
    """A word that takes one of several opposite values.

    about: target | drone, of whom it is said, "" where that is not plain. is_compared: said against the other of the
    two ("faster than the walker"). is_than: said against anything ("longer than the way"). is_scenery: beside a thing
    that stands about. is_plan: said of what is wanted ("to climb"); is_after_plan: somewhere after such a word.
    start: in the sentence. number: the numeral that it leads ("fell by 2 m"). frames: that its clause names.
    """

    dimension: str
    value: str
    word: str
    is_negated: bool
    about: str = ""
    is_compared: bool = False
    is_than: bool = False
    is_plan: bool = False
    is_after_plan: bool = False
    number: Numeral | None = None
    frames: frozenset[int] = frozenset()
    start: int = 0
    is_scenery: bool = False


@dataclass(frozen=True)
class Stated:
    """All of a sentence. text: it, as numerals and poles count its characters; frames: that it names; actions: what its
    words may argue for; named: those that they name alone."""

    text: str
    numerals: tuple[Numeral, ...]
    poles: tuple[Pole, ...]
    frames: frozenset[int]
    actions: frozenset[str]
    named: frozenset[str]
    is_approximate: bool
    is_less: bool
    is_more: bool


# --- reading ----------------------------------------------------------------------------------------------------------

_FRAME = (
    r"(?<![A-Za-z0-9])[tT]\s?[=_]?\s?[-−]?\d+(?![\d.]*\s?(?:m\b|s\b))|(?:\b[Ff]rames?|\b[Ss]teps?|第|#)[ "
    r"_]?\d+(?![\d.]*\d)(?:\s?[-–]\s?\d+)?"
)
_LIST_MARK = r"^\s*(?:[-*•]\s*)?\(?\d{1,2}[.):、）](?=\D)|[（(]\d{1,2}[)）]|(?<=[\s;；，,])\d\)(?=\s)|[①-⑨]|\b[23]-?D\b"
SCENERY_CHARACTERS = 30  # from a thing to its side
LED_CHARACTERS = 12  # from the end of "fell" to its number: "by about", "slightly by"
_CLAUSE = re.compile(r"[,;:，；：、。]|\.(?!\d)|\bbut\b|\bwhile\b|\band\b|而|但")
_SEEMING = r"(?<!appears )(?<!appear )(?<!seems )(?<!seem )"  # "appears to stand" says that somebody stands
_CROSS = re.compile(r"(\d)([x×])(\d)")  # "9x21"
# Between a word of course and a number that is not what it comes to.
_NOT_LED = {
    False: re.compile(r"\bfrom\b|\bsince\b|\bfor\b|[,:;(，：；（。、]|[自从由比]"),
    True: re.compile(r"\bfrom\b|\bsince\b|\bfor\b|[;(；（。]|[自从由比]"),
}
_BRACKETS = re.compile(r"（[^（）]*）|\([^()]*\)")
_OF_THE_OTHER = re.compile(r"outpac|outrun|lag", re.IGNORECASE)
_FRAME_NAME = re.compile(r"(?<![A-Za-z0-9])[tT](\d)(?!\d)")
_PART = re.compile(r"[,;:()，；。、：（）]|\b(?:but|and|while|whereas)\b|但|而")
_OTHER_FRAMES = re.compile(r"\b(?:before|until|till|after|since|from|by|up to)\b|前|后|直到|自|从|起|至|到", re.I)
_THAN = re.compile(r"\s+than\s+(?!at\b|before\b|an?\s|half\b|in\s|t\d|it was|earlier|the start|previous)")


class Lexicon:
    """The words of glossary.yaml for what is stated, with their patterns compiled, for one language."""

    def __init__(self, file: GlossaryFile, language: Language) -> None:
        self.language, lists, notions = language, file.lists, file.notions
        self.skipped, self._scenery, self._about, self._less, self._more = (
            self._any(lists[name][language]) for name in ("skipped", "scenery", "about", "less", "more")
        )
        self.strict = frozenset(file.strict)
        self.subjects = {who: self._any(words.said[language]) for who, words in notions["subject"].items()}
        self._actions = {token: self._any(words.argued[language]) for token, words in notions["action"].items()}
        self._named = {
            token: self._any(words.named[language]) for token, words in notions["action"].items() if words.named.en
        }
        self._pole_names: dict[str, tuple[str, str]] = {}
        # Within a notion the more special words stand first ("fully visible" before "visible").
        parts: dict[str, list[str]] = {}
        for notion, values in notions.items():
            for value, words in values.items():
                if notion != "subject" and words.said.en:
                    name = f"p{len(self._pole_names)}"
                    self._pole_names[name] = (notion, value)
                    parts.setdefault(notion, []).append(f"(?P<{name}>{self._option(words.said[language])})")
        self._poles = [re.compile("|".join(part), re.I) for part in parts.values()]
        plans = "|".join(lists["plans"][language])
        self._any_plan = re.compile(rf"\b(?:{plans})\s" if language == "en" else rf"(?:{plans})", re.I)
        self._plan = re.compile(
            rf"{_SEEMING}\b(?:{plans})(?:\s+[\w']+){{0,2}}\s+$" if language == "en" else rf"(?:{plans}).{{0,3}}$", re.I
        )
        self._negation = self._negations(lists["negations"][language])

    def _option(self, words: list[str]) -> str:
        options = "|".join(sorted(words, key=len, reverse=True))
        return rf"(?<![A-Za-z])(?:{options})(?![A-Za-z])" if self.language == "en" else f"(?:{options})"

    def _any(self, words: list[str]) -> re.Pattern[str]:
        return re.compile(self._option(words), re.I)

    def _negations(self, words: list[str]) -> re.Pattern[str]:
        options = "|".join(sorted(words, key=len, reverse=True))
        if self.language == "en":  # up to three words between: "not yet fully visible"
            return re.compile(rf"(?<![A-Za-z])(?:{options})(?:\s+[a-z-]+){{0,2}}\s+$", re.I)
        return re.compile(rf"(?:{options}).{{0,2}}$")

    def read(self, sentence: str) -> Stated:
        """Read a sentence."""
        frames = {int(digits) for digits in _FRAME_NAME.findall(sentence)}
        sentence = _CROSS.sub(r"\1 \2 \3", sentence)
        text = re.sub(f"{_FRAME}|{_LIST_MARK}", lambda match: " " * len(match.group()), sentence)
        plain = self.skipped.sub(lambda match: " " * len(match.group()), text)
        numerals = self._numerals(text)
        return Stated(
            text=sentence,
            numerals=tuple(numerals),
            poles=tuple(self._found_poles(plain, numerals, sentence)),
            frames=frozenset(frames),
            actions=frozenset(action for action, words in self._actions.items() if words.search(text)),
            named=frozenset(action for action, words in self._named.items() if words.search(text)),
            is_approximate=bool(self._about.search(text)),
            is_less=bool(self._less.search(text)),
            is_more=bool(self._more.search(text)),
        )

    def _numerals(self, text: str) -> list[Numeral]:
        found = []
        for numeral in read_numerals(text, self.language):
            if numeral.kind == "ratio":
                end = numeral.start + len(numeral.text)
                numeral = replace(numeral, about=self._whose_multiple(text, numeral.start, end))
            found.append(numeral)
        return found

    def _found_poles(self, text: str, numerals: list[Numeral], sentence: str) -> list[Pole]:
        found = []
        for pattern in self._poles:
            for match in pattern.finditer(text):
                dimension, value = self._pole_names[str(match.lastgroup)]
                clause = _CLAUSE.split(_BRACKETS.sub("", text[: match.start()]))[-1]
                about, is_compared = self._about_whom(clause, text[match.start() :], match.group())
                led = [
                    n
                    for n in numerals
                    if 0 <= n.start - match.end() <= LED_CHARACTERS
                    and not _NOT_LED[value == "steady"].search(
                        text, match.end() - (5 if self.language == "en" else 0), n.start
                    )
                ]
                pole = Pole(dimension, value, match.group(), bool(self._negation.search(clause)), about, is_compared)
                found.append(
                    replace(
                        pole,
                        start=match.start(),
                        is_scenery=bool(
                            self._scenery.search(clause[-SCENERY_CHARACTERS:])
                            or self._scenery.search(_CLAUSE.split(text[match.end() : match.end() + 12])[0])
                        ),
                        is_than=bool(_THAN.match(text, match.end())),
                        is_plan=bool(self._plan.search(clause)),
                        is_after_plan=bool(self._any_plan.search(text[: match.start()])),
                        number=led[0] if led and dimension == "trend" else None,
                        frames=_frames_round(sentence, match.start(), match.end())
                        if dimension == "visibility"
                        else frozenset(),
                    )
                )
        return found

    def _whose_multiple(self, text: str, start: int, end: int) -> str:
        """Tell whose speed is so many times that of the other, who is named beside it: after it in English, before it
        in Chinese."""
        if self.language == "en":
            near = re.split(r"[,;:.()]", text[end : end + 36])[0]
        else:
            near = re.split(r"[，；：。]", text[max(0, start - 22) : start])[-1]
            if "的" not in near[-6:]:
                return ""
        found = [(match.start(), who) for who, words in self.subjects.items() for match in words.finditer(near)]
        if not found:
            return ""
        named = min(found)[1] if self.language == "en" else max(found)[1]
        return "target" if named == "drone" else "drone"

    def _about_whom(self, clause: str, rest: str, word: str) -> tuple[str, bool]:
        """Tell of whom a word is said, and whether against the other: what stands after "than", else the clause's only
        subject."""
        if self.language == "en":
            than = "" if _OF_THE_OTHER.match(word) else r"than\s+"  # "outruns the walker"
            against = re.match(re.escape(word) + rf"\s+{than}(.{{0,24}})", rest, re.I)
        else:
            against = re.match(re.escape(word) + "于?(.{0,4})", rest) if "于" in rest[: len(word) + 1] else None
            against = (
                against
                or re.search(r"比(.{1,20})$", clause)
                or (re.match("比(.{1,4}?)(?:（[^（）]*）)?.{0,1}[快慢]", rest))
            )
        for who, words in self.subjects.items():
            if against and words.search(against[1].split(",")[0]):
                return ("drone" if who == "target" else "target"), True
        named = [who for who, words in self.subjects.items() if words.search(clause)]
        return (named[0] if len(named) == 1 else ""), False


def _frames_round(sentence: str, start: int, end: int) -> frozenset[int]:
    """Return the frames that the clause round a word names, none where it speaks of those before or after them."""
    first = max((mark.end() for mark in _PART.finditer(sentence, 0, start)), default=0)
    last = _PART.search(sentence, end)
    clause = sentence[first : last.start() if last else len(sentence)]
    return frozenset() if _OTHER_FRAMES.search(clause) else frozenset(int(d) for d in _FRAME_NAME.findall(clause))


@cache
def lexicon_of(language: Language) -> Lexicon:
    return Lexicon(glossary_file(), language)


def subject_before(text: str, end: int, language: Language) -> str:
    """Return who was named last before a place of a text: drone | target, "" where nobody was."""
    found = [
        (match.start(), who)
        for who, words in lexicon_of(language).subjects.items()
        for match in words.finditer(text, 0, end)
    ]
    return max(found)[1] if found else ""


@lru_cache(maxsize=4096)
def read_stated(sentence: str, language: Language) -> Stated:
    """Read what a sentence states; cached, as both checks and repairs ask again."""
    return lexicon_of(language).read(sentence)
