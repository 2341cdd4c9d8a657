"""Numbers of a clause as statements: whose value of what, at which frames, or which change of it."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

from caption.truth.prose.beside import Beside
from caption.truth.prose.changing import AFTERWARDS, MORE_THAN, Changing
from caption.truth.prose.clauses import Clause, Sentence
from caption.truth.prose.cues import (
    OVERALL,
    Context,
    times_of,
)
from caption.truth.prose.naming import Naming
from caption.truth.prose.numerals import EVERY_SECOND, WAY, Numeral
from caption.truth.prose.reading_ratios import ratio_statement
from caption.truth.prose.rows import Rows
from caption.truth.prose.statements import NOW, Mode, Statement
from caption.truth.prose.sureness import Sureness
from caption.truth.prose.timing import MEASURED, Timing
from caption.truth.prose.units import Units
from caption.truth.prose.versus import owners_behind
from caption.truth.prose.ways import WAYS, Ways

_GIVE_OR_TAKE = re.compile(r"(?:give or take|plus or minus|\+/-|±|to within|accurate to|不差|误差)\s*(?:about |约)?$")
# Shares of the picture: "one per cent of the image width", "图像宽度的百分之一".
_OF_PICTURE = {
    "en": re.compile(r"\s*of (?:the |a )?(?:image|picture|frame)(?:'s)?(?: (?:width|height))?\b"),
    "zh": re.compile(
        r"[^#]*(?:图像|画面|图片|画幅)(?:的)?(?:宽度|高度|宽|高)的?约?[^#]{0,5}$|[^#]*(?:图像|画面)(?:宽度|高度)"
    ),
}
_NEAR = 14  # letters behind a number in which its moment stands
_TIMES = re.compile(r"\s*[x*×]\s*(?=[#\d])")
_AS_BOX = re.compile(r"\s*(?:wide|tall)\b|宽|高(?!度)")
_ASIDE = re.compile(r"偏[左右]约?\s*$")
_PER = re.compile(r"\b(?:per|each|every)\b|每")


class NumberReader:
    """Reads the numbers of one clause."""

    def __init__(self, sentence: Sentence, clause: Clause, context: Context, in_scene: bool) -> None:
        self.sentence, self.clause, self.context, self.in_scene = sentence, clause, context, in_scene
        self.text, self.language = sentence.text, sentence.language
        self.statements: list[Statement] = []
        self.left_out = False
        self.timing = Timing(sentence, clause, context)
        self.naming = Naming(sentence, clause, context)
        self.changing = Changing(sentence, clause, context)
        self.beside = Beside(sentence, clause, context, in_scene=in_scene)
        self.sureness = Sureness(sentence, clause, context)
        self.ways, self.units = Ways(sentence, clause, self.sureness), Units(sentence, clause, context)
        self.rows = Rows(sentence, clause, context, self.beside, self.sureness, in_scene=in_scene)

    def read(self) -> None:
        groups: dict[int, list[int]] = {}
        for i in self.clause.numerals:
            numeral = self.units.with_unit(self.sentence.numerals[i])
            self.sentence.numerals[i] = numeral
            if numeral.unit not in ("s", "frames"):
                groups.setdefault(numeral.group, []).append(i)
        self._share_units_of_ends()
        for members in groups.values():
            self._share_unit(members)
            self._read_group(members)
        self._join_courses()
        self._speeds()
        self._units()

    def _share_unit(self, members: list[int]) -> None:
        """Give the unit of the first number of a row to those of it that have none."""
        first = self.sentence.numerals[members[0]]
        for i in members[1:]:
            if not self.sentence.numerals[i].unit:
                self.sentence.numerals[i] = replace(self.sentence.numerals[i], unit=first.unit, factor=first.factor)

    def _share_units_of_ends(self) -> None:
        """Give the unit of the end to the start of a way that has none: "from 6 to about 4.3 m/s"."""
        for i, j in itertools.pairwise(self.clause.numerals):
            first, last = self.sentence.numerals[i], self.sentence.numerals[j]
            if not first.unit and last.unit and self.changing.is_from_to(first, last):
                self.sentence.numerals[i] = replace(first, unit=last.unit, factor=last.factor)

    def _units(self) -> None:
        """Keep the unit of a foreign one that nothing else was read of: "hold the range at 16.7 km"."""
        told = {i for s in self.statements for i in s.numbers}
        for i in () if self.in_scene else self.clause.numerals:
            numeral = self.sentence.numerals[i]
            if i not in told and numeral.factor != 1.0 and numeral.unit in MEASURED:
                self.statements.append(Statement("unit", (self.clause.start, self.clause.end), numbers=(i,)))
            elif numeral.unit == "m" and numeral.fraction is None and (names := self._of_box(numeral)):
                row = [j for j in self.clause.numerals if self.sentence.numerals[j].group == numeral.group]
                self.statements.append(Statement("unit", (self.clause.start, self.clause.end), names, tuple(row)))

    def _of_box(self, numeral: Numeral) -> tuple[str, ...]:
        """Give the series of the box that a length would be if it were in pixels: "12 m wide", "a speck of 5 x 6 m"."""
        if numeral.joined in ("x", "*") or _TIMES.match(self.text, numeral.end):
            return ("box_width", "box_height")
        if (found := _AS_BOX.match(self.text, numeral.end)) and not self.clause.has("who", "scene"):
            return ("box_width",) if found[0].strip()[0] in "w宽" else ("box_height",)
        is_aside = self.language == "zh" and _ASIDE.search(self.text, self.clause.start, numeral.start)
        return ("offset_x",) if is_aside and self.clause.has("quantity", "box", "centre") else ()

    def _speeds(self) -> None:
        """Read two speeds that are set against each other: one is the drone's, the other the target's."""
        for a, b in self.sureness.pairs:
            i, j = self.sentence.numerals.index(a), self.sentence.numerals.index(b)
            if i not in self.clause.numerals or self.clause.is_blocked(a.start) or self.clause.has("link", "between"):
                continue
            there = next((c for c in self.sentence.clauses if c.start <= b.start < c.end), self.clause)
            if any(t.value[0] == "t" and t.value[1:].isdigit() for t in self.clause.of("time")):
                continue
            if there.has("time", "prev1", "prev2", "start", "past"):
                continue  # "0.37 m/s, against 3.46 the frame before"
            owners = [self.sureness.owners.right_beside(n) for n in (a, b)]
            if re.match(r"\s*的?[^(]*\(", self.text[b.end :]) or self.text[: self.clause.start].endswith(":"):
                owners = owners_behind(self.sentence, self.clause)  # "speeds of 5.8 and 4.9 m/s (drone, walker)"
            first = {"drone": 1, "target": -1, "": 0}[owners[0]] or -{"drone": 1, "target": -1, "": 0}[owners[1]]
            today = not any(t.value not in ("now", "last_step") for t in self.clause.of("time"))
            frames = (NOW,) if today else None
            self.statements.append(
                Statement(
                    "speeds",
                    (self.clause.start, self.clause.end),
                    (),
                    (i, j),
                    frames,
                    side=first,
                    hedge=self.beside.hedge(a),
                )
            )

    def _read_group(self, members: list[int]) -> None:
        numerals = [self.sentence.numerals[i] for i in members]
        first = numerals[0]
        joins = [n.joined for n in numerals[1:]]
        per_second = first.unit == "px" and EVERY_SECOND.match(self.text, numerals[-1].end)
        if per_second or self.clause.is_blocked(first.start) or self._is_planned(first.start):
            self.left_out = True
        elif "x" in joins or (joins[:1] in (["*"], ["by"], ["乘"]) and first.unit == "px"):
            in_pairs = len(members) if "x" in joins[1:] else 2
            self._add_pairs(members[:in_pairs])
            for i in members[in_pairs:]:  # "21x44 px, 4 px left, 7 px up"
                self._single([i], "number")
        elif first.unit == "percent":
            for i in members:
                self._percent(i)
        elif first.unit == "times" or (not first.unit and self.clause.has("quantity", "ratio")):
            self.statements.append(
                ratio_statement(self.sentence, self.clause, self.context, first.start, first.end, (members[0],))
            )
        elif first.unit == "clock":
            self._clock(members[0])
        elif first.unit not in MEASURED or self._is_none(first):
            self.left_out = self.left_out or any(n.whole is not None for n in numerals)
        elif len(members) >= 3 and not {"-", "~"} & set(joins):
            self._add(self.rows.series(members))
        elif (
            len(members) == 2
            and joins[0] in ("-", "~", "to", "至", "到", "or", "或")
            and not self.changing.comes_by(first)
            and not self.timing.comes_from(first)
            and not self._is_way(first, numerals[1])
        ):
            self._single(members, "range")
        elif (
            len(members) == 2
            and self.clause.has("link", "between")
            and joins[0] in ("and", "和", "与", "到", "至", "及")
        ):
            self._single(members, "range", None)
        elif len(members) == 2 and (joins[0] == "→" or self._is_way(first, numerals[1])):
            self._add(self.rows.course(members[0], members[1]))
        else:
            for i in members:
                self._single([i], "number")

    def _is_way(self, first: Numeral, last: Numeral) -> bool:
        """Tell whether a word between two numbers says which way it goes: "1.27 down to 1.09 m/s"."""
        return WAY.search(self.text, first.end, last.start) is not None

    def _is_none(self, numeral: Numeral) -> bool:
        """ "not a single pixel", "一个像素也没变", "give or take 0.3 m"."""
        if _GIVE_OR_TAKE.search(self.text[: numeral.start]):
            return True
        around = self.text[self.clause.start : numeral.end + 4]
        return numeral.whole is None and bool(re.search(r"\bnot\b|n't|\bnever\b|没|不", around))

    def _is_planned(self, at: int) -> bool:
        return any(t.end <= at for t in self.clause.of("modality", "plan"))

    # --- single numbers ----------------------------------------------------------------------------------------------

    def _single(self, members: list[int], kind: str, frames: tuple[int, ...] | str | None = "") -> None:
        numeral = self.sentence.numerals[members[0]]
        names, is_cued = self.naming.names(numeral)
        if self.in_scene and (not is_cued or numeral.unit in ("m", "mps")):
            self.left_out = True
            return
        names, mode, trend = self._change(numeral, names)
        if numeral.unit == "mps" and self.sureness.is_of_one_step(numeral):
            names = tuple([name for name in names if name != "target_mean"])
        if mode == "change" and numeral.unit == "m" and self.naming.is_of_height():
            names = ("altitude",)
        side, vertical = self.beside.side(numeral)
        side = 0 if numeral.sign and numeral.unit == "deg" else side  # "to the left of our own -147.4 degrees"
        sure_names = self.sureness.names(numeral, self.naming.told_after(numeral))
        sure_frames = self.sureness.frames(numeral)
        if frames == "":
            frames = sure_frames if mode == "value" and sure_frames else self._frames(numeral, mode)
        boxed = self.clause.has("quantity", "box", "width", "tall", "height") and is_cued and names[0].startswith("box")
        if numeral.unit == "px" and (side or vertical) and not boxed:
            names = ("offset_x",) if side else ("offset_y",)
        found = Statement(
            kind="range" if kind == "range" else "number",
            clause=(self.clause.start, self.clause.end),
            names=names,
            numbers=tuple(members),
            frames=frames,  # type: ignore[arg-type]
            mode=mode,
            hedge=self.beside.hedge(numeral),
            side=side or vertical,
            trend=trend,
            word=self.beside.aggregate(numeral),
            sure_names=sure_names,
            sure_frames=sure_frames,
            sure_mode=self.sureness.mode(numeral),
            reached=self.changing.reached(numeral),
            is_last=not self.sureness.moments.goes_on_after(numeral)
            and not any(t.start < numeral.end + _NEAR for t, moment in times_of(self.clause) if moment != (NOW,)),
            is_per_step=self.changing.is_per_step(numeral),
        )
        if self.naming.is_from_origin(numeral):
            found = replace(found, names=("displacement", "target_travelled"), sure_names=())
        if found.sure_names and not set(found.names) & set(found.sure_names):
            found = replace(found, names=found.sure_names)
        if names == ("way_difference",):
            found = replace(found, mode="value", frames=(NOW,), sure_names=names, sure_frames=(NOW,), sure_mode="value")
        if (
            (moment := self.naming.over_moment(numeral)) is not None
            and names == ("altitude",)
            and self.context.cue not in ("distance", "range", "slant")
        ):
            ends = (moment, NOW)
            found = replace(found, mode="change", frames=ends, sure_names=names, sure_frames=ends, sure_mode="change")
        found = self._angle(found) if numeral.unit == "deg" else found
        if self.changing.goes_from(numeral) or self.sureness.moments.is_some():
            found = replace(found, frames=None, sure_frames=None)
        if side and found.sure_names:
            names = tuple([name for name in found.names if name in found.sure_names])
            found = replace(found, names=names or found.names)
        found = self._surely(found, numeral)
        units = [self.sentence.numerals[i].unit for i in self.clause.numerals]
        is_alone = units.count(numeral.unit) == 1 or self.sureness.has_own_word(numeral)
        is_single = bool(found.sure_names) and not trend and is_alone
        is_named = self.clause.has("who", "drone", "target") or self.clause.has("quantity")
        self.statements.append(replace(found, is_single=is_single, is_named=is_named))
        if (end := self.beside.extreme(numeral)) and names:
            self.statements.append(replace(found, kind="extreme", names=found.sure_names or names, word=end))

    def _change(self, numeral: Numeral, names: tuple[str, ...]) -> tuple[tuple[str, ...], Mode, int]:
        """Say of what a number is, whether it is a change, and which way."""
        mode, trend = self.changing.change(numeral)
        if names and set(names) <= WAYS and mode != "value" and not self.changing.is_partial():
            mode, trend = "value", 0
        if numeral.unit == "mps" and self.naming.differs_by(numeral):
            names, mode, trend = (*names, "speed_difference", "difference_mean"), "either", 0
        return names, mode, trend

    def _angle(self, s: Statement) -> Statement:
        """Read an angle with a side as a turn: the target's, or the drone's from the window's start."""
        numeral = self.sentence.numerals[s.numbers[0]]
        if self.naming.is_of_first_heading(numeral):
            return replace(s, names=("yaw",), sure_names=("yaw",), sure_frames=s.frames)
        if s.side and self.naming.is_of_nose(numeral):
            s = replace(s, names=("bearing", "relative_course"), mode="value", sure_mode="value")
            return replace(s, sure_names=s.names, frames=s.sure_frames or s.frames)
        if s.side and s.names and set(s.names) <= {"target_turn", "target_heading"}:
            s = replace(s, mode="change", frames=None)  # "has bent left by 45 degrees"
        if set(s.names) == {"target_turn", "target_heading"} and OVERALL.search(self.text, self.clause.start):
            s = replace(s, names=("target_turn",), sure_names=("target_turn",))
        is_theirs = self.clause.has("who", "target") or self.clause.has("quantity", "target_heading")
        is_total = (s.side or set(s.names) <= {"yaw", "heading"}) and "yaw" in s.names and not is_theirs
        if not is_total or not self.ways.are_from_start():
            return s
        named = [moment for _, moment in times_of(self.clause) if moment not in ((0,), (0, 1))]
        frames = (NOW,) if not named else named[0] if len(named) == 1 else None
        return replace(s, names=("yaw",), mode="value", frames=frames, sure_names=("yaw",), sure_frames=frames, sure_mode="value")  # fmt: skip

    def _surely(self, s: Statement, numeral: Numeral) -> Statement:
        """Add what is sure of a number by how it was read: of what a length or a change is, and between which frames."""
        more = MORE_THAN.match(self.text, numeral.end)
        is_bare = not (self.clause.has("link", "than") or _PER.search(self.text, self.clause.start, self.clause.end))
        is_bare = is_bare and not (more and more["than"])
        is_length = (
            numeral.unit == "m"
            and is_bare
            and self.naming.is_by_a_word(numeral)
            and not self.sureness.is_in_group(numeral)
        )
        if set(s.names) <= WAYS and not self.sureness.owners.owner(numeral):
            is_length = False  # of somebody who is not known to have been named
        if is_length and s.names and set(s.names) <= WAYS and (end := self.ways.end_of_all()):
            return replace(s, sure_names=s.sure_names or s.names, sure_frames=end, sure_mode="value")
        if is_bare and (ways := self.ways.whole_way(numeral, s.names)):
            return replace(s, names=s.names or ways, sure_names=ways, sure_frames=(NOW,), sure_mode="value")
        if s.names and set(s.names) <= WAYS and self.ways.tells_part():
            return replace(s, sure_frames=None, sure_mode="either")  # "in the last step the drone flew 1.7 m"
        if not s.sure_names and (s.sure_mode == "change" or is_length):
            s = replace(s, sure_names=s.names)
        if s.mode == "value" or s.sure_frames is not None or s.frames is None or len(s.frames) != 2:
            return s
        if any(0 < t.start - numeral.end <= 8 for t in self.clause.of("time", "start", "past")):
            return s  # "2.1 degrees at first and 3.3 in the last step"
        if self.text.startswith(("at t", "在t"), self.clause.start) and not self.clause.has("time", "since"):
            return s  # "at t3 the target had slid 10 px"
        if s.names == ("yaw",) and s.frames == (-2, NOW) and self.changing.turned_by(numeral):
            return replace(s, sure_names=("yaw", "heading"), sure_frames=s.frames, sure_mode="change")
        if not s.sure_names and s.names == ("yaw",) and s.side:
            s = replace(s, sure_names=s.names)  # "has swung 3 degrees to the left in the last step"
        is_speed = numeral.unit == "mps" and s.mode == "either" and s.sure_names and s.frames == (-2, NOW)
        return replace(s, sure_frames=(NOW,) if is_speed else s.frames)  # a speed is that of the step before it

    def _frames(self, numeral: Numeral, mode: Mode) -> tuple[int, ...] | None:
        return self.timing.frames(numeral, mode, is_extreme=bool(self.beside.aggregate(numeral)))

    def _add(self, found: Statement | None) -> None:
        """Take a row as it was read; None of one that is left out."""
        if found is None:
            self.left_out = True
        else:
            self.statements.append(found)

    def _add_pairs(self, members: list[int]) -> None:
        before = self.statements[-1] if self.statements else None
        if before is not None and before.kind == "pair" and self.clause.has("trend"):
            self.statements.pop()
            members = [*before.numbers, *members]
        self.statements.append(self.rows.pairs(members))

    # --- several numbers ---------------------------------------------------------------------------------------------

    def _join_courses(self) -> None:
        """Make one statement of "from A to B": two values of one series, the later one after the earlier."""
        singles = [s for s in self.statements if s.kind == "number"]
        for early, late in itertools.pairwise(singles):
            if early not in self.statements:
                continue  # the end of another course
            a, b = self.sentence.numerals[early.numbers[0]], self.sentence.numerals[late.numbers[0]]
            if a.unit == b.unit and self.changing.is_from_to(a, b):
                self.statements = [s for s in self.statements if s is not early and s is not late]
                self._add(self.rows.course(early.numbers[0], late.numbers[0]))
                continue
            if early.mode != "value" or late.mode != "value":
                continue
            if a.unit == b.unit and self.changing.comes_after(a, b):
                self.statements = [s for s in self.statements if s is not early and s is not late]
                self._add(self.rows.course(late.numbers[0], early.numbers[0]))
                return
            if a.unit != b.unit or not self.timing.goes_to(b) or AFTERWARDS.search(self.text, a.end, b.start):
                continue
            if self.timing.comes_from(a) or (
                late.clause == early.clause
                and any(t.value.endswith(("up", "down")) for t in self.clause.of("trend") if t.start < b.start)
            ):
                self.statements = [s for s in self.statements if s is not early and s is not late]
                self._add(self.rows.course(early.numbers[0], late.numbers[0]))
                return

    def _percent(self, index: int) -> None:
        numeral = self.sentence.numerals[index]
        self.statements.append(
            replace(
                ratio_statement(self.sentence, self.clause, self.context, numeral.start, numeral.end, (index,)),
                kind="percent",
                word="picture"
                if _OF_PICTURE[self.language].match(
                    self.text, numeral.end if self.language == "en" else self.clause.start
                )
                else "",
                hedge=self.beside.hedge(numeral),
            )
        )

    def _clock(self, index: int) -> None:
        self.statements.append(Statement("clock", (self.clause.start, self.clause.end), (), (index,)))
