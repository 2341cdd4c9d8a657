"""The stages in order, inside one run folder: `cosfly run`. Resumes where it stopped."""

from __future__ import annotations

import logging
import platform
import resource
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import yaml

import caption.run.stage
import cosfly
import cosfly.inspection.stage
import cosfly.maps.stage
import cosfly.pedestrians.stage
import cosfly.planners.stage
import cosfly.render.stage
import cosfly.simplify.stage
import release.package
from cosfly.folder_lock import hold_folder
from cosfly.gallery import contact_sheet, preview_gif
from cosfly.planners.ahead import compiled_ahead
from cosfly.settings import RunConfig, manner_of_work
from cosfly.stage_folder import Manifest, Resume, read_manifest
from cosfly.store import read_json, refuse_link, write_bytes, write_json
from release.sources import Source, choose_licence

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stage:
    """One stage of a run: `work` makes `product` in the stage's folder and is safe to call again."""

    name: str
    product: Path
    work: Callable[[], Path]


@dataclass(frozen=True)
class StageResult:
    """One row of the closing table."""

    stage: Stage
    manifest: Manifest
    was_complete: bool


def stages(cfg: RunConfig, out: Path, *, resume: Resume = "if-same") -> list[Stage]:
    """Give the stages of a run in order; each works in the folder of its name."""
    seed, working = cfg.seed, manner_of_work(cfg)
    boxes, simplified = out / "maps/boxes_3d.json", out / "simplify/step2_simplified.json"
    walks, traces, tree = out / "pedestrians/path.json", out / "plan/drone_trace.json", out / "render"
    inspected, captions = out / "inspect/inspect.json", out / "caption/captions.jsonl"

    whole = [Source.of_files(tree, captions, inspected)]

    def stage(name: str, product: Path, run: Callable[..., Path], *inputs: Any, **options: Any) -> Stage:
        return Stage(name, product, partial(run, getattr(cfg, name), *inputs, out / name, resume=resume, **options))

    return [
        stage("maps", boxes, cosfly.maps.stage.run, seed=seed),
        stage("simplify", simplified, cosfly.simplify.stage.run, boxes),
        stage("pedestrians", walks, cosfly.pedestrians.stage.run, simplified, roi=cfg.roi, seed=seed, **working),
        stage("plan", traces, cosfly.planners.stage.run, simplified, walks, seed=seed, **working),
        stage("render", tree, cosfly.render.stage.run, boxes, simplified, traces, seed=seed, **working),
        stage("inspect", inspected, cosfly.inspection.stage.run, simplified, traces, tree, **working),
        stage("caption", captions, caption.run.stage.run, tree, seed=seed, **working),
        stage("release", out / "release/dataset", release.package.run, whole, **working),
    ]


def run(cfg: RunConfig, out: Path, *, resume: Resume = "if-same") -> list[StageResult]:
    """Make a data set: reads what the configuration names, writes one folder per stage below `out`.

    Every stage is complete or resumable at any moment; running again continues. Ends with `contact_sheet.png`, `preview.gif`
    and `summary.json` in the run folder.
    """
    choose_licence(cfg.release.licence, [(cfg.maps.source, cfg.maps.licence)])  # the last stage would ask for it
    todo = stages(cfg, out, resume=resume)
    for stage in todo:
        refuse_link(out / stage.name)
    with hold_folder(out):
        is_new = not (out / "run.yaml").exists()
        if is_new:
            _save_run(cfg, out)
        results = _work(cfg, out, todo)
        tree = out / "render"
        if not all(result.was_complete for result in results) or not (out / "preview.gif").exists():
            contact_sheet(tree, out / "contact_sheet.png")
            preview_gif(tree, out / "preview.gif")
        _save_summary(results, out)
        if not is_new:
            _save_run(cfg, out)  # not before every stage has taken these settings
    return results


def _work(cfg: RunConfig, out: Path, todo: list[Stage]) -> list[StageResult]:
    """Do the stages that are not complete."""
    results = []
    to_plan = not (out / "plan/manifest.json").exists()
    with compiled_ahead(cfg.plan.planner, needed=to_plan) as wait_for_compiled:
        for number, stage in enumerate(todo, 1):
            was_complete = (out / stage.name / "manifest.json").exists()
            if not was_complete:
                log.info("[%d/%d] %s", number, len(todo), stage.name)
            if stage.name == "plan" and not was_complete:
                wait_for_compiled()
            stage.work()  # refuses work of other settings, also where it is complete
            if was_complete:
                log.info("[%d/%d] %s: already complete", number, len(todo), stage.name)
            results.append(StageResult(stage, read_manifest(out / stage.name), was_complete))
    return results


def _save_run(cfg: RunConfig, out: Path) -> None:
    """Write `run.yaml`: the resolved configuration, which runs as it is."""
    header = f"# cosfly {cosfly.__version__}, Python {platform.python_version()}, {platform.platform()}\n"
    text = header + yaml.safe_dump(cfg.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    write_bytes(out / "run.yaml", text.encode())


def _save_summary(results: list[StageResult], out: Path) -> None:
    """Write `summary.json`: counts, seconds and peak memory. A resumed run adds to the peak of the one before."""
    path = out / "summary.json"
    before = read_json(path).get("peak_memory_mb", 0) if path.exists() else 0
    unit = 1024 * 1024 if sys.platform == "darwin" else 1024
    peak_mb = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / unit
    rows = [
        {"stage": r.stage.name, "counts": r.manifest.counts.model_dump(), "seconds": r.manifest.seconds}
        for r in results
    ]
    write_json(path, {"stages": rows, "peak_memory_mb": round(max(before, peak_mb), 1)})
