"""`report.html` of the inspection: one self-contained page (no script, no network) for the person who decides."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cosfly.escaping import for_html, html_page
from cosfly.inspection.view import PLOTS, FlightView
from cosfly.look.coverage_page import STYLE as COVERAGE_STYLE
from cosfly.look.coverage_page import coverage_html
from cosfly.products.inspection import RESULTS, FlightInspection, Inspection
from cosfly.products.issues import Issue
from cosfly.products.playback import STATES
from cosfly.reading.files import read_text
from cosfly.work.store import write_bytes

STYLE = "\n" + read_text(Path(__file__).with_name("report.css"))
MB = 1_000_000

# column title, metric, format
COLUMNS = (
    ("frames", "num_frames", "{:.0f}"),
    ("m", "length_m", "{:.1f}"),
    ("a m/s²", "accel_rms_mps2", "{:.2f}"),
    ("j m/s³", "jerk_rms_mps3", "{:.2f}"),
    ("S", "smoothness", "{:.3f}"),
    ("clear m", "clearance_min_m", "{:.2f}"),
    ("five-ray", "five_ray_mean", "{:.3f}"),
    ("rendered", "rendered_visibility_mean", "{:.3f}"),
    ("visible", "visible_share", "{:.0%}"),
    ("IoU", "track_quality", "{:.2f}"),
)
LEGEND = """a, j: RMS acceleration and jerk of the plan; S: smoothness score; clear: least distance of the drawn poses to an obstacle; five-ray: their mean
visibility on the map; rendered: mean visibility of the target in the frames; visible: frames that show it; IoU: projected box against mask. Maps: the drone's way blue,
the person's orange, from dot to ring, north up. Plots: over the seconds of the flight; a gap where nothing is known."""
PLOT_WIDTH, PLOT_HEIGHT = 250.0, 62.0


def write_report(path: Path, inspection: Inspection, views: dict[str, FlightView], page_mb: float) -> None:
    """Write the page; `views` holds pictures and curves by flight folder, of which as many are shown as the page may hold."""
    write_bytes(path, report_html(inspection, views, page_mb).encode())


def report_html(inspection: Inspection, views: dict[str, FlightView], page_mb: float) -> str:
    """Give the page's text. Flights that need a look come first, and are the last to lose their pictures."""
    order = sorted(inspection.flights, key=lambda f: (-RESULTS.index(f.result), f.folder))
    counts = inspection.funnel.flights
    summary = f"{counts.inspected} flights: {counts.accepted} accepted, {counts.review} to review, {counts.rejected} rejected."
    rows, left_out = cards(order, views, page_mb)
    if left_out:
        summary += (
            f" {left_out} are without pictures, map and plots: the page is held to {page_mb:g} MB (inspect.page_mb)."
        )
    body = f"""<h1>Inspection</h1>
<p class="lead">{for_html(summary)} A rejected flight breaks a rule; one in review is for a person to decide (cosfly inspect review).</p>
<h2>Funnel</h2>
<div class="funnel">{_funnel(inspection)}</div>
{_covered(inspection)}{_states(inspection)}<h2>Flights</h2>
<p class="lead">{LEGEND}</p>
{HEAD}
{rows}
<h2>Settings</h2>
<p class="lead">{for_html(", ".join(f"{name} {value}" for name, value in inspection.settings.items()))}</p>"""
    return html_page("cosfly: inspection", STYLE + COVERAGE_STYLE, body)


def _covered(inspection: Inspection) -> str:
    if inspection.coverage is None or not inspection.coverage.frames:
        return ""
    lead = f"{inspection.coverage.frames:,} frames of accepted flights, and where 5 % to 95 % of them lie; the line is the plain run that ships (quickstart)."
    return f'<h2>What is covered</h2>\n<p class="lead">{lead}</p>\n{coverage_html(inspection.coverage)}\n'


def _states(inspection: Inspection) -> str:
    """The frames of perturbed flights by what was applied to them, beside the paper's shares (tab:augmentation_states)."""
    counts = {
        state: sum(int(flight.metrics.get(f"frames_{state.replace(' ', '_')}") or 0) for flight in inspection.flights)
        for state in STATES
    }
    if not (total := sum(counts.values())):
        return ""
    rows = "".join(
        f'<tr><td>{for_html(state)}</td><td class="n">{counts[state]:,}</td><td class="n">{counts[state] / total:.1%}</td><td class="n">{share:.0%}</td></tr>'
        for state, share in STATES.items()
    )
    perturbed = total - counts["unperturbed"]
    lead = (
        f"{total:,} frames of perturbed flights, {perturbed / total:.1%} of them perturbed. The paper's shares are what is drawn where each event has a "
        "chance of 0.6; here a shift or turn that cannot be made falls back."
    )
    head = '<tr><th>state</th><th class="n">frames</th><th class="n">share</th><th class="n">paper</th></tr>'
    return f'<h2>Perturbation</h2>\n<p class="lead">{lead}</p>\n<table class="states"><thead>{head}</thead><tbody>{rows}</tbody></table>\n'


# --- the funnel -------------------------------------------------------------------------------------------------------


