"""Strong words against a window: they hold, or the window says the opposite by far, else nothing is said."""

from __future__ import annotations

import math
from itertools import pairwise

from caption.truth.prose.measured import Measured, change
from caption.truth.prose.statements import Statement
from caption.truth.references import QUANTITIES

_STANDS_MPS, _RUNS_MPS = 0.5, 1.8
_GOES_MPS = {"speed": 1.0, "target_speed": 0.9}  # from here on nobody says that it stands
_STROLLS_MPS = {"race": 1.5, "run": 0.8, "walk": 0.12}  # up to here nobody says that it races, or runs
# What no one calls a change, and what everyone does: units of the series.
_STILL: dict[str, float] = {
    "target_heading": 3.0, "yaw": 1.2, "altitude": 0.25, "height_over_target": 0.25, "distance": 0.35, "slant": 0.35, "pitch": 1.0, "depression": 1.0,
    "box_height": 1.0, "box_width": 1.0, "offset_x": 3.0, "offset_y": 3.0, "speed": 0.1, "target_speed": 0.1, "bearing": 1.0,
}  # fmt: skip
_CENTRED = (0.012, 0.04)  # of width and height: nobody calls it off the centre


class StrongJudge:
    """Compares strong words with one window."""

    def __init__(self, measured: Measured) -> None:
        self.measured, self.facts = measured, measured.facts

    def holds(self, s: Statement) -> bool | None:
        match s.kind:
            case "motion":
                return self._motion(s)
            case "extent":
                return self._extent(s)
            case "framing":
                return self._framing(s)
            case "sight":
                return self._sight(s)
            case "faster":
                return self._faster(s)
        return self._lies(s)

    def _motion(self, s: Statement) -> bool | None:
        name = s.names[0]
        series = self.measured.series(name) or (self.measured.series("target_mean") if name != "speed" else ())
        known = [v for i in self.measured.frames(s.frames) if i < len(series) and (v := series[i]) is not None]
        if not known:
            return None
        low, high = min(known), max(known)
        if s.word == "rest":
            return True if low <= _STANDS_MPS else False if low >= _GOES_MPS[name] else None
        if s.word == "walk":
            return True if high >= _STANDS_MPS else False if name != "speed" and high <= _STROLLS_MPS["walk"] else None
        most = 1.0 if name == "speed" else _STROLLS_MPS[s.word]
        return True if high >= _RUNS_MPS else False if high <= most else None

    def _extent(self, s: Statement) -> bool | None:
        answers = []
        for name in s.names:
            known = self.measured.known(name)
            if len(known) < 3:
                continue
            from_first = [change(name, known[0], v) for v in known]
            spread = max(from_first) - min(from_first)
            still = min(_STILL[name], QUANTITIES[name].allowed_spread(known)) if name in QUANTITIES else _STILL[name]
            answers.append(False if spread <= still else True if spread > 4.0 * _STILL[name] else None)
        return None if not answers or None in answers else True in answers

    def _framing(self, s: Statement) -> bool | None:
        f = self.facts
        offs = [
            (abs(x) / f.width_px, abs(y) / f.height_px)
            for i in self.measured.frames(s.frames)
            if (x := f.offset_x_px[i]) is not None and (y := f.offset_y_px[i]) is not None
        ]
        if not offs:
            return None
        if all(x <= _CENTRED[0] and y <= _CENTRED[1] for x, y in offs):
            return False
        return True if any(x > 0.05 or y > 0.1 for x, y in offs) else None

    def _sight(self, s: Statement) -> bool | None:
        seen = [self.facts.visibility[i] for i in self.measured.frames(s.frames)]
        if not seen:
            return None
        bears = {
            "covered": ("partly_occluded", "occluded", "out_of_view"),
            "unseen": ("occluded", "out_of_view"),
            "clear": ("visible",),
        }[s.word]
        if any(one in bears for one in seen):
            return True
        return None if s.word != "covered" and "partly_occluded" in seen else False

    def _faster(self, s: Statement) -> bool | None:
        """Tell whether the drone (side +1) or the target (-1) is the faster; wrong where the other is by more than a tenth at each frame and on average."""
        ours, theirs = self.measured.series("speed"), self.measured.series("target_speed")
        mean = self.facts.target_speed_mps
        pairs = [
            (own, other)
            for i in self.measured.frames(s.frames)
            for other in (theirs[i] if theirs else None, mean)
            if ours and (own := ours[i]) is not None and other is not None
        ]
        if not pairs:
            return None
        if any(s.side * (a - b) > 0.0 for a, b in pairs):
            return True
        return False if all(abs(a - b) > 0.05 + 0.1 * max(a, b) for a, b in pairs) else None

    def _lies(self, s: Statement) -> bool | None:
        match s.word:
            case "nose":
                return self._by_steps(s.side, [*self.facts.yaw_deg], least=0.5, far=1.0)
            case "bend":
                headings = self.measured.known("target_heading")
                turned = [0.0]
                for a, b in pairwise(headings):
                    turned.append(turned[-1] + change("target_heading", a, b))
                turn = self.facts.target_turn_deg or 0.0
                if turn * s.side > 0.0:
                    return True
                if abs(turn) > 150.0:
                    return None  # either way round
                return self._by_steps(s.side, turned, least=3.0, far=10.0)
            case "box":
                return self._beside_middle(s)
        return self._about(s)

    @staticmethod
    def _by_steps(side: int, turned: list[float], *, least: float, far: float) -> bool | None:
        """Compare with every change of a series, positive to the left: one that way and it may be meant; none and the whole the other way is wrong."""
        changes = [side * (b - a) for i, a in enumerate(turned) for b in turned[i + 1 :]]
        if not changes:
            return None
        whole = -side * (turned[-1] - turned[0])
        if whole >= far and max(changes) <= max(0.5 * least, 0.15 * whole):
            return False
        return True if max(changes) > least else None

    def _beside_middle(self, s: Statement) -> bool | None:
        known = [x for i in self.measured.frames(s.frames) if (x := self.facts.offset_x_px[i]) is not None]
        if not known:
            return None
        if any(-s.side * x >= 1 for x in known):
            return True
        return False if max(s.side * x for x in known) >= 3 else None

    def _about(self, s: Statement) -> bool | None:
        """Compare with where the target is and goes against the drone's heading: both, and its turn and drift, must be on the other side."""
        course = [math.sin(math.radians(v)) * s.side for v in self.measured.known("relative_course")[-2:]]
        bearing = [math.sin(math.radians(v)) * s.side for v in self.measured.known("bearing")]
        if any(v > 0.01 for v in (*course, *bearing)):
            return True
        far = min([*course[-1:], *bearing], default=0.0)
        if course and course[-1] < -0.5:
            return False
        drift = [-s.side * x for x in self.measured.known("offset_x")]
        if (len(drift) > 1 and drift[-1] - drift[0] > 2.0) or s.side * (self.facts.target_turn_deg or 0.0) > 5.0:
            return None
        return False if far < -0.15 else None
