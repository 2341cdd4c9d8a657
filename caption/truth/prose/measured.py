"""A window's series as the reader of prose asks for them: those of references.py, what follows from them, and rates over any span."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import combinations, pairwise

from caption.truth.facts import Facts
from caption.truth.references import QUANTITIES

Values = tuple[float | None, ...]


class Measured:
    """Series of a window by name, made when first asked for. A series that is not known at all is ()."""

    def __init__(self, facts: Facts) -> None:
        self.facts = facts
        self.num_frames = len(facts)
        self._series: dict[str, Values] = {}

    def series(self, name: str) -> Values:
        found = self._series.get(name)
        if found is None:
            make = _DERIVED.get(name)
            values = make(self.facts) if make else tuple(QUANTITIES[name].read(self.facts))
            if not any(v is not None for v in values) and name in _FALLBACKS:
                values = _FALLBACKS[name](self.facts)
            found = self._series[name] = values if any(v is not None for v in values) else ()
        return found

    def rates(self, name: str, frames: tuple[int, ...] | None = None) -> list[float]:
        """Give the change per second of a series over the spans that may be meant: all, that of two frames, or those up to a frame."""
        series, step_s = self.series(name), self.facts.step_s
        known = [(i, v) for i, v in enumerate(series) if v is not None]
        wanted = {f % len(series) for f in frames} if frames and series else set()
        return [
            change(name, a, b) / ((j - i) * step_s)
            for (i, a), (j, b) in combinations(known, 2)
            if not wanted or (j in wanted if len(wanted) == 1 else i in wanted and j in wanted)
        ]

    def steps(self, name: str) -> list[float | None]:
        """Give the change of a series in each step."""
        return [None if a is None or b is None else change(name, a, b) for a, b in pairwise(self.series(name))]

    def frames(self, told: tuple[int, ...] | None) -> list[int]:
        """Give the frames of a statement, counted from the oldest; all for None."""
        frames = range(self.num_frames) if told is None else told
        return [i for i in ((f + self.num_frames if f < 0 else f) for f in frames) if 0 <= i < self.num_frames]

    def known(self, name: str) -> list[float]:
        return [v for v in self.series(name) if v is not None]


def change(name: str, before: float, after: float) -> float:
    difference = after - before
    return (difference + 180.0) % 360.0 - 180.0 if name in ("heading", "target_heading") else difference


def picture_shares(f: Facts) -> Iterator[float]:
    """Yield sizes and offsets in the picture as shares of it; an offset also of its half."""
    pairs = (
        (f.box_width_px, f.width_px),
        (f.box_height_px, f.height_px),
        (f.offset_x_px, f.width_px),
        (f.offset_y_px, f.height_px),
    )
    for values, size in pairs:
        for v in values:
            if v is not None:
                yield from (abs(v) / size, 2.0 * abs(v) / size)


def _constant(value: float | None, facts: Facts) -> Values:
    return () if value is None else (value,) * len(facts)


def _area(f: Facts) -> Values:
    return tuple(
        [None if w is None or h is None else float(w * h) for w, h in zip(f.box_width_px, f.box_height_px, strict=True)]
    )


def _difference_mean(f: Facts) -> Values:
    mean = f.target_speed_mps
    return () if mean is None else tuple([None if v is None else v - mean for v in f.speed_mps])


def _relative_course(f: Facts) -> Values:
    """Where the target goes against the drone's heading, positive = left."""
    pairs = zip(f.target_headings_deg, f.heading_deg, strict=False)
    return tuple([None if a is None or b is None else change("heading", b, a) for a, b in pairs])


def _picture(f: Facts) -> Values:
    return (f.width_px, f.height_px, f.width_px / 2, f.height_px / 2)


_DERIVED: dict[str, Callable[[Facts], Values]] = {
    "target_mean": lambda f: _constant(f.target_speed_mps, f),
    "target_turn": lambda f: _constant(f.target_turn_deg, f),
    "difference_mean": _difference_mean,
    "way_difference": lambda f: (
        ()
        if not f.travelled_m or not f.target_travelled_m
        else tuple([None if w is None else v - w for v, w in zip(f.travelled_m, f.target_travelled_m, strict=True)])
    ),
    "relative_course": _relative_course,
    "box_area": _area,
    "picture": _picture,
}


def _travelled(f: Facts) -> Values:
    way, found = 0.0, [0.0]
    for speed in f.speed_mps[1:]:
        if speed is None:
            return ()
        way += speed * f.step_s
        found.append(round(way, 2))
    return tuple(found)


def _over(f: Facts) -> Values:
    pairs = zip(f.slant_m, f.distance_m, strict=True)
    return tuple([None if s is None or d is None or s < d else math.sqrt(s * s - d * d) for s, d in pairs])


def _depression(f: Facts) -> Values:
    pairs = zip(_over(f), f.distance_m, strict=True)
    return tuple([None if h is None or d is None else math.degrees(math.atan2(h, d)) for h, d in pairs])


# What a record without these series still says about them.
_FALLBACKS: dict[str, Callable[[Facts], Values]] = {
    "travelled": _travelled,
    "height_over_target": _over,
    "depression": _depression,
    "target_travelled": lambda f: (
        () if f.target_speed_mps is None else tuple([f.target_speed_mps * f.step_s * i for i in range(len(f))])
    ),
}
