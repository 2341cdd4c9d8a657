"""The unit of a number that is written without one."""

from __future__ import annotations

import re
from dataclasses import replace

from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import Context, crossing, times_of
from caption.truth.prose.numerals import Numeral
from caption.truth.prose.timing import MEASURED

_IMPLIED = {
    "speed": "mps", "distance": "m", "range": "m", "slant": "m", "altitude": "m", "over": "m", "yaw": "deg", "heading": "deg", "pitch": "deg",
    "depression": "deg", "bearing": "deg", "box": "px", "width": "px", "tall": "px", "centre": "px", "climb_rate": "mps",
    "yaw_rate": "dps", "travelled": "m", "displacement": "m", "target_heading": "deg",
}  # fmt: skip
# What may stand before such a number beside words of the lexicon.
_KNOWN = {
    "en": re.compile(r"(?:[\s,:]|\b(?:and|but|only|just|the|an?|at|of|to|did|does|do|is|are|was|were|then|still|so|with|in|on|it|that|has|had|have|as)\b)*"),
    "zh": re.compile(r"[\s,，、才只有仅还在也是为约的了又]*"),
}  # fmt: skip
_AT_PACE = re.compile(r"(?:\b(?:at|doing|does|do|did|making|makes|our|their|his|her)|\w's|只有|为|是|有) ?$")
_PLACED = re.compile(r"\s*(?:below|above|under|beneath|left|right|down|up)\b")
_IS_DONE = re.compile(r"已经|一共|飞出|走出|了")  # a way, not a pace


class Units:
    """The units of one clause's numbers."""

    def __init__(self, sentence: Sentence, clause: Clause, context: Context) -> None:
        self.sentence, self.clause, self.context = sentence, clause, context
        self.text = sentence.text

    def with_unit(self, numeral: Numeral) -> Numeral:
        """A number without a unit has that of the quantity right before it."""
        if numeral.unit == "m" and self._is_per_second():
            return replace(numeral, unit="")
        before = [n for n in map(self.sentence.numerals.__getitem__, self.clause.numerals) if n.end <= numeral.start]
        if not numeral.unit and before and before[-1].unit == "px" and _PLACED.match(self.text, numeral.end):
            return replace(numeral, unit="px")  # "ten pixels right of centre and fourteen below it"
        if numeral.unit or numeral.whole is None or self.clause.has("quantity", "ratio"):
            return numeral
        earlier = [n for n in self.sentence.numerals if n.start < numeral.start and n.unit in MEASURED]
        is_told = times_of(self.clause) or self.clause.has("time", "mean", "max", "min")
        if earlier and is_told and not self.clause.has("quantity") and self._is_only_unit(earlier[-1]):
            return replace(numeral, unit=earlier[-1].unit, factor=earlier[-1].factor)
        if earlier and earlier[-1].unit == "mps" and numeral.fraction is not None and self._is_pace(numeral):
            return replace(numeral, unit="mps", factor=earlier[-1].factor)
        near = [t for t in self.clause.of("quantity") if t.end <= numeral.start and t.value in _IMPLIED]
        if (
            not near
            and numeral.fraction is not None
            and not self.clause.has("quantity")
            and (only := self._only_unit(numeral))
        ):
            return replace(numeral, unit=only[0], factor=only[1])
        if (
            not near
            or numeral.start - near[-1].end > 12
            or crossing(self.sentence, self.clause, near[-1], numeral.start, numeral.end)
        ):
            return numeral
        if (
            numeral.fraction is None
            and near[-1].value in ("yaw", "centre", "box", "travelled", "speed")
            and "=" not in self.text[near[-1].start : numeral.start]
        ):
            return numeral
        return replace(numeral, unit=_IMPLIED[near[-1].value])

    def _only_unit(self, numeral: Numeral) -> tuple[str, float] | None:
        """Give the unit of all other numbers of the sentence: "we pass 17.3 metres, and left 12.8 two seconds ago"."""
        if not _KNOWN[self.sentence.language].fullmatch(self._unread_before(numeral)):
            return None
        told = {(n.unit, n.factor) for n in self.sentence.numerals if n.unit not in ("", "s", "frames")}
        is_later = any(n.unit and n.start < numeral.start for n in self.sentence.numerals)
        return told.pop() if is_later and len(told) == 1 and min(told)[0] in MEASURED else None

    def _unread_before(self, numeral: Numeral) -> str:
        """Give what stands before a number in its clause, without the words of the lexicon."""
        part, at = "", self.clause.start
        for token in self.clause.tokens:
            if at <= token.start and token.end <= numeral.start:
                part, at = part + self.text[at : token.start], token.end
        return part + self.text[at : numeral.start]

    def _is_pace(self, numeral: Numeral) -> bool:
        """ "and the walker crawls at 1.28", "而行人只有 0.62": a speed after one with its unit."""
        people = self.clause.of("who", "drone", "target")
        named = any(t.end <= numeral.start for t in people) or (not people and self.context.subject)
        bare = [n for n in map(self.sentence.numerals.__getitem__, self.clause.numerals) if not n.unit]
        alone = not self.clause.has("quantity") and len(bare) == 1
        return bool(named) and alone and _AT_PACE.search(self.text, self.clause.start, numeral.start) is not None

    def _is_per_second(self) -> bool:
        """ "每秒 0.4 米,后又提到 1.2 米": a length that may be a speed."""
        earlier = any(
            "每秒" in self.text[max(0, n.start - 4) : n.start] for n in self.sentence.numerals if n.unit == "mps"
        )
        is_way = (
            _IS_DONE.search(self.text, self.clause.start, self.clause.end)
            or self.clause.has("time", "window")
            or not all(t.value == "travelled" for t in self.clause.of("quantity"))
        )
        return earlier and not is_way  # "他只走 1.59 米" goes on about paces

    def _is_only_unit(self, earlier: Numeral) -> bool:
        """Tell whether a clause tells one number, or others of the same unit alone: "1.26 m/s at t1 and 1.19 now"."""
        told = [
            n for n in map(self.sentence.numerals.__getitem__, self.clause.numerals) if n.unit not in ("s", "frames")
        ]
        return len(told) == 1 or all(n.unit in ("", earlier.unit) for n in told)
