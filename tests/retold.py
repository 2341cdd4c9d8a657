"""True captions told of other windows, to find numbers that are misread and are true by chance.

    python tests/retold.py [--draws N]

The series of a caption's window are moved at random, and each number that one claim of its sentence gives becomes what that claim is
in the moved window: the text stays true. A number that the reader contradicts then was misread: taken for another quantity or
another frame, which in the caption's own window had the same value or stood within tolerance.
"""

from __future__ import annotations

import argparse
import dataclasses
import random
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import combinations

from specimens_prose import SECOND_SET

from caption.schema import EvidenceConfig
from caption.truth.facts import Facts
from caption.truth.gold import GoldCaption, read_gold_prose
from caption.truth.prose.judging_numbers import NumberJudge
from caption.truth.prose.measured import Measured
from caption.truth.prose.numerals import masked
from caption.truth.prose.pool import Pool
from caption.truth.prose.reading import read_form
from caption.truth.prose.statements import Form
from caption.truth.references import Fact, look_up, parse_reference
from cosfly.products.captions import Claim
from cosfly.products.sentences import sentences_of

KINDS = ("number", "list", "range", "course", "pair", "percent", "ratio", "speeds")
_FROM_ZERO = ("travelled_m", "displacement_m", "target_travelled_m", "yaw_deg", "offset_x_px", "offset_y_px")


def moved(facts: Facts, rng: random.Random) -> Facts:
    """Give the facts of another window: each series scaled, each of its values shaken, signs and zeros at the start kept."""
    found: dict[str, object] = {}
    for field in dataclasses.fields(facts):
        series = getattr(facts, field.name)
        if not isinstance(series, tuple) or field.name == "visibility":
            continue
        scale, digits = rng.uniform(0.75, 1.35), 0 if field.name.endswith("_px") else 2 if "mps" in field.name else 1
        shaken = [None if v is None else round(v * scale * rng.uniform(0.93, 1.07), digits) or v for v in series]
        found[field.name] = tuple(
            0 if field.name in _FROM_ZERO and v == 0 else (int(new) if new is not None and not digits else new)
            for v, new in zip(series, shaken, strict=True)
        )
    steps = [v for v in found["target_speeds_mps"] if v is not None]  # type: ignore[attr-defined]
    if facts.target_speed_mps is not None:
        found["target_speed_mps"] = round(sum(steps) / len(steps), 2) if steps else facts.target_speed_mps
    courses = found["target_headings_deg"]
    if courses and facts.target_turn_deg is not None and None not in (courses[1], courses[-1]):  # type: ignore[index]
        found["target_turn_deg"] = round((courses[-1] - courses[1] + 180.0) % 360.0 - 180.0, 1)  # type: ignore[index]
    return dataclasses.replace(facts, **found)


def retold(
    form: Form, runs: tuple[str, ...], claims: Iterable[Claim], facts: Facts, other: Facts
) -> tuple[tuple[str, ...], set[int]]:
    """Give a sentence's runs of digits for another window, and which of its numerals were changed; none where an order would turn."""
    new, changed, told = list(runs), set(), []
    for index, numeral in enumerate(form.numerals):
        if numeral.whole is None or numeral.factor != 1.0:
            continue
        value, step = numeral.read(runs)
        meant = {
            (one.quantity, one.at)
            for one in claims
            if isinstance(one.value, float)
            and one.unit in (numeral.unit, None, "")
            and abs(abs(one.value) - value) <= step
        }
        reference = parse_reference("@".join(filter(None, meant.pop()))) if len(meant) == 1 else None
        pair = [look_up(reference, window) for window in (facts, other)] if reference else []
        if not pair or not all(isinstance(one, Fact) and not isinstance(one.value, str) for one in pair):
            continue
        before, after = (float(one.value) for one in pair)  # type: ignore[union-attr,arg-type]
        if abs(abs(before) - value) > step + 0.06 * value or before * after < 0 or (not before) != (not after):
            continue
        digits = 0 if numeral.fraction is None else len(runs[numeral.fraction])
        whole, _, fraction = f"{abs(after):.{digits}f}".partition(".")
        new[numeral.whole] = whole
        if numeral.fraction is not None:
            new[numeral.fraction] = fraction
        changed.add(index)
        told.append((str(reference.quantity).removeprefix("target_"), before, after))  # type: ignore[union-attr]
    turns = any(a[0] == b[0] and (a[1] - b[1]) * (a[2] - b[2]) < 0 for a, b in combinations(told, 2))
    return tuple(new), set() if turns else changed


def misread(captions: Iterable[GoldCaption], draws: int) -> Iterator[tuple[str, str, str, bool]]:
    """Yield (caption, kind, sentence, whether it was contradicted) of every statement of numbers that was told of another window."""
    for caption in captions:
        for draw in range(draws):
            other = moved(caption.facts, random.Random(f"{caption.id}/{draw}"))
            measured = Measured(other)
            pool, subject, letter = Pool(measured), "", ""
            for name, text in sentences_of(caption.coc):
                subject, letter = ("" if name[0] != letter else subject), name[0]
                hidden, runs = masked(text, caption.language)
                form = read_form(hidden, caption.language, subject, letter == "R")
                subject = form.subject
                own = [claim for claim in caption.claims if claim.sentence == name and claim.quantity != "scene"]
                new, changed = retold(form, runs, own, caption.facts, other)
                judge = NumberJudge(measured, pool, EvidenceConfig(), form, new)
                for statement in form.statements:
                    numbers = {*statement.numbers, *(statement.operands or ())}
                    if statement.kind in KINDS and statement.numbers and changed >= numbers:
                        yield caption.id, statement.kind, text, judge.holds(statement) is False


def main() -> None:
    parser = argparse.ArgumentParser(description="Tell true captions of other windows and count the numbers misread.")
    parser.add_argument("--draws", type=int, default=3, help="windows per caption")
    draws = parser.parse_args().draws
    found = list(misread([*read_gold_prose(), *read_gold_prose(SECOND_SET)], draws))
    wrong = {(name, kind, text) for name, kind, text, is_wrong in found if is_wrong}
    print(
        f"contradicted: {sum(one[3] for one in found)} of {len(found)} statements, in {len({w[0] for w in wrong})} captions"
    )
    print(dict(Counter(kind for _, kind, _ in wrong)))
    for name, kind, text in sorted(wrong):
        print(name, kind, text)


if __name__ == "__main__":
    main()
