"""What the words leave no doubt of: a number's quantity and owner, its frame, and whether it is a value or a change.

Each is told alone; what is not told stays open. A number that no open reading makes true is a contradiction.
"""

from __future__ import annotations

import re
from functools import cached_property

from caption.truth.prose.changing import MORE_BY, MORE_THAN, ZH_MORE
from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import GOES_TO, Context, names_of, tells_step
from caption.truth.prose.lexicon import Token
from caption.truth.prose.moments import Moments
from caption.truth.prose.naming import OFF_CENTRE, OVER_OTHER
from caption.truth.prose.numerals import Numeral
from caption.truth.prose.owners import BEHIND, GOES_ON, LINK, Owners
from caption.truth.prose.statements import NOW, Mode
from caption.truth.prose.versus import pairs_of_speeds

_OFF_TO = re.compile(
    r"\s*(?:(?:to the |over to the )?(?P<x>left|right)|above|below) (?:of )?(?:and #(?:\.#)? ?(?:px|pixels) (?:to the )?(?:left|right|above|below) (?:of )?)?(?:the )?(?:\w+ )?(?:middle|cent(?:re|er)|axis|cross ?hairs?|reticle|midline)\b"
)
# "19 px across and 27 px down", both from the centre
_ACROSS = re.compile(
    r"\s*across (?P<and>and #(?:\.#)? ?(?:px|pixels) (?:down|low|up|high|below|above))|\s*(?:down|low)\b"
)
_ASIDE = re.compile(r"偏[左右](?:了|约|大约|近)?\s*$")
_CLOSING = re.compile(
    r"\b(?:clos(?:ing|ure)|approach\w*|opening|relative|vertical\w*|climb\w*|sink\w*|descen\w*|surplus|margin|lead|deficit|wind)\b|接近|靠近|逼近|远离|相对|垂直|爬升|升降|下降|富余|风"
)
_LEVEL = re.compile(r"\b(?:on|over|along|across) the ground\b|地面|平地|水平")
_BY = re.compile(r"\bby (?:about |roughly |some |only |just |almost |nearly |an? )*$")
_MISSING = re.compile(r"\b(?:short of|remain\w*|left over|to go|missing)\b|还差|相差|差了|仍差")
# unit -> cue -> what it surely names; an owner's where it is by drone and target.
_NAMED: dict[str, dict[str, tuple[str, ...]]] = {
    "m": {
        "distance": ("distance",), "range": ("distance", "slant"), "slant": ("slant",), "altitude": ("altitude", "height_over_target"), "height": ("altitude", "height_over_target"),
        "over": ("height_over_target",), "displacement": (), "travelled": (),
    },
    "mps": {"climb_rate": ("climb_rate", "rate:altitude")},
    "px": {
        "width": ("box_width",), "tall": ("box_height",), "height": ("box_height",), "altitude": ("box_height",),
        "box": ("box_width", "box_height"), "centre": ("offset_x", "offset_y"),
    },
    "deg": {"pitch": ("pitch", "depression"), "depression": ("pitch", "depression"), "bearing": ("bearing",), "yaw": (), "turn": (), "heading": (), "target_heading": ()},
    "dps": {"yaw_rate": ("rate:yaw", "rate:heading")},
}  # fmt: skip
_TOLD = {"alt_up": "altitude", "alt_down": "altitude", "dist_up": "distance", "dist_down": "distance"}


