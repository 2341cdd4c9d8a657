"""`cosfly bench`: a stage with more workers, and with workers that die and stall."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosfly.cli import options

if TYPE_CHECKING:
    from rich.table import Table

    from cosfly.bench.tables import Bench

app = typer.Typer()


@app.command()
def bench(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run that is finished up to the stage.")],
    out: Annotated[Path, typer.Option(help="New folder for bench.json and the pictures.")],
    stage: Annotated[str, typer.Option(help="Stage to measure.")] = "render",
    workers: Annotated[str, typer.Option(help="Counts of worker processes, as in 1,2,4.")] = "1,2,4",
    kills: Annotated[int, typer.Option(min=0, help="Workers to kill, at random moments.")] = 3,
    stalls: Annotated[int, typer.Option(min=0, help="Workers to stop, at random moments.")] = 1,
    overrides: options.Overrides = None,
) -> None:
    """Measure a stage with one and more workers, and with planted faults: tables, bench.json, bench.md, bench.png, pictures of the events."""
    from cosfly.bench import measure
    from cosfly.work.console import console

    counts = _counts(workers)
    cfg = options.resolve(run / "run.yaml", overrides)
    bench = measure.run(cfg, run, out, stage, counts, {"kill": kills, "stall": stalls}, cfg.seed)
    for table in _tables(bench):
        console.print(table, "")
    typer.echo(out)


def _tables(bench: Bench) -> list[Table]:
    """Give the tables for a terminal."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from cosfly.bench.tables import tables

    found = []
    for title, head, rows in tables(bench):
        # Eighty columns hold the widest.
        table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=0, show_edge=False)
        for number, name in enumerate(head):
            table.add_column(name, justify="right" if number else "left")
        for row in rows:
            table.add_row(*row)
        found.append(table)
    return found


def _counts(text: str) -> list[int]:
    """Read counts of workers; a usage error, exit 2, where they are none."""
    try:
        counts = [int(word) for word in text.split(",")]
    except ValueError:
        counts = []
    if not counts or min(counts) < 1:
        raise typer.BadParameter("whole numbers from 1 up, with commas between them", param_hint="'--workers'")
    return counts
