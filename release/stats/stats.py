"""`cosfly release stats`: what the paper tells of its data, computed again from the rows of a release."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosfly.geometry.coverage import Coverage
from cosfly.runtime.escaping import for_markdown
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import write_json
from cosfly.viz.coverage_page import coverage_html
from cosfly.viz.page import page
from release.counting import count_release
from release.reading import check_rows
from release.record import ReleaseRecord, read_record, release_folder
from release.stats.pixels import look_at, middle_picture
from release.stats.tables import Cell, Stats, Table, make_stats


def run(dataset: Path, out: Path, *, pixels: int = 200) -> Path:
    """Reads a release folder; writes `stats.json`, `stats.md`, `stats.html` and gives the page. Memory holds a row
    group and a few numbers a flight.

    Args:
        pixels: frames whose depth and instance pictures are decoded; 0 for none.
    Raises:
        InputError: it is no release, or something in it cannot be read.
    """
    dataset = release_folder(dataset)
    record = read_record(dataset / "release.json")
    for file in record.files:
        check_rows(dataset / file.path, file.rows)
    tracks = count_release(dataset, record.shards)
    coverage = Coverage.total(track.coverage for track in tracks)
    looked = look_at(dataset, record, pixels) if pixels else None
    stats = make_stats(record, tracks, looked)
    write_json(out / "stats.json", {**stats.model_dump(mode="json"), "coverage": coverage.model_dump(mode="json")})
    write_bytes(out / "stats.md", markdown(stats).encode())
    text = page_html(stats, coverage, tiles_of(record, stats), middle_picture(dataset, record))
    write_bytes(out / "stats.html", text.encode())
    return out / "stats.html"


# --- for people: one page without script or network, and Markdown -----------------------------------------------------

STYLE = """
.tables { columns: 560px 2; column-gap: 12px; } .tables .panel { break-inside: avoid; }
.tables .wide { column-span: all; margin-top: 12px; } figure.first img { max-width: 100%; border-radius: 8px; }
"""


def page_html(
    stats: Stats, coverage: Coverage, tiles: Sequence[tuple[str, str]] = (), picture: str | None = None
) -> str:
    """Return the page's text.

    Args:
        tiles: what a person asks first, how much and how good. picture: of one frame, JPEG in base64.
    """
    return page(
        "release/stats/page.html", title=", ".join(stats.runs) or stats.name, style=STYLE, stats=stats, tiles=tiles,
        picture=picture, coverage=coverage_html(coverage), look=TABLE_LOOK,
    )  # fmt: skip


def tiles_of(record: ReleaseRecord, stats: Stats) -> list[tuple[str, str]]:
    """Return what a person asks first: how much there is, and how good it is."""
    numbers, captions, found = record.numbers, record.numbers.captions, record.history.flights
    quality = {row[0]: row[1] for table in stats.tables if table.key == "quality_stats" for row in table.rows}
    seen, filled = numbers.visibility.mean, captions.values["values_filled_en"]
    values: list[tuple[str, Any, Any]] = [  # name, value or count, of how many
        ("frames", numbers.frames, None),
        ("flights", numbers.flights, None),
        ("trajectories", numbers.trajectories, None),
        ("towns", len(numbers.frames_by.town), None),
        ("captions", captions.frames_with, None),
        ("GB", round(numbers.files.bytes / 1e9, 2), None),
        ("of the tracks that were found are released", found.released, found.found),
        ("of the frames show the person", numbers.frames_target_visible, numbers.frames),
        ("of the frames show the person legibly", numbers.frames_target_legible, numbers.frames),
        ("of the person is visible, on average", seen, None if seen is None else 1),
        ("mean smoothness score", quality["mean smoothness score S"], None),
        ("of the decisions are the geometric label", captions.decision_equals_label, captions.with_label),
        ("values of the English captions are filled from facts", filled, None),
    ]
    return [
        (name, shown(value) if whole is None else f"{100 * value / whole:.1f} %")
        for name, value, whole in values
        if value is not None and whole != 0
    ]


def _numeric_columns(table: Table) -> list[bool]:
    return [all(isinstance(row[k], int | float | None) for row in table.rows) for k in range(len(table.head))]


def _greatest(table: Table) -> float:
    """Return what fills a bar, or a cell of a map: the greatest number there is; 1 where there is none."""
    cells = [cell for row in table.rows for cell in (row[1:] if table.plot == "heat" else row[1:2])]
    return max((float(cell) for cell in cells if isinstance(cell, int | float)), default=0.0) or 1.0


def shown(cell: Cell) -> str:
    """Return a number for people: no digits that say nothing."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    return f"{cell:,}" if isinstance(cell, int) else f"{cell:,.4f}".rstrip("0").rstrip(".")


TABLE_LOOK = {"shown": shown, "numeric_columns": _numeric_columns, "greatest": _greatest}  # of macros of tables.html


def markdown(stats: Stats) -> str:
    """Return the tables as Markdown."""
    parts = [f"# {for_markdown(stats.name)}: statistics", f"Content {for_markdown(stats.content_digest[:12])}."]
    for table in stats.tables:
        parts.append(f"## {for_markdown(table.title)}" + (f" ({for_markdown(table.paper)})" if table.paper else ""))
        parts += [for_markdown(table.note)] if table.note else []
        parts.append(_markdown_table(table.head, table.rows))
    absent: list[list[Cell]] = [[one.what, one.paper, one.why] for one in stats.absent]
    parts += ["## What this release does not show", _markdown_table(["what", "of the paper", "why"], absent)]
    parts += ["## Rules", *(for_markdown(f"{name}: {rule}.") for name, rule in stats.rules.items())]
    return "\n\n".join(parts) + "\n"


def _markdown_table(head: list[str], rows: list[list[Cell]]) -> str:
    texts = [
        [for_markdown(cell) if isinstance(cell, str) else shown(cell) for cell in row]
        for row in [list[Cell](head), *rows]
    ]
    lines = [f"| {' | '.join(cells)} |" for cells in texts]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])
