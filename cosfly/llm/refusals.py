"""The causes of refused requests, recognized by the server's text: one table for all servers, `refusals.yaml`.

Servers share no status codes: what one reports as 400 another reports as 422 or 500. The patterns match the texts of
vLLM, SGLang, llama.cpp, TGI, LM Studio, LiteLLM, OpenAI and similar hosts; tests/refusals.tsv lists them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from cosfly.runtime.config import read_yaml

Kind = Literal[
    "account", "too_long", "num_images", "no_vision", "no_system", "schema", "parameter", "content", "unknown"
]

KEY_VARIABLE = "COSFLY_API_KEY"
MOST_CHARACTERS = 4000  # of a text that are searched: some servers echo the request
NEVER = "$^"  # a pattern that matches nothing


class Meaning(NamedTuple):
    """A cause of refusals, matched by a pattern. what, fix: of the error. ends_run: all requests are refused."""

    what: str
    fix: str
    ends_run: bool
    pattern: str = NEVER


def _meanings() -> dict[Kind, Meaning]:
    causes: dict[Kind, dict[str, Any]] = read_yaml(Path(__file__).with_name("refusals.yaml"))
    return {kind: Meaning(pattern="|".join(cause.pop("patterns")) or NEVER, **cause) for kind, cause in causes.items()}


MEANINGS = _meanings()
ADDRESS = Meaning(
    "the server does not have this model, or the URL is not a chat endpoint", "correct the URL or --model", True
)
# The meaning of a status if no pattern matches the text.
STATUSES = dict.fromkeys((401, 403), MEANINGS["account"]) | dict.fromkeys((*range(300, 400), 404, 405), ADDRESS)
# Statuses of a server that is busy or away (above 511: Cloudflare's, 424: TGI's of a failed generation); only an empty
# account takes precedence.
AWAY = frozenset({408, 409, 424, 425, 429, 502, 503, 504, *range(520, 531)})


def kind_of(status: int, text: str) -> Kind:
    """Return the cause of a refusal with this body; `unknown` if no pattern matches."""
    start = text[:MOST_CHARACTERS]
    flags = re.IGNORECASE | re.DOTALL
    matching = (kind for kind, meaning in MEANINGS.items() if re.search(meaning.pattern, start, flags))
    kind: Kind = "account" if status == 402 else next(matching, "unknown")
    # In the text of a failed server these words are not about a window or a schema.
    is_other = status >= 500 and kind in ("content", "schema")
    return "unknown" if is_other or (status in AWAY and kind != "account") else kind


@dataclass(eq=False)
class Refusal(Exception):
    """A request that a server refused.

    message: the server's text, short, in one line, without the key. wait_s: how long the server asks to wait, if it
    does. code: the cause, as tallies count it. may_pass: whether the same request may be answered later, because the
    server is busy, away or broken.
    """

    status: int
    kind: Kind
    message: str
    wait_s: float | None = None

    @property
    def code(self) -> str:
        return f"refused_{self.status if self.kind == 'unknown' else self.kind}"

    def __str__(self) -> str:
        return f"HTTP {self.status} {self.message}".rstrip()

    @property
    def meaning(self) -> Meaning:
        by_text = MEANINGS[self.kind]
        return by_text if by_text.ends_run or self.kind == "content" else STATUSES.get(self.status, by_text)

    @property
    def is_loading(self) -> bool:
        """Whether the server is loading its model."""
        return self.status in AWAY and re.search(r"\bloading\b", self.message, re.IGNORECASE) is not None

    @property
    def may_pass(self) -> bool:
        return self.kind == "unknown" and (self.status in AWAY or self.status >= 500)
