"""`cosfly bench`: measure a stage of a finished run with several numbers of workers, from its events."""

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
from cosfly.runtime.limits import num_cpus
from cosfly.runtime.run_dir import Manifest, read_manifest

if TYPE_CHECKING:
    from cosfly.pipeline.settings import RunConfig

log = logging.getLogger(__name__)

FORMAT = FileFormat("cosfly.bench", "1.2")
STAGES = ("pedestrians", "plan", "render", "inspect", "caption", "release")  # those that process items


class BenchRun(BaseModel):
    """Figures of one run of the stage, which count frames of render and items of other stages."""

    workers: int
    seconds: float
    attempted: int  # done, or lost with a worker
    successful: int
    cores_used: float
    peak_memory_mib: float
    gpu_percent: float | None = None  # mean load; None without a GPU
    gpu_gib: float | None = None  # peak memory
    restarts: int
    failed: int

    @property
    def per_s(self) -> float:
        return self.successful / self.seconds


class Bench(BaseModel):
    """`bench.json`: one row for each number of workers."""

    stage: str
    cores: int
    rows: list[BenchRun]


def run(cfg: RunConfig, run_folder: Path, out: Path, stage: str, workers: Iterable[int]) -> Bench:
    """Read a run up to `stage`; write `bench.json` and the events of each measurement."""
    if stage not in STAGES:
        problem = "the benchmark cannot measure this stage"
        raise ConfigError(problem, where="--stage", got=stage, expected=f"one of {', '.join(STAGES)}")
    if out.exists() and any(out.iterdir()):
        raise ResumeError("the output directory is not empty", where=out, fix="choose another --out")
    if stage == "caption" and (cfg.caption.teacher_kind not in EMBEDDED or cfg.caption.judge.url):
        raise ConfigError(
            "the benchmark varies the workers, which a teacher or judge on a server does not use",
            where="caption.teacher",
            got=f"{cfg.caption.teacher}, and {'a' if cfg.caption.judge.url else 'no'} caption.judge.url",
            expected=f"{' or '.join(sorted(EMBEDDED))}, and no caption.judge.url",
            fix="pass --set caption.teacher=rules and remove caption.judge.url",
        )
    rows = [_measure(cfg, run_folder, out / f"workers_{count}", stage, count) for count in sorted(set(workers))]
    bench = Bench(stage=stage, cores=num_cpus(), rows=rows)
    write_model(out / "bench.json", bench, FORMAT)
    return bench


def _measure(cfg: RunConfig, run_folder: Path, folder: Path, stage: str, workers: int) -> BenchRun:
    from cosfly.pipeline.run import stages

    log.info("bench: %s with %d worker%s", stage, workers, "s" if workers > 1 else "")
    cfg = cfg.model_copy(update={"workers": workers})
    next(s for s in stages(cfg, run_folder, into=folder) if s.name == stage).work()
    events, manifest = read_events(folder / stage), read_manifest(folder / stage)
    row = bench_run(events, manifest, workers, counts_frames=stage == "render")
    os.replace(folder / stage / EVENTS, folder.with_suffix(".events.jsonl"))
    shutil.rmtree(folder)
    return row


def bench_run(events: list[Event], manifest: Manifest, workers: int, *, counts_frames: bool) -> BenchRun:
    """Return the figures of one run from its events and its manifest."""
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


def watchdog_figures(folder: Path) -> tuple[int, int, float, dict[str, int]]:
    """Return the watchdog's figures of a finished stage: worker processes, restarts, seconds, and losses by kind."""
    counts = Counter(event.event for event in read_events(folder))
    losses: dict[str, int] = {kind: count for kind, count in counts.items() if kind in LOSSES}
    restarts = counts["restarted"]
    return counts["worker_started"] + restarts, restarts, read_manifest(folder).seconds, losses


def tables(bench: Bench) -> dict[str, list[tuple[str, ...]]]:
    """Return title -> table: how the stage scales (tab:render_scaling), and its GPU where there is one.

    The first row of a table is its head, the first column is a name.
    """
    rate = "frames/s" if bench.stage == "render" else "items/s"
    first_per_s = bench.rows[0].per_s
    columns = {
        "workers": "{0.workers}", "wall s": "{0.seconds:.1f}", "attempted": "{0.attempted}",
        "successful": "{0.successful}", rate: "{0.per_s:.2f}", "speed-up": "{1:.2f}x", "cores": "{0.cores_used:.2f}",
        "MiB": "{0.peak_memory_mib:.0f}", "restarts": "{0.restarts}", "failed": "{0.failed}",
    }  # fmt: skip
    rows = [tuple(text.format(row, row.per_s / first_per_s) for text in columns.values()) for row in bench.rows]
    titled: dict[str, list[tuple[str, ...]]] = {f"{bench.stage} on {bench.cores} cores": [tuple(columns), *rows]}
    if any(row.gpu_percent is not None for row in bench.rows):
        used = [(str(row.workers), str(row.gpu_percent), str(row.gpu_gib)) for row in bench.rows]
        titled["NVIDIA GPUs"] = [("workers", "GPU %", "GPU GiB"), *used]
    return titled
