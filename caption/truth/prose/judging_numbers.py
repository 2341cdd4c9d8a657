"""Which numbers contradict a window: those that no reading that their words leave open makes true."""

from __future__ import annotations

import re
from dataclasses import replace

from caption.schema import EvidenceConfig
from caption.truth.prose.changing import EITHER_WAY
from caption.truth.prose.comparing_numbers import ABOUT, RESOLUTION, SIGNED, NumberComparison
from caption.truth.prose.cues import ANY
from caption.truth.prose.measured import Measured
from caption.truth.prose.pool import Pool
from caption.truth.prose.statements import Form, Mode, Statement

_EXTREME = re.compile(
    r"\b(?:low|high|peak|top|trough|maximum|minimum|mean|average) (?:of|at) (?:only |just )?$|\baverag(?:es|ed|ing) $|\b(?:bottomed out|bottomed|topped out|peaked|topped) at $|\bas (?:low|high|fast|slow) as (?:only |just )?$"
    r"|(?:最高|最低|最大|最小|最快|最慢|峰值|谷底|平均|均值|平均值)(?:为|是|曾|达|到|至|报|只有|仅|约)*\s*$"
)
_AT_FIRST = re.compile(r"\b(?:first|initially|start\w*|beg[ai]n\w*)\b|一开始|起初|最初|开头|第一步|首步")
_TURNS = ("yaw", "target_turn", "bearing")
_OF_TURNS = frozenset([*_TURNS, "heading", "target_heading"])
_SPEEDS = ("speed", "target_speed", "target_mean", "speed_difference", "difference_mean")
_WHOLE = 4  # numbers of a list that runs over the window
_ROUGHLY = 0.04  # share of a hedged number by which it may lie from another value of the window


