"""Coverage of tracks: counts of frames by height, distance, direction, size, occlusion, style, pace and more.

A student cannot learn situations that its data lack. The bins are fixed, so that the counts of tracks, runs and
releases add up. Pages compare them with those of `cosfly run showcase` (`default_coverage.json`).
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
    """Bins of one quantity: `num_bins` of width `step` from `low`; values beyond count in the outermost bins."""

    title: str
    unit: str
    low: float
    step: float
    num_bins: int

    def counts(self, values: np.ndarray) -> list[int]:
        """Count the values, (n,), in each bin; NaN counts nowhere."""
        numbers = np.asarray(values, dtype=np.float64)
        numbers = numbers[~np.isnan(numbers)]
        bins = np.clip(np.floor((numbers - self.low) / self.step), 0, self.num_bins - 1).astype(int)
        return np.bincount(bins, minlength=self.num_bins).tolist()

    def percentile(self, counts: list[int], share: float) -> float | None:
        """Return the value below which a share of the frames lies, interpolated within its bin; None without frames."""
        num_frames = sum(counts)
        if not num_frames:
            return None
        ends = np.cumsum(counts) / num_frames
        k = int(np.searchsorted(ends, share))
        start = ends[k - 1] if k else 0.0
        return float(self.low + self.step * (k + (share - start) / max(ends[k] - start, 1e-12)))


AXES = {
    "height_m": Axis("height above the ground under the person", "m", 0.0, 2.0, 50),
    "distance_m": Axis("distance to the person", "m", 0.0, 2.0, 50),
    "azimuth_deg": Axis("direction from the person to the drone: 0 in front, 90 to the left", "deg", -180.0, 15.0, 24),
    "target_height_px": Axis("height of the person in the picture", "px", 0.0, 4.0, 50),
    "visibility": Axis("visible share of the person", "", 0.0, 0.05, 20),
}

NAMED = ("styles", "paces", "labels", "weathers", "times_of_day")


class Coverage(Record):
    """Numbers of frames by bin of each axis, and by style, pace, label (of captions), weather and time of day."""

    frames: int = 0
    bins: dict[str, list[int]] = Field({})
    styles: dict[str, int] = Field({})
    paces: dict[str, int] = Field({})
    labels: dict[str, int] = Field({})
    weathers: dict[str, int] = Field({})
    times_of_day: dict[str, int] = Field({})

    @field_validator("bins")
    @classmethod
    def _are_those_of_the_axes(cls, bins: dict[str, list[int]]) -> dict[str, list[int]]:
        if unknown := [name for name in bins if name not in AXES]:
            raise ValueError(f"the coverage has an unknown axis {unknown[0]!r}; the axes are {', '.join(AXES)}")
        for name, axis in AXES.items() if bins else ():
            if (num := len(bins.get(name, ()))) != axis.num_bins:
                raise ValueError(f"the coverage must have {axis.num_bins} bins on the axis {name!r}, got {num}")
        return bins

    @classmethod
    def of(
        cls, seen: np.ndarray, hip_height_m: float, styles: Iterable[str], paces: Iterable[str],
        labels: Iterable[str] = (), weathers: Iterable[str] = (), times: Iterable[str] = (),
    ) -> Coverage:  # fmt: skip
        """Count frames.

        Args:
            seen: (n, 6) from the hip of the target to the drone (x, y, z, m), the target's heading (degrees), its
                height (px) and its visible share; NaN where unknown.
            styles, paces: one per frame. labels, weathers, times: one per frame that has one.
        """
        offsets_m = seen[:, :3]
        heading_deg, height_px, visibility = seen[:, 3:].T
        azimuth_deg = azimuths_deg(offsets_m, heading_deg)
        distance_m = np.linalg.norm(offsets_m, axis=1)
        values = (offsets_m[:, 2] + hip_height_m, distance_m, azimuth_deg, height_px, visibility)
        bins = {name: axis.counts(column) for (name, axis), column in zip(AXES.items(), values, strict=True)}
        counts = [dict(sorted(Counter(names).items())) for names in (styles, paces, labels, weathers, times)]
        return cls(frames=sum(counts[0].values()), bins=bins, **dict(zip(NAMED, counts, strict=True)))

    @classmethod
    def total(cls, parts: Iterable[Coverage]) -> Coverage:
        """Add up the frames of several coverages."""
        parts = list(parts)
        all_bins = [part.bins for part in parts if part.bins]
        bins = {name: np.sum([part_bins[name] for part_bins in all_bins], axis=0).tolist() for name in AXES if all_bins}
        counters = {name: sum((Counter(getattr(part, name)) for part in parts), Counter()) for name in NAMED}
        counts = {name: dict(sorted(counter.items())) for name, counter in counters.items()}
        return cls(frames=sum(part.frames for part in parts), bins=bins, **counts)

    def range_of(self, name: str) -> tuple[float | None, float | None]:
        """Return the 5th and the 95th percentile of an axis."""
        axis = AXES[name]
        counts = self.bins.get(name, [])
        return axis.percentile(counts, 0.05), axis.percentile(counts, 0.95)


def azimuths_deg(offsets_m: np.ndarray, headings_deg: np.ndarray) -> np.ndarray:
    """Return the azimuth of the drone relative to the target's heading, (n,) degrees, -180 to 180, left positive.

    offsets_m: (n, 3) from the target to the drone. headings_deg: (n,) of the target.
    """
    bearing = np.degrees(np.arctan2(offsets_m[:, 1], offsets_m[:, 0]))
    return (bearing - headings_deg + 180.0) % 360.0 - 180.0


@cache
def default_coverage() -> Coverage:
    """Return the coverage of the default run (`configs/showcase.yaml`), which is part of the package."""
    return validated(Coverage, read_json(DEFAULT), DEFAULT)
