"""The findings of a verification: one line for each kind of problem, with its count and the first places."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import ConfigDict

from cosfly.formats.issues import Issue, Report, Severity, sort_key
from cosfly.runtime.escaping import cut, for_terminal
from release.flight_rows import FlightRows

EXAMPLES = 3  # places of a kind that are named
Words = str | Callable[[int], Any]  # of all rows alike, or of each


class Kind(Issue):
    """All findings of one code; where, got, expected: of the first one."""

    model_config = ConfigDict(extra="forbid", frozen=False)

    examples: list[str]

    def __str__(self) -> str:
        times = "once" if self.count == 1 else f"{self.count:,} times"
        more = f"; also {', '.join(self.examples[1:])}" if len(self.examples) > 1 else ""
        text = f"{self.severity}: {self.code}: {times}: {self.where}: got {self.got}; expected {self.expected}{more}"
        return " ".join(for_terminal(text).split())


@dataclass
class Findings(Report):
    """Findings by kind."""

    kinds: dict[tuple[str, str], Kind] = field(default_factory=dict)

    def add(self, severity: Severity, code: str, where: object, got: object, expected: str) -> None:
        place = cut(str(where))
        kind = Kind(severity=severity, code=code, where=place, got=cut(str(got)), expected=expected, examples=[place])
        self._merge(kind)

    def judge(self, flight: FlightRows, rules: Iterable[tuple[str, str, np.ndarray, Words, Words]]) -> None:
        """Add an error for each row that is wrong. rules: code, column, which rows are wrong (n,) bool, what was found,
        what was expected."""
        for code, column, wrong, *words in rules:
            for i in np.flatnonzero(wrong).tolist():
                got, expected = (one if isinstance(one, str) else one(i) for one in words)
                self.error(code, flight.where(i, column), got, str(expected))

    def merge(self, kinds: Iterable[dict[str, Any]]) -> None:
        """Add what a worker found, as `dumped` gives it."""
        for values in kinds:
            self._merge(Kind.model_validate(values))

    def _merge(self, new: Kind) -> None:
        kind = self.kinds.setdefault((new.severity, new.code), new)
        if kind is not new:
            kind.count += new.count
            kind.examples = (kind.examples + new.examples)[:EXAMPLES]

    def dumped(self) -> list[dict[str, Any]]:
        return [kind.model_dump() for kind in self.kinds.values()]

    def report(self, level: str = "") -> Verified:
        """Return the report of all that was found."""
        return Verified(facts=self.facts, kinds=sorted(self.kinds.values(), key=sort_key), level=level)


@dataclass
class Verified(Report):
    """The report of a verification; of each kind of finding the first places."""

    kinds: list[Kind] = field(default_factory=list)
    level: str = ""

    def __post_init__(self) -> None:
        self.issues = [*self.kinds]

    def as_json(self) -> dict[str, Any]:
        """Return what `--json` writes."""
        return {
            "schema": "cosfly.verification", "schema_version": "1.0", "level": self.level, "ok": self.is_ok,
            "facts": self.facts, "findings": [kind.model_dump(exclude={"where"}) for kind in self.kinds],
        }  # fmt: skip
