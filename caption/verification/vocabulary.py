"""The prompts of a run, and the terms whose translation is fixed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from string import Template

from caption.schema import TextState
from caption.verification.glossary import LANGUAGES, load_glossary, term_pattern
from cosfly.formats.captions import ACTIONS

# Terms with a fixed translation, in addition to the names of the actions: English -> Chinese.
TERMS = {
    "target": "目标",
    "pedestrian": "行人",
    "drone": "无人机",
    "bounding box": "边界框",
    "image centre": "画面中心",
    "horizontal distance": "水平距离",
    "altitude": "高度",
    "yaw": "偏航",
    "speed": "速度",
    "current frame": "当前帧",
    "obstacle": "障碍物",
    "stable": "稳定",
}


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """The prompts of a run.

    Hashed by identity, so that caches of its prompts are fast.

    Args:
        prompts: name of a prompt file -> its text, with its version line.
        text_state: which flight data the questions contain.
    """

    prompts: Mapping[str, str]
    text_state: TextState = "relative"

    @cached_property
    def templates(self) -> dict[str, Template]:
        """The prompts without their version lines; `user_en` and `user_zh` are those of the text state."""
        templates = {name: Template(text.partition("\n")[2].rstrip("\n")) for name, text in self.prompts.items()}
        if self.text_state == "paper":
            templates |= {f"user_{language}": templates[f"user_paper_{language}"] for language in LANGUAGES}
        return templates

    def quoted(self) -> str:
        """Return the fixed translations as lines of a prompt."""
        names = [(action.en, action.zh) for action in ACTIONS.values()]
        return "\n".join(f"{en} = {zh}" for en, zh in [*names, *load_glossary().pairs(), *TERMS.items()])


_TRANSLATIONS = {action.en: action.zh for action in ACTIONS.values()} | TERMS


@cache
def _terms() -> re.Pattern[str]:
    return term_pattern(_TRANSLATIONS, "en")


def terms_in(english: str) -> tuple[tuple[str, str], ...]:
    """Return the names and terms of an English text with their translations."""
    found = dict.fromkeys(match.group() for match in _terms().finditer(english.lower()))
    return tuple((term, _TRANSLATIONS[term]) for term in found)
