"""`cosfly release stats`: the tables of a release and what it covers, as a page and as JSON."""

from __future__ import annotations

from pathlib import Path

from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import write_json
from cosfly.viz.coverage_page import coverage_html
from cosfly.viz.page import page
from release.card.tables import Cell, Table, tables_of
from release.record import RECORD, read_record, release_folder

STYLE = """
.tables { columns: 560px 2; column-gap: 12px; } .tables .panel { break-inside: avoid; }
.tables .wide { column-span: all; margin-top: 12px; }
"""


def run(dataset: Path, out: Path) -> Path:
    """Read the record of a release; write `stats.json` and `stats.html`, and return the page.

    The numbers are those of the record; `release verify` compares them with the rows.

    Raises:
        InputError: If the folder is not a release.
    """
    record = read_record(release_folder(dataset) / RECORD)
    tables, runs = tables_of(record), [source.run for source in record.provenance.sources]
    write_json(out / "stats.json", {
        "name": record.name, "runs": runs, "content_digest": record.content_digest,
        "tables": [table.model_dump(mode="json") for table in tables],
        "coverage": record.numbers.coverage.model_dump(mode="json"),
    })  # fmt: skip
    text = page(
        "release/card/stats.html", title=", ".join(runs) or record.name, style=STYLE, record=record, tables=tables,
        coverage=coverage_html(record.numbers.coverage), look=TABLE_LOOK,
    )  # fmt: skip
    write_bytes(out / "stats.html", text.encode())
    return out / "stats.html"


def _numeric_columns(table: Table) -> list[bool]:
    return [all(isinstance(row[k], int | float | None) for row in table.rows) for k in range(len(table.head))]


def _greatest(table: Table) -> float:
    """Return the value of a full bar, or of a cell in full colour: the greatest number; 1 if there is none."""
    cells = [cell for row in table.rows for cell in (row[1:] if table.plot == "heat" else row[1:2])]
    return max((float(cell) for cell in cells if isinstance(cell, int | float)), default=0.0) or 1.0


def shown(cell: Cell) -> str:
    """Return a cell for people: numbers without digits that say nothing."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    return f"{cell:,}" if isinstance(cell, int) else f"{cell:,.4f}".rstrip("0").rstrip(".")


TABLE_LOOK = {"shown": shown, "numeric_columns": _numeric_columns, "greatest": _greatest}  # of macros of tables.html
