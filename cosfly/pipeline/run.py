"""`cosfly run`: the stages in order, in one run directory. Resumes where it stopped."""

from __future__ import annotations

import contextlib
import logging
import platform
import resource
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

import caption.stage.stage
import cosfly
import cosfly.inspection.stage
import cosfly.maps.stage
import cosfly.pedestrians.stage
import cosfly.planners.stage
import cosfly.render.stage
import cosfly.simplify.stage
import release.build.stage
from cosfly.formats.bystanders import BYSTANDERS_FILE
from cosfly.pipeline.command_settings import worker_options
from cosfly.pipeline.runs import STAGES
from cosfly.pipeline.settings import RunConfig, run_checks
from cosfly.runtime.errors import ConfigError, InputError, ResumeError
from cosfly.runtime.io import write_bytes
from cosfly.runtime.json_io import read_object, validated, write_json
from cosfly.runtime.run_dir import Manifest, Resume, hold_folder, read_manifest
from cosfly.viz.gallery import contact_sheet
from cosfly.viz.viewer import run as write_viewer
from release.build.sources import Source, choose_licence

log = logging.getLogger(__name__)


class RunTotals(BaseModel):
    """`summary.json` of a run: counts and seconds of its stages."""

    stages: list[dict[str, Any]] = []
    peak_memory_mb: float = 0.0

    @classmethod
    def of(cls, run: Path) -> RunTotals:
        path = run / "summary.json"
        return validated(cls, read_object(path, what="summary"), path) if path.exists() else cls()


@dataclass(frozen=True)
class Stage:
    """One stage of a run: `work` makes its product in the folder of its name and may be called again."""

    name: str
    work: Callable[[], Path]


@dataclass(frozen=True)
class StageResult:
    """One row of the closing table."""

    stage: Stage
    manifest: Manifest
    was_complete: bool


def stages(cfg: RunConfig, out: Path, *, resume: Resume = "if-same") -> list[Stage]:
    """Return the stages of a run in order; each works in the folder of its name in the run directory."""
    seed = cfg.seed
    pool = worker_options(cfg)
    boxes = out / "maps/boxes_3d.json"
    simplified = out / "simplify/step2_simplified.json"
    paths = out / "pedestrians/path.json"
    others = paths.with_name(BYSTANDERS_FILE) if cfg.pedestrians.has_others else None
    traces = out / "plan/drone_trace.json"
    tree = out / "render"
    sources = [Source.of_files(tree, out / "caption/captions.jsonl", out / "inspect/inspect.json")]

    def stage(name: str, run: Callable[..., Path], *inputs: Any, **options: Any) -> Stage:
        return Stage(name, partial(run, getattr(cfg, name), *inputs, out / name, resume=resume, **options))

    return [
        stage("maps", cosfly.maps.stage.run, seed=seed, follow_links=cfg.follow_links),
        stage("simplify", cosfly.simplify.stage.run, boxes),
        stage("pedestrians", cosfly.pedestrians.stage.run, simplified, roi=cfg.roi, seed=seed, **pool),
        stage("plan", cosfly.planners.stage.run, simplified, paths, seed=seed, **pool),
        stage("render", cosfly.render.stage.run, boxes, simplified, traces, others=others, seed=seed, **pool),
        stage("inspect", cosfly.inspection.stage.run, simplified, traces, tree, **pool),
        stage("caption", caption.stage.stage.run, tree, seed=seed, **pool),
        joint_release(cfg, sources, out, resume),
    ]


def joint_release(cfg: RunConfig, sources: list[Source], out: Path, resume: Resume) -> Stage:
    """Return the stage that releases one or more runs together."""
    options: dict[str, Any] = {"resume": resume, **worker_options(cfg)}
    return Stage("release", partial(release.build.stage.run, cfg.release, sources, out / "release", **options))


def run(cfg: RunConfig, out: Path, *, resume: Resume = "if-same", until: str = "release") -> list[StageResult]:
    """Make a data set: read what the configuration names, write one folder per stage below `out`.

    With several towns each town has its own run directory below `out`, and one `release` is made of all. Every stage is
    complete or resumable at any moment. The run ends with `contact_sheet.png`, `viewer.html` and `summary.json`.
    """
    out = cfg.opened(out)
    num_stages = STAGES.index(until) + 1
    check_out(out)
    towns = cfg.all_towns()
    if until == "release":
        check(cfg)
    if not towns:
        return _run_town(cfg, out, stages(cfg, out, resume=resume)[:num_stages])
    with _run_directory(cfg, out):
        results = []
        for number, (name, town) in enumerate(towns.items(), 1):
            log.info("town %d of %d: %s", number, len(towns), name)
            town_stages = stages(town, out / name, resume=resume)[:-1]  # the release is made of all towns
            for result in _run_town(town, out / name, town_stages[:num_stages]):
                results.append(replace(result, stage=replace(result.stage, name=f"{name}/{result.stage.name}")))
        if until == "release":
            joint = joint_release(cfg, [Source.of_run(out / name) for name in towns], out, resume)
            results.append(_run_stage(joint, out, "all towns"))
        _save_summary(results, out)
    return results


