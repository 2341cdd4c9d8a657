"""The statistics for people: `stats.html`, one page without script or network, and `stats.md`."""

from __future__ import annotations

from cosfly.escaping import for_html, for_markdown, html_page
from cosfly.look.coverage_page import STYLE as COVERAGE_STYLE
from cosfly.look.coverage_page import coverage_html
from cosfly.products.coverage import Coverage
from release.stats.schema import Absent, Cell, Stats, Table

STYLE = """
:root { --line: #e2e8f0; --soft: #4a5568; --bar: #2b6cb0; } * { box-sizing: border-box; }
body { font: 14px/1.5 system-ui, "Segoe UI", "Noto Sans", "Noto Sans CJK SC", sans-serif; color: #1a202c; background: #f7fafc; margin: 0 auto; padding: 24px 22px 50px; max-width: 1400px; }
h1 { font-size: 23px; margin: 0 0 2px; overflow-wrap: anywhere; } h2 { font-size: 17px; margin: 26px 0 8px; } h3 { font-size: 14.5px; margin: 0 0 4px; } p { margin: 0 0 8px; color: var(--soft); max-width: 1000px; overflow-wrap: anywhere; }
.tables { columns: 560px 2; column-gap: 12px; } .table { background: #fff; border: 1px solid var(--line); border-radius: 8px; padding: 12px 16px; overflow-x: auto; margin: 0 0 12px; break-inside: avoid; }
.table.wide { column-span: all; margin-top: 12px; } .table p { font-size: 12.5px; } .table small { color: #66758a; font-weight: 400; }
table { border-collapse: collapse; } th { text-align: left; font-weight: 600; color: var(--soft); } th, td { padding: 3px 12px 3px 0; vertical-align: top; } tr + tr td { border-top: 1px solid #edf2f7; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; } td.bar { width: 26%; min-width: 80px; } td.bar i { display: block; height: 11px; margin-top: 6px; border-radius: 2px; background: var(--bar); min-width: 1px; }
td.bar div { display: flex; } td.bar div i { border-radius: 0; min-width: 0; } .k0 { background: #2f855a !important; } .k1 { background: #c53030 !important; } .k2 { background: #a0aec0 !important; }
td.heat { text-align: center; min-width: 38px; border: 1px solid #fff !important; font-variant-numeric: tabular-nums; padding: 3px; } th.turned { height: 150px; vertical-align: bottom; padding: 0 0 4px; } th.turned span { writing-mode: vertical-rl; transform: rotate(180deg); white-space: nowrap; }
"""
WIDE_COLUMNS = 7


def page_html(stats: Stats, coverage: Coverage) -> str:
    """Give the page's text."""
    tables = "".join(_table_html(table) for table in stats.tables)
    absent = "".join(
        f"<tr><td>{for_html(one.what)}</td><td>{for_html(one.paper)}</td><td>{for_html(one.why)}</td></tr>"
        for one in stats.absent
    )
    body = f"""<h1>{for_html(stats.name)}</h1>
<p>Computed from the rows of the release, content {for_html(stats.content_digest[:12])}; what the record alone can tell says so. Small words name what of the paper a table computes again.</p>
<h2>Tables</h2><div class="tables">{tables}</div>
<h2>What is covered</h2><p>Frames as released; below a histogram, where 5 % to 95 % of them lie. The line, and the last column, are those of the plain run that ships (quickstart).</p>
{coverage_html(coverage)}
<h2>What this release cannot tell</h2><div class="table wide"><table><tr><th>what</th><th>of the paper</th><th>why</th></tr>{absent}</table></div>"""
    return html_page(f"cosfly: {stats.name}", STYLE + COVERAGE_STYLE, body)


def _table_html(table: Table) -> str:
    paper = f" <small>{for_html(table.paper)}</small>" if table.paper else ""
    note = f"<p>{for_html(table.note)}</p>" if table.note else ""
    wide = " wide" if len(table.head) >= WIDE_COLUMNS else ""
    inner = _heat(table) if table.plot == "heat" else _plain(table)
    return f'<div class="table{wide}" id="{for_html(table.key)}"><h3>{for_html(table.title)}{paper}</h3>{note}{inner}</div>'


def _plain(table: Table) -> str:
    is_number = [all(isinstance(row[k], int | float | None) for row in table.rows) for k in range(len(table.head))]
    mark = [' class="n"' if number else "" for number in is_number]
    head = "".join(f"<th{own}>{for_html(name)}</th>" for own, name in zip(mark, table.head, strict=True))
    head += "<th></th>" if table.plot else ""
    top = max((float(row[1]) for row in table.rows if isinstance(row[1], int | float)), default=0.0)
    lines = ""
    for row in table.rows:
        cells = "".join(
            f'<td class="n">{shown(cell)}</td>'
            if isinstance(cell, int | float) or cell is None
            else f"<td>{for_html(cell)}</td>"
            for cell in row
        )
        lines += f"<tr>{cells}{_bar(table, row, top)}</tr>"
    return f"<table><tr>{head}</tr>{lines}</table>"


def _bar(table: Table, row: list[Cell], top: float) -> str:
    if table.plot == "bars":
        value = float(row[1]) if isinstance(row[1], int | float) else 0.0
        bar = f'<i style="width:{100 * value / top:.1f}%"></i>' if value else ""
        return f'<td class="bar">{bar}</td>'
    if table.plot == "stacked":
        values = [float(cell) for cell in row[1:] if isinstance(cell, int | float)]
        total = sum(values) or 1.0
        parts = "".join(
            f'<i class="k{k % 3}" style="width:{100 * value / total:.2f}%"></i>' for k, value in enumerate(values)
        )
        return f'<td class="bar"><div>{parts}</div></td>'
    return ""


def _heat(table: Table) -> str:
    top = (
        max((float(cell) for row in table.rows for cell in row[1:] if isinstance(cell, int | float)), default=0.0)
        or 1.0
    )
    is_turned = max(map(len, table.head)) > 9
    head = "".join(
        f'<th class="turned"><span>{for_html(name)}</span></th>' if is_turned else f"<th>{for_html(name)}</th>"
        for name in table.head[1:]
    )
    lines = ""
    for row in table.rows:
        cells = ""
        for cell in row[1:]:
            share = (float(cell) if isinstance(cell, int | float) else 0.0) / top
            ink = "#fff" if share > 0.55 else "#1a202c"
            cells += f'<td class="heat" style="background:rgba(43,108,176,{share:.3f});color:{ink}">{shown(cell) if cell else ""}</td>'
        lines += f"<tr><th>{for_html(str(row[0]))}</th>{cells}</tr>"
    return f"<table><tr><th>{for_html(table.head[0])}</th>{head}</tr>{lines}</table>"


def shown(cell: Cell) -> str:
    """Give a number for people: no digits that say nothing."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return for_html(cell)
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
