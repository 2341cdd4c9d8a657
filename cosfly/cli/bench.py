"""`cosfly bench`: a stage with more workers, and with workers that die and stall."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cosfly.cli import options

if TYPE_CHECKING:
    from rich.table import Table

    from cosfly.bench.measure import Bench

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
    """Measure a stage with one and more workers, and with planted faults: tables, bench.json, pictures of the events."""
    from cosfly.bench import measure
    from cosfly.console import console

    counts = _counts(workers)
    cfg = options.resolve(run / "run.yaml", overrides)
    bench = measure.run(cfg, run, out, stage, counts, {"kill": kills, "stall": stalls}, cfg.seed)
    for table in _tables(bench):
        console.print(table)
    typer.echo(out)


def _tables(bench: Bench) -> list[Table]:
    """Give the two tables: how the stage scales, and what became of the faults."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    scaling = Table(
        title=f"{bench.stage} on {bench.cores} cores", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    unit = "frames" if bench.counts_frames else "items"
    for name in ("workers", "wall s", "attempted", "successful", f"{unit}/s", "speed-up", "cores", "MiB"):
        scaling.add_column(name, justify="right")
    faults = Table(title="faults", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in (
        "workers",
        "fault",
        "planted",
        "noticed",
        "restarts",
        "retries",
        "saved",
        "failed",
        "runs",
        "wall s",
        "same",
    ):
        faults.add_column(name, justify="right")
    for row in bench.rows:
        if row.fault == "none":
            counted = (f"{row.seconds:.1f}", str(row.attempted), str(row.successful))
            speed = (f"{row.per_s:.2f}", f"{row.per_s / bench.rows[0].per_s:.2f}x")
            scaling.add_row(str(row.workers), *counted, *speed, f"{row.cores_used:.2f}", f"{row.peak_memory_mib:.0f}")
        noted = (row.planted, row.noticed, row.restarts, row.retries, row.recovered, row.failed, row.attempts)
        same = {None: "-", True: "yes", False: "no"}[row.same_products]
        faults.add_row(str(row.workers), row.fault, *map(str, noted), f"{row.seconds:.1f}", same)
    return [scaling, faults]


def _counts(text: str) -> list[int]:
    """Read counts of workers; a usage error, exit 2, where they are none."""
    try:
        counts = [int(word) for word in text.split(",")]
    except ValueError:
        counts = []
    if not counts or min(counts) < 1:
        raise typer.BadParameter("whole numbers from 1 up, with commas between them", param_hint="'--workers'")
    return counts
