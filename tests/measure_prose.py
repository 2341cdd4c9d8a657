"""Measure the judging of texts on captions that somebody else wrote: true ones flagged, one-change errors caught.

    python tests/measure_prose.py claims|prose [FILE...] [--only PREFIX...] [--show]

Files are gold sets (caption/truth/gold.py), by default the one that ships; --only: the captions whose id begins so. Figures by where
the error was planted (text, claims, both), language and kind; --show prints the true captions that were flagged and the errors that
were missed.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from caption.schema import EvidenceConfig
from caption.truth.claims import judge_claims
from caption.truth.facts import Facts
from caption.truth.gold import GOLD_PROSE, GoldCaption, PlantedError, read_gold_prose
from caption.truth.prose import check_prose
from cosfly.products.captions import Claim, Coc, Language

GROUPS = {"numbers": ("num", "halluc", "unit", "words", "ratio"), "sides": ("side", "clock")}
WHERE = ("text", "claims", "both")


Problems = Callable[[Coc, tuple[Claim, ...], Facts, Language], list[str]]


def planted(line: GoldCaption, error: PlantedError, where: str) -> tuple[Coc, tuple[Claim, ...]] | None:
    """Give the caption with an error in its text, its claims or both; None where the error has no claim to stand in."""
    coc = line.coc if where == "claims" else error.in_text(line.coc)
    claims = line.claims if where == "text" else error.in_claims(line.claims)
    return None if claims is None else (coc, claims)


def claims_problems(coc: Coc, claims: tuple[Claim, ...], facts: Facts, language: Language) -> list[str]:
    judged = judge_claims(coc, claims, facts, EvidenceConfig(), language)
    return [f"{one.name} {problem}" for one in judged for problem in one.problems]


def prose_problems(coc: Coc, claims: tuple[Claim, ...], facts: Facts, language: Language) -> list[str]:
    return check_prose(coc, facts, language)


MODES: dict[str, tuple[Problems, tuple[str, ...]]] = {
    "claims": (claims_problems, WHERE),
    "prose": (prose_problems, ("text",)),
}


@dataclass
class Score:
    """Counts of one measurement. caught, planted: (where, language, kind) -> errors."""

    num_true: int
    flagged: list[tuple[str, list[str]]]
    planted: Counter[tuple[str, str, str]]
    caught: Counter[tuple[str, str, str]]
    missed: list[tuple[str, str, PlantedError]]

    @property
    def flagged_share(self) -> float:
        return len(self.flagged) / self.num_true

    def caught_share(self, index: int = 0, value: str | None = None) -> float:
        """Share of the errors whose key has a value at an index; of all without."""
        keys = [key for key in self.planted if value is None or key[index] == value]
        return sum(self.caught[key] for key in keys) / max(1, sum(self.planted[key] for key in keys))


def measure(lines: Iterable[GoldCaption], problems: Problems, where: tuple[str, ...] = WHERE) -> Score:
    score = Score(0, [], Counter(), Counter(), [])
    for line in lines:
        score.num_true += 1
        facts = line.facts
        found = problems(line.coc, line.claims, facts, line.language)
        if found:
            score.flagged.append((line.id, found))
        for error in line.errors:
            for place in where:
                changed = planted(line, error, place)
                if changed is None:
                    continue
                key = (place, line.language, error.kind)
                score.planted[key] += 1
                if problems(*changed, facts, line.language):
                    score.caught[key] += 1
                else:
                    score.missed.append((place, line.id, error))
    return score


def show(score: Score, *, in_full: bool) -> None:
    print(f"true captions flagged: {len(score.flagged)} of {score.num_true} ({score.flagged_share:.1%})")
    print(f"errors caught: {score.caught.total()} of {score.planted.total()} ({score.caught_share():.1%})")
    for name, begins in GROUPS.items():
        keys = [key for key in score.planted if key[2].startswith(begins)]
        caught, count = sum(score.caught[key] for key in keys), sum(score.planted[key] for key in keys)
        print(f"  {name:12} {caught / max(1, count):6.1%} of {count}")
    for index in (0, 1, 2):
        for value in sorted({key[index] for key in score.planted}):
            count = sum(n for key, n in score.planted.items() if key[index] == value)
            print(f"  {value:12} {score.caught_share(index, value):6.1%} of {count}")
    if in_full:
        for name, found in score.flagged:
            print("flagged", name, found)
        for place, name, error in score.missed:
            print("missed ", place, name, error.model_dump(exclude_none=True))


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the judging of texts on a gold set.")
    parser.add_argument("mode", choices=MODES)
    parser.add_argument("files", nargs="*", type=Path, default=[GOLD_PROSE])
    parser.add_argument("--only", nargs="+", default=[""], help="captions whose id begins with one of these")
    parser.add_argument("--show", action="store_true", help="print what was flagged and what was missed")
    asked = parser.parse_args()
    lines = [line for file in asked.files for line in read_gold_prose(file) if line.id.startswith(tuple(asked.only))]
    if not lines:
        parser.error("no caption to measure")
    show(measure(lines, *MODES[asked.mode]), in_full=asked.show)


if __name__ == "__main__":
    main()
