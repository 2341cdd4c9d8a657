"""Every number that a window can give, by unit: what a number may be that is not what the reader took it for.

A reader of patterns takes some numbers for another quantity's or another frame's than the writer meant. A number that is exactly one of
these values is therefore no contradiction unless the words leave no doubt whose it is.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable
from itertools import combinations

from caption.truth.prose.measured import Measured, change
from caption.truth.prose.statements import Mode

Frames = frozenset[int] | None

_LENGTHS = (
    "distance", "slant", "altitude", "height_over_target", "travelled", "displacement", "target_travelled",
)  # fmt: skip
_SPEEDS = ("speed", "target_speed", "target_mean", "climb_rate", "speed_difference", "difference_mean")
_ANGLES = ("yaw", "heading", "pitch", "bearing", "depression", "target_turn", "target_heading")
_PIXELS = ("box_width", "box_height", "offset_x", "offset_y", "picture")
_SERIES: dict[str, tuple[str, ...]] = {
    "m": _LENGTHS,
    "mps": _SPEEDS,
    "deg": _ANGLES,
    "dps": ("yaw_rate",),
    "px": _PIXELS,
}
_RATES: dict[str, tuple[str, ...]] = {"mps": _LENGTHS, "dps": _ANGLES}
# Pairs of series whose difference people tell.
_BESIDE = {
    "m": (("travelled", "target_travelled"), ("travelled", "displacement"), ("slant", "distance"), ("altitude", "distance")),
    "mps": (("speed", "target_speed"), ("speed", "target_mean")),
    "deg": (("heading", "target_heading"), ("pitch", "depression")),
}  # fmt: skip

_NOISE = 1e-6  # of a difference of two printed values


class Pool:
    """Values of one window, by unit, sorted; made when first asked for."""

    def __init__(self, measured: Measured) -> None:
        self.measured = measured
        self._values: dict[tuple[str, tuple[str, ...], tuple[int, ...] | None, Mode], list[float]] = {}

    def holds(
        self,
        value: float,
        unit: str,
        slack: tuple[float, float],
        names: tuple[str, ...] = (),
        frames: tuple[int, ...] | None = None,
        mode: Mode = "either",
    ) -> bool:
        """Tell whether the window gives a value of this size, at most `slack` below or above it.

        names: the series that may give it, () for any. frames: those that it is of, or to or from which it changes, two for a change
        between them; None for any.
        """
        count = self.measured.num_frames
        if frames is not None and not all(-count <= frame < count for frame in frames):
            frames = None  # no frames of the window
        key = (unit, names, frames, mode)
        values = self._values.get(key)
        if values is None:
            wanted = None if frames is None else frozenset(frame % count for frame in frames)
            values = self._values[key] = sorted(map(abs, self._of(unit, names, wanted, mode)))
        place = bisect_left(values, abs(value) - slack[0] - _NOISE)
        return place < len(values) and values[place] <= abs(value) + slack[1] + _NOISE

    def _of(self, unit: str, names: tuple[str, ...], frames: Frames, mode: Mode) -> Iterable[float]:
        series = names or _SERIES.get(unit, ())
        found = [v for name in series if not name.startswith("rate:") for v in self._series(name, frames, mode)]
        rates = [name[5:] for name in names if name.startswith("rate:")] or ([] if names else _RATES.get(unit, ()))
        found += [v for name in rates for v in self._rates(name, frames)]
        return found if names else [*found, *self._differences(unit, frames)]

    def _series(self, name: str, frames: Frames, mode: Mode) -> Iterable[float]:
        known = [(i, v) for i, v in enumerate(self.measured.series(name)) if v is not None]
        frames = None if name == "picture" else frames
        if mode != "change":
            yield from (v for i, v in known if frames is None or i in frames)
            if known and frames is None:
                yield sum(v for _, v in known) / len(known)
        if mode != "value":
            for (i, a), (j, b) in combinations(known, 2):
                if frames is None or (frames <= {i, j} if len(frames) == 2 else frames & {i, j}):
                    yield change(name, a, b)

    def _rates(self, name: str, frames: Frames) -> Iterable[float]:
        return self.measured.rates(name, None if frames is None else tuple(frames))

    def _differences(self, unit: str, frames: Frames) -> Iterable[float]:
        for one, other in _BESIDE.get(unit, ()):
            ours, theirs = self.measured.series(one), self.measured.series(other)
            if not ours or not theirs:
                continue
            for i, a in enumerate(ours):
                for j, b in enumerate(theirs):
                    if frames is not None and not (i in frames and j in frames):
                        continue
                    if a is None or b is None:
                        continue
                    yield change("heading", b, a) if unit == "deg" else a - b
