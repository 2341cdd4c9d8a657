"""The words of one clause: whose a word is, which frames it speaks of, and the statements found."""

from __future__ import annotations

import re
from dataclasses import replace

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import Context, gap, owner_of, times_of
from caption.truth.prose.lexicon import Token
from caption.truth.prose.plainness import is_asserted, is_plain
from caption.truth.prose.statements import NOW, Statement

# What may tell of another moment than now.
_IN_PASSING = re.compile(
    r"\b(?:after|before|once|until|till|when|had|at first|first|then|began|earlier|from|momentar\w+|brief\w*)\b|先(?!生)|曾|此前|之前|起初|开头|一度|刚|后|又|原来|从|次帧"
)


class ClauseWords:
    """What the readers of words share."""

    def __init__(
        self, sentence: Sentence, clause: Clause, context: Context, *, in_scene: bool, is_plan: bool, is_reasoning: bool
    ) -> None:
        self.sentence, self.clause, self.context = sentence, clause, context
        self.in_scene, self.is_plan, self.is_reasoning = in_scene, is_plan, is_reasoning
        self.text, self.language = sentence.text, sentence.language
        self.span = (clause.start, clause.end)
        self.statements: list[Statement] = []
        self.left_out = False

    def _owner(self, token: Token) -> str:
        return owner_of(self.sentence, self.clause, token.start, token.end, self.context)

    def _frames(self, token: Token) -> tuple[int, ...] | None:
        """Give the frames that a word speaks of: those named nearest, now where none is, any where the past is told."""
        for time in self.clause.of("time"):
            name, _, count = time.value.partition(":")
            if name == "last":
                return tuple(range(-int(float(count)), 0))
            if name == "first":
                return tuple(range(int(float(count))))
        times = times_of(self.clause)
        if len(times) == 1 and len(times[0][1]) == 1 and times[0][1] != (NOW,):
            frame = times[0][1][0]
            before = {t.value for t in self.clause.of("time", "since", "until") if 0 <= times[0][0].start - t.end <= 4}
            if before == {"since"}:
                return (frame, NOW)
            if "until" in before and frame > 0:
                return tuple(range(frame))
        if times:
            return min(times, key=lambda pair: gap(pair[0], token.start, token.end))[1]
        if (
            self.clause.has("time", "some", "window", "past", "last_second", "last_step", "since", "until", "last_s")
            or self.context.has_past
        ):
            return None
        return (NOW,)

    def _trend_span(self) -> tuple[int, int] | None:
        """Give the two frames between which a clause tells of a change; None where it names none."""
        if self.clause.has("time", "last_step"):
            return (-2, NOW)
        if self.clause.has("time", "last_second"):
            return (-3, NOW)
        frames = [f[0] for time, f in times_of(self.clause) if len(f) == 1]
        if len(frames) == 2:
            return (frames[0], frames[1])
        if len(frames) == 1 and frames[0] != NOW and self._is_since(frames[0]):
            return (frames[0], NOW)
        return None

    def _is_since(self, frame: int) -> bool:
        """Tell whether "since" stands before the time of a frame: "since t1", not "from 25.6 m down to 23.6 m at t3"."""
        times = [time for time, frames in times_of(self.clause) if frames[0] == frame]
        reach = 10 if self.language == "en" else 2
        return any(0 <= times[0].start - t.end <= reach for t in self.clause.of("time", "since"))

    def _told_moment(self, token: Token) -> tuple[int, ...] | None:
        """Give the frames of a word that means one moment: those told, else now; any where another moment is told of."""
        if times_of(self.clause) or not _IN_PASSING.search(self.text, self.clause.start, self.clause.end):
            return self._frames(token)
        return None

    def _add(self, token: Token, **fields: object) -> None:
        found = Statement(clause=self.span, **fields)  # type: ignore[arg-type]
        sure = is_plain(found, token, self.sentence, self.clause, self.is_reasoning)
        asserted = is_asserted(found, token, self.sentence, self.clause, self.is_reasoning)
        self.statements.append(replace(found, is_sure=sure, is_asserted=asserted))
