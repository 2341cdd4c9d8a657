"""`report.html` of the inspection: one self-contained page (no script, no network) for the person who decides."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field

from cosfly.coverage_page import STYLE as COVERAGE_STYLE
from cosfly.coverage_page import coverage_html
from cosfly.escaping import for_html, html_page
from cosfly.frame_views import thumbnail
from cosfly.issues import Issue
from cosfly.products.inspection import RESULTS, FlightInspection, Inspection
from cosfly.products.playback import Flight
from cosfly.reading.files import read_text
from cosfly.store import write_bytes

CURVE_POINTS = 160

STYLE = "\n" + read_text(Path(__file__).with_name("report.css"))

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


class FlightView(BaseModel):
    """What a row shows: two curves with gaps, and the first, middle and last frame as JPEGs in base64, None for one that cannot be read."""

    height_m: list[float | None] = []
    visibility: list[float | None] = []
    pictures: list[Annotated[str, Field(pattern=r"^[A-Za-z0-9+/=]*$")] | None] = [None, None, None]


def draw_flight(flight: Flight, heights_m: np.ndarray, width_px: int) -> FlightView:
    """Give what a row shows.

    Args:
        heights_m: (n,) of the drone over the person. width_px: of the pictures.
    """
    rows = np.unique(np.linspace(0, len(flight) - 1, CURVE_POINTS).round().astype(int))
    curves = {"height_m": heights_m[rows], "visibility": flight.visibility[rows]}
    numbers = {
        name: [None if np.isnan(v) else round(float(v), 3) for v in values.tolist()] for name, values in curves.items()
    }
    middle, last = len(flight) // 2, len(flight) - 1
    return FlightView(**numbers, pictures=[thumbnail(flight.frame_folder(i), width_px) for i in (0, middle, last)])


def write_report(path: Path, inspection: Inspection, views: dict[str, FlightView]) -> None:
    """Write the page; `views` holds pictures and curves by flight folder."""
    write_bytes(path, report_html(inspection, views).encode())


def report_html(inspection: Inspection, views: dict[str, FlightView]) -> str:
    """Give the page's text. Flights that need a look come first."""
    order = sorted(inspection.flights, key=lambda f: (-RESULTS.index(f.result), f.folder))
    counts = inspection.funnel.flights
    summary = f"{counts.inspected} flights: {counts.accepted} accepted, {counts.review} to review, {counts.rejected} rejected."
    heads = "".join(f'<th class="n">{for_html(title)}</th>' for title, _, _ in COLUMNS)
    rows = "\n".join(_row(flight, views.get(flight.folder, FlightView())) for flight in order)
    body = f"""<h1>Inspection</h1>
<p class="lead">{for_html(summary)} A rejected flight breaks a rule; one in review is for a person to decide.</p>
<h2>Funnel</h2>
<div class="funnel">{_funnel(inspection)}</div>
{_covered(inspection)}<h2>Flights</h2>
<p class="lead">a, j: RMS acceleration and jerk of the plan; S: smoothness score; clear: least distance of the
drawn poses to an obstacle; five-ray: their mean visibility on the map; rendered: mean visibility of the target in the frames; visible: frames that show it; IoU: projected box against mask.</p>
<div class="scroll"><table><thead><tr><th>flight</th><th>first, middle, last frame</th>{heads}<th>height over person, visibility</th></tr></thead><tbody>
{rows}
</tbody></table></div>
<h2>Settings</h2>
<p class="lead">{for_html(", ".join(f"{name} {value}" for name, value in inspection.settings.items()))}</p>"""
    return html_page("cosfly: inspection", STYLE + COVERAGE_STYLE, body)


def _covered(inspection: Inspection) -> str:
    if inspection.coverage is None or not inspection.coverage.frames:
        return ""
    lead = f"{inspection.coverage.frames:,} frames of accepted flights, and where 5 % to 95 % of them lie; the line is the plain run that ships (quickstart)."
    return f'<h2>What is covered</h2>\n<p class="lead">{lead}</p>\n{coverage_html(inspection.coverage)}\n'


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


def _row(flight: FlightInspection, view: FlightView) -> str:
    issues = "".join(_issue(issue) for issue in flight.issues if issue.severity != "note")
    name = f"<b>{for_html(flight.trajectory)}</b><br>{for_html(flight.variant)} <small>{for_html(flight.town)}</small>"
    label = f'{name}<br><span class="tag {flight.result}">{flight.result}</span>'
    wide = (
        f'<tr class="wide"><td colspan="{len(COLUMNS) + 3}"><ul class="issues">{issues}</ul></td></tr>'
        if issues
        else ""
    )
    numbers = "".join(f'<td class="n">{_number(flight.metrics.get(key), form)}</td>' for _, key, form in COLUMNS)
    pictures = "".join(
        f'<img alt="frame" src="data:image/jpeg;base64,{picture}">'
        if picture
        else '<span class="gone">no picture</span>'
        for picture in view.pictures
    )
    curves = _curve(view.height_m, "#2b6cb0", "m", least_span=5.0) + _curve(view.visibility, "#2f855a", "", (0, 1))
    first = '<tr class="open">' if issues else "<tr>"
    return f'{first}<td>{label}</td><td class="pictures">{pictures}</td>{numbers}<td>{curves}</td></tr>{wide}'


def _issue(issue: Issue) -> str:
    times = f" &times;{issue.count}" if issue.count > 1 else ""
    text = f"{issue.where}: {issue.got}; expected {issue.expected}"
    return f'<li class="{issue.severity}"><b>{for_html(issue.code)}</b>{times} {for_html(text)}</li>'


def _number(value: float | int | None, form: str) -> str:
    return "&ndash;" if value is None else form.format(value)


def _curve(
    values: list[float | None],
    color: str,
    unit: str,
    span: tuple[float, float] | None = None,
    least_span: float = 0.0,
) -> str:
    """Draw a small curve with its range; a gap where a value is unknown. `least_span` keeps noise from looking like flight."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    low, high = span or (min(known), max(known))
    spare = max(0.0, least_span - (high - low)) / 2.0
    low, high = low - spare, high + spare
    width, height = 150.0, 34.0
    step, scale = width / max(1, len(values) - 1), (height - 4.0) / ((high - low) or 1.0)
    parts, pen_is_down = [], False
    for i, value in enumerate(values):
        if value is None:
            pen_is_down = False
            continue
        parts.append(f"{'L' if pen_is_down else 'M'}{i * step:.1f} {height - 2.0 - (value - low) * scale:.1f}")
        pen_is_down = True
    path = f'<path d="{"".join(parts)}" fill="none" stroke="{color}" stroke-width="1.5"/>'
    label = f"<small>{min(known):.2f} to {max(known):.2f} {unit}</small>"
    return f'<svg width="{width:.0f}" height="{height:.0f}">{path}</svg>{label}'
