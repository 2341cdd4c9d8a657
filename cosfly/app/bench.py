"""`cosfly bench`: a stage of a finished run again, with several counts of worker processes; its figures come from its events."""

from __future__ import annotations

import logging
import os
import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel

from caption.teachers.teacher import EMBEDDED
from cosfly.app.pipeline import stages
from cosfly.app.settings import RunConfig
from cosfly.errors import ConfigError, ResumeError
from cosfly.work.stage_events import EVENTS, LOSSES, Event, read_events
from cosfly.work.stage_folder import Manifest, read_manifest
from cosfly.work.store import write_bytes, write_model
from cosfly.work.worker_pool import WORDS

log = logging.getLogger(__name__)

SCHEMA, VERSION = "cosfly.bench", "1.1"
STAGES = ("pedestrians", "plan", "render", "inspect", "caption", "release")  # those that do items


class Row(BaseModel):
    """Figures of one run of the stage.

    attempted: frames of render, or items of another stage, that were done, and those that were lost with a worker.
    """

    workers: int
    seconds: float
    attempted: int
    successful: int
    cores_used: float
    peak_memory_mib: float
    restarts: int
    failed: int

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
    """`bench.json`: one row for each count of workers, and the stages of the run as they were made."""

    stage: str
    cores: int
    rows: list[Row]
    stages: list[StageRow] = []


def run(cfg: RunConfig, run_folder: Path, out: Path, stage: str, workers: Iterable[int]) -> Bench:
    """Reads a run up to `stage`; writes `bench.json`, `bench.md` and the events of each run. The stage's products are removed again.

    Raises:
        ConfigError: the stage has no items, or a server does them. ResumeError: `out` holds something.
    """
    if stage not in STAGES:
        raise ConfigError("not a stage that can be measured", where="--stage", got=stage, expected=", ".join(STAGES))
    if out.exists() and any(out.iterdir()):
        raise ResumeError("the folder is not empty", where=out, fix="choose another --out")
    asked = cfg.caption.teacher_kind not in EMBEDDED or cfg.caption.judge.url or cfg.caption.reader.urls
    if stage == "caption" and asked:
        raise ConfigError(
            "captions that a server writes are no work of workers",
            where="caption.teacher",
            got=cfg.caption.teacher,
            expected="an embedded teacher, no judge and no reader",
            fix="--set caption.teacher=rules",
        )
    bench = Bench(
        stage=stage,
        cores=len(os.sched_getaffinity(0)),
        rows=[_measured(cfg, run_folder, out / f"workers_{count}", stage, count) for count in sorted(set(workers))],
        stages=stage_rows(run_folder, STAGES),
    )
    write_bytes(out / "bench.md", markdown(bench).encode())
    write_model(out / "bench.json", bench, schema=SCHEMA, version=VERSION)
    return bench


def _measured(cfg: RunConfig, run_folder: Path, folder: Path, stage: str, workers: int) -> Row:
    """Run the stage once; gives its figures."""
    log.info("bench: %s with %d worker%s", stage, workers, "s" if workers > 1 else "")
    cfg = cfg.model_copy(update={"workers": workers})
    next(s for s in stages(cfg, run_folder, into=folder) if s.name == stage).work()
    row = row_of(read_events(folder / stage), read_manifest(folder / stage), workers, counts_frames=stage == "render")
    os.replace(folder / stage / EVENTS, folder.with_suffix(".events.jsonl"))
    shutil.rmtree(folder)
    return row


def row_of(events: list[Event], manifest: Manifest, workers: int, *, counts_frames: bool) -> Row:
    """Give the figures of one run from what its events and its manifest say."""
    done = [event for event in events if event.event == "item_done"]
    lost = [event for event in events if event.event in WORDS]
    probes = [event for event in events if event.event == "probe"]
    size = (lambda event: event.steps or 0) if counts_frames else (lambda event: 1)
    return Row(
        workers=workers,
        seconds=manifest.seconds,
        attempted=sum(map(size, [*done, *lost])),
        successful=sum(size(event) for event in done if event.status == "kept"),
        cores_used=round(float(np.mean([probe.cores_used or 0.0 for probe in probes] or [0.0])), 2),
        peak_memory_mib=max((sum((probe.rss_mib or {}).values()) for probe in probes), default=0.0),
        restarts=_num(events, "restarted"),
        failed=manifest.counts.failed.total(),
    )


def stage_rows(run_folder: Path, names: Iterable[str]) -> list[StageRow]:
    """Give what the events of the finished stages of a run say."""
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


class TextTable(NamedTuple):
    """A table of words; the first column is a name."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def tables(bench: Bench) -> list[TextTable]:
    """Give how the stage scales (tab:render_scaling), and the stages of the run (tab:watchdog_reliability)."""
    unit, first = "frames" if bench.stage == "render" else "items", bench.rows[0].per_s
    scaling = [
        (str(row.workers), f"{row.seconds:.1f}", str(row.attempted), str(row.successful), f"{row.per_s:.2f}", f"{row.per_s / first:.2f}x",
         f"{row.cores_used:.2f}", f"{row.peak_memory_mib:.0f}", str(row.restarts), str(row.failed))
        for row in bench.rows
    ]  # fmt: skip
    stages = [
        (row.stage, str(row.launches), str(row.restarts), f"{row.seconds:.1f}",
         ", ".join(f"{WORDS[mode]} ({count})" for mode, count in row.modes.items()) or "none")  # type: ignore[index]
        for row in bench.stages
    ]  # fmt: skip
    head = (
        "workers", "wall s", "attempted", "successful", f"{unit}/s", "speed-up", "cores", "MiB", "restarts", "failed",
    )  # fmt: skip
    return [
        TextTable(f"{bench.stage} on {bench.cores} cores", head, scaling),
        TextTable("stages of the run", ("stage", "launches", "restarts", "wall s", "lost workers"), stages),
    ]


def markdown(bench: Bench) -> str:
    """Give the tables as Markdown."""
    parts = []
    for title, head, rows in tables(bench):
        lines = [head, ("---",) * len(head), *rows]
        parts.append(f"**{title}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines))
    return "\n".join(parts)
