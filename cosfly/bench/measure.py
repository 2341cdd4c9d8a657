"""Runs one stage of a finished run again, with several counts of workers and with planted faults; figures from its events."""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from caption.teachers.teacher import EMBEDDED
from cosfly.app.pipeline import Stage, stages
from cosfly.app.settings import RunConfig
from cosfly.bench.faults import Faults, planted
from cosfly.bench.picture import draw_events, draw_scaling
from cosfly.bench.tables import Bench, Row, markdown, stage_rows
from cosfly.errors import ConfigError, EnvironmentMissing, ResumeError
from cosfly.work.stage_events import EVENTS, Event, read_events
from cosfly.work.stage_folder import Manifest, read_manifest
from cosfly.work.store import write_bytes, write_model
from cosfly.work.worker_pool import WORDS

log = logging.getLogger(__name__)

MOST_ATTEMPTS = 5  # at a stage that stops because its workers are killed all the time
SCHEMA, VERSION = "cosfly.bench", "1.0"
STAGES = ("pedestrians", "plan", "render", "inspect", "caption", "release")  # those that do items


def run(
    cfg: RunConfig,
    run_folder: Path,
    out: Path,
    stage: str,
    workers: Iterable[int],
    faults: dict[str, int],
    seed: int = 0,
) -> Bench:
    """Read a run up to `stage`, write `bench.json`, its tables and figure, and a picture of the events of each run; give what was
    measured.

    The stage's products are removed again. Faults are planted with the greatest number of workers.

    Args:
        faults: kind of SIGNALS -> how often.
    Raises:
        ConfigError: the stage has no items, or a server does them. ResumeError: `out` holds something.
    """
    if stage not in STAGES:
        raise ConfigError("not a stage that can be measured", where="--stage", got=stage, expected=", ".join(STAGES))
    if out.exists() and any(out.iterdir()):
        raise ResumeError("the folder is not empty", where=out, fix="choose another --out")
    if stage == "caption" and (cfg.caption.teacher_kind not in EMBEDDED or cfg.caption.judge.url is not None):
        raise ConfigError(
            "captions that a server writes are no work of workers",
            where="caption.teacher",
            got=cfg.caption.teacher,
            expected="an embedded teacher, and no judge",
            fix="--set caption.teacher=rules",
        )
    counts = sorted(set(workers))
    bench = Bench(stage=stage, cores=len(os.sched_getaffinity(0)), rows=[])
    digests: dict[str, str] = {}
    for count in counts:
        row, digests = _measured(cfg, run_folder, out / f"workers_{count}", stage, count)
        bench.rows.append(row)
    for kind, number in faults.items():
        if number:
            planned = Faults(kind, number, bench.rows[len(counts) - 1].seconds, seed)
            row, found = _measured(cfg, run_folder, out / kind, stage, counts[-1], planned)
            bench.rows.append(row.model_copy(update={"same_products": found == digests}))
    bench.stages = stage_rows(run_folder, STAGES)
    write_bytes(out / "bench.md", markdown(bench).encode())
    write_bytes(out / "bench.png", draw_scaling(bench))
    write_model(out / "bench.json", bench, schema=SCHEMA, version=VERSION)
    return bench


def _measured(
    cfg: RunConfig,
    run_folder: Path,
    folder: Path,
    stage: str,
    workers: int,
    faults: Faults | None = None,
) -> tuple[Row, dict[str, str]]:
    """Run the stage once; gives its figures, and the digest of each product."""
    cfg = cfg.model_copy(update={"workers": workers})
    todo = next(s for s in stages(cfg, run_folder, into=folder) if s.name == stage)
    kind = faults.kind if faults else "none"
    log.info("bench: %s with %d worker%s, faults: %s", stage, workers, "s" if workers > 1 else "", kind)
    begin_s, attempts = time.monotonic(), 0
    with planted(faults, folder / stage) as moments_s:
        while attempts == 0 or not (folder / stage / "manifest.json").exists():
            attempts += 1
            _work(todo, may_stop=attempts < MOST_ATTEMPTS)
    manifest, events = read_manifest(folder / stage), read_events(folder / stage)
    row = row_of(events, manifest, workers, counts_frames=stage == "render")
    about = {"fault": kind, "planted": len(moments_s), "attempts": attempts}
    row = row.model_copy(update=about | {"seconds": round(time.monotonic() - begin_s, 1)})
    os.replace(folder / stage / EVENTS, folder.with_suffix(".events.jsonl"))
    shutil.rmtree(folder)
    write_bytes(
        folder.with_suffix(".png"),
        draw_events(events, f"{stage}, {workers} worker{'s' if workers > 1 else ''}, faults: {kind}"),
    )
    return row, {output.path: output.sha256 for output in manifest.outputs}


def _work(stage: Stage, may_stop: bool) -> None:
    """Run a stage; where it stops because too many workers were lost, it is left as it is and can go on."""
    try:
        stage.work()
    except EnvironmentMissing as error:
        if not may_stop:
            raise
        log.warning("bench: %s; the same command again", error)


def row_of(events: list[Event], manifest: Manifest, workers: int, *, counts_frames: bool) -> Row:
    """Give the figures of one run from what its events and its manifest say."""
    done = [event for event in events if event.event == "item_done"]
    lost = [event for event in events if event.event in WORDS]
    retried = {event.item for event in events if event.event == "retried"}
    probes = [event for event in events if event.event == "probe"]
    successful = [event for event in done if event.status == "kept"]
    size = (lambda event: event.steps or 0) if counts_frames else (lambda event: 1)
    return Row(
        workers=workers,
        seconds=manifest.seconds,
        attempted=sum(map(size, [*done, *lost])),
        successful=sum(map(size, successful)),
        cores_used=round(float(np.mean([probe.cores_used or 0.0 for probe in probes] or [0.0])), 2),
        peak_memory_mib=max((sum((probe.rss_mib or {}).values()) for probe in probes), default=0.0),
        noticed=len(lost),
        restarts=sum(event.event == "restarted" for event in events),
        retries=sum(event.event == "retried" for event in events),
        recovered=len(retried & {event.item for event in successful}),
        failed=manifest.counts.failed.total(),
    )
