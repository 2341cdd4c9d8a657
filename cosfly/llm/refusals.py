"""The causes of refused requests, recognized by the server's text: one table for all servers.

Servers share no status codes: what one reports as 400 another reports as 422 or 500. The patterns match the texts of
vLLM, SGLang, llama.cpp, TGI, LM Studio, LiteLLM, OpenAI and similar hosts; tests/refusals.tsv lists them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, NamedTuple

from cosfly.llm.protocol import KEY_VARIABLE

Kind = Literal["account", "too_long", "num_images", "no_vision", "schema", "parameter", "content", "unknown"]

MOST_CHARACTERS = 4000  # of a text that are searched: some servers echo the request


class Meaning(NamedTuple):
    """A cause of refusals, matched by a pattern. what, fix: of the error. ends_run: all requests are refused."""

    what: str
    fix: str
    ends_run: bool
    pattern: str = "$^"


SMALLER = "send smaller pictures (image.max_side_px) or fewer (image.modalities, image.layout=tiled)"
# The first pattern that matches counts: specific ones come before general ones.
MEANINGS: dict[Kind, Meaning] = {
    "account": Meaning(
        "the account has no credit left",
        "add credit to the account, then run the same command again",
        True,
        r"insufficient[_ ](quota|balance|credit|fund)|billing_hard_limit|credit balance is too low",
    ),
    "too_long": Meaning(
        "prompt and answer do not fit the server's context",
        f"raise the context (vLLM: --max-model-len, llama.cpp: --ctx-size), lower endpoint.max_tokens, or {SMALLER}",
        False,
        r"context[_ ](length|size|window)|maximum model length|max_model_len|exceed_context|max_tokens is too large"
        r"|longer than the (maximum|model)|prompt is too long|input length|max_new_tokens|input is too long"
        r"|max_tokens` or `max_completion_tokens|max_tokens must be at least 1|`inputs` must have less than"
        r"|input token count|maximum (allowed length|number of tokens)|(maximum|max)_?[_ ]sequence[_ ]length"
        r"|max_num_tokens|session max length|max length exceeded|model token limit|too many tokens",
    ),
    "num_images": Meaning(
        "the prompts have more or larger pictures than the server accepts",
        f"raise the limit (vLLM: --limit-mm-per-prompt), or {SMALLER}",
        True,
        r"at most \d+ (image|item)|too many images|image count \d+ exceeds|\d+ images, exceeding|too much media"
        r"|images? .{0,60}(exceeds? (the )?(limit|maximum)|per (request|prompt|message))|encoder cache size"
        r"|limit-mm-per-prompt|images? exceeds? max",
    ),
    "no_vision": Meaning(
        "the model or its server does not accept pictures",
        "serve a vision model (llama.cpp: with --mmproj)",
        True,
        r"not a multimodal model|mmproj|image input is not supported|(does|do)( not|n't) support (image|vision"
        r"|multimodal)|support image input|image_url is only supported|unknown variant `?image_url|only supports? text"
        r"|invalid type: sequence, expected a string|cannot unmarshal array into .{0,80}content",
    ),
    "schema": Meaning(
        "the server refuses the JSON schema",
        "set endpoint.json_schema=false",
        False,
        r"response[_ ]?format|response_?(json_?)?schema|json[_ ]schema|guided[_ ](json|decoding)|structured[_ ]outputs?"
        r"|grammar|llguidance|outlines",
    ),
    "parameter": Meaning(
        "the server refuses a parameter of the request",
        "set supported parameters in endpoint (temperature, top_p, max_tokens, extra_body); null in extra_body removes "
        "a field",
        True,
        r"unsupported[_ ](parameter|value)|unsupportedparams|unrecognized request argument|extra_forbidden"
        r"|extra inputs are not permitted|not support (the )?parameters?|argument not supported|unknown name"
        r"|not supported (with|by|for|on) this model|unknown (field|parameter)|unexpected keyword"
        r"|property .{0,80}is unsupported",
    ),
    "content": Meaning(
        "the server's filter refuses the content",
        "look at the pictures of the window, or use another server",
        False,
        r"content[_ ](filter|management policy|policy)|data_?inspection|inappropriate content|safety|moderation"
        r"|flagged",
    ),
    "unknown": Meaning("the server refuses the request", "read the log of the server", False),
}
STATUSES = {  # meaning of a status if no pattern matches the text
    **dict.fromkeys((401, 403), Meaning("the server refuses the API key", f"set {KEY_VARIABLE} to a valid key", True)),
    404: Meaning(
        "the server does not have this model, or the URL is not a chat endpoint", "correct the URL or --model", True
    ),
    **dict.fromkeys((*range(300, 400), 405), Meaning("the URL is not a chat endpoint", "correct the URL", True)),
}
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


@dataclass(frozen=True)
class Refusal:
    """A request that a server refused.

    message: the server's text, short, in one line, without the key. code: the cause, as tallies count it. summary:
    status and message. may_pass: whether the same request may be answered later, because the server is busy, away or
    broken.
    """

    status: int
    kind: Kind
    message: str

    @property
    def code(self) -> str:
        return f"refused_{self.status if self.kind == 'unknown' else self.kind}"

    @property
    def summary(self) -> str:
        return f"HTTP {self.status} {self.message}".rstrip()

    @property
    def meaning(self) -> Meaning:
        by_text = MEANINGS[self.kind]
        return by_text if by_text.ends_run or self.kind == "content" else STATUSES.get(self.status, by_text)

    @property
    def may_pass(self) -> bool:
        return self.kind == "unknown" and (self.status in AWAY or self.status >= 500)


class RefusedRequest(Exception):
    """A request was refused. wait_s: How long the server asks to wait, if it does."""

    def __init__(self, refusal: Refusal, wait_s: float | None) -> None:
        super().__init__(refusal.summary)
        self.refusal = refusal
        self.wait_s = wait_s
