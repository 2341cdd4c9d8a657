"""Findings of inspection and of `release verify`: one type, printed in one way."""

from dataclasses import dataclass, field
from typing import Literal

from cosfly.runtime.escaping import cut, for_terminal
from cosfly.runtime.json_io import Record

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


class Issue(Record):
    """One finding. `count`: its occurrences; `where` and `got` are those of the first."""

    severity: Severity
    code: str
    where: str
    got: str
    expected: str
    count: int = 1

    def __str__(self) -> str:
        times = f" ({self.count} times, this is the first)" if self.count > 1 else ""
        text = f"{self.severity}: {self.code}: {self.where}: got {self.got}; expected {self.expected}{times}"
        return " ".join(for_terminal(text).split())


def sort_key(issue: Issue) -> tuple:
    """Return the key that sorts the worst first, then by code and place."""
    return SEVERITIES.index(issue.severity), issue.code, issue.where, issue.got


@dataclass
class Report:
    """Findings of one check run."""

    issues: list[Issue] = field(default_factory=list)
    facts: list[str] = field(default_factory=list)  # lines about what was checked

    def add(self, severity: Severity, code: str, where: object, got: object, expected: str) -> None:
        self.issues.append(
            Issue(severity=severity, code=code, where=cut(str(where)), got=cut(str(got)), expected=expected)
        )

    def error(self, code: str, where: object, got: object, expected: str) -> None:
        self.add("error", code, where, got, expected)

    def warn(self, code: str, where: object, got: object, expected: str) -> None:
        self.add("warning", code, where, got, expected)

    @property
    def is_ok(self) -> bool:
        """Whether there is no error; warnings and notes are allowed."""
        return not self.num("error")

    def num(self, severity: Severity) -> int:
        return sum(issue.count for issue in self.issues if issue.severity == severity)

    def merged(self) -> list[Issue]:
        """Return the first issue of each severity and code, with the number of occurrences, sorted."""
        first: dict[tuple[str, str], Issue] = {}
        for issue in self.issues:
            key = (issue.severity, issue.code)
            num_before = first[key].count if key in first else 0
            first[key] = first.get(key, issue).model_copy(update={"count": num_before + issue.count})
        return sorted(first.values(), key=sort_key)

    def __str__(self) -> str:
        numbers = [(severity, self.num(severity)) for severity in SEVERITIES]
        counts = ", ".join(f"{number:,} {severity}{'' if number == 1 else 's'}" for severity, number in numbers)
        lines = [*map(for_terminal, self.facts), *map(str, sorted(self.issues, key=sort_key))]
        return "\n".join([*lines, f"{'OK' if self.is_ok else 'NOT OK'}: {counts}"])
