"""How much of what could be flown was flown: heights, distances, directions, sizes, occlusion, styles, paces.

A student cannot learn what it never sees. Counts of frames in fixed bins, so that flights, runs and releases add up;
each compared with those of `cosfly run showcase` (`default_coverage.json`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from pydantic import Field, field_validator

from cosfly.runtime.json_io import Record, read_json, validated

DEFAULT = Path(__file__).with_name("default_coverage.json")


@dataclass(frozen=True)
class Axis:
    """Bins of one quantity: `num_bins` of `step` from `low`; what lies beyond counts in the outermost."""

    title: str
    unit: str
    low: float
    step: float
    num_bins: int

    def counts(self, values: np.ndarray) -> list[int]:
        """Count the values, (n,), in each bin; NaN counts nowhere."""
        known = np.asarray(values, dtype=np.float64)
        known = known[~np.isnan(known)]
        bins = np.clip(np.floor((known - self.low) / self.step), 0, self.num_bins - 1).astype(int)
        return np.bincount(bins, minlength=self.num_bins).tolist()

    def percentile(self, counts: list[int], share: float) -> float | None:
        """Return the value that a share of the frames stay below, to a part of a bin; None without any."""
        total = sum(counts)
        if not total:
            return None
        ends = np.cumsum(counts) / total
        k = int(np.searchsorted(ends, share))
        before = ends[k - 1] if k else 0.0
        return float(self.low + self.step * (k + (share - before) / max(ends[k] - before, 1e-12)))


AXES = {
    "height_m": Axis("height over the person's ground", "m", 0.0, 2.0, 50),
    "distance_m": Axis("distance to the person", "m", 0.0, 2.0, 50),
    "azimuth_deg": Axis("where the drone stands round the walker: 0 in front, 90 to the left", "deg", -180.0, 15.0, 24),
    "target_height_px": Axis("height of the person in the picture", "px", 0.0, 4.0, 50),
    "visibility": Axis("visible share of the person", "", 0.0, 0.05, 20),
}

NAMED = ("styles", "paces", "labels", "weathers", "times_of_day")
COUNTED = (*NAMED, "skies")
PAIR = " | "  # between the two names of a pair


class Coverage(Record):
    """Frames by bin of each axis, by style, by pace, by label, which only captions tell, and where there is any by
    weather, by time of day, and by both (skies), as "heavy_rain | night"."""

    frames: int = 0
    bins: dict[str, list[int]] = Field({})
    styles: dict[str, int] = Field({})
    paces: dict[str, int] = Field({})
    labels: dict[str, int] = Field({})
    weathers: dict[str, int] = Field({})
    times_of_day: dict[str, int] = Field({})
    skies: dict[str, int] = Field({})

    @field_validator("bins")
    @classmethod
    def _are_those_of_the_axes(cls, bins: dict[str, list[int]]) -> dict[str, list[int]]:
        found = {name: len(counts) for name, counts in bins.items()}
        if found and found != (wanted := {name: axis.num_bins for name, axis in AXES.items()}):
            raise ValueError(f"bins must be {wanted}, or none; got {found}")
        return bins

    @classmethod
    def of(
        cls, seen: np.ndarray, hip_height_m: float, styles: Iterable[str], paces: Iterable[str],
        labels: Iterable[str] = (), skies: Iterable[tuple[str | None, str | None]] = (),
    ) -> Coverage:  # fmt: skip
        """Count frames.

        Args:
            seen: (n, 6) from the hip of the target to the drone (x, y, z, m), the target's heading (degrees), its
                height (px) and its visible share; NaN where unknown.
            styles, paces: of each frame. labels: of those that have one. skies: weather and time of day of each, None
                where unknown.
        """
        offsets_m, heading_deg, height_px, visibility = seen[:, :3], *seen[:, 3:].T
        azimuth_deg = azimuths_deg(offsets_m, heading_deg)
        distance_m = np.linalg.norm(offsets_m, axis=1)
        values = (offsets_m[:, 2] + hip_height_m, distance_m, azimuth_deg, height_px, visibility)
        bins = {name: axis.counts(column) for (name, axis), column in zip(AXES.items(), values, strict=True)}
        pairs = list(skies)
        weathers, times = ([pair[k] for pair in pairs if pair[k] is not None] for k in (0, 1))
        both = [PAIR.join((weather, time)) for weather, time in pairs if weather is not None and time is not None]
        named = [dict(sorted(Counter(names).items())) for names in (styles, paces, labels, weathers, times, both)]
        return cls(frames=sum(named[0].values()), bins=bins, **dict(zip(COUNTED, named, strict=True)))

    @classmethod
    def total(cls, parts: Iterable[Coverage]) -> Coverage:
        """Add up the frames of many."""
        parts = list(parts)
        counted = [part.bins for part in parts if part.bins]
        bins = {name: np.sum([one[name] for one in counted], axis=0).tolist() for name in AXES if counted}
        named = {name: sum((Counter(getattr(part, name)) for part in parts), Counter()) for name in COUNTED}
        counts = {name: dict(sorted(found.items())) for name, found in named.items()}
        return cls(frames=sum(part.frames for part in parts), bins=bins, **counts)

    def range_of(self, name: str) -> tuple[float | None, float | None]:
        """Return the 5th and the 95th percentile of an axis."""
        axis, counts = AXES[name], self.bins.get(name, [])
        return axis.percentile(counts, 0.05), axis.percentile(counts, 0.95)


def azimuths_deg(offsets_m: np.ndarray, headings_deg: np.ndarray) -> np.ndarray:
    """Return where the drone stands as seen from the walker: (n,) degrees from the heading, -180 to 180, left positive.

    Args:
        offsets_m: (n, 3) from person to drone. headings_deg: (n,), the walking direction of the target.
    """
    bearing = np.degrees(np.arctan2(offsets_m[:, 1], offsets_m[:, 0]))
    return (bearing - headings_deg + 180.0) % 360.0 - 180.0


@cache
def default_coverage() -> Coverage:
    """Return what the plain run that ships covers (`configs/showcase.yaml`)."""
    return validated(Coverage, read_json(DEFAULT), DEFAULT)
