"""When: the frames that a number's value is of, by the times that its clause names."""

from __future__ import annotations

import re

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import Context, crossing, gap, is_wide, times_of
from caption.truth.prose.lexicon import Token
from caption.truth.prose.numerals import Numeral
from caption.truth.prose.statements import NOW, Mode

MEASURED = ("m", "mps", "deg", "dps", "px")
_AT = re.compile(r"[\s,]*(?:at|in|during|for|on|of)?\s*(?:the )?")


_PRESENT = {"en": re.compile(r"\b(?:is|are|has|have|reads|stands|sits)\b|'s\b"), "zh": re.compile(r"已|现|为止")}


class Timing:
    """The times of one clause."""

    def __init__(self, sentence: Sentence, clause: Clause, context: Context) -> None:
        self.sentence, self.clause, self.context = sentence, clause, context
        self.text, self.language = sentence.text, sentence.language

    def frames(self, numeral: Numeral, mode: Mode, *, is_extreme: bool) -> tuple[int, ...] | None:
        times = times_of(self.clause)
        if mode != "value":
            if self.clause.has("time", "last_step"):
                return (-2, NOW)
            if self.clause.has("time", "last_second"):
                return (-3, NOW)
            named = list(dict.fromkeys(frames[0] for _, frames in times if len(frames) == 1))
            if (
                len(named) == 1
                and named[0] not in (NOW, 1)
                and (mode == "change" or self.clause.has("time", "since") or self.clause.has("link", "than"))
            ):
                return (named[0], NOW)
            return tuple(named) if len(named) == 2 and mode == "change" else None
        wide = is_wide(self.clause) or self.comes_from(numeral) or (self.context.has_past and not self._is_present())
        return None if times or wide or is_extreme else (NOW,)

    def _time_gap(self, time: Token, numeral: Numeral) -> int:
        """A Chinese time stands before what it tells of, an English one on either side."""
        if self.language == "zh" and time.start >= numeral.end:
            return 8 + 3 * (time.start - numeral.end)
        if self.language == "en" and time.start >= numeral.end and _AT.fullmatch(self.text, numeral.end, time.start):
            return 0
        if time.end <= numeral.start and re.search(r"\bto\b|[到至]", self.text[time.end : numeral.start]):
            return 20 + gap(time, numeral.start, numeral.end)
        return gap(time, numeral.start, numeral.end)

    def adjacent_frames(self, numeral: Numeral) -> tuple[int, ...] | None:
        """Give the frame that is told right beside a number, if that number is the nearest one to it."""
        reach = 16 if self.language == "en" else 8
        measured = [
            self.sentence.numerals[i] for i in self.clause.numerals if self.sentence.numerals[i].unit in MEASURED
        ]
        for time, frames in sorted(times_of(self.clause), key=lambda pair: self._time_gap(pair[0], numeral)):
            if self._time_gap(time, numeral) > reach:
                return None
            nearest = min(measured, key=lambda n: self._time_gap(time, n), default=numeral)
            spans = self.clause.of("time", "since", "until", "past")
            between = self.text[time.end : numeral.start]
            if (
                time.end <= numeral.start and len(between) <= 6 and "起" not in between and self.comes_from(numeral)
            ):  # "from the 21 m at first"
                links = {t.start for t in self.clause.of("link", "from")}
                spans = [t for t in spans if t.start not in links]
            if nearest.start == numeral.start and not any(0 <= time.start - t.end <= 5 for t in spans):
                return frames
        return None

    def _is_present(self) -> bool:
        return _PRESENT[self.language].search(self.text, self.clause.start, self.clause.end) is not None

    def comes_from(self, numeral: Numeral) -> bool:
        near = [t for t in self.clause.of("link", "from") if 0 <= numeral.start - t.end <= 20]
        near += [
            t
            for t in self.clause.of("trend")
            if 0 <= numeral.start - t.end <= 16 and self.text[: t.end].endswith(" from")
        ]
        return any(not crossing(self.sentence, self.clause, t, numeral.start, numeral.end) for t in near)

    def goes_to(self, numeral: Numeral) -> bool:
        near = [t for t in self.clause.of("link", "to") if 0 <= numeral.start - t.end <= 12]
        near += [
            t
            for t in self.clause.of("trend")
            if 0 <= numeral.start - t.end <= 12 and self.text[: t.end].endswith(("到", "至", " to"))
        ]
        return any(not crossing(self.sentence, self.clause, t, numeral.start, numeral.end) for t in near)
