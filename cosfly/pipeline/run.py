"""The stages in order, inside one run folder: `cosfly run`. Resumes where it stopped."""

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

import caption.run.stage
import cosfly
import cosfly.inspection.stage
import cosfly.maps.stage
import cosfly.pedestrians.stage
import cosfly.planners.stage
import cosfly.render.stage
import cosfly.simplify.stage
import release.package.stage
from cosfly.formats.bystanders import OTHERS_FILE
from cosfly.pipeline.command_settings import worker_options
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.errors import ConfigError, CosflyError, InputError, ResumeError
from cosfly.runtime.io import refuse_link, write_bytes
from cosfly.runtime.json_io import read_object, write_json
from cosfly.runtime.run_dir import Manifest, Resume, hold_folder, read_manifest
from cosfly.viz.gallery import contact_sheet
from release.package.sources import Source, choose_licence
from release.viewer.content import ViewerConfig
from release.viewer.page import run as write_viewer

log = logging.getLogger(__name__)

SUMMARY = "summary.json"


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


def stages(cfg: RunConfig, out: Path, *, resume: Resume = "if-same", into: Path | None = None) -> list[Stage]:
    """Return the stages of a run in order; each works in the folder of its name, of the run or of `into`."""
    seed, working = cfg.seed, worker_options(cfg)
    boxes, simplified = out / "maps/boxes_3d.json", out / "simplify/step2_simplified.json"
    walks, traces, tree = out / "pedestrians/path.json", out / "plan/drone_trace.json", out / "render"
    others = walks.with_name(OTHERS_FILE) if cfg.pedestrians.has_others else None
    inspected, captions = out / "inspect/inspect.json", out / "caption/captions.jsonl"

    whole = [Source.of_files(tree, captions, inspected)]

    def stage(name: str, product: Path, run: Callable[..., Path], *inputs: Any, **options: Any) -> Stage:
        return Stage(
            name, product, partial(run, getattr(cfg, name), *inputs, (into or out) / name, resume=resume, **options)
        )

    return [
        stage("maps", boxes, cosfly.maps.stage.run, seed=seed, follow_links=cfg.follow_links),
        stage("simplify", simplified, cosfly.simplify.stage.run, boxes),
        stage("pedestrians", walks, cosfly.pedestrians.stage.run, simplified, roi=cfg.roi, seed=seed, **working),
        stage("plan", traces, cosfly.planners.stage.run, simplified, walks, seed=seed, **working),
        stage("render", tree, cosfly.render.stage.run, boxes, simplified, traces, others=others, seed=seed, **working),
        stage("inspect", inspected, cosfly.inspection.stage.run, simplified, traces, tree, **working),
        stage("caption", captions, caption.run.stage.run, tree, seed=seed, **working),
        joint_release(cfg, whole, into or out, resume),
    ]


def joint_release(cfg: RunConfig, sources: list[Source], out: Path, resume: Resume) -> Stage:
    """Return the stage that releases runs together."""
    work = partial(
        release.package.stage.run, cfg.release, sources, out / "release", resume=resume, **worker_options(cfg)
    )
    return Stage("release", out / "release/dataset", work)


def run(cfg: RunConfig, out: Path, *, resume: Resume = "if-same", until: str = "release") -> list[StageResult]:
    """Make a data set: reads what the configuration names, writes one folder per stage below `out`; of several towns
    one run folder for each, and `release`.

    Args:
        until: the last stage that is done.

    Every stage is complete or resumable at any moment; running again continues. Ends with `contact_sheet.png`,
    `viewer.html` and `summary.json` in the run directory, or in that of each town if there are several.
    """
    out = cfg.opened(out)
    check_out(out)
    towns = check(cfg)
    if not towns:
        return _run_town(cfg, out, _up_to(until, stages(cfg, out, resume=resume)))
    for name in (*towns, "release"):
        refuse_link(out / name)
    with _run_folder(cfg, out):
        results = []
        for number, (name, town) in enumerate(towns.items(), 1):
            log.info("town %d of %d: %s", number, len(towns), name)
            own = _up_to(until, stages(town, out / name, resume=resume)[:-1])  # the release is made of all
            made = _run_town(town, out / name, own)
            results += [replace(one, stage=replace(one.stage, name=f"{name}/{one.stage.name}")) for one in made]
        if until == "release":
            joint = joint_release(cfg, [Source.of_run(out / name) for name in towns], out, resume)
            results.append(_do(joint, out, "all towns"))
        _save_summary(results, out)
    return results


def _up_to(name: str, todo: list[Stage]) -> list[Stage]:
    return todo[: next((k for k, stage in enumerate(todo, 1) if stage.name == name), len(todo))]


@contextlib.contextmanager
def _run_folder(cfg: RunConfig, out: Path) -> Iterator[None]:
    """Hold a run folder with its `run.yaml`, which other settings replace when every stage has taken them, or at once
    where no map is finished yet."""
    with hold_folder(out):
        is_new = not any(any(out.glob(maps)) for maps in ("maps/manifest.json", "*/maps/manifest.json"))
        if is_new or not (out / "run.yaml").exists():
            _save_run(cfg, out)
        yield
        if not is_new:
            _save_run(cfg, out)


