"""Measure the judging of texts on the gold set: true ones flagged, one-change errors caught.

    python tests/measure_prose.py claims|prose|reader [--sets N...] [--show]

Sets are those of caption/truth/gold.py, by default those whose writers gave claims (1 and 2). Figures by where the
error was planted (text, claims, both), language and kind; --show prints the true captions that were flagged and the
errors that were missed.

`reader` stands for language models, of which none could be had: `cosfly caption reader-check` asks a served endpoint
that answers with the writers' claims (a perfect reader), or with those after a fault at a stated rate. Their writers
had read the captions and no code of ours.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from specimens_captions import VOCABULARY
from teacher_server import TeacherServer

from caption.schema import EvidenceConfig, ReaderConfig
from caption.teachers.reader import check_reader, reader_check_table
from caption.truth.claims import judge_claims
from caption.truth.facts import Facts
from caption.truth.gold import GoldCaption, PlantedError, read_gold
from caption.truth.prose import check_prose
from caption.truth.sizes import same_size
from caption.truth.stated import read_stated
from cosfly.products.actions import shipped_actions
from cosfly.products.captions import Claim, Coc, Language
from cosfly.products.sentences import sentences_of
from cosfly.work.console import console

GROUPS = {"numbers": ("num", "halluc", "unit", "words", "ratio"), "sides": ("side", "clock")}
WHERE = ("text", "claims", "both")


Problems = Callable[[Coc, tuple[Claim, ...], Facts, Language], list[str]]


def planted(line: GoldCaption, error: PlantedError, where: str) -> tuple[Coc, tuple[Claim, ...]] | None:
    """Give the caption with an error in its text, its claims or both; None where the error has no claim to stand in."""
    coc = line.coc if where == "claims" else error.in_text(line.coc)
    claims = line.claims if where == "text" else error.in_claims(line.claims)
    return None if claims is None else (coc, claims)


def claims_problems(coc: Coc, claims: tuple[Claim, ...], facts: Facts, language: Language) -> list[str]:
    judged = judge_claims(coc, claims, facts, EvidenceConfig(), language, shipped_actions())
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


# --- readers that are no models ---------------------------------------------------------------------------------------


def _quoted(claim: Claim, sentence: str, language: Language) -> dict[str, Any]:
    """Give a claim as a reader writes it: it quotes the clause that holds its number, else its sentence."""
    quote = sentence
    if isinstance(claim.value, float):
        for clause in re.split(r"(?<=[,;，；])", sentence):
            if any(same_size(numeral, claim) for numeral in read_stated(clause, language).numerals):
                quote = clause
                break
    return claim.model_dump(exclude={"quote"}) | {"at": claim.at or "", "unit": claim.unit or "", "quote": quote}


def perfect_readings(gold: Iterable[GoldCaption]) -> dict[str, list[dict]]:
    """Give what a perfect reader answers to each text, by its sentences: the claims of its writer, with the planted
    error in them."""
    found: dict[str, list[dict]] = {}
    for caption in gold:
        texts = [(caption.coc, caption.claims)]
        texts += [(e.in_text(caption.coc), e.in_claims(caption.claims) or caption.claims) for e in caption.errors]
        for coc, claims in texts:
            sentences = dict(sentences_of(coc))
            key = _key_of(f"{name}: {text}" for name, text in sentences.items())
            there = [_quoted(c, sentences[c.sentence], caption.language) for c in claims if c.sentence in sentences]
            found.setdefault(key, there)  # of a wrong decision the text is the true one
    return found


def _key_of(lines: Iterable[str]) -> str:
    return "\n".join(sorted(lines))


Fault = Callable[[dict, random.Random], dict | None]  # a claim -> what a bad reader makes of it

_OTHER = {"left": "right", "right": "left", "increasing": "decreasing", "decreasing": "increasing"}


def loses(claim: dict, rng: random.Random) -> dict | None:
    return claim if rng.random() > 0.2 else None


def misreads(claim: dict, rng: random.Random) -> dict:
    is_wrong = isinstance(claim["value"], float) and rng.random() < 0.1
    return claim | {"value": round(claim["value"] * 1.3 + 1, 2)} if is_wrong else claim


def misquotes(claim: dict, rng: random.Random) -> dict:
    return claim | {"quote": claim["quote"][::-1]} if rng.random() < 0.1 else claim


def turns(claim: dict, rng: random.Random) -> dict:
    return claim | {"value": _OTHER.get(claim["value"], claim["value"])} if rng.random() < 0.05 else claim


FAULTS: dict[str, Fault | None] = {
    "perfect": None, "loses 20 % of claims": loses, "misreads 10 % of numbers": misreads, "misquotes 10 %": misquotes,
    "swaps 5 % of sides and trends": turns,
}  # fmt: skip


def answers_of(readings: dict[str, list[dict]], fault: Fault | None, *, alike: bool = False) -> Callable[[dict], str]:
    """Give what a reader with a fault answers to a request; alike: it errs in the same way whatever the order of the
    question."""

    def answer(body: dict) -> str:
        lines = body["messages"][1]["content"].split("\n")
        rng = random.Random(_key_of(lines) if alike else json.dumps(body["messages"][1:]))  # not by how it is asked
        claims = readings[_key_of(lines)]
        found = claims if fault is None else [wrong for claim in claims if (wrong := fault(claim, rng))]
        return json.dumps({"claims": found})

    return answer


def measure_readers(gold: Sequence[GoldCaption]) -> None:
    readings = perfect_readings(gold)
    cases = [(name, fault, False) for name, fault in FAULTS.items()] + [("swaps 5 %, alike twice", turns, True)]
    for name, fault, alike in cases:
        server = TeacherServer()
        server.text = answers_of(readings, fault, alike=alike)
        with server:
            check = asyncio.run(check_reader(ReaderConfig(urls=(server.url,)), VOCABULARY, gold))
        check.models = [name]
        console.print(reader_check_table(check))


def main() -> None:
    parser = argparse.ArgumentParser(description="Measure the judging of texts on the gold set.")
    parser.add_argument("mode", choices=[*MODES, "reader"])
    parser.add_argument("--sets", nargs="+", type=int, default=[1, 2], help="numbers of sets")
    parser.add_argument("--show", action="store_true", help="print what was flagged and what was missed")
    asked = parser.parse_args()
    gold = [caption for caption in read_gold() if caption.set in asked.sets]
    if asked.mode == "reader":
        measure_readers([caption for caption in gold if caption.claims])
    else:
        show(measure(gold, *MODES[asked.mode]), in_full=asked.show)


if __name__ == "__main__":
    main()
