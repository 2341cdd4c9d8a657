"""The words of both languages, `glossary.yaml`: the one reader of them."""

import re
from collections import Counter
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from cosfly.formats.captions import ACTIONS, Language
from cosfly.runtime.config import read_yaml

GLOSSARY_FILE = Path(__file__).with_name("glossary.yaml")
LANGUAGES: tuple[Language, Language] = ("en", "zh")
VISIBILITY = ("visible", "partly_occluded", "illegible", "occluded", "out_of_view")


class Unit(NamedTuple):
    """A unit as it is written: its name among ours, and the factor to it."""

    name: str
    factor: float


@cache
def _glossary() -> dict[str, Any]:
    return read_yaml(GLOSSARY_FILE)


# --- words that are written -------------------------------------------------------------------------------------------


def form_of(word: str, form: int, language: Language) -> str:
    """Return a word of the facts as it is written; text that is no such word stays as it is."""
    if word not in _glossary()["slots"]:
        return word
    forms = _glossary()["slots"][word][language]
    return str(forms[min(form, len(forms) - 1)])


def form_after(before: str) -> int:
    """Return the form of an English verb after these words; Chinese has one."""
    return next((form for form, pattern in _before_forms().items() if pattern.search(before)), 0)


@cache
def _before_forms() -> dict[int, re.Pattern[str]]:
    """Return form of a verb -> pattern of the words before it, the longest first: after "has", "to", "is"."""
    words = _glossary()["before_forms"]
    adverbs = rf"(?:\s+(?:{'|'.join(words['adverbs'])}))*\s*$"
    patterns = {form: "|".join(words["patterns"][form]) for form in (2, 3, 1)}
    return {form: re.compile(pattern.replace("ADVERBS", adverbs), re.IGNORECASE) for form, pattern in patterns.items()}


def written_unit(unit: str, language: Language) -> str:
    return str(_glossary()["units"][unit][language][0])


def prompt_line(name: str, language: Language) -> str:
    return str(_glossary()["prompt_lines"][name][language])


def translations() -> list[tuple[str, str]]:
    """Return the English and Chinese of all that has a fixed translation: actions, visibility, units, terms."""
    seen = [(form_of(word, 0, "en"), form_of(word, 0, "zh")) for word in VISIBILITY]
    units = [(written_unit(unit, "en"), written_unit(unit, "zh")) for unit in _glossary()["units"]]
    return [*_names().items(), *seen, *units, *_glossary()["terms"].items()]


def terms_in(english: str) -> dict[str, str]:
    """Return the names of actions and the terms of an English text with their translations."""
    pattern, known = _terms()
    return {match.group(): known[match.group()] for match in pattern.finditer(english.lower())}


@cache
def _terms() -> tuple[re.Pattern[str], dict[str, str]]:
    known = _names() | _glossary()["terms"]
    return _any_of(known, "en"), known


def _names() -> dict[str, str]:
    return {action.en: action.zh for action in ACTIONS.values()}


# --- words that are read ----------------------------------------------------------------------------------------------


@cache
def spellings(language: Language) -> dict[str, str]:
    """Return the spellings of a unit that may stand behind a slot, and the unit."""
    return {spelling: unit for unit, words in _glossary()["units"].items() for spelling in words[language]}


@cache
def written_units(language: Language) -> dict[str, Unit]:
    """Return every spelling of a unit in running text, foreign ones too."""
    units: dict[str, Unit] = {}
    for name, factors in _glossary()["written_units"][language].items():
        for factor, written in factors.items():
            for spelling in filter(None, map(str.strip, written.split(","))):
                units.setdefault(spelling, Unit(name, float(factor)))
    return units


@cache
def mentions(kind: str, name: str, language: Language) -> re.Pattern[str]:
    """Return the pattern that finds a word of a list of the glossary, such as `comparatives`, or of one quantity or
    subject (`name`, otherwise "") of a list of these."""
    words = _glossary()[kind]
    options = "|".join((words[name] if name else words)[language])
    return re.compile(rf"\b(?:{options})\b" if language == "en" else f"(?:{options})", re.IGNORECASE)


def mentioned(kind: str, text: str, language: Language) -> list[str]:
    """Return the quantities or subjects that a text names."""
    return [name for name in _glossary()[kind] if mentions(kind, name, language).search(text)]


def stands_at(kind: str, before: str, after: str, language: Language) -> bool:
    """Return whether a word for "more", "less" or "about" stands before or behind a number."""
    ahead, behind = _around(kind, language)
    return bool(ahead.search(before) or behind.match(after))


@cache
def _around(kind: str, language: Language) -> tuple[re.Pattern[str], re.Pattern[str]]:
    """Return the patterns of the words before and behind a number."""
    words = _glossary()["around_numbers"][kind]
    ahead, behind = "|".join(words["before"][language]), "|".join(words["behind"][language])
    return re.compile(rf"(?:{ahead})\s*$", re.IGNORECASE), re.compile(rf"\s*(?:{behind})", re.IGNORECASE)


@cache
def ends_of_clauses(language: Language) -> re.Pattern[str]:
    return re.compile("|".join(_glossary()["ends_of_clauses"][language]), re.IGNORECASE)


def is_negated(text: str, start: int, language: Language) -> bool:
    """Return whether one of the two words before a place of a text, in small letters, is a negation."""
    negations = _glossary()["negations"][language]
    if language == "zh":
        return text[max(0, start - 4) : start].endswith(tuple(negations))
    clause = re.split(r"[.,;:]", text[max(0, start - 24) : start])[-1]  # two words take no more than 24 characters
    words_before = re.findall(r"[a-z']+", clause)[-2:]
    return not set(negations).isdisjoint(words_before)


def swapped_opposite(english: str, chinese: str) -> str | None:
    """Return the name of an opposite of which one side is lost and the other one gained in the translation."""
    counts_en, counts_zh = count_opposites(english, "en"), count_opposites(chinese, "zh")
    for name in sorted({name for name, _ in counts_en.keys() | counts_zh.keys()}):
        for sign in (1, -1):
            is_lost = counts_zh[name, sign] < counts_en[name, sign]
            if is_lost and counts_zh[name, -sign] > counts_en[name, -sign]:
                return name
    return None


def count_opposites(text: str, language: Language) -> Counter[tuple[str, int]]:
    """Count the opposites of a text: (name, 1 for the first of its two sides, -1 for the other), negations applied."""
    pattern, opposites = _opposites(language)
    counts = Counter[tuple[str, int]]()
    text = text.lower() if language == "en" else text
    for match in pattern.finditer(text):
        if match.group() in opposites:
            name, sign = opposites[match.group()]
            counts[name, -sign if is_negated(text, match.start(), language) else sign] += 1
    return counts


@cache
def _opposites(language: Language) -> tuple[re.Pattern[str], dict[str, tuple[str, int]]]:
    """Return the pattern of opposites, and of what looks like one; spelling -> its opposite and side."""
    opposites = {
        word: (name, sign)
        for name, sides in _glossary()["opposites"].items()
        for words, sign in zip(sides.values(), (1, -1), strict=True)
        for word in words[language]
    }
    return _any_of([*opposites, *_glossary()["not_opposites"][language]], language), opposites


def _any_of(words: Iterable[str], language: Language) -> re.Pattern[str]:
    """Return the pattern of any of some words, the longest first."""
    options = "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))
    return re.compile(rf"(?<![a-z_])(?:{options})(?![a-z_])" if language == "en" else options)