class NumberJudge(NumberComparison):
    """Judges the numbers of a sentence; `holds` says True, False, or None where that is not sure."""

    def __init__(self, measured: Measured, pool: Pool, cfg: EvidenceConfig, form: Form, runs: tuple[str, ...]) -> None:
        super().__init__(measured, cfg, form, runs)
        self.pool = pool

    def holds(self, s: Statement) -> bool | None:
        found = self._holds(s)
        return None if found is False and self._is_told_difference(s) else found

    def _is_told_difference(self, s: Statement) -> bool:
        """Tell whether a number is what lies between the ends of a way that its sentence tells: "from 43.8° to 60.0°, that is, 16.2°"."""
        if s.kind != "number":
            return False
        _, value, step = self.read(s.numbers[0])
        courses = [one.numbers for one in self.form.statements if one.kind == "course" and len(one.numbers) == 2]
        return any(
            abs(value - abs(a - b)) <= step + x + y for (_, a, x), (_, b, y) in (map(self.read, c) for c in courses)
        )

    def _holds(self, s: Statement) -> bool | None:
        if self.is_in_wrong_unit(s):
            return False
        if s.kind == "unit":
            return None
        if s.is_per_step:
            return self._is_of_steps(s)
        s = self._as_recorded(s)
        found = self.compare(s)
        if s.kind == "number" and not self._is_possible(s, is_meant=found is True):
            return None if self._is_others_turn(s) else False
        if (s.kind == "course" and self._goes_otherwise(s)) or self._is_reached_otherwise(s):
            return False
        if found is False and not self.runs_against_itself(s) and not self._is_plain(s) and self.is_of_the_window(s):
            return None
        return None if found is False and self._is_others_turn(s) else found

    def is_in_wrong_unit(self, s: Statement) -> bool:
        """Tell whether numbers of a foreign unit are nothing that their words may mean, but would be in ours: "12.5 ft" of 12.5 m."""
        if s.kind not in ("number", "course", "list", "range", "unit"):
            return False
        read = [self.read(i) for i in s.numbers]
        if s.kind == "unit" and s.names:
            return all(self.pool.holds(value, "px", (step, step), s.names, None, "value") for _, value, step in read)
        return all(
            numeral.factor != 1.0
            and self.pool.holds(value / numeral.factor, numeral.unit, (step / numeral.factor,) * 2, s.names)
            and not self.pool.holds(value, numeral.unit, (slack := 0.05 * value + step, slack), s.names)
            for numeral, value, step in read
        )

    def is_on_wrong_side(self, s: Statement) -> bool:
        """Tell whether an offset is right but for its side, or an angle of somebody named is false with its side."""
        if s.kind != "number" or not s.side:
            return False
        numeral = self.form.numerals[s.numbers[0]]
        is_turn = numeral.unit == "deg" and not numeral.sign and s.is_single
        return is_turn or (numeral.unit == "px" and self._is_mirrored(s))

    def _as_recorded(self, s: Statement) -> Statement:
        """A record without the target's steps tells its speed over the window for that of a step."""
        if "target_speed" not in s.names or self._is_known("target_speed"):
            return s
        names, sure = (
            tuple("target_mean" if name == "target_speed" else name for name in told)
            for told in (s.names, s.sure_names)
        )
        return replace(s, names=names, sure_names=sure)

    def _is_of_steps(self, s: Statement) -> bool:
        """Tell whether a change of each step lies between the least and the largest step of a series, of any where none is named."""
        numeral, value, step = self.read(s.numbers[0])
        slack = max(step, RESOLUTION[numeral.unit]) + ABOUT * value * bool(s.hedge)
        for name in s.sure_names or ANY[numeral.unit]:
            sign = s.side * SIGNED.get(name, 0)
            steps = [v for v in self.measured.steps(name.removeprefix("rate:")) if v is not None]
            sizes = [abs(v) for v in steps if v * sign >= 0]
            if sizes and min(sizes) - slack <= value <= max(sizes) + slack:
                return True
        return False

    def _is_reached_otherwise(self, s: Statement) -> bool:
        """Tell whether a value that a rise or fall ends at is one of its series, but nowhere after a lower or higher one."""
        if not s.reached or not s.names:
            return False
        _, value, step = self.read(s.numbers[0])
        near = step + _ROUGHLY * value * bool(s.hedge)
        places = [
            (known, i)
            for name in s.names
            if (known := [abs(v) for v in self.measured.known(name.removeprefix("rate:"))]) and name[:4] != "rate"
            for i, v in enumerate(known)
            if abs(v - value) <= near
        ]
        if not places:
            return False
        if any(i == 0 for _, i in places) and _AT_FIRST.search(self.form.text, *s.clause):
            return False  # nothing is known of before
        if s.is_last:  # told of no other moment: it goes on no further
            places = [(known, i) for known, i in places if not self._goes_through(known, i, s.reached, near)]
            if not places:
                return True
        if s.reached == EITHER_WAY:
            return False
        return bool(places) and not any(s.reached * (known[i] - v) > 0 for known, i in places for v in known[:i])

    @staticmethod
    def _goes_through(known: list[float], i: int, reached: int, near: float) -> bool:
        """Tell whether a series goes on past its value at i the way that it came."""
        if i == len(known) - 1:
            return False
        way = (known[i] - known[i - 1] if i else 0.0) if reached == EITHER_WAY else float(reached)
        return (known[i + 1] - known[i]) * (1 if way > 0 else -1 if way < 0 else 0) > near

    def _is_others_turn(self, s: Statement) -> bool:
        """Tell whether an angle is exactly the other's turn or where the other stands, now: whose it is is often told sentences before."""
        if s.kind != "number" or not set(s.names) <= _OF_TURNS:
            return False
        _, value, step = self.read(s.numbers[0])
        slack = step + _ROUGHLY * value * bool(s.hedge)
        others = [self.measured.series(name) for name in _TURNS if name not in s.names]
        now = [series[-1] for series in others if series and series[-1] is not None]
        return any(abs(abs(v) - value) <= slack and s.side * v >= 0 for v in now)

    def _is_plain(self, s: Statement) -> bool:
        """Tell whether the words leave no doubt whose value a number is, and of which frame."""
        if s.kind in ("pair", "clock", "speeds", "ratio", "percent", "extreme"):
            return True
        if s.kind == "course":
            return bool(s.sure_names) and (s.sure_mode == "value" or self._is_turned_round(s))
        if s.kind == "range":
            return self._falls(s) and not self._are_changes(replace(s, frames=None))
        if s.kind != "number":
            return False
        if s.sure_names and not s.hedge and _EXTREME.search(self.form.text, 0, self.form.numerals[s.numbers[0]].start):
            return s.word in ("max", "min", "mean")  # "a low of 17.5 m" is the lowest
        numeral, value, step = self.read(s.numbers[0])
        if s.side or s.trend or numeral.sign:
            bare, unsigned = replace(s, side=0, trend=0), replace(numeral, sign=0)
            if any(self._matches(bare, unsigned, value, step, name) for name in s.names if self._is_known(name)):
                return True  # the right number on the wrong side
        return self._is_mirrored(s)

    def _is_turned_round(self, s: Statement) -> bool:
        """Tell whether a course is right but for its order: "from 0.42 to 0.50" of what fell."""
        other = replace(s, numbers=s.numbers[::-1], trend=-s.trend, names=s.sure_names, frames=None, span=None)
        return self._course(other) is True and self._course(replace(other, numbers=s.numbers, trend=s.trend)) is False

    def _is_mirrored(self, s: Statement) -> bool:
        """Tell whether a number is right at some frame, but always on the other side."""
        names = [name for name in s.names if self._is_known(name)]
        if not s.side or not names or not all(name in SIGNED for name in names):
            return False
        numeral, value, step = self.read(s.numbers[0])
        free = replace(s, frames=s.sure_frames)
        other = replace(free, side=-s.side)
        return any(self._matches(other, numeral, value, step, name) for name in names) and not any(
            self._matches(free, numeral, value, step, name) for name in names
        )

    def _is_possible(self, s: Statement, *, is_meant: bool) -> bool:
        """Tell whether a number is a value of the window that its words leave open; within tolerance where it is what is likely meant."""
        if is_meant and not s.sure_names and s.sure_frames is None and s.sure_mode == "either":
            return True
        numeral, value, step = self.read(s.numbers[0])
        passes: list[tuple[tuple[str, ...], float, Mode]]
        rough = _ROUGHLY * value * bool(s.hedge)
        tight = max(step, RESOLUTION[numeral.unit]) + ABOUT * value * bool(s.hedge)
        passes = [(s.sure_names, step + rough, mode) for mode in ("value", "change") if s.sure_mode in (mode, "either")]
        if passes[-1][2] == "change":
            passes[-1] = (s.sure_names, tight, "change")
        if is_meant and s.sure_mode != "change":  # changes are told exactly
            slack = self.slack(numeral.unit, value, step, s.hedge, numeral.factor)
            passes.append((s.sure_names or s.names, slack, "value"))
        for names, near, mode in passes:
            below, above = near, near
            if s.hedge == "more":
                above = max(0.6 * value, 4 * near)
            elif s.hedge == "less":
                below = 0.5 * value + near
            if self.pool.holds(value, numeral.unit, (below, above), names, s.sure_frames, mode):
                return True
        return False

    def is_of_the_window(self, s: Statement) -> bool:
        """Tell whether all numbers of a statement are values that the window gives for something."""
        if s.kind == "course":
            anything = replace(s, names=(), frames=None, span=None, trend=0)
            return self._course(anything) is not False or self._are_changes(anything)
        if s.kind == "list" and len(s.numbers) >= _WHOLE:
            return self._list(replace(s, names=(), trend=0)) is not False
        for numeral, value, step in map(self.read, s.numbers):
            slack = step + _ROUGHLY * value * bool(s.hedge)
            frames = s.sure_frames if s.kind == "number" else None
            names = _SPEEDS if frames is not None and s.is_named and s.names and set(s.names) <= set(_SPEEDS) else ()
            if not self.pool.holds(value, numeral.unit, (slack, slack), names, frames):
                return False
        return True

    def _are_changes(self, s: Statement) -> bool:
        """Tell whether all numbers are changes of one series: "from 1.4 m to 1.1 m per step"."""
        read = [self.read(i) for i in s.numbers]
        free = replace(s, mode="change")
        return any(
            all(self._matches(free, numeral, value, step, name) for numeral, value, step in read)
            for name in ANY[read[0][0].unit]
        )

    def runs_against_itself(self, s: Statement) -> bool:
        """Tell whether "decreases from 20 m to 21 m" contradicts itself."""
        if s.kind != "course" or not s.trend:
            return False
        (numeral, first, _), (_, last, _) = (self.read(i) for i in s.numbers)
        return numeral.unit not in ("deg", "px") and s.trend * (last - first) < 0
