"""What a server means when it refuses a request, from the words that it gives: one table for all servers.

Servers agree on no codes: what one calls 400 another calls 422 or 500. The patterns are of what vLLM, SGLang,
llama.cpp, TGI, LM Studio, LiteLLM, OpenAI and hosts like it say; tests/refusals.tsv holds their texts. The table names
a cause, and decides what no other window would fare better with.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

Kind = Literal["account", "too_long", "num_images", "no_vision", "schema", "parameter", "content", "unknown"]

MOST_CHARACTERS = 4000  # of a text that are searched: some servers send the request back


@dataclass(frozen=True)
class Meaning:
    """what: to say where the server is at fault. fix: what to do. ends_run: it is the server's fault, whatever was
    asked."""

    what: str
    fix: str
    ends_run: bool


SMALLER = "send smaller pictures (image.max_side_px) or fewer (image.modalities, image.layout=tiled)"
MEANINGS: dict[Kind, Meaning] = {
    "account": Meaning("the account has no credit left", "see to the account, then run the same command again", True),
    "too_long": Meaning(
        "prompt and answer do not fit the server's context",
        f"raise the context (vLLM: --max-model-len, llama.cpp: --ctx-size), lower endpoint.max_tokens, or {SMALLER}",
        False,
    ),
    "num_images": Meaning(
        "the server takes fewer or smaller pictures than the prompts hold",
        f"raise the limit (vLLM: --limit-mm-per-prompt), or {SMALLER}",
        True,
    ),
    "no_vision": Meaning(
        "the model or its server takes no pictures", "serve a vision model (llama.cpp: with --mmproj)", True
    ),
    "schema": Meaning("the server refuses the JSON schema", "set endpoint.json_schema=false", False),
    "parameter": Meaning(
        "the server refuses a parameter of the request",
        "set what it takes in endpoint (temperature, top_p, max_tokens, extra_body); null in extra_body leaves a field "
        "out",
        True,
    ),
    "content": Meaning("the server's filter refuses the content", "look at the window, or ask another server", False),
    "unknown": Meaning("the server refuses the request", "see to the server", False),
}

# The first that matches counts: what is specific stands before what is general.
_PATTERNS: tuple[tuple[Kind, str], ...] = (
    ("account", r"insufficient[_ ](quota|balance|credit|fund)|billing_hard_limit|credit balance is too low"),
    (
        "too_long",
        r"context[_ ](length|size|window)|maximum model length|max_model_len|exceed_context|longer than the (maximum"
        r"|model)"
        r"|prompt is too long|input length|max_new_tokens|max_tokens` or `max_completion_tokens|max_tokens is too large"
        r"|max_tokens must be at least 1|`inputs` must have less than|input token count|maximum (allowed length|number "
        r"of tokens)"
        r"|(maximum|max)_?[_ ]sequence[_ ]length|max_num_tokens|session max length|max length exceeded|model token "
        r"limit|input is too long|too many tokens",
    ),
    (
        "num_images",
        r"at most \d+ (image|item)|too many images|image count \d+ exceeds|\d+ images, exceeding|too much media"
        r"|images? .{0,60}(exceeds? (the )?(limit|maximum)|per (request|prompt|message))|encoder cache size"
        r"|limit-mm-per-prompt|images? exceeds? max",
    ),
    (
        "no_vision",
        r"not a multimodal model|mmproj|image input is not supported|(does|do)( not|n't) support (image|vision"
        r"|multimodal)|support image input|image_url is only supported|unknown variant `?image_url|only supports? text"
        r"|invalid type: sequence, expected a string|cannot unmarshal array into .{0,80}content",
    ),
    (
        "schema",
        r"response[_ ]?format|response_?(json_?)?schema|json[_ ]schema|guided[_ ](json|decoding)|structured[_ ]outputs?"
        r"|grammar|llguidance|outlines",
    ),
    (
        "parameter",
        r"unsupported[_ ](parameter|value)|unsupportedparams|unrecognized request argument|extra_forbidden"
        r"|extra inputs are not permitted|not support (the )?parameters?|argument not supported|unknown name"
        r"|not supported (with|by|for|on) this model|unknown (field|parameter)|unexpected keyword"
        r"|property .{0,80}is unsupported",
    ),
    (
        "content",
        r"content[_ ](filter|management policy|policy)|data_?inspection|inappropriate content|safety|moderation"
        r"|flagged",
    ),
)
_TABLE = tuple((kind, re.compile(pattern, re.IGNORECASE | re.DOTALL)) for kind, pattern in _PATTERNS)
# Statuses of a server that is busy or away, those above 511 Cloudflare's: whatever else their texts say, only an empty
# account is more than that. 424 is what TGI says of a generation that broke.
AWAY = frozenset({408, 409, 424, 425, 429, 502, 503, 504, *range(520, 531)})


def kind_of(status: int, text: str) -> Kind:
    """Name what a refusal means; `unknown` where the table does not know its text.

    Args:
        text: the body as it came.
    """
    text = text[:MOST_CHARACTERS]
    found = (kind for kind, pattern in _TABLE if pattern.search(text))
    kind: Kind = "account" if status == 402 else next(found, "unknown")
    if status >= 500 and kind in ("content", "schema"):
        return "unknown"  # these words in the text of a server that failed are no verdict on a window or a schema
    return "unknown" if status in AWAY and kind != "account" else kind


@dataclass(frozen=True)
class Refusal:
    """A request that a server refused; `words`: what it says, short, in one line, without a key."""

    status: int
    kind: Kind
    words: str

    @property
    def code(self) -> str:
        """A word for tallies."""
        return f"refused_{self.status if self.kind == 'unknown' else self.kind}"

    @property
    def said(self) -> str:
        return f"HTTP {self.status} {self.words}".rstrip()

    @property
    def meaning(self) -> Meaning:
        return MEANINGS[self.kind]

    @property
    def may_pass(self) -> bool:
        """Whether the same request may be answered later: the server is busy, away or broken."""
        return self.kind == "unknown" and (self.status in AWAY or self.status >= 500)
