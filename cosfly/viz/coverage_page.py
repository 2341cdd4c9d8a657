"""The coverage of a run as HTML: histograms and tables, compared with the default run."""

from __future__ import annotations

from typing import Any

from cosfly.formats.weather import TIMES, WEATHERS, resolved, sky_kind
from cosfly.geometry.coverage import AXES, NAMED, PAIR, Axis, Coverage, default_coverage
from cosfly.viz.page import fragment

WIDTH_PX, HEIGHT_PX = 300.0, 110.0
TEMPLATE = "cosfly/viz/templates/coverage.html"


def coverage_html(coverage: Coverage) -> str:
    """Return a histogram for each axis, with the range of 90 % of the frames, and a table for each kind of name."""
    default = default_coverage()
    histograms = []
    for (name, axis), (title, span, default_span) in zip(AXES.items(), ranges(coverage), strict=True):
        bars = _histogram(axis, coverage.bins.get(name, []), default.bins[name])
        histograms.append(bars | {"title": title, "range": span, "range_of_plain": default_span})
    names = {kind: shares(coverage, kind) for kind in NAMED}
    return fragment(TEMPLATE, histograms=histograms, names=names, skies=_skies(coverage.skies))


def _skies(frames: dict[str, int]) -> dict[str, Any] | None:
    """Return a table of frames, weather by time of day: the paper's 15 x 4, and other presets."""
    if not frames:
        return None
    counts = {tuple(name.split(PAIR)): count for name, count in frames.items()}
    weathers = [*WEATHERS, *sorted({weather for weather, _ in counts} - set(WEATHERS))]
    times = [*TIMES, *sorted({time for _, time in counts} - set(TIMES))]
    rows = [(weather, [counts.get((weather, time)) for time in times]) for weather in weathers]
    shipped = [pair for pair in counts if pair[0] in WEATHERS and pair[1] in TIMES]
    num_day_dry = 0
    for weather, time in shipped:
        if sky_kind(resolved(WEATHERS[weather], TIMES[time])) == "day_dry":
            num_day_dry += counts[weather, time]
    by_day = f"{num_day_dry / sum(counts.values()):.0%} of the frames by day and dry"
    note = f"{len(counts)} of {len(weathers) * len(times)} pairs; {by_day}"
    return {"times": times, "rows": rows, "note": note}


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


def _histogram(axis: Axis, counts: list[int], default: list[int]) -> dict[str, Any]:
    """Return shares of frames by bin as bars, and those of the default run as a line of steps."""
    heights = [[value / (sum(row) or 1) for value in row] for row in (counts, default) if row]
    top = max((max(row) for row in heights), default=0.0) or 1.0
    filled = [k for row in (counts, default) for k, value in enumerate(row) if value] or [0]
    first, last = min(filled), max(filled)
    step = WIDTH_PX / max(8, last - first + 1)

    def y(share: float) -> float:
        return round(HEIGHT_PX * (1 - share / top), 1)

    edges = [f"{axis.low + k * axis.step:g}" for k in range(last + 2)]
    bars = [
        {
            "x": round((k - first) * step, 1),
            "y": y(share),
            "width": round(max(1.0, step - 1), 1),
            "height": round(HEIGHT_PX - y(share), 1),
            "title": f"{edges[k]} to {edges[k + 1]} {axis.unit}: {100 * share:.1f} %",
        }
        for k, share in enumerate(heights[0] if counts else [])
        if first <= k <= last
    ]
    shown = [(k, share) for k, share in enumerate(heights[-1]) if first <= k <= last]
    line = " ".join(f"{(k - first + side) * step:.1f},{y(share)}" for k, share in shown for side in (0, 1))
    return {
        "bars": bars,
        "line": line,
        "low": edges[first],
        "high": edges[last + 1],
        "end_x": round((last - first + 1) * step),
    }
