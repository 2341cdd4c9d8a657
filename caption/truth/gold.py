"""The gold set: captions of free prose that nobody of the project wrote, true to their windows, with errors planted one
at a time.

It measures what reads texts (readers, the rules for prose, the covering by claims) and gives `judge-check` its
conflicts. A line holds
the measured series of its window (`facts`), a true caption, in sets 1 and 2 what its writer says that its sentences
claim, and `errors`: changes of one piece of a text, or of one claim's value, each of which makes the caption false.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from caption.truth.facts import Facts
from cosfly.products.captions import Claim, Coc, Language
from cosfly.reading.documents import parse_document, validated
from cosfly.reading.files import read_unpacked

GOLD = Path(__file__).with_name("gold.jsonl.gz")


class PlantedError(BaseModel):
    """One thing made wrong. claim: index of the claim that it makes wrong, `claim_value` that claim's value then."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: str
    field: Literal["critical_components", "reasoning_trace", "flight_decision"]
    old: str
    new: str
    claim: int | None = None
    claim_value: float | str | None = None

    def in_text(self, coc: Coc) -> Coc:
        """Give the caption with the error in its text."""
        return coc.model_copy(update={self.field: getattr(coc, self.field).replace(self.old, self.new, 1)})

    def in_claims(self, claims: tuple[Claim, ...]) -> tuple[Claim, ...] | None:
        """Give the claims with the error in one of them; None where no claim can hold it."""
        if self.claim is None or self.claim_value is None:
            return None
        wrong = claims[self.claim].model_copy(update={"value": self.claim_value})
        return (*claims[: self.claim], wrong, *claims[self.claim + 1 :])


class GoldCaption(BaseModel):
    """A true caption with its planted errors. set: who wrote it, 1 to 18. label: the decision that its flight took;
    None: geometry cannot tell."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str
    set: int
    language: Language
    facts: Facts
    label: str | None
    critical_components: str
    reasoning_trace: str
    flight_decision: str
    claims: tuple[Claim, ...] = ()
    errors: tuple[PlantedError, ...]

    @property
    def coc(self) -> Coc:
        return Coc(**{name: getattr(self, name) for name in Coc.model_fields})


def read_gold(path: Path = GOLD) -> Iterator[GoldCaption]:
    """Yield the captions of a set, by default the one that ships."""
    for number, line in enumerate(read_unpacked(path, what="gold captions").splitlines(), 1):
        where = f"{path}:{number}"
        value = parse_document(line, where, what="line")
        yield validated(GoldCaption, value, where)
