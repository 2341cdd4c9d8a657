"""Rows of numbers: the ends of a way, the values of a series, sizes."""

from __future__ import annotations

import re

from caption.truth.prose.beside import Beside
from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import Context, is_wide, names_of, times_of
from caption.truth.prose.naming import Naming
from caption.truth.prose.statements import NOW, Statement
from caption.truth.prose.sureness import Sureness
from caption.truth.prose.timing import Timing

_BECOMES = re.compile(r"\s*(?:has|have) (?:now )?(?:become|shrunk|grown)\b|\s*(?:已经?)?(?:变成|变为|缩成|成了)")
_LED_TO = re.compile(r"\bto (?:(?:about|roughly|some|only|just|a mere) )?$")
_AND_BACK = re.compile(r"\band (?:\w+ )?(?:back|recover\w*)\b")
_EXTREME = re.compile(r"\b(?:biggest|largest|smallest|tallest|widest|peak)\b|最")


class Rows:
    """The rows of one clause."""

    def __init__(
        self,
        sentence: Sentence,
        clause: Clause,
        context: Context,
        beside: Beside,
        sureness: Sureness,
        *,
        in_scene: bool,
    ) -> None:
        self.sentence, self.clause, self.context, self.in_scene = sentence, clause, context, in_scene
        self.text, self.language = sentence.text, sentence.language
        self.timing, self.naming = Timing(sentence, clause, context), Naming(sentence, clause, context)
        self.beside, self.sureness = beside, sureness

    def course(self, early: int, late: int) -> Statement | None:
        """Read the ends of one way; None where nothing is known of them."""
        numeral = self.sentence.numerals[late]
        names, is_cued = self.naming.names(self.sentence.numerals[early])
        if not is_cued:
            names, is_cued = self.naming.names(numeral)
        if not is_cued and self.in_scene:
            return None
        others = ("dist", "alt") if numeral.unit == "mps" else ()  # "the speed has dropped back to 3.5 m/s"
        trends = [t for t in self.clause.of("trend") if t.value.endswith(("up", "down"))]
        trends = [t for t in trends if not t.value.startswith(others)] if others else trends
        first = self.sentence.numerals[early]
        if _LED_TO.search(self.text, self.clause.start, first.start):  # "after slowing to 2 m/s they sprang to 8.7 m/s"
            trends = [t for t in trends if t.start >= first.end]
        is_there_and_back = _AND_BACK.search(self.text, first.end, numeral.start) is not None
        signs = {1 if t.value.endswith("up") else -1 for t in trends if not self.sentence.is_negated(self.clause, t)}
        signs = set() if is_there_and_back else signs
        start = self.timing.adjacent_frames(self.sentence.numerals[early])
        frames = self.timing.adjacent_frames(numeral)
        if frames is None:
            loose = [t for t in times_of(self.clause) if t[1] not in (start, (NOW,))]
            is_past = self.clause.has("time", "past", "until", "max", "min") or self.context.has_past
            later = any(t.value == "now" and t.start > numeral.end for c in self.sentence.clauses for t in c.of("time"))
            frames = None if later or loose or (is_past and not self.clause.has("time", "now")) else (NOW,)
        side, vertical = self.beside.side(numeral)
        if numeral.unit == "px" and (side or vertical):
            names, is_cued = ("offset_x",) if side else ("offset_y",), True
        told = {own for n in (first, numeral) if (own := self.sureness.names(n))}
        people = {*self.context.people, *(t.value for t in self.clause.of("who", "drone", "target"))}
        goes_on = numeral.unit == "mps" and len(people) == 1 and not self.sureness.closes()
        if goes_on and self.clause.has("quantity"):
            names = names_of("speed", "mps", "")  # "the speed fell from 3.9 to 3.3 m/s"
        ends_now = (bool(told) or goes_on) and frames == (NOW,) and not self.sureness.moments.goes_on_after(numeral)
        is_owned = goes_on or names == ("speed",) or set(names) == {"target_speed", "target_mean"}
        if is_cued and not told and (numeral.unit != "mps" or is_owned):
            told = {names}
        return Statement(
            kind="course", sure_names=told.pop() if len(told) == 1 else (), sure_frames=self.sureness.ends_of_course(first, numeral), sure_mode="value" if ends_now or self.sureness.moments.beside(numeral) == NOW else "either",
            clause=(self.clause.start, self.clause.end), names=names, numbers=(early, late), frames=frames,
            hedge=self.beside.hedge(numeral) or self.beside.hedge(self.sentence.numerals[early]), side=side or vertical,
            trend=signs.pop() if len(signs) == 1 else 0,
            span=(start[0], NOW) if start is not None and len(start) == 1 else None,
        )  # fmt: skip

    def series(self, members: list[int]) -> Statement | None:
        """Read a row of numbers of one series; None where nothing is known of it."""
        names, is_cued = self.naming.names(self.sentence.numerals[members[0]])
        if not is_cued:
            names, is_cued = self.naming.names(self.sentence.numerals[members[-1]])
        if not is_cued and self.in_scene:
            return None
        trends = {t.value for t in self.clause.of("trend") if t.value.endswith(("up", "down"))}
        signs = {1 if value.endswith("up") else -1 for value in trends}
        return Statement(
            "list", (self.clause.start, self.clause.end), names, tuple(members), None, trend=signs.pop() if len(signs) == 1 else 0,
            hedge=self.beside.hedge(self.sentence.numerals[members[0]]), side=self.beside.side(self.sentence.numerals[members[0 if self.language == "zh" else -1]])[0],
        )  # fmt: skip

    def pairs(self, members: list[int]) -> Statement:
        """Read "w x h", once or from one to the other."""
        trends = {
            1 if t.value.endswith("up") else -1 for t in self.clause.of("trend") if t.value.endswith(("up", "down"))
        }
        times = times_of(self.clause)
        is_past = self.clause.has("time", "past", "start") or self.context.has_past or is_wide(self.clause)
        frames: tuple[int, ...] | None = None if is_past and not self.clause.has("time", "now") else (NOW,)
        if len(members) == 2 and len(times) == 1:
            frames = times[0][1]
        elif _BECOMES.match(self.text, self.sentence.numerals[members[-1]].end) or (
            self._is_beside_now()
            or self.clause.has("time", "max", "min")
            or _EXTREME.search(self.text, self.clause.start, self.clause.end)
        ):
            frames = None
        return Statement(
            "pair",
            (self.clause.start, self.clause.end),
            numbers=tuple(members),
            frames=frames,
            hedge=self.beside.hedge(self.sentence.numerals[members[0]]),
            trend=trends.pop() if len(trends) == 1 else 0,
        )

    def _is_beside_now(self) -> bool:
        """Tell whether a clause in brackets stands beside one that tells of now: "27x59 px now (21x58 px when it came back)"."""
        before = [c for c in self.sentence.clauses if c.end <= self.clause.start]
        in_brackets = self.text[: self.clause.start].endswith("(")
        return in_brackets and bool(before) and before[-1].has("time", "now") and not self.clause.has("time", "now")