@contextlib.contextmanager
def _run_directory(cfg: RunConfig, out: Path) -> Iterator[None]:
    """Lock a run directory and write its `run.yaml`.

    A run without a finished map writes it at once; any other when all stages have accepted the settings.
    """
    with hold_folder(out):
        is_new = not any(any(out.glob(maps)) for maps in ("maps/manifest.json", "*/maps/manifest.json"))
        if is_new or not (out / "run.yaml").exists():
            _save_run(cfg, out)
        yield
        if not is_new:
            _save_run(cfg, out)


def check(cfg: RunConfig) -> None:
    """Check, before the first stage, the requirements of the release."""
    towns = cfg.all_towns()
    maps = [(name, town.maps.licence) for name, town in towns.items()] or [(cfg.maps.source, cfg.maps.licence)]
    choose_licence(cfg.release.licence, maps)
    for town in towns.values() or [cfg]:
        if missing := ", ".join(sorted(set(cfg.release.modalities) - set(town.render.modalities))):
            rendered = ", ".join(town.render.modalities)
            raise ConfigError(
                f"release.modalities contains {missing}, but the run does not render these pictures",
                where="render.modalities",
                got=rendered,
                fix=f"add {missing} to render.modalities, or pass --set 'release.modalities=[{rendered}]'",
            )
        absent = ", ".join(sorted(set(cfg.release.tracks) - set(town.render.tracks)))
        if cfg.release.pairs == "both" and absent:
            rendered = ", ".join(town.render.tracks)
            raise ConfigError(
                f"release.tracks contains {absent}, but the run does not render these tracks",
                where="render.tracks",
                got=rendered,
                fix=f"add {absent} to render.tracks, or pass --set 'release.tracks=[{rendered}]'",
            )


def check_out(out: Path) -> None:
    """Refuse to make a run in the folder of a stage: its tree would hold a second one."""
    if (out / "stage.json").exists() and not (out / "run.yaml").exists():
        raise ResumeError(
            "the output directory contains the output of a single stage, not of a run",
            where=out,
            got="stage.json, but no run.yaml",
            fix="choose another --out, such as the run directory above this folder",
        )


def check_with_files(cfg: RunConfig) -> None:
    """Check the requirements of the last stage, and that the files of all maps exist."""
    towns = cfg.all_towns().values() or [cfg]
    run_checks([partial(check, cfg), *(partial(_check_files, town) for town in towns)], cfg.name)


def _check_files(cfg: RunConfig) -> None:
    files = getattr(cfg.maps, cfg.maps.source).inputs()
    if missing := {name: str(path) for name, path in files.items() if not path.exists()}:
        where = f"maps.{cfg.maps.source}: {', '.join(missing)}"
        problem = f"an input file of the map does not exist: {', '.join(missing.values())}"
        raise InputError(problem, where=where, fix="correct the paths in these settings")


def _run_town(cfg: RunConfig, out: Path, town_stages: list[Stage]) -> list[StageResult]:
    """Run the stages of one town."""
    with _run_directory(cfg, out):
        results = [_run_stage(stage, out, f"{k}/{len(town_stages)}") for k, stage in enumerate(town_stages, 1)]
        # summary.json is written after the pictures, so they are up to date if it has these very stages.
        is_shown = RunTotals.of(out).stages == _rows(results) and (out / "viewer.html").exists()
        if (out / "render/manifest.json").exists() and not is_shown:
            contact_sheet(out / "render", out / "contact_sheet.png")
            write_viewer(out, out / "viewer.html")
        _save_summary(results, out)
    return results


def _run_stage(stage: Stage, out: Path, progress: str) -> StageResult:
    """Run a stage; a complete stage refuses other settings, and continues if there is more to do."""
    folder = out / stage.name
    before = read_manifest(folder) if (folder / "manifest.json").exists() else None
    if before is None:
        log.info("[%s] %s", progress, stage.name)
    stage.work()
    after = read_manifest(folder)
    if before == after:
        log.info("[%s] %s: already complete", progress, stage.name)
    return StageResult(stage, after, before == after)


def _save_run(cfg: RunConfig, out: Path) -> None:
    """Write `run.yaml`: the resolved configuration, which can be run as it is."""
    header = f"# cosfly {cosfly.__version__}, Python {platform.python_version()}, {platform.platform()}\n"
    text = header + yaml.safe_dump(cfg.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    write_bytes(out / "run.yaml", text.encode())


def _rows(results: list[StageResult]) -> list[dict[str, Any]]:
    return [
        {
            "stage": result.stage.name,
            "counts": result.manifest.counts.model_dump(mode="json"),
            "seconds": result.manifest.seconds,
        }
        for result in results
    ]


def _save_summary(results: list[StageResult], out: Path) -> None:
    """Write `summary.json`; the peak memory is that of a resumed run if it was larger."""
    unit = 1024 * 1024 if sys.platform == "darwin" else 1024
    peak_mb = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / unit
    peak_mb = round(max(RunTotals.of(out).peak_memory_mb, peak_mb), 1)
    write_json(out / "summary.json", {"stages": _rows(results), "peak_memory_mb": peak_mb})
