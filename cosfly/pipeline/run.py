"""`cosfly run`: the stages in order, in one run directory. Resumes where it stopped."""

import contextlib
import logging
import platform
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import yaml

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
from cosfly.runtime.run_dir import Manifest, hold_folder, read_manifest
from cosfly.viz.gallery import contact_sheet
from cosfly.viz.viewer import run as write_viewer
from release.build.sources import Source, choose_licence

log = logging.getLogger(__name__)


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


def stages(cfg: RunConfig, out: Path) -> list[Stage]:
    """Return the stages of a run in order; each works in the folder of its name in the run directory."""
    seed = cfg.seed
    pool = worker_options(cfg)
    boxes = out / "maps/boxes_3d.json"
    simplified = out / "simplify/step2_simplified.json"
    paths = out / "pedestrians/path.json"
    others = paths.with_name(BYSTANDERS_FILE) if cfg.pedestrians.others else None
    traces = out / "plan/drone_trace.json"
    tree = out / "render"
    sources = [Source.of_files(tree, out / "caption/captions.jsonl", out / "inspect/inspect.json")]

    def stage(name: str, run: Callable[..., Path], *inputs: Any, **options: Any) -> Stage:
        return Stage(name, partial(run, getattr(cfg, name), *inputs, out / name, **options))

    return [
        stage("maps", cosfly.maps.stage.run, seed=seed, follow_links=cfg.follow_links),
        stage("simplify", cosfly.simplify.stage.run, boxes),
        stage("pedestrians", cosfly.pedestrians.stage.run, simplified, roi=cfg.roi, seed=seed, **pool),
        stage("plan", cosfly.planners.stage.run, simplified, paths, seed=seed, **pool),
        stage("render", cosfly.render.stage.run, boxes, simplified, traces, others=others, seed=seed, **pool),
        stage("inspect", cosfly.inspection.stage.run, simplified, traces, tree, **pool),
        stage("caption", caption.stage.stage.run, tree, seed=seed, **pool),
        joint_release(cfg, sources, out),
    ]


def joint_release(cfg: RunConfig, sources: list[Source], out: Path) -> Stage:
    """Return the stage that releases one or more runs together."""
    options = worker_options(cfg)
    return Stage("release", partial(release.build.stage.run, cfg.release, sources, out / "release", **options))


def run(cfg: RunConfig, out: Path, *, until: str = "release") -> list[StageResult]:
    """Make a data set: read what the configuration names, write one folder per stage below `out`.

    With several towns each town has its own run directory below `out`, and one `release` is made of all. Every stage is
    complete or resumable at any moment. The run ends with `contact_sheet.png` and `viewer.html`.
    """
    out = cfg.opened(out)
    num_stages = STAGES.index(until) + 1
    check_out(out)
    towns = cfg.all_towns()
    if until == "release":
        check(cfg)
    if not towns:
        return _run_town(cfg, out, stages(cfg, out)[:num_stages])
    with _run_directory(cfg, out):
        results = []
        for number, (name, town) in enumerate(towns.items(), 1):
            log.info("town %d of %d: %s", number, len(towns), name)
            town_stages = stages(town, out / name)[:-1]  # the release is made of all towns
            for result in _run_town(town, out / name, town_stages[:num_stages]):
                results.append(replace(result, stage=replace(result.stage, name=f"{name}/{result.stage.name}")))
        if until == "release":
            joint = joint_release(cfg, [Source.of_run(out / name) for name in towns], out)
            results.append(_run_stage(joint, out, "all towns"))
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
        _check_rendered("modalities", cfg.release.modalities, town.render.modalities, "pictures")
        if cfg.release.pairs == "both":
            _check_rendered("tracks", cfg.release.tracks, town.render.tracks, "tracks")


def _check_rendered(setting: str, released: Collection[str], rendered: Collection[str], noun: str) -> None:
    missing = ", ".join(sorted(set(released) - set(rendered)))
    if missing:
        got = ", ".join(rendered)
        what = f"release.{setting} contains {missing}, but the run does not render these {noun}"
        fix = f"add {missing} to render.{setting}, or pass --set 'release.{setting}=[{got}]'"
        raise ConfigError(what, where=f"render.{setting}", got=got, fix=fix)


def check_out(out: Path) -> None:
    """Refuse to make a run in the folder of a stage: its tree would hold a second one."""
    if (out / "stage.json").exists() and not (out / "run.yaml").exists():
        what = "the output directory contains the output of a single stage, not of a run"
        fix = "choose another --out, such as the run directory above this folder"
        raise ResumeError(what, where=out, got="stage.json, but no run.yaml", fix=fix)


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
    with _run_directory(cfg, out):
        results = [_run_stage(stage, out, f"{k}/{len(town_stages)}") for k, stage in enumerate(town_stages, 1)]
        viewer = out / "viewer.html"  # written last: current if it is newer than all manifests
        finished_ns = [(out / stage.name / "manifest.json").stat().st_mtime_ns for stage in town_stages]
        is_shown = viewer.exists() and viewer.stat().st_mtime_ns > max(finished_ns)
        if (out / "render/manifest.json").exists() and not is_shown:
            contact_sheet(out / "render", out / "contact_sheet.png")
            write_viewer(out, viewer)
    return results


def _run_stage(stage: Stage, out: Path, progress: str) -> StageResult:
    """Run a stage; a complete stage refuses other settings, and continues if there is more to do."""
    folder = out / stage.name
    before = read_manifest(folder) if (folder / "manifest.json").exists() else None
    log.info("[%s] %s", progress, stage.name)
    stage.work()
    after = read_manifest(folder)
    return StageResult(stage, after, before == after)


def _save_run(cfg: RunConfig, out: Path) -> None:
    """Write `run.yaml`: the resolved configuration, which can be run as it is."""
    header = f"# cosfly {cosfly.__version__}, Python {platform.python_version()}, {platform.platform()}\n"
    text = header + yaml.safe_dump(cfg.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    write_bytes(out / "run.yaml", text.encode())
