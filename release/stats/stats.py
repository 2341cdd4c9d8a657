"""`cosfly release stats`: what a release covers, drawn beside the plain run that ships. Reads `release.json`, writes a page and its numbers."""

from __future__ import annotations

from pathlib import Path

from cosfly.coverage_page import STYLE, coverage_html
from cosfly.escaping import for_html, html_page
from cosfly.store import write_bytes, write_json
from release.record import ReleaseRecord, read_record

PAGE = (
    "body { font: 14px/1.45 system-ui, 'Noto Sans', sans-serif; color: #1a202c; background: #f7fafc; margin: 24px auto; padding: 0 24px; "
    "max-width: 1400px; } td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; } table { border-collapse: collapse; } "
    "th { text-align: left; }"
)


def run(dataset: Path, out: Path) -> Path:
    """Reads `release.json` of a release folder; writes `stats.html` and `stats.json` (frames by bin, style, pace and label). Gives the page.

    Raises:
        InputError: there is no release record, or a field of it is wrong.
    """
    record = read_record(dataset / "release.json")
    write_json(out / "stats.json", record.numbers.coverage.model_dump(mode="json"))
    page = out / "stats.html"
    write_bytes(page, html_page(f"cosfly: {record.name}", PAGE + STYLE, _body(record)).encode())
    return page


def _body(record: ReleaseRecord) -> str:
    numbers = record.numbers
    lead = (
        f"{numbers.frames:,} frames of {numbers.flights:,} flights over {numbers.trajectories:,} trajectories; "
        "below a histogram, where 5 % to 95 % of the frames lie; the line, and the last column of the tables, are those of the plain run that "
        "ships (quickstart)."
    )
    return f"<h1>{for_html(record.name)}</h1>\n<p>{for_html(lead)}</p>\n{coverage_html(numbers.coverage)}"
