"""The figures of a bench as tables, for the terminal and as Markdown: how a stage scales, and what became of lost workers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from pydantic import BaseModel

from cosfly.work.stage_events import LOSSES, Event, read_events
from cosfly.work.stage_folder import read_manifest
from cosfly.work.worker_pool import WORDS


class Row(BaseModel):
    """Figures of one run of the stage.

    attempted: frames of render or items of another stage that were done, and those that were lost with a worker. recovered: items that were
    lost and done in the end. attempts: how often the command had to be run. same_products: as without faults, byte for byte.
    """

    workers: int
    fault: str = "none"
    planted: int = 0
    attempts: int = 1
    seconds: float
    attempted: int
    successful: int
    cores_used: float
    peak_memory_mib: float
    noticed: int
    restarts: int
    retries: int
    recovered: int
    failed: int
    same_products: bool | None = None

    @property
    def per_s(self) -> float:
        return self.successful / self.seconds


class StageRow(BaseModel):
    """What the watchdog saw of one stage of the run that was measured. launches: worker processes; modes: how workers were lost."""

    stage: str
    launches: int
    restarts: int
    seconds: float
    modes: dict[str, int]


class Bench(BaseModel):
    """`bench.json`: one row for each count of workers, then one for each kind of fault; and the stages of the run as they were made."""

    stage: str
    cores: int
    rows: list[Row]
    stages: list[StageRow] = []

    @property
    def counts_frames(self) -> bool:
        return self.stage == "render"

    @property
    def undisturbed(self) -> list[Row]:
        return [row for row in self.rows if row.fault == "none"]


class Table(NamedTuple):
    """A table of words; the first column is a name."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def stage_rows(run_folder: Path, names: Iterable[str]) -> list[StageRow]:
    """Tell of the finished stages of a run what their events say."""
    rows = []
    for name in names:
        folder = run_folder / name
        if (folder / "manifest.json").is_file():
            events = read_events(folder)
            rows.append(StageRow(
                stage=name, launches=_num(events, "worker_started", "restarted"), restarts=_num(events, "restarted"),
                seconds=read_manifest(folder).seconds, modes=dict(Counter(event.event for event in events if event.event in LOSSES)),
            ))  # fmt: skip
    return rows


def _num(events: list[Event], *kinds: str) -> int:
    return sum(event.event in kinds for event in events)


def tables(bench: Bench) -> list[Table]:
    """Give the three tables: how the stage scales (tab:render_scaling), what became of planted faults, and the run's stages (tab:watchdog_reliability)."""
    unit = "frames" if bench.counts_frames else "items"
    first = bench.rows[0].per_s
    scaling = [
        (str(row.workers), f"{row.seconds:.1f}", str(row.attempted), str(row.successful), f"{row.per_s:.2f}", f"{row.per_s / first:.2f}x",
         f"{row.cores_used:.2f}", f"{row.peak_memory_mib:.0f}", str(row.restarts), str(row.failed))
        for row in bench.undisturbed
    ]  # fmt: skip
    same = {None: "-", True: "yes", False: "no"}
    faults = [
        (row.fault, *map(str, (row.workers, row.planted, row.noticed, row.restarts, row.retries, row.recovered, row.failed)),
         str(row.attempted - row.successful), str(row.attempts), f"{row.seconds:.1f}", same[row.same_products])
        for row in bench.rows
    ]  # fmt: skip
    stages = [
        (row.stage, str(row.launches), str(row.restarts), f"{row.seconds:.1f}",
         ", ".join(f"{WORDS[mode]} ({count})" for mode, count in row.modes.items()) or "none")  # type: ignore[index]
        for row in bench.stages
    ]  # fmt: skip
    return [
        Table(
            f"{bench.stage} on {bench.cores} cores",
            (
                "workers",
                "wall s",
                "attempted",
                "successful",
                f"{unit}/s",
                "speed-up",
                "cores",
                "MiB",
                "restarts",
                "failed",
            ),
            scaling,
        ),
        Table(
            f"faults, and {unit} that were lost by them",
            (
                "fault",
                "workers",
                "planted",
                "seen",
                "restarts",
                "retries",
                "saved",
                "failed",
                "lost",
                "runs",
                "wall s",
                "same",
            ),
            faults,
        ),
        Table("stages of the run", ("stage", "launches", "restarts", "wall s", "lost workers"), stages),
    ]


def markdown(bench: Bench) -> str:
    """Give the tables as Markdown."""
    parts = []
    for title, head, rows in tables(bench):
        lines = [head, ("---",) * len(head), *rows]
        parts.append(f"**{title}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines))
    return "\n".join(parts)
