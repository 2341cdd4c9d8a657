"""The gold set: captions of free prose that nobody of the project wrote, true to their windows, with errors planted one at a time.

It measures what reads texts (the reader of prose, the covering by claims) and gives `judge-check` its conflicts. A line of a set
holds the measured series of its window (`facts`), a true caption, what its sentences claim, and `false`: changes of one piece of a
text, or of one claim's value, each of which makes the caption false.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from caption.truth.facts import Facts
from cosfly.products.captions import Claim, Coc, Language
from cosfly.reading.documents import model_lines

GOLD_PROSE = Path(__file__).with_name("gold_prose.jsonl")


class PlantedError(BaseModel):
    """One thing made wrong. claim: index of the claim that it makes wrong, `claim_value` that claim's value then."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    kind: str
    field: str | None = None
    old: str = ""
    new: str = ""
    claim: int | None = None
    claim_value: float | str | None = None
    # Sets without `field` give the changed texts as a whole.
    critical_components: str | None = None
    reasoning_trace: str | None = None
    flight_decision: str | None = None

    def in_text(self, coc: Coc) -> Coc:
        """Give the caption with the error in its text."""
        if self.field is not None:
            return coc.model_copy(update={self.field: getattr(coc, self.field).replace(self.old, self.new, 1)})
        changed = {name: getattr(self, name) for name in Coc.model_fields}
        return coc.model_copy(update={name: text for name, text in changed.items() if text is not None})

    def in_claims(self, claims: tuple[Claim, ...]) -> tuple[Claim, ...] | None:
        """Give the claims with the error in one of them; None where no claim can hold it."""
        if self.claim is None or self.claim_value is None:
            return None
        wrong = claims[self.claim].model_copy(update={"value": self.claim_value})
        return (*claims[: self.claim], wrong, *claims[self.claim + 1 :])


class GoldCaption(BaseModel):
    """A true caption with its planted errors. label: the decision that its flight took; None: geometry cannot tell."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    id: str
    language: Language = Field(alias="lang")
    facts: Facts
    label: str | None
    critical_components: str
    reasoning_trace: str
    flight_decision: str
    claims: tuple[Claim, ...] = ()
    errors: tuple[PlantedError, ...] = Field(alias="false")

    @property
    def coc(self) -> Coc:
        return Coc(**{name: getattr(self, name) for name in Coc.model_fields})


def read_gold_prose(path: Path = GOLD_PROSE) -> Iterator[GoldCaption]:
    """Yield the captions of a set, by default the one that ships.

    Raises:
        InputError: names the file, the line and the field.
    """
    return (
        caption for _, caption in model_lines(path, GoldCaption, what="gold captions", fix="give a set of this format")
    )
