"""The statistics for people: `stats.html`, one page without script or network, and `stats.md`."""

from __future__ import annotations

from cosfly.escaping import for_markdown
from cosfly.look.coverage_page import coverage_html
from cosfly.look.page import page
from cosfly.products.coverage import Coverage
from release.stats.cells import Absent, Cell, Stats, Table

STYLE = """
.tables { columns: 560px 2; column-gap: 12px; } .tables .panel { break-inside: avoid; } .tables .wide { column-span: all; margin-top: 12px; }
td.bar { width: 26%; min-width: 80px; } td.bar > i { display: block; height: 11px; margin-top: 6px; border-radius: 2px; min-width: 1px; } td.bar .stack { height: 11px; margin: 6px 0 0; }
.k0 { --own: var(--good); } .k1 { --own: var(--bad); } .k2 { --own: var(--unread); }
"""


def page_html(stats: Stats, coverage: Coverage) -> str:
    """Give the page's text."""
    return page(
        "release/stats/page.html", title=stats.name, style=STYLE, stats=stats, coverage=coverage_html(coverage), shown=shown,
        numeric_columns=_numeric_columns, greatest=_greatest,
    )  # fmt: skip


def _numeric_columns(table: Table) -> list[bool]:
    return [all(isinstance(row[k], int | float | None) for row in table.rows) for k in range(len(table.head))]


def _greatest(table: Table) -> float:
    """Give what fills a bar, or a cell of a map: the greatest number there is; 1 where there is none."""
    cells = [cell for row in table.rows for cell in (row[1:] if table.plot == "heat" else row[1:2])]
    return max((float(cell) for cell in cells if isinstance(cell, int | float)), default=0.0) or 1.0


def shown(cell: Cell) -> str:
    """Give a number for people: no digits that say nothing."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    return f"{cell:,}" if isinstance(cell, int) else f"{cell:,.4f}".rstrip("0").rstrip(".")


def markdown(stats: Stats) -> str:
    """Give the tables as Markdown."""
    parts = [f"# {for_markdown(stats.name)}: statistics", f"Content {for_markdown(stats.content_digest[:12])}."]
    for table in stats.tables:
        parts.append(f"## {for_markdown(table.title)}" + (f" ({for_markdown(table.paper)})" if table.paper else ""))
        parts += [for_markdown(table.note)] if table.note else []
        parts.append(_markdown_table(table.head, table.rows))
    parts += ["## What this release cannot tell", _absent(stats.absent)]
    return "\n\n".join(parts) + "\n"


def _absent(absent: list[Absent]) -> str:
    return _markdown_table(["what", "of the paper", "why"], [[one.what, one.paper, one.why] for one in absent])


def _markdown_table(head: list[str], rows: list[list[Cell]]) -> str:
    lines = ["| " + " | ".join(for_markdown(name) for name in head) + " |", "|" + "|".join("---" for _ in head) + "|"]
    lines += [
        "| " + " | ".join(for_markdown(cell) if isinstance(cell, str) else shown(cell) for cell in row) + " |"
        for row in rows
    ]
    return "\n".join(lines)
