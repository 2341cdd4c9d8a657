"""What a sentence states: the reader's findings before anything is compared with a window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

from caption.truth.prose.numerals import Numeral

Kind = Literal[
    "number", "list", "range", "course", "pair", "percent", "ratio", "clock", "speeds", "extreme",
    "trend", "steady", "mixed", "changing", "side", "centre", "visibility", "state", "comparison",
    "record", "course_side", "unit", "motion", "extent", "framing", "lies", "sight", "faster",
]  # fmt: skip
Mode = Literal["value", "change", "either"]
Hedge = Literal["", "about", "more", "less"]
NOW = -1
Force = Literal["directive", "aim", "open", "option", "told"]


class Said(NamedTuple):
    """An action that a text names. side: +1 left, -1 right, 0 where none is named.

    force: what is to be done, what is aimed at only, an option or a supposition, what is told as it happens, or open. clause: where.
    """

    action: str
    side: int
    force: Force
    clause: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Statement:
    """One thing that a clause states. Frames count from the oldest, negative ones from the current one back.

    names: the series that it may speak of, () where that is open: any of the number's unit. frames: the values that it may mean, None
    for any frame. numbers: indices of the sentence's numerals. mode: whether a number is a value of the series or a change of it.
    side: +1 left (or above), -1 right (or below). trend: +1 up, -1 down. word: of a visibility, state, comparison or an aggregate.
    is_sure: False for a word that may not contradict, because it is not plain. is_asserted: that it is said of some moment, whichever, is plain.
    sure_names, sure_frames, sure_mode: of a number, what the words leave no doubt of (sureness.py); empty where they leave it open.
    operands: the numbers whose ratio is told; is_ordered: that of the first to the second, else either way. span: frames between which a change is told. reached: +1 of a value that a rise ends at, -1 a fall, EITHER_WAY (changing.py) where the way is not told. negated: the opposite is stated. is_named: that its clause names what goes up or down. is_single: of a number of which the words say surely what it is, the only one of its unit in its clause. is_per_step: of a change that is told of each step. is_last: of a value that was reached and of which no moment but now is told. clause: for the message.
    """

    kind: Kind
    clause: tuple[int, int]
    names: tuple[str, ...] = ()
    numbers: tuple[int, ...] = ()
    frames: tuple[int, ...] | None = (NOW,)
    mode: Mode = "value"
    hedge: Hedge = ""
    side: int = 0
    trend: int = 0
    word: str = ""
    value: float = 0.0
    span: tuple[int, int] | None = None
    negated: bool = False
    is_sure: bool = True
    is_asserted: bool = False
    sure_names: tuple[str, ...] = ()
    sure_frames: tuple[int, ...] | None = None
    sure_mode: Mode = "either"
    operands: tuple[int, int] | None = None
    is_ordered: bool = False
    reached: int = 0
    is_named: bool = False
    is_single: bool = False
    is_per_step: bool = False
    is_last: bool = False


@dataclass(frozen=True, slots=True)
class Form:
    """A sentence as it was read, its digits aside.

    left_out: a number or an opposite of which nothing is known; subject: who it spoke of last. actions: those that it names.
    asks_of_past: a question about another moment than now, which its answer need not name again.
    """

    text: str
    numerals: tuple[Numeral, ...]
    statements: tuple[Statement, ...]
    left_out: bool
    subject: str
    actions: tuple[Said, ...] = ()
    asks_of_past: bool = False