def check(cfg: RunConfig) -> dict[str, RunConfig]:
    """Check what the last stage would ask for, before the first; gives the settings of each town, if there are any.

    Raises:
        ConfigError: nobody says under which licence the release goes out, or it asks for pictures that are not drawn.
    """
    towns = {name: cfg.of_town(name) for name in cfg.towns}
    maps = [(name, town.maps.licence) for name, town in towns.items()] or [(cfg.maps.source, cfg.maps.licence)]
    choose_licence(cfg.release.licence, maps)
    for one in towns.values() or [cfg]:
        if missing := sorted(set(cfg.release.modalities) - set(one.render.modalities)):
            what, got = "the release asks for pictures that nobody draws", f"no {', no '.join(missing)}"
            fix = f"draw them, or --set 'release.modalities=[{', '.join(one.render.modalities)}]'"
            raise ConfigError(what, where="render.modalities", got=got, fix=fix)
    return towns


def begun_run(config: Path, cfg: RunConfig) -> Path | None:
    """Return the run directory that a configuration belongs to: a run, or the run.yaml of one that has begun."""
    if (config / "run.yaml").is_file():
        return config
    places = [config.parent, *(config.parent / town for town in cfg.towns)]
    has_begun = config.name == "run.yaml" and any(any(place.glob("*/stage.json")) for place in places)
    return config.parent if has_begun else None


def check_out(out: Path) -> None:
    """Refuse to make a run in the folder of a stage: its tree would hold a second one."""
    if (out / "stage.json").exists() and not (out / "run.yaml").exists():
        fix = "choose another --out; a run goes on with its own folder, in which those of its stages stand"
        raise ResumeError("the folder of a stage, not of a run", where=out, got="stage.json in it", fix=fix)


def check_with_files(cfg: RunConfig) -> None:
    """Check what the last stage would ask for, and that the files of all maps are there.

    Raises:
        CosflyError: of several the text names each.
    """
    problems = list[CosflyError]()
    try:
        check(cfg)
    except CosflyError as error:
        problems.append(error)
    for one in [cfg.of_town(name) for name in cfg.towns] or [cfg]:
        where = f"maps.{one.maps.source}"
        try:
            files = getattr(one.maps, one.maps.source).inputs()
        except CosflyError as error:
            problems.append(error)
            continue
        problems += [
            InputError("there is no such file", where=f"{where}: {name}", got=str(path))
            for name, path in files.items()
            if not path.exists()
        ]
    if len(problems) > 1:
        raise ConfigError.of_all([str(problem) for problem in problems], where=cfg.name)
    if problems:
        raise problems[0]


def _run_town(cfg: RunConfig, out: Path, todo: list[Stage]) -> list[StageResult]:
    """Do the stages of one town."""
    for stage in todo:
        refuse_link(out / stage.name)
    with _run_folder(cfg, out):
        results = [_do(stage, out, f"{number}/{len(todo)}") for number, stage in enumerate(todo, 1)]
        tree = out / "render"
        has_frames = (tree / "manifest.json").exists()
        if has_frames and not (_is_summed_up(results, out) and (out / "viewer.html").exists()):
            contact_sheet(tree, out / "contact_sheet.png")
            write_viewer(out, out / "viewer.html", ViewerConfig())
        _save_summary(results, out)
    return results


def _do(stage: Stage, out: Path, place: str) -> StageResult:
    """Do a stage that is not complete; one that is refuses other settings, or goes on where more is to be done."""
    folder = out / stage.name
    before = read_manifest(folder) if (folder / "manifest.json").exists() else None
    if before is None:
        log.info("[%s] %s", place, stage.name)
    stage.work()
    after = read_manifest(folder)
    if before == after:
        log.info("[%s] %s: already complete", place, stage.name)
    return StageResult(stage, after, before == after)


def _save_run(cfg: RunConfig, out: Path) -> None:
    """Write `run.yaml`: the resolved configuration, which runs as it is."""
    header = f"# cosfly {cosfly.__version__}, Python {platform.python_version()}, {platform.platform()}\n"
    text = header + yaml.safe_dump(cfg.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    write_bytes(out / "run.yaml", text.encode())


def _rows(results: list[StageResult]) -> list[dict[str, Any]]:
    return [
        {"stage": r.stage.name, "counts": r.manifest.counts.model_dump(mode="json"), "seconds": r.manifest.seconds}
        for r in results
    ]


def _summary(path: Path) -> dict[str, Any]:
    return read_object(path, what="summary") if path.exists() else {}


def _is_summed_up(results: list[StageResult], out: Path) -> bool:
    """Return whether a run came to its end with these very stages: `summary.json` is written after the pictures."""
    return _summary(out / SUMMARY).get("stages") == _rows(results)


def _save_summary(results: list[StageResult], out: Path) -> None:
    """Write `summary.json`: counts, seconds and peak memory. A resumed run adds to the peak of the one before."""
    path = out / SUMMARY
    before = _summary(path).get("peak_memory_mb", 0)
    if not isinstance(before, int | float):
        where = f"{path}: peak_memory_mb"
        raise InputError("not a summary", where=where, got=repr(before)[:80], expected="a number", fix="remove it")
    unit = 1024 * 1024 if sys.platform == "darwin" else 1024
    peak_mb = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / unit
    write_json(path, {"stages": _rows(results), "peak_memory_mb": round(max(before, peak_mb), 1)})
