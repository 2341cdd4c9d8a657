"""What stands beside a number: its side, a hedge, an extreme; and whether its place is plain."""

from __future__ import annotations

import re
from typing import Literal

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import Context, crossing, gap
from caption.truth.prose.lexicon import Token
from caption.truth.prose.numerals import Numeral
from caption.truth.prose.statements import Hedge
from caption.truth.prose.timing import Timing

_COMES_TO = re.compile(r" to $|回[^,]{0,2}[到至]")
_EXTREME = {
    "en": re.compile(
        r",? ?(?:which is |that is |it is |and |now )*(?:by far |easily )?(?:the|its|our|his|her|their) "
        r"(?:(?P<most>longest|largest|biggest|greatest|highest|widest|tallest|farthest|furthest|fastest|quickest)|shortest|smallest|lowest|narrowest|closest|nearest|slowest|least)"
        r"(?: \w+)?(?: yet| so far| seen| (?:of|in|over) (?:the |all )?(?:window|five|four|frames|series|sequence|steps|whole|clip|lot|run)\b)"
    ),
    "zh": re.compile(
        r",?(?:也|正|恰|又)?(?:是|为|系)(?:这)?(?:整个|全)?(?:窗口|五帧|四步|序列|全程|两秒|期间|段)*(?:里|中|内|以来|的|之)*最(?:(?P<most>[远大宽高快长])|[近小窄低慢短])的?(?:一次|一帧|一步|值|时刻|数)"
    ),
}  # fmt: skip
_IS = re.compile(r"\b(?:is|are|was|were)\b")
_ZH_AFTER = 2  # letters between a number and its side: "3 度(左)"

_LEVEL_SIDES = ("left", "right", "cw", "ccw")


class Beside:
    """The neighbours of one clause's numbers. used_sides: the sides that belong to a number."""

    def __init__(self, sentence: Sentence, clause: Clause, context: Context, *, in_scene: bool) -> None:
        self.sentence, self.clause, self.context = sentence, clause, context
        self.in_scene, self.timing = in_scene, Timing(sentence, clause, context)
        self.used_sides: set[Token] = set()
        self.text, self.language = sentence.text, sentence.language

    def side(self, numeral: Numeral) -> tuple[int, int]:
        """Give +1 for a number to the left or -1 to the right, and the same for above and below."""
        reach = 24 if self.language == "en" else 8
        near = [t for t in self.clause.of("side") if abs(gap(t, numeral.start, numeral.end)) <= reach]
        if self.language == "zh":
            near = [t for t in near if t.start < numeral.end or t.start - numeral.end <= _ZH_AFTER]
        near = [t for t in near if not crossing(self.sentence, self.clause, t, numeral.start, numeral.end)]
        near = [
            t for t in near if t.value in _LEVEL_SIDES or not self.text.startswith(" to ", t.end)
        ]  # "24 px down to 9"
        if not self.clause.has("side") and not self.in_scene:
            near = self._explained(numeral)
        if not near or (self.in_scene and numeral.unit != "px"):
            return 0, 0
        if self.language == "zh":  # "中心左侧 42 像素", "向左转动 10 度": the side stands before
            near.sort(key=lambda t: (t.end > numeral.start, gap(t, numeral.start, numeral.end)))
        else:
            near.sort(key=lambda t: gap(t, numeral.start, numeral.end) - (8 if t.start >= numeral.end else 0))
        token = near[0]
        if _COMES_TO.search(self.text, token.end, numeral.start):
            return 0, 0  # "has come back right to 0.9 degrees"
        if numeral.unit == "deg" and self._is_of_person(token):
            self.used_sides.add(token)
            return 0, 0
        if self.clause.has("move") and numeral.unit != "px" and token.value not in ("cw", "ccw"):
            return 0, 0
        if numeral.unit in ("px", "deg"):
            self.used_sides.add(token)
        value = token.value
        if value in ("above", "below"):
            return 0, (1 if value == "above" else -1) if numeral.unit == "px" else 0
        return (1 if value in ("left", "ccw") else -1), 0

    def _explained(self, numeral: Numeral) -> list[Token]:
        """Give the side that a number in brackets or behind a colon explains: "a hair to the left (17 px)"."""
        before = [c for c in self.sentence.clauses if c.end <= self.clause.start]
        marks = {"px": ("(", ":"), "deg": ("(",)}.get(numeral.unit, ())
        if not before or before[-1].numerals or self.text[before[-1].end : self.clause.start] not in marks:
            return []
        if before[-1].has("who", "scene") or (numeral.unit == "deg" and self.clause.has("quantity")):
            return []
        sides = before[-1].of("side", "left", "right", "cw", "ccw")
        return sides if len(sides) == 1 else []

    def _is_of_person(self, side: Token) -> bool:
        """ "the nose is 5 degrees left of the walker": the other way round than the walker's bearing."""
        people = self.clause.of("who", "target")
        if self.language == "zh":
            return any(0 <= side.start - t.end <= 1 and self.text[t.start - 1 : t.start] in "在位" for t in people)
        return any(0 <= t.start - side.end <= 9 and self.text.startswith(" of", side.end) for t in people)

    def hedge(self, numeral: Numeral) -> Hedge:
        reach = 14 if self.language == "en" else 4
        for token in reversed(self.clause.of("hedge")):
            distance = numeral.start - token.end if token.end <= numeral.start else token.start - numeral.end
            if (
                self.language == "en"
                and token.start >= numeral.end
                and not self.text.startswith(("or ", "give"), token.start)
            ):
                continue
            if any(t.start == token.start for t in self.clause.of("time", "max", "min")):
                continue  # "earlier up to 22 m", "as low as 18 m" is an extreme
            if any(token.end <= t.start and t.end <= numeral.start for t in self.clause.of("who")):
                continue  # "slightly above the target's 1.2 m/s"
            if token.end <= numeral.start and _IS.search(self.text, token.end, numeral.start):
                continue  # "the walker below is only 24 m off"
            if -1 <= distance <= reach and not crossing(self.sentence, self.clause, token, numeral.start, numeral.end):
                return token.value  # type: ignore[return-value]
        return ""

    def extreme(self, numeral: Numeral) -> Literal["", "max", "min"]:
        """Say of which end of its series a number is told to be: "23.0 m, the longest of the five frames"."""
        found = _EXTREME[self.language].match(self.text, numeral.end)
        return "" if found is None or numeral.unit not in ("m", "mps", "px") else "max" if found["most"] else "min"

    def aggregate(self, numeral: Numeral) -> str:
        near = [t for t in self.clause.of("time", "max", "min", "mean") if gap(t, numeral.start, numeral.end) <= 30]
        near = [t for t in near if not crossing(self.sentence, self.clause, t, numeral.start, numeral.end)]
        return near[-1].value if near else ""
