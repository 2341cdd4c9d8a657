"""The words of both languages, `glossary.yaml`: the one reader of them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

from pydantic import Field

from cosfly.formats.captions import Language
from cosfly.runtime.config import Config, build, read_yaml

GLOSSARY_FILE = Path(__file__).with_name("glossary.yaml")
LANGUAGES: tuple[Language, Language] = ("en", "zh")
VISIBILITY = ("visible", "partly_occluded", "illegible", "occluded", "out_of_view")


class Words(Config):
    en: list[str] = Field(description="English")
    zh: list[str] = Field(description="Chinese")

    def __getitem__(self, language: Language) -> list[str]:
        return self.en if language == "en" else self.zh


class _Factors(Config):
    en: dict[str, dict[str | int | float, str]] = Field(description="unit -> factor to it -> English spellings")
    zh: dict[str, dict[str | int | float, str]] = Field(description="and Chinese")


class GlossaryFile(Config):
    schema_: str = Field(alias="schema", description="cosfly.glossary")
    schema_version: str = Field(description="version of this layout")
    slots: dict[str, Words] = Field(description="word -> forms that a slot is filled with")
    opposites: dict[str, dict[str, Words]] = Field(description="name -> its two sides with their spellings")
    negations: Words = Field(description="words that reverse what follows")
    not_opposites: Words = Field(description="spellings that contain an opposite but do not mean it")
    quantities: dict[str, Words] = Field(description="quantity -> patterns that name it")
    subjects: dict[str, Words] = Field(description="drone and target -> patterns that name them")
    comparatives: Words = Field(description="patterns of clauses that compare two quantities")
    hypothetical: Words = Field(description="patterns of clauses whose numbers are not compared")
    units: dict[str, Words] = Field(description="unit -> spellings, the first is written")
    written_units: _Factors = Field(description="every way a unit is written in running text")


class Unit(NamedTuple):
    """A unit as it is written: its name among ours, and the factor to it."""

    name: str
    factor: float


class Glossary:
    """The glossary with its patterns compiled."""

    def __init__(self, file: GlossaryFile) -> None:
        self.file = file
        self.written_units = {one: {unit: words[one][0] for unit, words in file.units.items()} for one in LANGUAGES}
        self._opposites = {one: _opposites(file, one) for one in LANGUAGES}
        self._terms = {one: term_pattern([*self._opposites[one], *file.not_opposites[one]], one) for one in LANGUAGES}

    def slot_words(self, language: Language) -> dict[str, tuple[str, ...]]:
        """Return the forms of each word that a slot is filled with."""
        return {word: tuple(forms[language]) for word, forms in self.file.slots.items()}

    def visibility(self, word: str, language: Language) -> str:
        return self.file.slots[word][language][0]

    def spellings(self, language: Language) -> dict[str, str]:
        """Return every spelling of a unit and the unit."""
        return {spelling: unit for unit, words in self.file.units.items() for spelling in words[language]}

    def opposites(self, text: str, language: Language) -> list[tuple[str, int]]:
        """Find opposites in a text: (name, +1 or -1), negations applied."""
        text = text.lower() if language == "en" else text
        found = []
        for match in self._terms[language].finditer(text):
            if match.group() in self._opposites[language]:
                name, sign = self._opposites[language][match.group()]
                found.append((name, -sign if self.is_negated(text, match.start(), language) else sign))
        return found

    def swapped(self, english: str, chinese: str) -> str | None:
        """Return the name of an opposite of which one side is lost and the other one gained in the translation."""
        counts_en, counts_zh = Counter(self.opposites(english, "en")), Counter(self.opposites(chinese, "zh"))
        for name in sorted({name for name, _ in counts_en.keys() | counts_zh.keys()}):
            for sign in (1, -1):
                is_lost = counts_zh[name, sign] < counts_en[name, sign]
                if is_lost and counts_zh[name, -sign] > counts_en[name, -sign]:
                    return name
        return None

    def is_negated(self, text: str, start: int, language: Language) -> bool:
        """Return whether a negation stands just before a place of a text (English in small letters)."""
        if language == "zh":
            return text[max(0, start - 4) : start].endswith(tuple(self.file.negations.zh))
        words = re.findall(r"[a-z']+", re.split(r"[.,;:]", text[max(0, start - 24) : start])[-1])
        return bool(set(self.file.negations.en).intersection(words[-2:]))

    def pairs(self) -> list[tuple[str, str]]:
        """Return the words of visibility and the units, English and Chinese, as they are written."""
        seen = [(self.visibility(word, "en"), self.visibility(word, "zh")) for word in VISIBILITY]
        return seen + [(words.en[0], words.zh[0]) for words in self.file.units.values()]


def _opposites(file: GlossaryFile, language: Language) -> dict[str, tuple[str, int]]:
    """Return the spellings of opposites: word -> its name, and 1 for the first of the two sides, -1 for the other."""
    return {
        word: (name, sign)
        for name, sides in file.opposites.items()
        for words, sign in zip(sides.values(), (1, -1), strict=True)
        for word in words[language]
    }


def term_pattern(words: Iterable[str], language: Language) -> re.Pattern[str]:
    """Return the pattern of any of some words, the longest first."""
    options = "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))
    return re.compile(rf"(?<![a-z_])(?:{options})(?![a-z_])" if language == "en" else options)


@cache
def load_glossary() -> Glossary:
    """Read the glossary."""
    return Glossary(build(GlossaryFile, read_yaml(GLOSSARY_FILE), GLOSSARY_FILE))


@cache
def mentions(kind: str, name: str, language: Language) -> re.Pattern[str]:
    """Return the pattern that finds a mention.

    Args:
        kind: a list of patterns. name: of a quantity or subject, "" of the other lists.
    """
    words = getattr(load_glossary().file, kind)
    options = "|".join((words[name] if name else words)[language])
    return re.compile(rf"\b(?:{options})\b" if language == "en" else f"(?:{options})", re.IGNORECASE)


@cache
def written_units(language: Language) -> dict[str, Unit]:
    """Return every spelling of a unit in running text, foreign ones too."""
    units: dict[str, Unit] = {}
    for name, factors in getattr(load_glossary().file.written_units, language).items():
        for factor, spellings in factors.items():
            for spelling in filter(None, map(str.strip, spellings.split(","))):
                units.setdefault(spelling, Unit(name, float(factor)))
    return units
