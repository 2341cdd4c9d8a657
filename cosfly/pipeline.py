"""The stages in order, inside one run folder: `cosfly run`. Resumes where it stopped."""

from __future__ import annotations

import logging
import platform
import resource
import sys
from collections.abc import Callable
from dataclasses import dataclass
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
from cosfly.errors import NoPathError
from cosfly.gallery import contact_sheet, preview_gif
from cosfly.settings import RunConfig, num_workers
from cosfly.stage_folder import Resume, StageFolder
from cosfly.store import read_json, write_bytes, write_json

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StageResult:
    """One row of the closing table."""

    stage: str
    product: Path
    manifest: dict
    was_complete: bool


@dataclass(frozen=True)
class Stage:
    """One stage of a run: `work` fills `folder` and is safe to call again."""

    name: str
    folder: Path
    product: Path
    work: Callable[[], Path]


def stages(cfg: RunConfig, out: Path, *, resume: Resume = "if-same") -> list[Stage]:
    """Give the stages of a run in order, with all their paths."""
    seed, workers = cfg.seed, num_workers(cfg.workers)
    spread: dict[str, Any] = {"workers": workers, "resume": resume}
    names = ("maps", "simplify", "pedestrians", "plan", "render", "inspect", "caption", "release")
    to = {name: out / name for name in names}
    boxes, simplified = to["maps"] / "boxes_3d.json", to["simplify"] / "step2_simplified.json"
    paths, traces = to["pedestrians"] / "path.json", to["plan"] / "drone_trace.json"
    tree, inspected = to["render"], to["inspect"] / "inspect.json"
    captions, published = to["caption"] / "captions.jsonl", to["release"] / "dataset"
    works: dict[str, tuple[Path, Callable[[], Path]]] = {
        "maps": (boxes, lambda: cosfly.maps.stage.run(cfg.maps, to["maps"], seed=seed, resume=resume)),
        "simplify": (simplified, lambda: cosfly.simplify.stage.run(cfg.simplify, boxes, to["simplify"], resume=resume)),
        "pedestrians": (
            paths,
            lambda: cosfly.pedestrians.stage.run(
                cfg.pedestrians, simplified, to["pedestrians"], seed=seed, roi=cfg.roi, **spread
            ),
        ),
        "plan": (
            traces,
            lambda: cosfly.planners.stage.run(cfg.plan, simplified, paths, to["plan"], seed=seed, **spread),
        ),
        "render": (
            tree,
            lambda: cosfly.render.stage.run(cfg.render, boxes, simplified, traces, tree, seed=seed, **spread),
        ),
        "inspect": (inspected, lambda: cosfly.inspection.stage.run(cfg.inspect, traces, tree, to["inspect"], **spread)),
        "caption": (captions, lambda: caption.run.stage.run(cfg.caption, tree, to["caption"], seed=seed, **spread)),
        "release": (
            published,
            lambda: release.package.run(cfg.release, tree, captions, inspected, to["release"], **spread),
        ),
    }
    return [Stage(name, to[name], *works[name]) for name in names]


def run(cfg: RunConfig, out: Path, *, resume: Resume = "if-same") -> list[StageResult]:
    """Make a data set: reads what the configuration names, writes one folder per stage below `out`.

    Every stage is complete or resumable at any moment; running again continues. Ends with `contact_sheet.png`, `preview.gif`
    and `summary.json` in the run folder.
    """
    todo = stages(cfg, out, resume=resume)
    _save_run(cfg, out)
    results = []
    for number, stage in enumerate(todo, 1):
        was_complete = (stage.folder / "manifest.json").exists()
        log.info("[%d/%d] %s%s", number, len(todo), stage.name, ": already complete" if was_complete else "")
        stage.work()
        manifest = StageFolder(stage.folder, stage.name, is_complete=True).manifest()
        if manifest["counts"]["kept"] == 0:
            raise NoPathError(
                "the stage kept nothing, so there is nothing for the next one",
                where=stage.folder,
                got=str({word: manifest["counts"][word] for word in ("dropped", "failed")}),
                fix=f"see {stage.folder / 'failures.jsonl'}, change the settings and choose another --out",
            )
        results.append(StageResult(stage.name, stage.product, manifest, was_complete))
    tree = out / "render"
    if not all(result.was_complete for result in results) or not (out / "preview.gif").exists():
        contact_sheet(tree, out / "contact_sheet.png")
        preview_gif(tree, out / "preview.gif")
    _save_summary(results, out)
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
    rows = [{"stage": r.stage, "counts": r.manifest["counts"], "seconds": r.manifest["seconds"]} for r in results]
    write_json(path, {"stages": rows, "peak_memory_mb": round(max(before, peak_mb), 1)})
