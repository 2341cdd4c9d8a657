"""What a run covers, for people: histograms and tables as HTML, and as Markdown, beside the plain run that ships. Used by inspection and release."""

from __future__ import annotations

from cosfly.escaping import for_html
from cosfly.products.coverage import AXES, NAMED, PAIR, Axis, Coverage, default_coverage
from cosfly.products.weather import TIMES, WEATHERS

WIDTH_PX, HEIGHT_PX = 300.0, 110.0
INK, BESIDE = "#2b6cb0", "#c05621"
STYLE = """
.coverage { display: grid; grid-template-columns: repeat(auto-fit, minmax(330px, 1fr)); gap: 12px; }
.coverage .panel { background: #fff; border: 1px solid #e2e8f0; border-radius: 8px; padding: 12px 16px; }
.coverage h3 { font-size: 14px; margin: 0 0 6px; } .coverage small { color: #718096; } .coverage table { width: 100%; }
.coverage td, .coverage th { padding: 3px 8px 3px 0; border-bottom: 1px solid #e2e8f0; position: static; background: none; }
"""


def coverage_html(coverage: Coverage) -> str:
    """Give a grid of histograms, one an axis, with where 5 % to 95 % of the frames lie, and of tables, one for each kind of name."""
    plain = default_coverage()
    panels = [
        f"<h3>{axis.title}{', ' * bool(axis.unit)}{axis.unit}</h3>{_histogram(axis, coverage.bins.get(name, []), plain.bins[name])}"
        f"<small>{_range(coverage, name)}; plain run: {_range(plain, name)}</small>"
        for name, axis in AXES.items()
    ]
    for kind in NAMED:
        rows = "".join(
            f'<tr><td>{for_html(name.replace("_", " "))}</td><td class="n">{count:,}</td><td class="n">{share}</td>'
            f'<td class="n">{beside}</td></tr>'
            for name, count, share, beside in shares(coverage, kind)
        )
        if rows:
            head = f'<tr><th>{kind.replace("_", " ")}</th><th class="n">frames</th><th class="n">share</th><th class="n">plain run</th></tr>'
            panels.append(f"<table>{head}{rows}</table>")
    if coverage.skies:
        panels.append(_skies(coverage.skies))
    return '<div class="coverage">' + "".join(f'<div class="panel">{panel}</div>' for panel in panels) + "</div>"


def _skies(frames: dict[str, int]) -> str:
    """Give a table of frames, weather by time of day: the 15 x 4 of the paper, and presets of somebody's own beside them."""
    counts = {tuple(name.split(PAIR)): count for name, count in frames.items()}
    weathers = [*WEATHERS, *sorted({weather for weather, _ in counts} - set(WEATHERS))]
    times = [*TIMES, *sorted({time for _, time in counts} - set(TIMES))]
    head = "".join(f'<th class="n">{for_html(time)}</th>' for time in times)
    rows = "".join(
        f"<tr><td>{for_html(weather.replace('_', ' '))}</td>"
        + "".join(
            f'<td class="n">{counts[weather, time]:,}</td>' if (weather, time) in counts else '<td class="n">-</td>'
            for time in times
        )
        + "</tr>"
        for weather in weathers
    )
    note = f"{len(counts)} of {len(weathers) * len(times)} pairs; drawn uniformly, each preset is expected in {1 / len(weathers):.1%} of the flights"
    return (
        f"<h3>frames by weather and time of day</h3><table><tr><th></th>{head}</tr>{rows}</table><small>{note}</small>"
    )


def ranges(coverage: Coverage) -> list[tuple[str, str, str]]:
    """Give a row for each axis: title, 5 % to 95 % of the frames, the same of the plain run."""
    plain = default_coverage()
    return [
        (f"{axis.title}{', ' * bool(axis.unit)}{axis.unit}", _range(coverage, name), _range(plain, name))
        for name, axis in AXES.items()
    ]


def shares(coverage: Coverage, kind: str) -> list[tuple[str, int, str, str]]:
    """Give a row for each name of a kind of NAMED: name, frames, share of them, share in the plain run; empty where none is known."""
    counts, plain = getattr(coverage, kind), getattr(default_coverage(), kind)
    if not counts:
        return []
    names = sorted({*counts, *plain}, key=lambda name: (-counts.get(name, 0), name))
    return [(name, counts.get(name, 0), _share(counts, name), _share(plain, name)) for name in names]


def _share(counts: dict[str, int], name: str) -> str:
    total = sum(counts.values())
    return f"{100.0 * counts.get(name, 0) / total:.1f} %" if total else "-"


def _range(coverage: Coverage, name: str) -> str:
    """Say where 5 % to 95 % of the frames lie; of a circle, how they are shared out."""
    if name == "azimuth_deg":
        return _sides(coverage.bins.get(name, []))
    low, high = coverage.range_of(name)
    digits = 2 if AXES[name].step < 1.0 else 0
    return "-" if low is None or high is None else f"{low:.{digits}f} to {high:.{digits}f}"


def _sides(counts: list[int]) -> str:
    total = sum(counts)
    if not total:
        return "-"
    axis = AXES["azimuth_deg"]
    middles = [abs(axis.low + (k + 0.5) * axis.step) for k in range(axis.num_bins)]
    behind = sum(count for count, middle in zip(counts, middles, strict=True) if middle > 135.0) / total
    ahead = sum(count for count, middle in zip(counts, middles, strict=True) if middle < 45.0) / total
    return f"{behind:.0%} behind, {1 - behind - ahead:.0%} beside, {ahead:.0%} in front"


def _histogram(axis: Axis, counts: list[int], beside: list[int]) -> str:
    """Draw shares of frames by bin; the plain run's as a line of steps."""
    heights = [[value / (sum(row) or 1) for value in row] for row in (counts, beside) if row]
    top = max((max(row) for row in heights), default=0.0) or 1.0
    filled = [k for row in (counts, beside) for k, value in enumerate(row) if value] or [0]
    first, last = min(filled), max(filled)
    step = WIDTH_PX / max(8, last - first + 1)
    bars = "".join(
        f'<rect x="{(k - first) * step:.1f}" y="{HEIGHT_PX * (1 - share / top):.1f}" width="{max(1.0, step - 1):.1f}" '
        f'height="{HEIGHT_PX * share / top:.1f}" fill="{INK}"><title>{axis.low + k * axis.step:g} to '
        f"{axis.low + (k + 1) * axis.step:g} {axis.unit}: {100 * share:.1f} %</title></rect>"
        for k, share in enumerate(heights[0] if counts else [])
        if first <= k <= last
    )
    line = " ".join(
        f"{(k - first + side) * step:.1f},{HEIGHT_PX * (1 - share / top):.1f}"
        for k, share in enumerate(heights[-1])
        if first <= k <= last
        for side in (0, 1)
    )
    ends = [axis.low + first * axis.step, axis.low + (last + 1) * axis.step]
    return (
        f'<svg viewBox="0 0 {WIDTH_PX:.0f} {HEIGHT_PX + 16:.0f}" width="100%" font-size="11" fill="#4a5568">{bars}'
        f'<polyline points="{line}" fill="none" stroke="{BESIDE}" stroke-width="1.5"/>'
        f'<text x="0" y="{HEIGHT_PX + 13:.0f}">{ends[0]:g}</text>'
        f'<text x="{(last - first + 1) * step:.0f}" y="{HEIGHT_PX + 13:.0f}" text-anchor="end">{ends[1]:g}</text></svg>'
    )
