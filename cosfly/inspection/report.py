"""`report.html` of the inspection: one self-contained page, without scripts, for the reviewer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.formats.inspection import RESULTS, Inspection, TrackInspection
from cosfly.formats.playback import STATES
from cosfly.inspection.view import PLOTS, TrackView, frames_of_issues
from cosfly.runtime.io import read_text
from cosfly.viz.coverage_page import coverage_html
from cosfly.viz.page import fragment, page

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
    ("legible", "legible_share", "{:.0%}"),
    ("IoU", "track_quality", "{:.2f}"),
)
PLOT_WIDTH, PLOT_HEIGHT = 250.0, 62.0
OPENING_PICTURES = 4


def report_html(name: str, inspection: Inspection, views: Mapping[str, TrackView], page_mb: float) -> str:
    """Return the page. Tracks that need a decision come first, and keep their pictures longest.

    Args:
        name: of the run. views: pictures and curves by track folder, as many as `page_mb` allows.
    """
    tracks, coverage = inspection.flights, inspection.coverage
    accepted = [track for track in tracks if track.result == "accepted"] or tracks
    accepted = [track for track in sorted(accepted, key=lambda track: track.track) if track.folder in views]
    counts = {
        state: sum(int(track.metrics.get(f"frames_{state.replace(' ', '_')}") or 0) for track in tracks)
        for state in STATES
    }
    total = sum(counts.values())
    cards, size, num_without_pictures = list[str](), 0, 0
    for track in sorted(tracks, key=lambda track: (-RESULTS.index(track.result), track.folder)):
        card = _card(track, views.get(track.folder))
        if track.folder in views and size + len(card) > page_mb * MB:
            card, num_without_pictures = _card(track, None), num_without_pictures + 1
        size += len(card)
        cards.append(card)
    return page(
        "cosfly/inspection/report.html", title=name, style=STYLE, inspection=inspection, results=RESULTS,
        columns=COLUMNS, cards=cards, num_without_pictures=num_without_pictures, page_mb=page_mb,
        pictures=[one for track in accepted if (one := views[track.folder].pictures[1])][:OPENING_PICTURES],
        states=[(one, counts[one], f"{counts[one] / max(total, 1):.1%}", f"{STATES[one]:.0%}") for one in STATES],
        num_perturbable=total, coverage=coverage_html(coverage) if coverage is not None and coverage.frames else None,
    )  # fmt: skip


def _card(track: TrackInspection, view: TrackView | None) -> str:
    issues = [issue for issue in track.issues if issue.severity != "note"]
    plots = [] if view is None else [plot for name in PLOTS if (plot := _plot(name, view)) is not None]
    return fragment(
        "cosfly/inspection/card.html", track=track, columns=COLUMNS, issues=issues, view=view, plots=plots,
        asked=frames_of_issues(track.issues, int(track.metrics.get("num_frames") or 0)),
    )  # fmt: skip


def _plot(name: str, view: TrackView) -> dict[str, Any] | None:
    """Return a curve over time and its range, with gaps for unknown values; None if all are unknown."""
    title, unit, span = PLOTS[name]
    values, time_s = view.curves.get(name, []), view.time_s
    known = [value for value in values if value is not None]
    if not known:
        return None
    edges = [*known, *(edge for edge in span if edge is not None)]
    low, high = min(edges), max(edges)
    scale = (PLOT_HEIGHT - 4.0) / ((high - low) or 1.0)
    step = PLOT_WIDTH / ((time_s[-1] - time_s[0]) or 1.0)
    points = [
        (before, f"{(at_s - time_s[0]) * step:.1f} {PLOT_HEIGHT - 2.0 - (value - low) * scale:.1f}")
        for before, at_s, value in zip([None, *values], time_s, values, strict=False) if value is not None
    ]  # fmt: skip
    return {
        "title": title,
        "path": "".join(f"{'M' if before is None else 'L'}{point}" for before, point in points),
        "found": f"{min(known):.2f} to {max(known):.2f}{' ' * bool(unit)}{unit}, mean {float(np.mean(known)):.2f}",
        "axes": f"{low:.4g} to {high:.4g}; {time_s[0]:g} s to {time_s[-1]:g} s",
    }