def _funnel(inspection: Inspection) -> str:
    planned, flights = inspection.funnel.trajectories, inspection.funnel.flights
    bars = [_bar("trajectories planned", planned.planned, planned.planned)]
    for reason, count in planned.dropped.items():
        bars.append(_bar(f"dropped before rendering: {reason}", count, planned.planned, "rejected", sub=True))
    if planned.not_rendered:
        bars.append(_bar("not rendered", planned.not_rendered, planned.planned, "rejected", sub=True))
    bars.append(_bar("trajectories rendered", planned.rendered, planned.planned))
    for result in RESULTS:
        bars.append(_bar(result, getattr(planned, result), planned.planned, result, sub=True))
    bars.append("<hr>")
    bars.append(_bar("flights inspected (clean, perturbed)", flights.inspected, flights.inspected))
    for result in RESULTS:
        bars.append(_bar(result, getattr(flights, result), flights.inspected, result, sub=True))
    for reason, count in flights.reasons.items():
        bars.append(_bar(f"reason: {reason}", count, flights.inspected, sub=True))
    return "\n".join(bars)


def _bar(label: str, count: int, total: int, kind: str = "", *, sub: bool = False) -> str:
    width = 100.0 * count / total if total else 0.0
    shade = f"{kind} zero" if count == 0 else kind
    return (
        f'<div class="bar{" sub" if sub else ""}"><span>{for_html(label.replace("_", " "))}</span>'
        f'<i class="{shade}" style="width:{width:.1f}%"></i><b>{count}</b></div>'
    )


# --- flights ----------------------------------------------------------------------------------------------------------

HEAD = (
    '<div class="row head"><span>flight</span>'
    + "".join(f"<span>{for_html(title)}</span>" for title, _, _ in COLUMNS)
    + "</div>"
)


def cards(
    flights: list[FlightInspection],
    views: dict[str, FlightView],
    page_mb: float,
    more: Callable[[FlightInspection], str] = lambda flight: "",
) -> tuple[str, int]:
    """Give a row for each flight that opens, and how many of them have no pictures because the page would be too large.

    Args:
        more: what else stands in a flight's part of the page, as HTML.
    """
    parts, size, left_out = list[str](), 0, 0
    for flight in flights:
        card = _card(flight, views.get(flight.folder), more(flight))
        if flight.folder in views and size + len(card) > page_mb * MB:
            card, left_out = _card(flight, None, more(flight)), left_out + 1
        size += len(card)
        parts.append(card)
    return "\n".join(parts), left_out


def _card(flight: FlightInspection, view: FlightView | None, more: str) -> str:
    issues = "".join(_issue(issue) for issue in flight.issues if issue.severity != "note")
    name = f"<b>{for_html(flight.trajectory)}</b> {for_html(flight.variant)} <small>{for_html(flight.town)}</small>"
    numbers = "".join(
        f'<span class="n" title="{for_html(title)}"><i>{for_html(title)}</i>{_number(flight.metrics.get(key), form)}</span>'
        for title, key, form in COLUMNS
    )
    shown = "" if view is None else _shown(view)
    state = "" if flight.result == "accepted" else " open"
    return (
        f'<details class="flight"{state}><summary class="row"><span>{name} <span class="tag {flight.result}">{flight.result}</span></span>{numbers}</summary>'
        f"{f'<ul class=issues>{issues}</ul>' if issues else ''}{more}{shown}</details>"
    )


def _shown(view: FlightView) -> str:
    pictures = "".join(
        f'<img alt="frame" src="data:image/jpeg;base64,{picture}">'
        if picture
        else '<span class="gone">no picture</span>'
        for picture in view.pictures
    )
    plan = f'<img class="plan" alt="map" src="data:image/jpeg;base64,{view.plan}">' if view.plan else ""
    plots = "".join(
        _plot(title, unit, view.time_s, view.curves[name], span)
        for name, (title, unit, span) in PLOTS.items()
        if name in view.curves
    )
    return f'<div class="look"><div class="pictures">{pictures}</div>{plan}<div class="plots">{plots}</div></div>'


def _issue(issue: Issue) -> str:
    times = f" &times;{issue.count}" if issue.count > 1 else ""
    text = f"{issue.where}: {issue.got}; expected {issue.expected}"
    return f'<li class="{issue.severity}"><b>{for_html(issue.code)}</b>{times} {for_html(text)}</li>'


def _number(value: float | int | None, form: str) -> str:
    return "&ndash;" if value is None else form.format(value)


def _plot(
    title: str, unit: str, time_s: list[float], values: list[float | None], span: tuple[float | None, float | None]
) -> str:
    """Draw values over time, with their range; a gap where one is unknown. span: what the axis shows at least."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    low = min([*known, *(edge for edge in span if edge is not None)])
    high = max([*known, *(edge for edge in span if edge is not None)])
    scale = (PLOT_HEIGHT - 4.0) / ((high - low) or 1.0)
    step = PLOT_WIDTH / ((time_s[-1] - time_s[0]) or 1.0)
    parts, pen_is_down = [], False
    for at_s, value in zip(time_s, values, strict=True):
        if value is None:
            pen_is_down = False
            continue
        parts.append(f"{'L' if pen_is_down else 'M'}{(at_s - time_s[0]) * step:.1f} {PLOT_HEIGHT - 2.0 - (value - low) * scale:.1f}")  # fmt: skip
        pen_is_down = True
    mean = float(np.mean(known))
    told = f"{min(known):.2f} to {max(known):.2f}{for_html(f' {unit}' if unit else '')}, mean {mean:.2f}"
    return (
        f"<figure><figcaption>{for_html(title)} <small>{told}</small></figcaption>"
        f'<svg viewBox="0 0 {PLOT_WIDTH:.0f} {PLOT_HEIGHT:.0f}" preserveAspectRatio="none"><path d="{"".join(parts)}"/></svg>'
        f"<small>{low:.4g} to {high:.4g}; {time_s[0]:g} s to {time_s[-1]:g} s</small></figure>"
    )
