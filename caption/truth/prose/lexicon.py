"""What words mean to the reader: one file per language, compiled to one scan that finds all of them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import NamedTuple

from pydantic import Field

from cosfly.errors import ConfigError
from cosfly.products.captions import Language
from cosfly.work.config import Config, build, read_yaml

Phrases = dict[str, str]  # value -> phrases, separated by commas


class _LexiconFile(Config):
    schema_: str = Field(alias="schema", description="cosfly.prose_lexicon")
    schema_version: str = Field(description="version of this layout")
    quantity: Phrases = Field(description="what is measured")
    who: Phrases = Field(description="whose it is; scenery is nobody's")
    side: Phrases = Field(description="directions in the plane and in the picture")
    trend: Phrases = Field(
        description="how something changes; the prefix says what, none: whatever the clause speaks of"
    )
    visibility: Phrases = Field(description="how much of the target is seen")
    state: Phrases = Field(description="moving or not")
    compare: Phrases = Field(description="of drone against target")
    time: Phrases = Field(description="which frames")
    negation: Phrases = Field(description="words that turn a term round, and those that only look like one")
    modality: Phrases = Field(description="what is not stated as observed")
    hedge: Phrases = Field(description="about, more than, less than")
    link: Phrases = Field(description="small words before a number")
    ratio: Phrases = Field(description="how many times")
    action: Phrases = Field(description="words for the decisions")
    position: Phrases = Field(description="where in the picture")
    bend: Phrases = Field(description="the target's way")
    move: Phrases = Field(description="ways of flying whose side is not a turn")
    units: dict[str, dict[str | int | float, str]] = Field(description="unit -> factor to it -> spellings")


class Token(NamedTuple):
    """A phrase with one of its meanings: kind and value as in the file. start, end: in the masked text."""

    kind: str
    value: str
    start: int
    end: int


class Unit(NamedTuple):
    name: str
    factor: float


class Lexicon:
    """One language's words, compiled."""

    def __init__(self, file: _LexiconFile, language: Language) -> None:
        self.language = language
        self._meanings: dict[str, list[tuple[str, str]]] = {}
        for kind in _LexiconFile.model_fields:
            if kind not in ("schema_", "schema_version", "units"):
                for value, phrases in getattr(file, kind).items():
                    self._add(kind, value, phrases)
        self._scan = _compiled(self._meanings, language)
        self.units: dict[str, Unit] = {}
        for name, factors in file.units.items():
            for factor, spellings in factors.items():
                for spelling in split(spellings):
                    self.units.setdefault(spelling, Unit(name, float(factor)))
        self.unit_pattern = _trie(self.units)

    def _add(self, kind: str, value: str, phrases: str) -> None:
        for phrase in split(phrases):
            for form in inflected(phrase):
                meanings = self._meanings.setdefault(form, [])
                if (kind, value) not in meanings:
                    meanings.append((kind, value))

    def scan(self, masked: str) -> list[Token]:
        """Find the longest phrases of a text, each once for each of its meanings."""
        found = []
        for match in self._scan.finditer(masked):
            start, end = match.span()
            found += [Token(kind, value, start, end) for kind, value in self._meanings[match.group()]]
        return found


def split(phrases: str) -> Iterable[str]:
    return (phrase for phrase in (part.strip() for part in phrases.split(",")) if phrase)


def inflected(phrase: str) -> list[str]:
    """Give every form of a phrase whose words may end in a star: `climb*` is climb, climbs, climbed, climbing."""
    forms = [""]
    for word in phrase.split(" "):
        endings = [word]
        if word.endswith("*"):
            stem = word[:-1]
            endings = [stem, stem + "s", stem + "es", stem + "ed", stem + "d", stem + "ing"]
            if stem.endswith("e"):
                endings.append(stem[:-1] + "ing")
            elif stem.endswith("y"):
                endings += [stem[:-1] + "ies", stem[:-1] + "ied"]
            else:
                endings += [stem + stem[-1] + "ed", stem + stem[-1] + "ing", stem + "e"]
        forms = [f"{form} {ending}".strip() for form in forms for ending in endings]
    return forms


def _compiled(phrases: Iterable[str], language: Language) -> re.Pattern[str]:
    body = _trie(phrases)
    return re.compile(rf"(?<![a-z]){body}(?![a-z])" if language == "en" else body)


def _trie(phrases: Iterable[str]) -> str:
    """Give a pattern of many phrases that shares their beginnings, so that a scan looks at a letter once; longest first."""
    tree: dict = {}
    for phrase in phrases:
        node = tree
        for letter in phrase:
            node = node.setdefault(letter, {})
        node[""] = {}
    return _branch(tree)


def _branch(node: dict) -> str:
    ends = "" in node
    parts = [re.escape(letter) + _branch(child) for letter, child in sorted(node.items()) if letter]
    if not parts:
        return ""
    body = parts[0] if len(parts) == 1 and not ends else "(?:" + "|".join(parts) + ")"
    return body + "?" if ends else body


@cache
def load_lexicon(language: Language) -> Lexicon:
    """Read a language's lexicon, which is part of the package."""
    path = Path(__file__).with_name(f"{language}.yaml")
    data = read_yaml(path)
    if data.get("schema") != "cosfly.prose_lexicon":
        raise ConfigError(f"{path}: schema is {data.get('schema')!r}, expected 'cosfly.prose_lexicon'")
    return Lexicon(build(_LexiconFile, data, str(path)), language)
