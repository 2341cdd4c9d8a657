"""The words of both languages, `glossary.yaml`: the one reader of them.

Everything that writes, reads or compares the two languages takes its words here; what a sentence states: stated.py. What
a set of actions adds: vocabulary.py.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

from pydantic import Field

from cosfly.formats.captions import Language
from cosfly.runtime.config import Config, build, read_yaml

GLOSSARY_FILE = Path(__file__).with_name("glossary.yaml")
LANGUAGES: tuple[Language, Language] = ("en", "zh")
ASPECTS = ("mean", "min", "max", "change")  # of a quantity, for which words of its own stand beside slots


class Words(Config):
    en: list[str] = Field([], description="English")
    zh: list[str] = Field([], description="Chinese")

    def __getitem__(self, language: Language) -> list[str]:
        return self.en if language == "en" else self.zh


class _Value(Config):
    """Words of one value of a notion, by who takes them: as `glossary.yaml` says."""

    slot: Words = Field(Words(), description="forms that a slot is filled with")
    opposite: Words = Field(Words(), description="spellings of an opposite")
    said: Words = Field(Words(), description="patterns that a claim must cover")
    beside: Words = Field(Words(), description="words beside slots with which a sentence may be proved")
    argued: Words = Field(Words(), description="patterns that may argue for an action")
    named: Words = Field(Words(), description="patterns that name an action alone")


class _Factors(Config):
    en: dict[str, dict[str | int | float, str]] = Field(description="unit -> factor to it -> English spellings")
    zh: dict[str, dict[str | int | float, str]] = Field(description="and Chinese")


class GlossaryFile(Config):
    schema_: str = Field(alias="schema", description="cosfly.glossary")
    schema_version: str = Field(description="version of this layout")
    notions: dict[str, dict[str, _Value]] = Field(description="notion -> value -> its words")
    strict: list[str] = Field(description="notions or notion.value that a claim must cover")
    lists: dict[str, Words] = Field(description="words that change what others mean")
    units: dict[str, Words] = Field(description="unit -> spellings, the first is written")
    written_units: _Factors = Field(description="every way a unit is written in running text")


class Unit(NamedTuple):
    """A unit as it is written: its name among ours, and the factor to it."""

    name: str
    factor: float


class Glossary:
    """The glossary with its patterns compiled."""

    def __init__(self, file: GlossaryFile) -> None:
        self.slot_words = {
            value: {language: tuple(words.slot[language]) for language in LANGUAGES}
            for values in file.notions.values()
            for value, words in values.items()
            if words.slot.en
        }
        seen = (word for word in file.notions["visibility"] if word in self.slot_words)
        self.visibility = {word: {one: self.slot_words[word][one][0] for one in LANGUAGES} for word in seen}
        self.written_units = {one: {unit: words[one][0] for unit, words in file.units.items()} for one in LANGUAGES}
        self._units = {
            one: {spelling: unit for unit, words in file.units.items() for spelling in words[one]} for one in LANGUAGES
        }
        self._denials, lists = file.lists["denials"], file.lists
        self._poles = {one: _opposites(file, one) for one in LANGUAGES}
        self._terms = {one: term_pattern([*self._poles[one], *lists["not_terms"][one]], one) for one in LANGUAGES}
        self._states = {one: term_pattern(lists["states"][one], one) for one in LANGUAGES}
        self._idioms = {one: re.compile("|".join(lists["idioms"][one]), re.IGNORECASE) for one in LANGUAGES}

    def spellings(self, language: Language) -> dict[str, str]:
        """Return every spelling of a unit and the unit."""
        return self._units[language]

    def without_idioms(self, text: str, language: Language) -> str:
        """Blank what states nothing of a window, so that the words in it are not taken for statements."""
        return self._idioms[language].sub(lambda match: " " * len(match[0]), text)

    def states(self, text: str, language: Language) -> list[str]:
        """Find words for what a slot can say, opposites aside."""
        return [match.group() for match in self._states[language].finditer(text.lower())]

    def poles(self, text: str, language: Language) -> list[tuple[str, int, int]]:
        """Find opposites in a text: (pair, +1 or -1, position), negations applied."""
        text = text.lower() if language == "en" else text
        found = []
        for match in self._terms[language].finditer(text):
            term = match.group()
            if term not in self._poles[language]:
                continue  # one of not_terms
            name, sign = self._poles[language][term]
            found.append((name, -sign if self.is_negated(text, match.start(), language) else sign, match.start()))
        return found

    def is_negated(self, text: str, start: int, language: Language) -> bool:
        """Return whether a negation stands just before a place of a text (English in small letters)."""
        if language == "zh":
            return text[max(0, start - 4) : start].endswith(tuple(self._denials.zh))
        words = re.findall(r"[a-z']+", re.split(r"[.,;:]", text[max(0, start - 24) : start])[-1])
        return bool(set(self._denials.en).intersection(words[-2:]))

    def pairs(self) -> list[tuple[str, str]]:
        """Return its words of visibility and its units, English and Chinese, as they are written."""
        pairs = [(pair["en"], pair["zh"]) for pair in self.visibility.values()]
        units = {unit: spelling for spelling, unit in reversed(self._units["zh"].items())}
        english = {unit: spelling for spelling, unit in reversed(self._units["en"].items())}
        return pairs + [(english[unit], units[unit]) for unit in english if unit in units]


def _opposites(file: GlossaryFile, language: Language) -> dict[str, tuple[str, int]]:
    """Return the spellings of opposites: word -> its notion, and 1 for the first of the two, -1 for the other."""
    return {
        word: (notion, sign)
        for notion, values in file.notions.items()
        for words, sign in zip((one.opposite for one in values.values() if one.opposite.en), (1, -1), strict=False)
        for word in words[language]
    }


def term_pattern(words: Iterable[str], language: Language) -> re.Pattern[str]:
    """Return the pattern of any of some words, the longest first."""
    options = "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))
    return re.compile(rf"(?<![a-z_])(?:{options})(?![a-z_])" if language == "en" else options)


@cache
def glossary_file() -> GlossaryFile:
    return build(GlossaryFile, read_yaml(GLOSSARY_FILE), GLOSSARY_FILE)


def listed(name: str, language: Language) -> str:
    """Return the words of a list as one pattern, whole words in English."""
    options = "|".join(glossary_file().lists[name][language])
    return rf"\b(?:{options})\b" if language == "en" else f"(?:{options})"


@cache
def mentions(name: str, language: Language | None = None) -> re.Pattern[str]:
    """Return what finds a word of a list; without a language one of either, also within other words."""
    both = (words for one in LANGUAGES for words in glossary_file().lists[name][one])
    return re.compile("|".join(both) if language is None else listed(name, language), re.I)


@cache
def written_units(language: Language) -> dict[str, Unit]:
    """Return every spelling of a unit in running text, foreign ones too."""
    units: dict[str, Unit] = {}
    for name, factors in getattr(glossary_file().written_units, language).items():
        for factor, spellings in factors.items():
            for spelling in filter(None, map(str.strip, spellings.split(","))):
                units.setdefault(spelling, Unit(name, float(factor)))
    return units


@cache
def words_beside(language: Language) -> dict[str, tuple[str, frozenset[str]]]:
    """Return the words with which a sentence with slots may be proved: word -> kind, and the quantities that it speaks
    of."""
    notions, found = glossary_file().notions, dict[str, tuple[str, frozenset[str]]]()
    for names, one in (notions["subject"] | notions["kind"]).items():
        found |= dict.fromkeys(one.beside[language], (names, frozenset((names,))))
    for names, one in notions["quantity"].items():
        kind = "aspect" if names in ASPECTS else "middle" if names.startswith("middle") else "quantity"
        found |= dict.fromkeys(one.beside[language], (kind, frozenset(names.split())))
    return found


@cache
def load_glossary() -> Glossary:
    """Read the glossary."""
    return Glossary(glossary_file())
