"""What one request of the endpoint's doctor gave, read without trust: any field may be of another kind than it should be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cosfly.chat.client import ChatClient
from cosfly.chat.contract import Request
from cosfly.chat.protocol import ERROR_INSTEAD, THOUGHT_FIELDS, final_text, read_body
from cosfly.chat.refusals import Refusal
from cosfly.chat.wire import Response


@dataclass(frozen=True)
class Probe:
    """What one request gave: `value` is the decoded body of a 200, else None and `detail` tells why; refusal: what the server meant."""

    value: dict[str, Any] | None
    detail: str
    seconds: float
    refusal: Refusal | None = None

    @property
    def _choice(self) -> dict:
        choices = (self.value or {}).get("choices")
        first = choices[0] if isinstance(choices, list) and choices else {}
        return first if isinstance(first, dict) else {}

    @property
    def message(self) -> dict:
        message = self._choice.get("message")
        return message if isinstance(message, dict) else {}

    @property
    def text(self) -> str:
        return final_text(self.message) or ""

    @property
    def finish_reason(self) -> str | None:
        reason = self._choice.get("finish_reason")
        return reason if isinstance(reason, str) else None

    @property
    def prompt_tokens(self) -> int | None:
        return self._count("prompt_tokens")

    @property
    def completion_tokens(self) -> int | None:
        return self._count("completion_tokens")

    @property
    def thoughts(self) -> str:
        """What it says before its answer, where a server tells that apart."""
        thoughts = (self.message.get(name) for name in THOUGHT_FIELDS)
        return next((text for text in thoughts if isinstance(text, str) and text), "")

    @property
    def is_too_long(self) -> bool:
        return self.refusal is not None and self.refusal.kind == "too_long"

    def _count(self, name: str) -> int | None:
        usage = (self.value or {}).get("usage")
        count = usage.get(name) if isinstance(usage, dict) else None
        return count if type(count) is int else None


def read_probe(response: Response, request: Request, client: ChatClient, seconds: float) -> Probe:
    """Read a response; `seconds`: what it took."""
    found = client.read(response, request, is_structured=False)
    if isinstance(found, Refusal):
        fix = "" if found.kind == "unknown" else f"; {found.meaning.fix}"
        return Probe(None, found.said + fix, seconds, found)
    if response.is_cut or (isinstance(found, str) and found.startswith(ERROR_INSTEAD)):
        return Probe(None, str(found), seconds)
    try:
        value = read_body(response.body)
    except ValueError:
        return Probe(None, "the body is not JSON", seconds)
    if not isinstance(value, dict):
        return Probe(None, "the body is not a JSON object", seconds)
    return Probe(value, "", seconds)
