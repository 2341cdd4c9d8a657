"""The coverage of a release in tables, next to that of the default run."""

from __future__ import annotations

from cosfly.geometry.coverage import AXES, NAMED, Coverage, default_coverage
from cosfly.viz.page import fragment


def coverage_html(coverage: Coverage) -> str:
    """Return a table of the ranges of 90 % of the frames, and a table for each kind of name."""
    names = {kind: shares(coverage, kind) for kind in NAMED}
    return fragment("cosfly/viz/templates/coverage.html", ranges=ranges(coverage), names=names)


def ranges(coverage: Coverage) -> list[tuple[str, str, str]]:
    """Return a row for each axis: title, range of 5 % to 95 % of the frames, that range for the default run."""
    default = default_coverage()
    titles = [f"{axis.title}, {axis.unit}".rstrip(", ") for axis in AXES.values()]
    return [(title, _range(coverage, name), _range(default, name)) for title, name in zip(titles, AXES, strict=True)]


def shares(coverage: Coverage, kind: str) -> list[tuple[str, int, str, str]]:
    """Return a row for each name of a kind of NAMED: name, frames, share, share in the default run."""
    counts = getattr(coverage, kind)
    default_counts = getattr(default_coverage(), kind)
    if not counts:
        return []
    names = sorted({*counts, *default_counts}, key=lambda name: (-counts.get(name, 0), name))

    def share(table: dict[str, int], name: str) -> str:
        total = sum(table.values())
        return f"{100.0 * table.get(name, 0) / total:.1f} %" if total else "-"

    return [(name, counts.get(name, 0), share(counts, name), share(default_counts, name)) for name in names]


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
