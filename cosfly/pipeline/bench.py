"""`cosfly bench`: a stage of a finished run again, with several counts of workers; figures come from its events."""

from __future__ import annotations

import logging
import os
import shutil
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel

from caption.teachers.teacher import EMBEDDED
from cosfly.runtime.errors import ConfigError, ResumeError
from cosfly.runtime.events import EVENTS, LOSSES, Event, read_events
from cosfly.runtime.json_io import FileFormat, write_model
from cosfly.runtime.run_dir import Manifest, read_manifest

if TYPE_CHECKING:
    from cosfly.pipeline.settings import RunConfig

log = logging.getLogger(__name__)

FORMAT = FileFormat("cosfly.bench", "1.2")
STAGES = ("pedestrians", "plan", "render", "inspect", "caption", "release")  # those that do items


class BenchRun(BaseModel):
    """Figures of one run of the stage.

    attempted: frames of render, or items of another stage, that were done, and those that were lost with a worker.
    """

    workers: int
    seconds: float
    attempted: int
    successful: int
    cores_used: float
    peak_memory_mib: float
    gpu_percent: float | None = None  # the mean of the probes, and the most memory; None on a machine without
    gpu_gib: float | None = None
    restarts: int
    failed: int

    @property
    def per_s(self) -> float:
        return self.successful / self.seconds


class StageRow(BaseModel):
    """What the watchdog saw of a stage of the run. launches: worker processes; modes: how workers were lost."""

    stage: str
    launches: int
    restarts: int
    seconds: float
    modes: dict[str, int]


class Bench(BaseModel):
    """`bench.json`: one row for each count of workers."""

    stage: str
    cores: int
    rows: list[BenchRun]


def run(cfg: RunConfig, run_folder: Path, out: Path, stage: str, workers: Iterable[int]) -> Bench:
    """Reads a run up to `stage`; writes `bench.json` and the events of each run; products go again.

    Raises:
        ConfigError: the stage has no items, or a server does them. ResumeError: `out` holds something.
    """
    if stage not in STAGES:
        raise ConfigError("not a stage that can be measured", where="--stage", got=stage, expected=", ".join(STAGES))
    if out.exists() and any(out.iterdir()):
        raise ResumeError("the folder is not empty", where=out, fix="choose another --out")
    asked = cfg.caption.teacher_kind not in EMBEDDED or cfg.caption.judge.url
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
    )
    write_model(out / "bench.json", bench, FORMAT)
    return bench


def _measured(cfg: RunConfig, run_folder: Path, folder: Path, stage: str, workers: int) -> BenchRun:
    """Run the stage once; gives its figures."""
    from cosfly.pipeline.run import stages

    log.info("bench: %s with %d worker%s", stage, workers, "s" if workers > 1 else "")
    cfg = cfg.model_copy(update={"workers": workers})
    next(s for s in stages(cfg, run_folder, into=folder) if s.name == stage).work()
    row = row_of(read_events(folder / stage), read_manifest(folder / stage), workers, counts_frames=stage == "render")
    os.replace(folder / stage / EVENTS, folder.with_suffix(".events.jsonl"))
    shutil.rmtree(folder)
    return row


def row_of(events: list[Event], manifest: Manifest, workers: int, *, counts_frames: bool) -> BenchRun:
    """Return the figures of one run from what its events and its manifest say."""
    done = [event for event in events if event.event == "item_done"]
    lost = [event for event in events if event.event in LOSSES]
    probes = [event for event in events if event.event == "probe"]
    loads = [probe.gpu_percent for probe in probes if probe.gpu_percent is not None]
    size = (lambda event: event.steps or 0) if counts_frames else (lambda event: 1)
    return BenchRun(
        workers=workers,
        seconds=manifest.seconds,
        attempted=sum(map(size, [*done, *lost])),
        successful=sum(size(event) for event in done if event.status == "kept"),
        cores_used=round(float(np.mean([probe.cores_used or 0.0 for probe in probes] or [0.0])), 2),
        peak_memory_mib=max((sum((probe.rss_mib or {}).values()) for probe in probes), default=0.0),
        gpu_percent=round(float(np.mean(loads)), 1) if loads else None,
        gpu_gib=round(max(probe.gpu_mib or 0.0 for probe in probes) / 1024.0, 2) if loads else None,
        restarts=sum(event.event == "restarted" for event in events),
        failed=manifest.counts.failed.total(),
    )


def stage_rows(run_folder: Path, names: Iterable[str]) -> list[StageRow]:
    """Return what the events of the finished stages of a run say."""
    rows = []
    for name in names:
        folder = run_folder / name
        if (folder / "manifest.json").is_file():
            events = read_events(folder)
            counts = Counter(event.event for event in events)
            restarts, seconds = counts["restarted"], read_manifest(folder).seconds
            counted = {"launches": counts["worker_started"] + restarts, "restarts": restarts, "seconds": seconds}
            rows.append(StageRow(stage=name, modes={k: n for k, n in counts.items() if k in LOSSES}, **counted))
    return rows


def tables(bench: Bench) -> dict[str, list[tuple[str, ...]]]:
    """Return how the stage scales (tab:render_scaling), and what that takes of a GPU where there is one.

    A table's first row is its head, the first column is a name.
    """
    unit, first = "frames" if bench.stage == "render" else "items", bench.rows[0].per_s
    scaling: list[tuple[str, ...]] = [
        ("workers", "wall s", "attempted", "successful", f"{unit}/s", "speed-up", "cores", "MiB", "restarts", "failed")
    ]
    for row in bench.rows:
        rates = f"{row.per_s:.2f}", f"{row.per_s / first:.2f}x", f"{row.cores_used:.2f}", f"{row.peak_memory_mib:.0f}"
        counts = str(row.attempted), str(row.successful)
        scaling.append((str(row.workers), f"{row.seconds:.1f}", *counts, *rates, str(row.restarts), str(row.failed)))
    found = {f"{bench.stage} on {bench.cores} cores": scaling}
    if any(row.gpu_percent is not None for row in bench.rows):
        used = [(str(row.workers), str(row.gpu_percent), str(row.gpu_gib)) for row in bench.rows]
        found["its NVIDIA devices"] = [("workers", "GPU %", "GPU GiB"), *used]
    return found
