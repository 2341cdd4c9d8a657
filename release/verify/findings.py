"""What verification finds: one line for each kind of problem, with its count and the first places; flat in memory however much is wrong."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel, ConfigDict

from cosfly.escaping import cut, for_terminal
from cosfly.products.issues import SEVERITIES, Issue, Report, Severity, sort_key

EXAMPLES = 3  # places of a kind that are named


class Kind(BaseModel):
    """All findings of one code. got, expected: of the first one."""

    model_config = ConfigDict(extra="forbid")

    severity: Severity
    code: str
    count: int = 0
    got: str = ""
    expected: str = ""
    examples: list[str] = []

    def __str__(self) -> str:
        times = "once" if self.count == 1 else f"{self.count:,} times"
        more = f"; also {', '.join(self.examples[1:])}" if len(self.examples) > 1 else ""
        got, expected = self.got, self.expected
        text = f"{self.severity}: {self.code}: {times}: {self.examples[0]}: got {got}; expected {expected}{more}"
        return " ".join(for_terminal(text).split())


@dataclass
class Findings:
    """Findings by kind. `facts` are lines that tell what was checked."""

    kinds: dict[tuple[str, str], Kind] = field(default_factory=dict)
    facts: list[str] = field(default_factory=list)

    def add(self, severity: Severity, code: str, where: object, got: object, expected: str) -> None:
        kind = self.kinds.setdefault((severity, code), Kind(severity=severity, code=code))
        if not kind.count:
            kind.got, kind.expected = cut(str(got)), expected
        kind.count += 1
        if len(kind.examples) < EXAMPLES:
            kind.examples.append(cut(str(where)))

    def error(self, code: str, where: object, got: object, expected: str) -> None:
        self.add("error", code, where, got, expected)

    def warn(self, code: str, where: object, got: object, expected: str) -> None:
        self.add("warning", code, where, got, expected)

    def note(self, code: str, where: object, got: object, expected: str) -> None:
        self.add("note", code, where, got, expected)

    def merge(self, kinds: Iterable[dict[str, Any]]) -> None:
        """Add what a worker found, as `dumped` gives it."""
        for values in kinds:
            new = Kind.model_validate(values)
            kind = self.kinds.setdefault((new.severity, new.code), Kind(severity=new.severity, code=new.code))
            if not kind.count:
                kind.got, kind.expected = new.got, new.expected
            kind.count += new.count
            kind.examples = (kind.examples + new.examples)[:EXAMPLES]

    def dumped(self) -> list[dict[str, Any]]:
        return [kind.model_dump() for kind in self.kinds.values()]

    def report(self) -> Verified:
        """Give the report of all that was found."""
        issues = [
            Issue(severity=k.severity, code=k.code, where=k.examples[0], got=k.got, expected=k.expected, count=k.count)
            for k in self.kinds.values()
        ]
        kinds = sorted(self.kinds.values(), key=lambda kind: (SEVERITIES.index(kind.severity), kind.code))
        return Verified(issues=sorted(issues, key=sort_key), facts=self.facts, kinds=kinds)


@dataclass
class Verified(Report):
    """The report of a verification. `issues` has one entry a kind, the first occurrence's with the count; kinds the first places too."""

    kinds: list[Kind] = field(default_factory=list)
    level: str = ""

    def as_json(self) -> dict[str, Any]:
        """Give what `--json` writes."""
        return {
            "schema": "cosfly.verification",
            "schema_version": "1.0",
            "level": self.level,
            "ok": self.is_ok,
            "facts": self.facts,
            "findings": [kind.model_dump() for kind in self.kinds],
        }

    def __str__(self) -> str:
        counts = ", ".join(
            f"{self.num(severity):,} {severity}{'' if self.num(severity) == 1 else 's'}" for severity in SEVERITIES
        )
        verdict = "OK" if self.is_ok else "NOT OK"
        return "\n".join([*map(for_terminal, self.facts), *map(str, self.kinds), f"{verdict}: {counts}"])
