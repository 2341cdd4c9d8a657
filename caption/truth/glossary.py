"""The bilingual glossary (`glossary.yaml`, and the names and terms of the actions in use): words, units, opposites.

One reader, one frozen record with its patterns compiled; everything that writes or compares the two languages takes it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from pydantic import Field

from cosfly.products.actions import ActionSet, actions_in_use
from cosfly.products.captions import Language
from cosfly.work import in_place
from cosfly.work.config import Config, build, read_yaml

GLOSSARY_FILE = Path(__file__).with_name("glossary.yaml")
LANGUAGES: tuple[Language, Language] = ("en", "zh")


class _Pair(Config):
    en: str = Field(description="English")
    zh: str = Field(description="Chinese")


class _Spellings(Config):
    en: list[str] = Field(description="English")
    zh: list[str] = Field(description="Chinese")


class _Factors(Config):
    en: dict[str, dict[str | int | float, str]] = Field(description="unit -> factor to it -> English spellings")
    zh: dict[str, dict[str | int | float, str]] = Field(description="and Chinese")


class _Opposites(Config):
    positive: _Spellings = Field(description="one side")
    negative: _Spellings = Field(description="the other side")


class _Forms(Config):
    en: list[str] = Field(min_length=1, description="forms of a word in English")
    zh: list[str] = Field(min_length=1, description="and in Chinese")


class _Beside(Config):
    quantities: dict[str, _Pair] = Field(description="quantities, or the aspect of one, -> words that speak of them")
    kinds: dict[str, _Pair] = Field(description="kind -> its words")


class _GlossaryFile(Config):
    schema_: str = Field(alias="schema", description="cosfly.glossary")
    schema_version: str = Field(description="version of this layout")
    visibility: dict[str, _Pair] = Field(description="visibility words")
    units: dict[str, _Spellings] = Field(description="unit -> spellings, the first is written")
    written_units: _Factors = Field(description="every way a unit is written in running text")
    polarity: dict[str, _Opposites] = Field(description="opposites")
    negations: _Spellings = Field(description="words that turn a term round")
    not_terms: _Spellings = Field(description="spellings that hold a term but do not mean it")
    slot_words: dict[str, dict[str, _Forms]] = Field(
        description="kind -> what is true -> the words that a slot is filled with"
    )
    states: _Spellings = Field(description="words beside slots for what a slot can say")
    beside: _Beside = Field(description="words beside slots with which a sentence may be proved")
    idioms: _Spellings = Field(description="patterns in which an opposite states nothing of this window")


class Unit(NamedTuple):
    """A unit as it is written: its name among ours, and the factor to it."""

    name: str
    factor: float


class Glossary:
    """The glossary with its patterns compiled."""

    def __init__(self, file: _GlossaryFile, actions: ActionSet) -> None:
        self.actions = {token: {"en": action.en, "zh": action.zh} for token, action in actions.actions.items()}
        self.visibility = {word: {"en": pair.en, "zh": pair.zh} for word, pair in file.visibility.items()}
        self.terms = [(pair.en, pair.zh) for pair in actions.terms]
        self._units: dict[Language, dict[str, str]] = {"en": {}, "zh": {}}
        for unit, spellings in file.units.items():
            for language in LANGUAGES:
                self._units[language].update(dict.fromkeys(getattr(spellings, language), unit))
        self.written_units: dict[Language, dict[str, str]] = {
            language: {unit: spellings[0] for unit, spellings in _by_unit(file, language)} for language in LANGUAGES
        }
        self._poles: dict[Language, dict[str, tuple[str, int]]] = {"en": {}, "zh": {}}
        for name, pair in file.polarity.items():
            for language in LANGUAGES:
                self._poles[language].update(dict.fromkeys(getattr(pair.positive, language), (name, 1)))
                self._poles[language].update(dict.fromkeys(getattr(pair.negative, language), (name, -1)))
        self._negations_en, self._negations_zh = set(file.negations.en), tuple(file.negations.zh)
        self._terms = {
            language: _term_pattern(self._poles[language], getattr(file.not_terms, language), language)
            for language in LANGUAGES
        }
        self.slot_words = {
            word: {"en": tuple(forms.en), "zh": tuple(forms.zh)}
            for words in file.slot_words.values()
            for word, forms in words.items()
        }
        self._states = {
            language: _term_pattern(dict.fromkeys(getattr(file.states, language), ("", 0)), [], language)
            for language in LANGUAGES
        }
        self._idioms = {
            language: re.compile("|".join(getattr(file.idioms, language)), re.IGNORECASE) for language in LANGUAGES
        }
        pairs = [*((action.en, action.zh) for action in actions.actions.values()), *self.terms]
        self._translations = dict(pairs)
        self._translated = _term_pattern(dict.fromkeys(self._translations, ("", 0)), [], "en")

    def spellings(self, language: Language) -> dict[str, str]:
        """Give every spelling of a unit and the unit."""
        return self._units[language]

    def without_idioms(self, text: str, language: Language) -> str:
        """Blank what states nothing of a window, so that the words in it are not taken for statements."""
        return self._idioms[language].sub(lambda match: " " * len(match[0]), text)

    def states(self, text: str, language: Language) -> list[str]:
        """Find words for what a slot can say, opposites aside."""
        return [match.group() for match in self._states[language].finditer(text.lower())]

    def terms_in(self, english: str) -> tuple[tuple[str, str], ...]:
        """Give the terms of an English text with their translations."""
        found = dict.fromkeys(match.group() for match in self._translated.finditer(english.lower()))
        return tuple((term, self._translations[term]) for term in found)

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
        """Tell whether a negation stands just before a place of a text (English in small letters)."""
        if language == "zh":
            return text[max(0, start - 4) : start].endswith(self._negations_zh)
        words = re.findall(r"[a-z']+", re.split(r"[.,;:]", text[max(0, start - 24) : start])[-1])
        return bool(self._negations_en.intersection(words[-2:]))

    def quoted(self) -> str:
        """Give the glossary as lines for a translation prompt."""
        pairs = [(pair["en"], pair["zh"]) for group in (self.actions, self.visibility) for pair in group.values()]
        units = {unit: spelling for spelling, unit in reversed(self._units["zh"].items())}
        english = {unit: spelling for spelling, unit in reversed(self._units["en"].items())}
        pairs += [(english[unit], units[unit]) for unit in english if unit in units]
        return "\n".join(f"{en} = {zh}" for en, zh in pairs + self.terms)


def _by_unit(file: _GlossaryFile, language: Language) -> Iterator[tuple[str, list[str]]]:
    return ((unit, getattr(spellings, language)) for unit, spellings in file.units.items())


def _term_pattern(poles: dict[str, tuple[str, int]], not_terms: list[str], language: Language) -> re.Pattern[str]:
    words = sorted([*poles, *not_terms], key=len, reverse=True)
    options = "|".join(re.escape(word) for word in words)
    return re.compile(rf"(?<![a-z_])(?:{options})(?![a-z_])" if language == "en" else options)


@cache
def _file() -> _GlossaryFile:
    return build(_GlossaryFile, read_yaml(GLOSSARY_FILE), GLOSSARY_FILE)


@cache
def written_units(language: Language) -> dict[str, Unit]:
    """Give every spelling of a unit in running text, foreign ones too."""
    units: dict[str, Unit] = {}
    for name, factors in getattr(_file().written_units, language).items():
        for factor, spellings in factors.items():
            for spelling in filter(None, map(str.strip, spellings.split(","))):
                units.setdefault(spelling, Unit(name, float(factor)))
    return units


@cache
def words_beside(language: Language) -> dict[str, tuple[str, frozenset[str]]]:
    """Give the words with which a sentence with slots may be proved: word -> kind, and the quantities that it speaks
    of."""
    beside, found = _file().beside, dict[str, tuple[str, frozenset[str]]]()
    for names, pair in (beside.kinds | beside.quantities).items():
        kind = names if names in beside.kinds else "aspect" if names in ("mean", "min", "max", "change") else "quantity"
        kind = "middle" if names.startswith("middle") else kind
        words = filter(None, map(str.strip, getattr(pair, language).split(",")))
        found |= dict.fromkeys(words, (kind, frozenset(names.split())))
    return found


@in_place.kept()
def load_glossary() -> Glossary:
    """Read the glossary, and put the actions in use into it."""
    return Glossary(_file(), actions_in_use())