class Sureness:
    """The certainties of one clause's numbers."""

    def __init__(self, sentence: Sentence, clause: Clause, context: Context) -> None:
        self.sentence, self.clause, self.context = sentence, clause, context
        self.text, self.language = sentence.text, sentence.language
        self.people = {t.value for t in clause.of("who", "drone", "target")}
        self.moments, self.owners = Moments(sentence, clause), Owners(sentence, clause, context)

    @cached_property
    def pairs(self) -> list[tuple[Numeral, Numeral]]:
        """Give the pairs of speeds against each other; once the numbers have their units."""
        return pairs_of_speeds(self.sentence, self.clause)

    # --- whose, and of what ------------------------------------------------------------------------------------------

    def names(self, numeral: Numeral, told: tuple[str, ...] = ()) -> tuple[str, ...]:
        """Give the series of which a number surely is. told: those of the word for its change."""
        if self.differs_by(numeral):
            return ("speed_difference", "difference_mean")
        if self.is_in_group(numeral) or (numeral.unit == "mps" and self._may_differ(numeral)):
            return ()
        if _MISSING.search(self.text, self.clause.start, self.clause.end) or self._is_apart(numeral):
            return ()
        if numeral.unit == "px" and (across := _ACROSS.match(self.text, numeral.end)):
            return ("offset_x",) if across["and"] else ()
        if numeral.unit == "px" and self.language == "en" and (beside := _OFF_TO.match(self.text, numeral.end)):
            return ("offset_x",) if beside["x"] else ("offset_y",)
        if (
            numeral.unit == "px"
            and numeral.side
            and (
                _ASIDE.search(self.text, 0, numeral.start)
                or not self.clause.has("quantity", "box", "width", "tall", "height")
            )
        ):
            return ("offset_x",)
        if numeral.unit == "px" and OFF_CENTRE.search(self.text, 0, numeral.start):
            return ("offset_y",)
        cues = self._cues(numeral)
        if numeral.unit == "m" and OVER_OTHER.match(self.text, numeral.end):
            return ("height_over_target",)
        if numeral.unit == "mps" and not cues:
            return self._speeds(numeral)
        if (
            numeral.unit == "deg"
            and not cues
            and numeral.sign
            and self.people == {"target"}
            and self.context.cue == "heading"
        ):
            return names_of("heading", "deg", "target") if self.owners.opens(self.clause.of("who")[0]) else ()
        cues = cues or self._gone_on_about(numeral)
        named = _NAMED.get(numeral.unit, {})
        found = {named[cue] or self._owned(cue, numeral) for cue in cues}
        if numeral.unit == "px" and cues & {"width", "tall", "height"} and self.clause.has("position", "frame"):
            found = {(*names, "picture") for names in found}  # "in a picture 1280 px wide"
        if len(found) > 1 and numeral.unit == "px":
            found.discard(("box_width", "box_height"))  # "box height", "框子高"
        if found == {("distance", "slant")} and _LEVEL.search(self.text, self.clause.start, self.clause.end):
            return ("distance",)  # "on the ground they were 17 m apart"
        return found.pop() if len(found) == 1 else () if cues else told

    def differs_by(self, numeral: Numeral) -> bool:
        """Tell whether a speed is that by which one of the two is faster now: "slower than the walker by 0.3 m/s"."""
        if (
            numeral.unit != "mps"
            or self.language != "en"
            or not _BY.search(self.text, self.clause.start, numeral.start)
        ):
            return False
        at = self.sentence.clauses.index(self.clause)
        near = self.sentence.clauses[max(0, at - 1) : at + 1]
        people = {t.value for c in near for t in c.of("who", "drone", "target")}
        is_now = all(t.value in ("now", "last_step") for c in near for t in c.of("time"))
        return is_now and len(people) == 2 and any(c.has("compare", "faster", "slower") for c in near)

    def _is_apart(self, numeral: Numeral) -> bool:
        """Tell whether a number is of something else than the clauses before: worked out from them, or along another line."""
        derived = _DERIVED[self.language].search(self.text, max(0, self.clause.start - 6), numeral.start)
        return derived is not None or (numeral.unit == "m" and _ALONG.match(self.text, numeral.end) is not None)

    def _speeds(self, numeral: Numeral) -> tuple[str, ...]:
        if self.closes():
            return ()
        owner, link = self.owners.owner(numeral), LINK[self.language]
        beside = any(
            t.end <= numeral.start and link.fullmatch(self.text, t.end, numeral.start)
            for t in self.clause.of("quantity", "speed")
        )
        names = names_of("speed", "mps", owner) if owner or beside else ()
        return tuple([n for n in names if n != "target_mean"]) if self.is_of_one_step(numeral) else names

    def is_of_one_step(self, numeral: Numeral) -> bool:
        """Tell whether a speed is told of one step and not of the window: "1.2 m/s now", "in the final half second they fell back to 1.2 m/s"."""
        return tells_step(self.sentence, self.clause) or self.moments.beside(numeral) is not None

    def _gone_on_about(self, numeral: Numeral) -> set[str]:
        """Give the one quantity of the clauses before, where this one only goes on about it: "..., now 20.3 m"."""
        if self.clause.has("quantity") or not GOES_ON[self.language].fullmatch(
            self.text, self.clause.start, numeral.start
        ):
            return set()
        before = [c for c in self.sentence.clauses if c.end <= self.clause.start]
        named = _NAMED.get(numeral.unit, {})
        told = {t.value for c in before for t in c.of("quantity") if t.value in named}
        told |= {_TOLD[t.value] for c in before for t in c.of("trend") if numeral.unit == "m" and t.value in _TOLD}
        if "yaw" in told and any(c.has("who", "target") for c in before):
            return set()  # "the person is left of the nose, 3 degrees"
        if self.text[: self.clause.start].endswith(("(", ":")) and numeral.unit != "m":
            return set()
        if self.text[: self.clause.start].endswith(":") and len(told) != 1:
            return set()  # "gains height while closing in: up by 2.1 m"
        if self.text[: self.clause.start].endswith(("(", ":")):
            last = before[-1].of("quantity") if before else []
            mark = self.clause.start - 1
            return told & {
                t.value for t in last if mark - t.end <= 1 or t.start == before[-1].start
            }  # "altitude (18.5 m)"
        return told if len(told) == 1 else set()

    def is_in_group(self, numeral: Numeral) -> bool:
        """Tell whether numbers stand in a row, whose quantities may stand in one too: "height and range: 20 m and 21 m"."""
        row = [n for n in self.sentence.numerals if n.group == numeral.group]
        if numeral.unit == "px" and all(_SIDED.search(self.text, 0, n.start) for n in row):
            return False  # "偏右 12 像素、偏下 19 像素"
        if len(row) > 1 and (all(self.has_own_word(n) for n in row) or self._is_named_in(row, numeral)):
            return False  # "12.0 m up, 9.5 m away", "斜距 28.0 米、水平距离 20.5 米"
        after = MORE_THAN.match(self.text, row[-1].end) if self.language == "en" and len(row) == 2 else None
        if after and after["than"]:
            return False  # "20.0 m, 1.2 m lower than at t3"
        return len(row) > 1 or any(numeral in pair for pair in self.pairs)

    def _is_named_in(self, row: list[Numeral], numeral: Numeral) -> bool:
        """Tell whether a quantity stands between a number of a row and the one before it."""
        before = [n for n in row if n.end <= numeral.start]
        link = LINK[self.language]
        return bool(before) and any(
            before[-1].end <= t.start and t.end <= numeral.start and link.fullmatch(self.text, t.end, numeral.start)
            for t in self.clause.of("quantity")
        )

    def has_own_word(self, numeral: Numeral) -> bool:
        quantities = [t for c in self.sentence.clauses for t in c.of("quantity")]
        behind = any(
            (
                numeral.start < t.start <= numeral.end + 1 + self.text.startswith("的", numeral.end)
                and t.end > numeral.end
            )
            or (numeral.unit == "m" and t.start >= numeral.end and BEHIND.fullmatch(self.text, numeral.end, t.start))
            for t in quantities
        )
        before = [t for t in self.clause.of("quantity") if t.end <= numeral.start]
        return behind or (
            len(before) == 1 and LINK[self.language].fullmatch(self.text, before[0].end, numeral.start) is not None
        )

    def _cues(self, numeral: Numeral) -> set[str]:
        """Give the quantities right beside a number, else those of which its clause speaks."""
        named = _NAMED.get(numeral.unit, {})
        tokens = [t for c in self.sentence.clauses for t in c.of("quantity") if t.value in named]
        at = {t.start for t in tokens if t.value == "travelled" and GOES_TO.search(self.text[t.end : numeral.start])}
        tokens = [t for t in tokens if t.start not in at]  # "flew at 20 m"
        link = LINK[self.language]
        near = [t for t in tokens if t.end <= numeral.start and link.fullmatch(self.text, t.end, numeral.start)]
        behind = [t for t in tokens if t.start >= numeral.end and BEHIND.fullmatch(self.text, numeral.end, t.start)]
        near += [t for t in behind if not self.is_before_number(t)]
        near += [t for t in tokens if numeral.start < t.start < numeral.end < t.end]  # "17 px high"
        if near:
            found = {t.value for t in near}
            from_start = self.clause.has("quantity", "displacement") and found <= {"slant", "distance"}
            return {"displacement"} if from_start else found  # "离起点的直线距离"
        told = [
            t
            for t in self.clause.tokens
            if (t.kind == "quantity" and t.value in named and t.start not in at)
            or (numeral.unit == "m" and t.kind == "trend" and t.value in _TOLD)
        ]
        found = {t.value if t.kind == "quantity" else _TOLD[t.value] for t in told}
        return found if len({named[cue] for cue in found}) == 1 and any(t.end <= numeral.start for t in told) else set()

    def is_before_number(self, token: Token) -> bool:
        """Tell whether a number of its own stands right behind a quantity: "飞了5.1米却只位移0.4米"."""
        after = [n.start for n in self.sentence.numerals if n.start >= token.end]
        return self.language == "zh" and bool(after) and not self.text[token.end : after[0]].strip()

    def _owned(self, cue: str, numeral: Numeral) -> tuple[str, ...]:
        if self.clause.has("quantity", "bearing") or (self.clause.has("side") and len(self.people) > 1):
            return ()
        if cue == "yaw" and (
            "target" in self.people
            or (not self.people and self.context.subject == "target" and not self.context.is_carried)
        ):
            return ()  # "the nose points 2 degrees away from the walker"
        owner = "drone" if cue == "yaw" else self.owners.owner(numeral)
        if cue == "displacement" and not owner and not any(c.has("who", "target") for c in self.sentence.clauses):
            owner = "drone"
        if cue in ("turn", "heading", "yaw") and owner == "drone":
            return ("yaw", "heading")
        if cue == "displacement" and owner == "drone":
            return ("displacement",)
        return names_of("turn" if numeral.unit == "deg" else cue, numeral.unit, owner) if owner else ()

    def closes(self) -> bool:
        """Tell whether a speed may be that of a climb, of an approach or a difference."""
        if _CLOSING.search(self.text, self.clause.start, self.clause.end):
            return True
        return self.clause.has(
            "quantity", "difference", "distance", "slant", "altitude", "over", "ratio"
        ) or self.clause.has("trend", "alt_up", "alt_down", "dist_up", "dist_down")

    def frames(self, numeral: Numeral) -> tuple[int, ...] | None:
        """Give the frame of which a number surely is, or the two between which it is a change."""
        if self.differs_by(numeral):
            return (NOW,)
        if self.is_in_group(numeral):
            beside = self.moments.beside(numeral)
            return None if beside is None else (beside,)
        mode = self.mode(numeral)
        return self.moments.span() if mode == "change" else self.moments.frames(numeral, is_value=mode == "value")

    def ends_of_course(self, first: Numeral, last: Numeral) -> tuple[int, ...] | None:
        """Give the frames of "from A at t1 to B now" or "from A to B in the last step", where both are told."""
        found = [self.moments.beside(n) for n in (first, last)]
        if found[1] is None and (
            _LATER.search(self.text, last.end, self.clause.end) or _AND_THEN.match(self.text, last.end)
        ):
            return None  # "dipping to 18.3 m at the middle frame and back up to 22.2 m half a second later"
        if found[0] is not None:
            return None if found[0] == found[1] else (found[0], NOW if found[1] is None else found[1])
        told = self.clause
        before = [c for c in self.sentence.clauses if c.end <= told.start]
        if before and not told.has("time") and self.text[before[-1].end : told.start] == "(":
            told = before[-1]  # "slowed in the last step (1.27 down to 1.09 m/s)"
        times = [t for t in told.of("time") if self.text[t.start : t.end] != "up to"]
        spans = {t.value for t in times} - {"since", "last_s:0.5"}  # "from", "half a second"
        return (-2, NOW) if spans == {"last_step"} and found[1] in (None, NOW) else None

    # --- value or change ---------------------------------------------------------------------------------------------

    def mode(self, numeral: Numeral) -> Mode:
        if self.differs_by(numeral):
            return "value"
        if numeral.unit == "deg" and not self.clause.has("quantity", "pitch", "depression", "bearing"):
            return "value" if numeral.sign and self.moments.beside(numeral) is not None else "either"
        if self._is_changed(numeral):
            return "change"
        if numeral.sign > 0:
            return "either"
        if numeral.unit == "mps":
            return "either" if self._may_differ(numeral) else "value"
        tokens = [t for t in self.clause.of("quantity") if t.end <= numeral.start]
        if self.text[max(0, numeral.start - 3) : numeral.start].strip("约近 ").endswith("了") and not _REACHED.search(
            self.text, self.clause.start, numeral.start
        ):
            return "either"
        if any(LINK[self.language].fullmatch(self.text, t.end, numeral.start) for t in tokens):
            return "value"
        return "either"

    def _may_differ(self, numeral: Numeral) -> bool:
        """Tell whether a speed may be a change or a difference: "by 2 m/s", "2 m/s faster", "快 2 米/秒"."""
        if self.language == "en":
            before = re.search(r"\b(?:by|than|per|another|further)\b", self.text[self.clause.start : numeral.start])
            return bool(before or MORE_THAN.match(self.text, numeral.end) or self._follows_trend(numeral))
        return bool(
            ZH_MORE.search(self.text[: numeral.start])
            or re.search(r"(?<![到至])了|[差比较]", self.text[self.clause.start : numeral.start])
        ) or self._follows_trend(numeral)

    def _follows_trend(self, numeral: Numeral) -> bool:
        trends = [t for t in self.clause.of("trend") if t.value not in ("steady", "mixed") and t.end <= numeral.start]
        trends = [t for t in trends if not self.text[: t.end].endswith(("到", "至", "回", "为", " to", " from"))]
        return any(_CHANGES_BY[self.language].fullmatch(self.text, t.end, numeral.start) for t in trends)

    def _is_changed(self, numeral: Numeral) -> bool:
        if numeral.unit not in ("m", "px") or self.clause.has("quantity", "travelled", "displacement", "over"):
            return False
        if self.language == "en":
            after = MORE_THAN.match(self.text, numeral.end)
            if (
                after
                and after["than"]
                and any(0 <= t.start - after.end() <= 12 for t in self.clause.of("who", "drone", "target"))
            ):
                return False  # "17 m higher than the walker"
            if after and after["word"] not in ("above", "below", "more", "less", "up", "down", "further"):
                return True
        elif numeral.unit == "px" and self.clause.has("quantity", "centre"):
            return False  # "比中心低 49 像素"
        elif MORE_BY.search(self.text, 0, numeral.start):
            return True
        elif ZH_MORE.search(self.text[: numeral.start]):
            thans = self.clause.of("link", "than")
            return bool(thans) and not any(thans[0].start <= t.start for t in self.clause.of("who", "target", "drone"))
        return self._follows_trend(numeral)


_LATER = re.compile(r"\blater\b|之后|以后")
_AND_THEN = re.compile(r"\s*,?\s*(?:and|before|but)? ?then (?:to|back|again|up|down)\b")
_SIDED = re.compile(r"[左右上下](?:方|侧|边|偏|移)?\s*$")
_DERIVED = {"en": re.compile(r"\bi\.?e\b\.?|[,;(]\s*that is\b"), "zh": re.compile(r"也就是|亦即|折合|相当于")}
_ALONG = re.compile(r"\s*(?:in a|as a|along the) straight line\b")
_REACHED = re.compile(r"[到至]了[约近]?\s*$")
_CHANGES_BY = {
    "en": re.compile(r"\s*(?:by|of|another|a further|about|roughly|some|almost|nearly|just|only|exactly|a mere|\s)*"),
    "zh": re.compile(r"\s*(?:了|约|大约|近|将近|仅|又|只)*\s*"),
}
