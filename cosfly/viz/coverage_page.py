"""The coverage of a release in tables."""

from __future__ import annotations

from cosfly.geometry.coverage import AXES, NAMED, Coverage
from cosfly.viz.page import fragment


def coverage_html(coverage: Coverage) -> str:
    """Return a table of the ranges of 90 % of the frames, and a table for each kind of name."""
    names = {kind: shares(coverage, kind) for kind in NAMED}
    return fragment("cosfly/viz/templates/coverage.html", ranges=ranges(coverage), names=names)


def ranges(coverage: Coverage) -> list[tuple[str, str]]:
    """Return a row for each axis: title, and range of 5 % to 95 % of the frames."""
    titles = [f"{axis.title}, {axis.unit}".rstrip(", ") for axis in AXES.values()]
    return [(title, _range(coverage, name)) for title, name in zip(titles, AXES, strict=True)]


def shares(coverage: Coverage, kind: str) -> list[tuple[str, int, str]]:
    """Return a row for each name of a kind of NAMED: name, frames, share."""
    counts = getattr(coverage, kind)
    total = sum(counts.values())
    names = sorted(counts, key=lambda name: (-counts[name], name))
    return [(name, counts[name], f"{100.0 * counts[name] / total:.1f} %") for name in names]


def _range(coverage: Coverage, name: str) -> str:
    """Return the range of 5 % to 95 % of the frames; for a circle, the shares of its sides."""
    axis = AXES[name]
    if name == "azimuth_deg":
        counts = coverage.bins.get(name, [])
        total = sum(counts)
        if not total:
            return "-"
        middles = [abs(axis.low + (k + 0.5) * axis.step) for k in range(axis.num_bins)]
        behind = sum(count for count, middle in zip(counts, middles, strict=True) if middle > 135.0) / total
        ahead = sum(count for count, middle in zip(counts, middles, strict=True) if middle < 45.0) / total
        return f"{behind:.0%} behind, {1 - behind - ahead:.0%} to the side, {ahead:.0%} in front"
    low, high = coverage.range_of(name)
    digits = 2 if axis.step < 1.0 else 0
    return "-" if low is None or high is None else f"{low:.{digits}f} to {high:.{digits}f}"
