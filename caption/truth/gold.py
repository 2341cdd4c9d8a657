"""The gold set of `judge-check`: true captions that nobody of the project wrote, with errors planted one at a time.

A line holds the measured series of its window (`facts`), a true caption, and `errors`: changes of one piece of a text,
each of which makes the caption false.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from caption.truth.facts import Facts
from cosfly.products.captions import Coc, Language
from cosfly.reading.documents import Record, parse_document, validated
from cosfly.reading.files import read_unpacked

GOLD = Path(__file__).with_name("gold.jsonl.gz")


class PlantedError(Record):
    """One thing made wrong."""

    kind: str
    field: Literal["critical_components", "reasoning_trace", "flight_decision"]
    old: str
    new: str

    def in_text(self, coc: Coc) -> Coc:
        """Give the caption with the error in its text."""
        return coc.model_copy(update={self.field: getattr(coc, self.field).replace(self.old, self.new, 1)})


class GoldCaption(Record):
    """A true caption with its planted errors. label: the decision that its flight took."""

    id: str
    language: Language
    facts: Facts
    label: str
    critical_components: str
    reasoning_trace: str
    flight_decision: str
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
