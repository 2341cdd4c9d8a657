"""Statements with numbers against a window: True, False, or None where the window does not tell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

from caption.schema import EvidenceConfig
from caption.truth.prose.cues import ANY
from caption.truth.prose.judging_ratios import ratio_holds
from caption.truth.prose.measured import Measured, change
from caption.truth.prose.numerals import Numeral
from caption.truth.prose.statements import Form, Statement

SIGNED = {
    "yaw": 1,
    "heading": 1,
    "bearing": 1,
    "relative_course": 1,
    "target_turn": 1,
    "target_heading": 1,
    "offset_x": -1,
    "offset_y": -1,
}
RESOLUTION = {"m": 0.1, "mps": 0.02, "deg": 0.2, "px": 1.0, "dps": 0.4}  # of a difference of two printed values
ABOUT = 0.07  # share of the value that "about" allows


class NumberComparison:
    """Compares the numbers of a sentence with one window, as they were read."""

    def __init__(self, measured: Measured, cfg: EvidenceConfig, form: Form, runs: tuple[str, ...]) -> None:
        self.measured, self.cfg, self.form, self.runs = measured, cfg, form, runs

    def compare(self, s: Statement) -> bool | None:
        match s.kind:
            case "number":
                return self._number(s)
            case "range":
                return self._range(s)
            case "course":
                return self._course(s)
            case "list":
                return self._list(s)
            case "pair":
                return self._pairs(s)
            case "percent" | "ratio":
                return ratio_holds(s, self.measured, {i: self.read(i)[1:] for i in (*s.numbers, *(s.operands or ()))})
            case "speeds":
                return self._speeds(s)
            case "extreme":
                return self._extreme(s)
        return self._clock(s)

    def _falls(self, s: Statement) -> bool:
        (_, first, _), (_, last, _) = (self.read(i) for i in s.numbers)
        return s.kind == "range" and last < first and self.form.numerals[s.numbers[1]].joined in ("to", "至", "到")

    def read(self, index: int) -> tuple[Numeral, float, float]:
        numeral = self.form.numerals[index]
        return (numeral, *numeral.read(self.runs))

    def slack(self, unit: str, value: float, step: float, hedge: str, factor: float = 1.0) -> float:
        cfg = self.cfg
        base = {"m": cfg.tolerance_m, "mps": cfg.tolerance_mps, "deg": cfg.tolerance_deg, "px": cfg.tolerance_px, "dps": 0.5 * cfg.tolerance_deg}[unit]  # fmt: skip
        if factor != 1.0:
            base = 0.05 * abs(value)  # of a foreign unit: absolute tolerances are those of our own
        if unit == "px" and value < 25:
            base = min(base, 2.0)
        share = ABOUT if hedge else cfg.relative
        return max(base, share * abs(value)) + step + 1e-9

    def _frames(self, s: Statement, name: str) -> list[int]:
        count = len(self.measured.series(name))
        frames = range(count) if s.frames is None or name == "picture" else s.frames
        return [i for i in ((f + count if f < 0 else f) for f in frames) if 0 <= i < count]

    def values(self, s: Statement, name: str) -> Iterator[float]:
        """Yield what a statement may mean by a value of a series."""
        if name.startswith("rate:"):
            yield from self.measured.rates(name[5:], s.frames)
            return
        series = self.measured.series(name)
        known = [v for i in self._frames(s, name) if (v := series[i]) is not None]
        every = self.measured.known(name)
        if not s.word or not every or name in ("heading", "target_heading"):
            yield from known
        elif s.word == "mean":
            yield sum(every) / len(every)
        elif name in SIGNED or name in ("pitch", "climb_rate"):
            yield from (max(every), min(every))
        else:
            yield max(every) if s.word == "max" else min(every)

    def changes(self, s: Statement, name: str) -> Iterator[float]:
        if name.startswith("rate:"):
            return
        series = self.measured.series(name)
        known = [(i, v) for i, v in enumerate(series) if v is not None]
        wanted = self._frames(s, name) if s.frames is not None and len(s.frames) == 2 else None
        for (i, a), (j, b) in combinations(known, 2):
            if name == "target_heading" and i > 1 and j < len(series) - 1 and j > i + 1:
                continue
            if wanted is None or (i in wanted and j in wanted):
                yield change(name, a, b)

    def _matches(self, s: Statement, numeral: Numeral, value: float, step: float, name: str) -> bool:
        slack = self.slack(numeral.unit, value, step, s.hedge, numeral.factor)
        sign = numeral.sign if name in SIGNED or name in ("pitch", "climb_rate") else 0
        base = name.removeprefix("rate:")
        if base in SIGNED and s.side:
            sign = s.side * SIGNED[base]
        if s.mode != "change" or name == "target_turn":
            for true in self.values(s, name):
                if s.side and sign and true * sign < -2.0 * step:
                    continue  # on the other side by more than its rounding
                if self._close(value, true, slack, sign, s.hedge):
                    return True
        if s.mode == "value":
            return False
        tight = max(step, RESOLUTION[numeral.unit]) + 1e-9
        tight += ABOUT * value if s.hedge else 0.0
        direction = (
            sign if base in SIGNED and s.side else 0 if name in ("yaw", "heading", "bearing", "pitch") else s.trend
        )
        known = [] if name.startswith("rate:") else self.measured.known(name)
        if s.hedge == "less" and known and max(known) - min(known) <= value + tight:
            return True  # "varies by less than"
        return any(self._close(value, true, tight, direction, s.hedge) for true in self.changes(s, name))

    @staticmethod
    def _close(value: float, true: float, slack: float, sign: int, hedge: str) -> bool:
        size = abs(true)
        if sign and true * sign < 0 and size > slack:
            return False
        if hedge == "more":
            return value - slack <= size <= max(1.6 * value, value + 4 * slack)
        if hedge == "less":
            return 0.5 * value - slack <= size <= value + slack
        return abs(value - size) <= slack

    def _number(self, s: Statement) -> bool | None:
        numeral, value, step = self.read(s.numbers[0])
        is_known = False
        for name in s.names or ANY[numeral.unit]:
            if self.measured.series(name.removeprefix("rate:")):
                if self._matches(s, numeral, value, step, name):
                    return True
                is_known = is_known or s.frames is None or s.mode != "value" or self._knows(s, name)
        if not is_known or not self._is_told(s):
            return None
        return False

    def _is_known(self, name: str) -> bool:
        return bool(self.measured.series(name.removeprefix("rate:")))

    def _is_told(self, s: Statement) -> bool:
        """A record without the target's steps knows its speed over the window alone."""
        return self.measured.facts.target_speeds_mps != () or "target_mean" not in s.names or s.frames in (None, (-1,))

    def _knows(self, s: Statement, name: str) -> bool:
        if name.startswith("rate:"):
            return True
        series = self.measured.series(name)
        return any(series[i] is not None for i in self._frames(s, name))

    def _range(self, s: Statement) -> bool | None:
        (numeral, low, step), (_, high, _) = self.read(s.numbers[0]), self.read(s.numbers[1])
        if numeral.unit == "mps" and not s.sure_names and self._speeds(replace(s, side=0)):
            return True  # "twice as quick as the drone, 1.34 to 0.59 m/s"
        if self._falls(s) and s.mode == "value":
            return self._course(replace(s, frames=None, trend=0))  # "21.8 to 18.1 m" is a way down
        if high < low:
            low, high = high, low
        slack = self.slack(numeral.unit, high, step, "")
        is_unknown = False
        for name in s.names or ANY[numeral.unit]:
            if not self.measured.series(name.removeprefix("rate:")):
                is_unknown = is_unknown or bool(s.names)
                continue
            known = [abs(v) for v in self.values(s, name)]
            if s.mode != "value":
                known += [abs(v) for v in self.changes(s, name)]
            if any(low - slack <= v <= high + slack for v in known) and (
                s.frames is not None
                or s.mode != "value"
                or (abs(min(known) - low) <= slack and abs(max(known) - high) <= slack)
            ):
                return True
            every = [abs(v) for v in self.measured.known(name)] if not name.startswith("rate:") else []
            if every and abs(min(every) - low) <= slack and abs(max(every) - high) <= slack:
                return True
        return None if is_unknown else False

    def _course(self, s: Statement) -> bool | None:
        (numeral, first, step), (_, last, step_last) = self.read(s.numbers[0]), self.read(s.numbers[1])
        if s.trend and s.trend * (last - first) < 0 and numeral.unit not in ("deg", "px"):
            return False
        is_unknown = False
        for name in s.names or ANY[numeral.unit]:
            series = self.measured.series(name) if not name.startswith("rate:") else ()
            if not series:
                is_unknown = is_unknown or (bool(s.names) and not name.startswith("rate:"))
                continue
            ends = set(self._frames(s, name))
            known = [(i, v) for i, v in enumerate(series) if v is not None]
            if ends == {len(series) - 1} and series[-1] is None:
                ends = {known[-1][0]}  # as it was last seen
            slack_first = self.slack(numeral.unit, first, step, s.hedge)
            slack_last = self.slack(numeral.unit, last, step_last, s.hedge)
            for (i, a), (j, b) in combinations(known, 2):
                if s.span is not None and s.span[0] >= 0 and i != s.span[0]:
                    continue
                if not self._are_sides(name, (a, b), replace(s, side=0)):
                    continue
                if j in ends and abs(first - abs(a)) <= slack_first and abs(last - abs(b)) <= slack_last:
                    return True
            if name in ("target_mean", "target_turn"):
                is_unknown = is_unknown or not self.measured.facts.target_speeds_mps
        return None if is_unknown else False

    def _goes_otherwise(self, s: Statement) -> bool:
        """Tell whether a course that is told of certain frames is that of none of its series there."""
        if not s.sure_names or s.sure_frames is None:
            return False
        series = [self.measured.series(name.removeprefix("rate:")) for name in s.sure_names]
        ends = [[values[frame] for frame in s.sure_frames] for values in series if values]
        known = [pair for pair in ends if None not in pair]
        told = [
            (value, self.slack(n.unit, value, step, s.hedge, n.factor)) for n, value, step in map(self.read, s.numbers)
        ]
        return bool(known) and not any(
            all(abs(value - abs(true or 0.0)) <= slack for (value, slack), true in zip(told, pair, strict=True))
            for pair in known
        )

    def _list(self, s: Statement) -> bool | None:
        read = [self.read(i) for i in s.numbers]
        unit, count = read[0][0].unit, len(read)
        is_unknown = False
        for name in s.names or ANY[unit]:
            series = self.measured.series(name.removeprefix("rate:"))
            if not series:
                is_unknown = is_unknown or bool(s.names)
                continue
            for values in (
                series,
                [v for v in series if v is not None],
                self.measured.steps(name.removeprefix("rate:")),
            ):
                for start in range(len(values) - count + 1):
                    part = values[start : start + count]
                    if all(v is not None and abs(abs(v) - value) <= self.slack(unit, value, step, s.hedge) * 0.5 for v, (_, value, step) in zip(part, read, strict=True)):  # fmt: skip
                        if not self._are_sides(name, part, s):
                            return False
                        return not s.trend or s.trend * (abs(part[-1] or 0.0) - abs(part[0] or 0.0)) >= 0
        singles = [Statement("number", s.clause, s.names, (i,), None, hedge=s.hedge, mode="either") for i in s.numbers]
        if count < self.measured.num_frames - 1 and all(self._number(single) for single in singles):
            return True
        return None if is_unknown else False

    def _are_sides(self, name: str, part: Sequence[float | None], s: Statement) -> bool:
        """Tell whether the sides of a row are right: those of its numbers, or the one that stands for all."""
        sides = [self.form.numerals[i].side for i in s.numbers]
        if not any(sides) and s.side:
            sides = [s.side] * len(sides)
        sign = -1 if name == "offset_y" else SIGNED.get(name, 0)
        return not any(
            sign * side * (v or 0.0) < -RESOLUTION["px"] * (name[0] == "o") for side, v in zip(sides, part, strict=True)
        )

    def _pairs(self, s: Statement) -> bool | None:
        f = self.measured.facts
        if not any(w is not None for w in f.box_width_px):
            return None
        sizes = [(self.read(a)[1], self.read(b)[1]) for a, b in zip(s.numbers[::2], s.numbers[1::2], strict=False)]
        sizes = [size for size in sizes if size != (f.width_px, f.height_px)]
        for place, (width, height) in enumerate(sizes):
            is_last = place == len(sizes) - 1
            frames = self._frames(s, "box_width") if is_last else list(range(self.measured.num_frames))
            if all(f.box_width_px[i] is None for i in frames):
                frames = list(range(self.measured.num_frames))  # told of when the person was last seen
            if not any(self._is_box(i, width, height, s.hedge) for i in frames):
                return False
        areas = [width * height for width, height in sizes]
        return not (s.trend and len(areas) == 2 and s.trend * (areas[1] - areas[0]) < 0)

    def _is_box(self, frame: int, width: float, height: float, hedge: str) -> bool:
        f = self.measured.facts
        pairs = ((f.box_width_px[frame], width), (f.box_height_px[frame], height))
        for true, told in pairs:
            slack = max(2.0 if told < 25 else self.cfg.tolerance_px, ABOUT * told * bool(hedge))
            if true is None or abs(true - told) > slack:
                return False
        return True

    def _speeds(self, s: Statement) -> bool | None:
        ours, theirs, means = (self.measured.series(name) for name in ("speed", "target_speed", "target_mean"))
        (numeral, a, step_a), (_, b, step_b) = (self.read(i) for i in s.numbers)
        pairs = [
            (v, w)
            for other in (theirs, means)
            if other
            for i in self._frames(s, "speed")
            if (v := ours[i]) is not None and (w := other[i]) is not None
        ]
        if not pairs:
            return None
        told = [
            (value, self.slack("mps", value, step, s.hedge, numeral.factor))
            for value, step in ((a, step_a), (b, step_b))
        ]
        orders = [told] * (s.side >= 0) + [told[::-1]] * (s.side <= 0)
        return any(
            abs(v - x) <= slack_v and abs(w - y) <= slack_w for (x, slack_v), (y, slack_w) in orders for v, w in pairs
        )

    def _extreme(self, s: Statement) -> bool | None:
        """Tell whether a value of a series is its largest or smallest; None of one that it does not hold."""
        _, value, step = self.read(s.numbers[0])
        ends = []
        for name in s.names:
            known = [abs(v) for v in self.measured.known(name)] if self._is_known(name) else []
            if any(abs(v - value) <= step for v in known):
                ends.append(max(known) if s.word == "max" else min(known))
        return any(abs(end - value) <= 2.0 * step for end in ends) if ends else None

    def _clock(self, s: Statement) -> bool | None:
        _, hour, _ = self.read(s.numbers[0])
        bearing = self.measured.series("bearing")
        angle = -((hour % 12.0) * 30.0 + 180.0) % 360.0 - 180.0
        if bearing and bearing[-1] is not None:
            error = abs((bearing[-1] - angle + 180.0) % 360.0 - 180.0)
            return True if error <= 17.0 else False if error > 25.0 else None
        return None
