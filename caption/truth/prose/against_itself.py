"""What a sentence tells against its own numbers: two speeds and who is faster, a row of values and which way they go."""

from __future__ import annotations

import re
from itertools import pairwise

from caption.truth.prose.comparing_numbers import NumberComparison
from caption.truth.prose.statements import NOW, Form, Statement

_DRONE, _TARGET = {"speed"}, {"target_speed", "target_mean"}
_ANOTHER_MOMENT = re.compile(
    r"\b(?:now|again|but|then|last|latest|final\w*|yet|before|after\w*|until|since|at t\d|was|were|had|again|first)\b|现|又|再|随后|最后|最近|但|后|曾|先|末|t\d"
)
_BETWEEN = re.compile(r"[\s,:;(]*(?:and|with)?[\s,]*")


def compares_wrongly(s: Statement, form: Form, numbers: NumberComparison) -> bool:
    """Tell whether "faster" stands beside two speeds of now, the drone's and the target's, of which the other is larger."""
    if s.kind != "comparison" or s.word not in ("faster", "slower") or s.frames != (NOW,):
        return False
    ours, theirs = _speeds(form, numbers, _DRONE), _speeds(form, numbers, _TARGET)
    if len(ours) != 1 or len(theirs) != 1:
        return False
    difference = ours.pop() - theirs.pop()
    return difference * (1 if s.word == "faster" else -1) * (-1 if s.negated else 1) < 0


def _speeds(form: Form, numbers: NumberComparison, names: set[str]) -> set[float]:
    """Give the speeds that a sentence tells of somebody now; none where one of them is of another moment or open."""
    told = [s for s in form.statements if s.kind == "number" and s.names and set(s.names) <= names]
    if any(s.frames != (NOW,) or s.mode != "value" for s in told):
        return set()
    return {numbers.read(s.numbers[0])[1] for s in told}


def goes_wrongly(s: Statement, form: Form, numbers: NumberComparison) -> bool:
    """Tell whether a clause says "step by step slower" right beside a row of values that rise."""
    if s.kind != "trend" or s.negated or _ANOTHER_MOMENT.search(form.text, *s.clause):
        return False
    rows = [row for row in form.statements if row.kind in ("list", "course") and set(row.names) & set(s.names)]
    if len(rows) != 1 or rows[0].clause == s.clause:
        return False
    row, (first, second) = rows[0], sorted((s.clause, rows[0].clause))
    if not _BETWEEN.fullmatch(form.text, first[1], second[0]):
        return False
    read = [numbers.read(i) for i in row.numbers]
    rises = {b[1] > a[1] for a, b in pairwise(read)}
    return read[0][0].unit in ("m", "mps") and rises == {s.trend < 0} and all(a[1] != b[1] for a, b in pairwise(read))
