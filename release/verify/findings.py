"""The findings of a verification: one line for each kind of problem, with its count and the first places."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ConfigDict

from cosfly.formats.issues import Issue, Report, Severity, sort_key
from cosfly.runtime.escaping import cut, for_terminal
from release.reading import TrackRows

EXAMPLES = 3  # places of a kind that are named
Words = str | Callable[[int], Any]  # the same for all rows, or a function of the row's number


class Kind(Issue):
    """All findings of one code; where, got and expected are those of the first one."""

    model_config = ConfigDict(extra="forbid", frozen=False)

    examples: list[str]  # the first places

    def __str__(self) -> str:
        times = f" ({self.count:,} times)" if self.count > 1 else ""
        more = f"; also {', '.join(self.examples[1:])}" if len(self.examples) > 1 else ""
        text = f"{self.severity}: {self.code}{times}: {self.where}: got {self.got}; expected {self.expected}{more}"
        return " ".join(for_terminal(text).split())


@dataclass
class Findings(Report):
    """Findings, one issue of each kind."""

    level: str = ""  # of the verification

    def add(self, severity: Severity, code: str, where: object, got: object, expected: str) -> None:
        place = cut(str(where))
        kind = Kind(severity=severity, code=code, where=place, got=cut(str(got)), expected=expected, examples=[place])
        self.merge([kind])

    def merge(self, kinds: Iterable[Kind]) -> None:
        """Add findings, such as those of a worker."""
        for new in kinds:
            for kind in self.issues:
                if isinstance(kind, Kind) and (kind.severity, kind.code) == (new.severity, new.code):
                    kind.count += new.count
                    kind.examples = (kind.examples + new.examples)[:EXAMPLES]
                    break
            else:
                self.issues.append(new)

    def compare(self, code: str, where: str, got: Any, expected: Any) -> None:
        """Add an error if a value is not the expected one; of mappings one for each key."""
        if isinstance(got, Mapping) and isinstance(expected, Mapping):
            for name in sorted({*got, *expected}):
                self.compare(code, f"{where}: {name}", got.get(name), expected.get(name))
        elif got != expected:
            self.error(code, where, got, str(expected))

    def judge(self, track: TrackRows, rules: Iterable[tuple[str, str, np.ndarray, Words, Words]]) -> None:
        """Add an error for each row that is wrong.

        Args:
            rules: of each rule its code, the column, which of the n rows are wrong, (n,) bool, got, and expected.
        """
        for code, column, is_wrong, got, expected in rules:
            for i in np.flatnonzero(is_wrong).tolist():
                got_here = got if isinstance(got, str) else got(i)
                expected_here = expected if isinstance(expected, str) else expected(i)
                self.error(code, track.where(i, column), got_here, str(expected_here))

    def as_json(self) -> dict[str, Any]:
        """Return what `--json` writes."""
        return {
            "schema": "cosfly.verification", "schema_version": "1.0", "level": self.level, "ok": self.is_ok,
            "facts": self.facts,
            "findings": [kind.model_dump(exclude={"where"}) for kind in sorted(self.issues, key=sort_key)],
        }  # fmt: skip
