"""What an answer becomes: a `Draft`, or why it is `Refused`. How each format reads one: formats.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cosfly.formats.captions import TOKENS, Coc, Template

# Asked for between the texts and the decision. It is free even where the decision is given.
THEREFORE = {"therefore": {"type": "string", "enum": list(TOKENS)}}


@dataclass(frozen=True)
class Draft:
    """A caption in one language.

    Args:
        coc: its plain text. therefore: the decision to which the reasoning leads, of the English alone.
        template: what the text was filled from. outside: the sentences without their slots.
        num_filled: slots that were filled with a value.
    """

    coc: Coc
    outside: tuple[str, ...]
    template: Template | None = None
    num_filled: int = 0
    therefore: str | None = None

    @property
    def written(self) -> dict[str, Any]:
        """The answer as the teacher wrote it: the template where there is one."""
        return self.coc.model_dump() | (self.template.model_dump() if self.template else {})


@dataclass(frozen=True)
class Refused:
    """An answer of the right structure that is not taken.

    Args:
        reason: a code that is counted. complaint: the fault and what is allowed, for the teacher. draft: what could be
            read of the answer.
    """

    reason: str
    complaint: str
    draft: Draft | None = None
