"""Statements without numbers against a window: True, False, or None where the window does not tell or lies between."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

from caption.truth.facts import PARTLY_BELOW, STANDING_MPS
from caption.truth.prose.measured import Measured, change
from caption.truth.prose.statements import Statement
from caption.truth.references import MATCHING_MPS, MATCHING_SHARE, OFF_CENTRE_SHARE, QUANTITIES

assert PARTLY_BELOW < 1.0
_BANDS = {"box_area": (8.0, 0.16), "target_mean": (0.3, 0.0), "difference_mean": (0.3, 0.0)}
_SEEN = ("visible", "partly_occluded")
_RUNNING_MPS = 1.8
_RESTING_MPS = 0.5  # faster than this nobody calls it standing or hovering


def band_of(name: str, values: list[float]) -> float:
    """Give the spread that counts as no change."""
    if name in _BANDS:
        least, share = _BANDS[name]
        return max(least, share * max(map(abs, values)))
    return QUANTITIES[name].allowed_spread(values)


class WordJudge:
    """Compares words with one window."""

    def __init__(self, measured: Measured) -> None:
        self.measured = measured
        self.facts = measured.facts

    def holds(self, s: Statement) -> bool | None:
        match s.kind:
            case "trend":
                return self._trend(s)
            case "steady":
                return self._over(s, self._is_steady)
            case "mixed":
                return self._over(s, self._is_mixed)
            case "changing":
                return self._over(s, self._is_changing)
            case "side":
                return self._side(s)
            case "centre":
                return self._centre(s)
            case "visibility":
                return self._visibility(s)
            case "state":
                return self._state(s)
            case "record":
                return self._record(s)
            case "course_side":
                return self._course_side(s)
        return self._comparison(s)

    def _over(self, s: Statement, test) -> bool | None:
        """Take the kindest answer of the series that are meant."""
        answers = [test(name, values) for name in s.names if len(values := self.measured.known(name)) >= 2]
        if not answers or all(a is None for a in answers):
            return None
        return True if True in answers else False if None not in answers else None

    def is_never(self, s: Statement) -> bool:
        """Tell whether a state or visibility is that of no frame of the window, and the drone does not what the target is said to do."""
        if s.kind == "visibility":
            return self._visibility(replace(s, frames=None)) is False
        if s.kind != "state" or s.word in ("hovering", "flying", "straight"):
            return False
        facts, free = self.facts, replace(s, frames=None)
        drone = [v for v in facts.speed_mps if v is not None]
        ours = {
            "standing": min(drone, default=0.0) <= _RESTING_MPS,
            "turning": abs(facts.yaw_deg[-1] - facts.yaw_deg[0]) >= 3.0,
        }
        return not ours.get(s.word, max(drone, default=1.0) >= STANDING_MPS) and self._state(free) is False

    def is_ever_against(self, s: Statement) -> bool:
        """Tell whether a trend's series never goes its way between any two frames, and goes the other way by far, or the other one is the faster by far."""
        if s.kind == "comparison" and not s.negated:
            pairs = self._pairs_of_speeds(replace(s, frames=None))
            match s.word:
                case "faster":
                    return bool(pairs) and all(ours < 0.8 * theirs - 0.1 for ours, theirs in pairs)
                case "slower":
                    return bool(pairs) and all(theirs < 0.8 * ours - 0.1 for ours, theirs in pairs)
            return False
        if s.kind != "trend" or s.negated or not s.names:
            return False
        for name in s.names:
            known = self.measured.known(name)
            changes = [s.trend * change(name, a, b) for i, a in enumerate(known) for b in known[i + 1 :]]
            if not changes or max(changes) > 0.0 or min(changes) > -2.0 * band_of(name, known):
                return False
        return True

    # --- trends ------------------------------------------------------------------------------------------------------

    def _trend(self, s: Statement) -> bool | None:
        answers = [self._goes(s, name) for name in s.names if len(self.measured.known(name)) >= 2]
        if not answers or all(a is None for a in answers):
            return None
        if s.negated:
            return True if True in answers else None
        return True if True in answers else False if None not in answers else None

    def _goes(self, s: Statement, name: str) -> bool | None:
        series = self.measured.series(name)
        spans = self._spans(s, series)
        if not spans:
            return None
        changes = [s.trend * change(name, series[i], series[j]) for i, j in spans]  # type: ignore[arg-type]
        if s.negated:
            return True if max(changes) <= band_of(name, self.measured.known(name)) else None
        return any(c > 0 for c in changes)

    def _spans(self, s: Statement, series: tuple[float | None, ...]) -> list[tuple[int, int]]:
        """Give the spans over which a trend may be meant: that which is told, else the window, its end, or any where the past is told."""
        count = len(series)
        known = [i for i in range(count) if series[i] is not None]
        if s.span is not None:
            first, last = (i + count if i < 0 else i for i in s.span)
            first, last = min(first, last), max(first, last)
            first = next((i for i in known if i >= first), count)
            return [(first, last)] if first < last < count and series[last] is not None else []
        if s.frames is None:
            return [(i, j) for i in known for j in known if i < j]
        if len(known) < 2 or known[-1] != count - 1:
            return []
        return [(known[0], known[-1]), (known[-2], known[-1])]

    def _is_steady(self, name: str, values: list[float]) -> bool | None:
        band = band_of(name, values)
        recent = values[-3:]
        if max(values) - min(values) <= band or max(recent) - min(recent) <= band:
            return True
        return None

    def _is_changing(self, name: str, values: list[float]) -> bool | None:
        spread, band = max(values) - min(values), band_of(name, values)
        return True if spread > band else None if spread > 0.5 * band else False

    def _is_mixed(self, name: str, values: list[float]) -> bool | None:
        turns = {b > a for a, b in pairwise(values) if a != b}
        return len(turns) == 2

    def _record(self, s: Statement) -> bool | None:
        """Tell whether the value of now is the largest or smallest of the window; the kindest answer of the series that are meant."""
        answers: list[bool | None] = []
        for name in s.names:
            series, known = self.measured.series(name), [abs(v) for v in self.measured.known(name)]
            if len(known) < 2 or series[-1] is None:
                continue
            off = max(known) - abs(series[-1]) if s.word == "max" else abs(series[-1]) - min(known)
            spread = max(known) - min(known)
            answers.append(
                True if off <= 0.1 * spread else None if off <= 0.4 * spread or spread <= 0.02 * max(known) else False
            )
        return True if True in answers else False if answers and None not in answers else None

    def _course_side(self, s: Statement) -> bool | None:
        """Tell whether the target goes to a side of the drone's heading; unsure where it drifts there in the picture or turns that way."""
        course = [math.sin(math.radians(v)) * s.side for v in self.measured.known("relative_course")]
        if not course:
            return None
        if course[-1] > 0.1:
            return True
        drift = [-s.side * v for v in self.measured.known("offset_x")]
        turn = s.side * (self.facts.target_turn_deg or 0.0)
        is_other = (len(drift) >= 2 and drift[-1] - drift[0] > 2.0) or turn > 5.0
        return None if is_other or max(course[-2:]) > -0.3 else False

    # --- places ------------------------------------------------------------------------------------------------------

    def _side(self, s: Statement) -> bool | None:
        name = s.names[0]
        if len(s.names) == 2 and name == "yaw":
            answers = (self._turned(s), self._bends(s))
            return True if True in answers else None if None in answers else False
        if name == "yaw":
            return self._turned(s)
        if name == "target_turn":
            return self._bends(s)
        sign = s.side if name == "bearing" else -s.side
        series = self.measured.series(name)
        known = [series[i] for i in self.measured.frames(s.frames) if series and series[i] is not None]
        if not known:
            return None
        least = 2.0 if name == "offset_x" else 0.5
        if any(sign * v > 0 for v in known):  # type: ignore[operator]
            return True
        drift = [v for v in series if v is not None]
        moved = any(sign * (drift[-1] - v) > least for v in drift)
        if name == "offset_x" and moved and not any(sign * v < -least for v in known):  # type: ignore[operator]
            return None
        return False

    def _turned(self, s: Statement) -> bool | None:
        yaw = self.facts.yaw_deg
        if s.span is not None:
            first, last = (i + len(yaw) if i < 0 else i for i in s.span)
            return s.side * (yaw[last] - yaw[first]) > 0 if 0 <= first < last < len(yaw) else None
        spans = [yaw[-1] - yaw[0], yaw[-1] - yaw[-2]]
        if s.frames is None or s.frames != (-1,):
            spans += [b - a for a, b in pairwise(yaw)]
        return any(s.side * v > 0 for v in spans)

    def _bends(self, s: Statement) -> bool | None:
        turn = self.facts.target_turn_deg
        headings = self.measured.known("target_heading")
        turns = [change("target_heading", a, b) for a, b in pairwise(headings)]
        if turn is None and not turns:
            return None
        if turn is not None and not turns and (abs(turn) > 150.0 or (s.word == "likely" and abs(turn) < 5.0)):
            return None
        latest = [] if s.frames is None else [t for t in turns[-1:] if abs(t) >= 8.0]
        if any(s.side * t > 0 for t in [*latest, *([] if turn is None else [turn])]):
            return True
        if s.frames is None and turn is not None and abs(turn) <= 150.0:
            return False
        if len(headings) >= 2 and s.side * change("target_heading", headings[0], headings[-1]) > 0:
            return True
        if turn is not None and 15.0 <= abs(turn) <= 150.0 and abs(turns[-1] if turns else 0.0) < 8.0:
            return False
        return None if any(s.side * t > 0 for t in turns) else False

    def _centre(self, s: Statement) -> bool | None:
        f = self.facts
        pairs = [(f.offset_x_px[i], f.offset_y_px[i]) for i in self.measured.frames(s.frames)]
        known = [(abs(x) / f.width_px, abs(y or 0) / f.height_px) for x, y in pairs if x is not None]
        if not known:
            return None
        if s.frames is None:
            return (min(x for x, _ in known) <= OFF_CENTRE_SHARE) if s.word != "off" else None
        x, y = known[-1]
        if s.word == "off":
            return (
                True
                if x > OFF_CENTRE_SHARE
                else False
                if x <= 0.4 * OFF_CENTRE_SHARE and y <= OFF_CENTRE_SHARE
                else None
            )
        if x <= OFF_CENTRE_SHARE:
            return True if y <= 0.1 else None
        return False if x > 1.5 * OFF_CENTRE_SHARE else None

    # --- seen, moving, faster ----------------------------------------------------------------------------------------

    def _visibility(self, s: Statement) -> bool | None:
        answers = [self._is_seen(s.word, self.facts.visibility[i]) for i in self.measured.frames(s.frames)]
        if not answers:
            return None
        if s.negated:
            answers = [None if a is None else not a for a in answers]
            if s.word == "full":
                answers = [self.facts.visibility[i] != "visible" for i in self.measured.frames(s.frames)]
        if s.frames is None or s.frames == (0, 1):
            return True if True in answers else False if None not in answers else None
        return False if False in answers else None if None in answers else True

    @staticmethod
    def _is_seen(word: str, fact: str) -> bool | None:
        match word:
            case "full":
                return fact == "visible"
            case "visible":
                return fact in _SEEN
            case "partly":
                return fact == "partly_occluded"
            case "hidden":
                return None if fact == "partly_occluded" else fact not in _SEEN
        return fact == "out_of_view" if fact != "occluded" else None

    def _state(self, s: Statement) -> bool | None:
        if s.word in ("turning", "straight"):
            return self._bending(s)
        target = s.word in ("standing", "walking", "running")
        series = self.measured.series("target_speed" if target else "speed")
        known = [
            series[i] for i in self.measured.frames(s.frames) if series and i < len(series) and series[i] is not None
        ]
        mean = self.facts.target_speed_mps
        if target and mean is not None and (not known or s.frames is None):
            known.append(mean)
        if not known:
            return None
        low, high = min(v for v in known if v is not None), max(v for v in known if v is not None)
        if s.word == "running":
            answer: bool | None = high >= _RUNNING_MPS or (None if high >= 1.2 else False)
        elif s.word in ("standing", "hovering"):
            answer = True if low <= 0.3 else None if low <= _RESTING_MPS else False
        else:
            answer = True if high >= STANDING_MPS else None if high > 0.1 and s.word == "flying" else False
        if s.negated and answer is not None:
            answer = not answer
        return answer

    def _bending(self, s: Statement) -> bool | None:
        turn, headings = self.facts.target_turn_deg, self.measured.known("target_heading")
        steps = [abs(change("target_heading", a, b)) for a, b in pairwise(headings)]
        if turn is None and not steps:
            return None
        most = max([*steps, abs(turn or 0.0)])
        answer = True if most >= 10.0 else False if most < 5.0 else None
        if s.word == "straight" and answer is not None:
            answer = None if answer and most < 25.0 else not answer
        return None if answer is None else answer != s.negated

    def _comparison(self, s: Statement) -> bool | None:
        pairs = self._pairs_of_speeds(s)
        if not pairs:
            return None
        answers = []
        for ours, theirs in pairs:
            difference = ours - theirs
            band = max(MATCHING_MPS, MATCHING_SHARE * theirs)
            if s.word == "matching":
                answers.append(
                    True if abs(difference) <= band else None if abs(difference) <= 2.5 * band + 0.1 else False
                )
            else:
                ahead = difference if s.word == "faster" else -difference
                answers.append(
                    ahead > 0 if not s.value else True if ahead > band else False if ahead <= 0.5 * band else None
                )
        if s.negated:
            answers = [None if a is None else not a for a in answers]
        return True if True in answers else False if None not in answers else None

    def _pairs_of_speeds(self, s: Statement) -> list[tuple[float, float]]:
        ours, theirs = self.measured.series("speed"), self.measured.series("target_speed")
        mean = self.facts.target_speed_mps
        pairs = []
        for i in self.measured.frames(s.frames):
            if not ours or ours[i] is None:
                continue
            if theirs and theirs[i] is not None:
                pairs.append((ours[i], theirs[i]))
            if mean is not None and (i == len(ours) - 1 or not theirs):
                pairs.append((ours[i], mean))
        return pairs  # type: ignore[return-value]
