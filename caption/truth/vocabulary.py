"""What a run speaks with: its actions, the words that follow from them, its prompts. Chosen by a stage or command, from
its settings or from what stands beside captions, and passed to all that speak or read.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from string import Template

from caption.truth.glossary import load_glossary, term_pattern
from cosfly.products.actions import ActionSet
from cosfly.products.captions import Language


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """actions: the closed set. prompts: name of a prompt file -> its text, with its version line.

    Hashed by identity, so that caches of what is worked out of it are fast.
    """

    actions: ActionSet
    prompts: Mapping[str, str]

    @cached_property
    def names(self) -> dict[str, dict[Language, str]]:
        """The actions' names in running text, by token."""
        return {token: {"en": action.en, "zh": action.zh} for token, action in self.actions.actions.items()}

    @cached_property
    def _translations(self) -> dict[str, str]:
        names = {name["en"]: name["zh"] for name in self.names.values()}
        return names | {pair.en: pair.zh for pair in self.actions.terms}

    def terms_in(self, english: str) -> tuple[tuple[str, str], ...]:
        """Give the names and terms of an English text with their translations."""
        found = dict.fromkeys(match.group() for match in self._terms.finditer(english.lower()))
        return tuple((term, self._translations[term]) for term in found)

    @cached_property
    def _terms(self) -> re.Pattern[str]:
        return term_pattern(self._translations, "en")

    def quoted(self) -> str:
        """Give names, words and terms as lines for a translation prompt."""
        names = [(name["en"], name["zh"]) for name in self.names.values()]
        pairs = [*names, *load_glossary().pairs(), *((pair.en, pair.zh) for pair in self.actions.terms)]
        return "\n".join(f"{en} = {zh}" for en, zh in pairs)

    @cached_property
    def templates(self) -> dict[str, Template]:
        """The prompts without their version lines."""
        return {name: Template(text.partition("\n")[2].rstrip("\n")) for name, text in self.prompts.items()}
