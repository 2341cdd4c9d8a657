"""What was found out about a sentence."""

from __future__ import annotations

from typing import NamedTuple

from cosfly.products.captions import SentenceState


class Judged(NamedTuple):
    """A sentence and what was found out about it. problems: "kind: what", empty unless it is contradicted.

    proved: something in it was compared with the facts, all of that holds, and no numeral or opposite was left out.
    unread: the rest.
    """

    name: str  # C1 is the first sentence of critical_components, R1 of reasoning_trace
    text: str
    state: SentenceState
    problems: tuple[str, ...] = ()
