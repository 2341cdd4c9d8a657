"""Many runs, of maps x configurations x seeds, as one job: `cosfly campaign`. Run again it goes on.

Each run is `cosfly run` in a process and a folder of its own, whose products, journals and manifests alone say how far
it is: the campaign keeps no book beside them. One that fails does not stop the others; one release is made of all.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field, StringConstraints, field_validator

from cosfly.app import pipeline
from cosfly.app.estimate import other_settings
from cosfly.app.runs import STAGES, find
from cosfly.app.settings import RunConfig
from cosfly.errors import ConfigError, CosflyError, nearest
from cosfly.look.frame_views import small_jpeg
from cosfly.look.page import page
from cosfly.products.captions import read_captions
from cosfly.reading.arrays import read_picture
from cosfly.reading.files import read_span
from cosfly.work.chance import rng_for
from cosfly.work.config import Config, apply_overrides, build, read_yaml, shipped
from cosfly.work.console import console
from cosfly.work.folder_lock import hold_folder
from cosfly.work.provenance import checked_inputs, read_stage_record
from cosfly.work.stage_events import progress_of, read_events
from cosfly.work.stage_folder import Manifest, Resume, Tally, read_manifest
from cosfly.work.store import storage_errors, write_bytes
from cosfly.work.worker import end_with_parent
from release.package.config import ReleaseConfig
from release.package.sources import Source, choose_licence

log = logging.getLogger(__name__)

FILE, REPORT, LOGS, SETTINGS = "campaign.yaml", "report.html", "logs", "settings"
OF_A_RUN = STAGES[:-1]  # the release is made of all
NOT_A_RUN = ("release", LOGS, SETTINGS)
LONGEST_TAIL = 65536  # of a log, in which the error of a run stands last
SHEET_PX = 960
PATIENCE_S = 20.0  # for a run that was told to end
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_]{1,40}$")]


class CampaignConfig(Config):
    """What a campaign is of: every map with every configuration and every seed, but what is left out."""

    name: Name = Field("campaign", description="name of the campaign and its release")
    configs: dict[Name, dict[str, Any]] = Field(
        {"quickstart": {"base": "quickstart"}},
        min_length=1,
        description="configurations: name -> `base`, a YAML file or one that ships, and the settings that differ",
    )
    maps: dict[Name, dict[str, Any]] = Field(
        {},
        description="maps: name -> the `maps` section of its runs, whose seed derives from the map's name too; "
        "none: each configuration's own map",
    )
    seeds: tuple[int, ...] = Field((0,), min_length=1, description="seeds, each a run of every map and configuration")
    leave_out: tuple[str, ...] = Field((), description="runs that are not made: their names, * for any part")
    at_once: int = Field(1, ge=1, description="runs at work at the same time, which share the worker processes")
    workers: int = Field(0, ge=0, description="worker processes of all runs together; 0 takes one per core")
    release: ReleaseConfig = Field(
        default_factory=lambda: ReleaseConfig(split_by="town"),
        description="the release of all runs, in place of their own; split_by is town unless it is set",
    )

    @field_validator("release", mode="before")
    @classmethod
    def _no_map_in_two_splits(cls, given: Any) -> Any:
        return {"split_by": "town"} | given if isinstance(given, dict) else given

    @field_validator("seeds")
    @classmethod
    def _distinct(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) != len(seeds):
            raise ValueError("a seed is listed twice")
        return seeds


@dataclass(frozen=True)
class Run:
    """One run of a campaign: its name, which says map, configuration and seed, settings and folder."""

    name: str
    cfg: RunConfig
    folder: Path

    def towns(self) -> list[RunConfig]:
        return [self.cfg.of_town(name) for name in self.cfg.towns] or [self.cfg]

    def stages(self) -> list[tuple[str, Path]]:
        """Give the stages with the folder of each, of several towns those of all."""
        towns = [f"{town}/" for town in self.cfg.towns] or [""]
        return [(town + stage, self.folder / town / stage) for town in towns for stage in OF_A_RUN]

    def num_complete(self) -> int:
        return sum((folder / "manifest.json").exists() for _, folder in self.stages())

    def is_done(self) -> bool:
        """Tell whether all stages are complete with these very settings, and what failed is accepted."""
        if self.num_complete() < len(self.stages()) or self.other_settings() or not self._has_the_same_maps():
            return False
        failed = sum(read_manifest(folder).counts.failed.total() for _, folder in self.stages())
        return failed <= self.cfg.max_failed

    def other_settings(self) -> list[str]:
        """Name the settings that its stages were made with otherwise; those of the release are none of them."""
        return [name for name in other_settings(self.cfg, self.folder) if not name.startswith("release.")]

    def _has_the_same_maps(self) -> bool:
        """Tell whether the files of its maps are those that it was made of; what cannot be read its stage tells of."""
        try:
            for place, town in [(name, self.cfg.of_town(name)) for name in self.cfg.towns] or [("", self.cfg)]:
                made_of = read_stage_record(self.folder / place / "maps").inputs
                now = checked_inputs(getattr(town.maps, town.maps.source).inputs())
                if {name: one.sha256 for name, one in made_of.items()} != {
                    name: one.sha256 for name, one in now.items()
                }:
                    return False
        except CosflyError:
            return False
        return True


def load_campaign(path: Path, overrides: list[str], out: Path | None) -> tuple[CampaignConfig, list[Run], Path]:
    """Read a campaign's file, or the folder of one that has begun.

    Returns:
        Its settings, its runs in order, and its folder.
    Raises:
        ConfigError: names all problems, of each configuration and run.
    """
    if path.is_dir():
        out, path = out or path, path / FILE
    cfg = build(CampaignConfig, apply_overrides(read_yaml(path), overrides), path)
    out = out or Path("campaigns") / cfg.name
    runs, problems = [], dict[str, str]()  # a mistake of all runs is one: its words -> the first run with it
    every = list(_combinations(cfg))
    chosen = [one for one in every if not any(fnmatchcase(one[0], pattern) for pattern in cfg.leave_out)]
    names = [name for name, *_ in every]
    for pattern in cfg.leave_out:
        if not any(fnmatchcase(name, pattern) for name in names):
            problems[f"no run is called {pattern!r}{nearest(pattern, names)}"] = "leave_out"
    if not chosen:
        raise ConfigError("every run is left out", where=f"{path}: leave_out", got=", ".join(cfg.leave_out))
    for name, place, config, seed in chosen:
        try:
            runs.append(Run(name, _settings(cfg, name, place, config, seed), out / name))
            pipeline.check_with_files(runs[-1].cfg)
        except CosflyError as error:
            problems.setdefault(str(error), name)
    if problems:
        raise ConfigError.of_all([f"{name}: {words}" for words, name in problems.items()], where=path)
    maps = [(town.name, town.maps.licence) for one in runs for town in one.towns()]
    choose_licence(cfg.release.licence, maps)
    return cfg, runs, out


def _combinations(cfg: CampaignConfig) -> Iterator[tuple[str, str | None, str, int]]:
    """Yield name, map, configuration and seed of each run, also of those that are left out."""
    for place in cfg.maps or [None]:
        for config in cfg.configs:
            for seed in cfg.seeds:
                yield "-".join([*([place] if place else []), config, str(seed)]), place, config, seed


def _settings(cfg: CampaignConfig, name: str, place: str | None, config: str, seed: int) -> RunConfig:
    changes = dict(cfg.configs[config])
    base = changes.pop("base", None)
    where = f"configs.{config}"
    data = {} if base is None else read_yaml(_file_of(base, f"{where}.base"))
    if "release" in changes:
        fix = "set it in `release` of the campaign"
        raise ConfigError("the runs of a campaign have one release", where=f"{where}.release", fix=fix)
    # With the release's settings a run is asked before its first stage what the release will ask after all.
    data = _merged(data, changes) | {"name": name, "seed": seed, "release": cfg.release.model_dump(mode="json")}
    if place is not None:
        if "towns" in data:
            raise ConfigError("towns have maps of their own", where=where, fix="leave out `maps`, or the towns")
        source = str(cfg.maps[place].get("source", "synthetic"))
        of_source = cfg.maps[place].get(source, {})
        named = {"name": place} | of_source if isinstance(of_source, dict) else of_source
        data["maps"] = {"source": source, **cfg.maps[place], source: named}
        data["seed"] = int(rng_for(seed, "run", place).integers(2**31))  # as of a town: no two maps share their walks
    return build(RunConfig, data, where)


def _merged(data: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Give settings with the changes in them, group by group."""
    merged = dict(data)
    for name, value in changes.items():
        both = isinstance(value, dict) and isinstance(merged.get(name), dict)
        merged[name] = _merged(merged[name], value) if both else value
    return merged


def _file_of(base: Any, where: str) -> Path:
    path = Path(str(base))
    if path.is_file():
        return path
    if len(path.parts) == 1 and (packaged := shipped(f"{path}.yaml")).is_file():
        return packaged
    raise ConfigError("no such configuration", where=where, got=str(base), expected="a YAML file, or one that ships")


# --- at work ----------------------------------------------------------------------------------------------------------


def run(cfg: CampaignConfig, runs: list[Run], out: Path, *, resume: Resume = "if-same") -> Manifest | None:
    """Do all runs that are not done, then the release of all; writes `report.html`.

    Returns:
        The manifest of the release; None where a run failed, of which the log and the report tell.
    """
    stood = (out / FILE).exists()
    with hold_folder(out, nothing=() if stood else (FILE,)):
        settings = yaml.safe_dump(cfg.model_dump(mode="json", exclude_unset=True), sort_keys=False)
        write_bytes(out / FILE, settings.encode())
        _tell_left_behind(runs, out)
        done = {one.name for one in runs if one.is_done()}
        todo = [one for one in runs if one.name not in done]
        log.info("%s: %d of %d runs are done", cfg.name, len(done), len(runs))
        cores = cfg.workers or len(os.sched_getaffinity(0))
        at_work: dict[str, subprocess.Popen] = {}
        work = partial(_do, out, max(1, cores // min(cfg.at_once, len(todo) or 1)), resume, at_work, done)
        with _shown(runs, out, at_work, done), ThreadPoolExecutor(cfg.at_once) as threads:
            try:
                list(threads.map(work, todo))
            except BaseException:
                threads.shutdown(wait=False, cancel_futures=True)
                ending = list(at_work.values())
                for process in ending:
                    process.terminate()
                for process in ending:
                    try:
                        process.wait(PATIENCE_S)
                    except subprocess.TimeoutExpired:
                        process.kill()
                raise
        failed = [one.name for one in todo if one.name not in done]
        try:
            if failed:
                log.error("%s: no release is made: %d runs failed: %s", cfg.name, len(failed), ", ".join(failed))
                return None
            joint = RunConfig(name=cfg.name, workers=cfg.workers, release=cfg.release)
            sources = [
                replace(
                    Source.of_run(one.folder / town), run=f"{one.name}_{town}".rstrip("_")
                )  # towns of seeds: one name
                for one in runs
                for town in one.cfg.towns or [""]
            ]
            pipeline.joint_release(joint, sources, out, resume).work()
            return read_manifest(out / "release")
        finally:
            write_report(cfg, runs, out)


def _tell_left_behind(runs: list[Run], out: Path) -> None:
    """Say which runs stand there that the campaign does not name; they are left alone, and out of the release."""
    names = {one.name for one in runs} | {*NOT_A_RUN}
    left = [path.name for path in find(out, depth=1) if path != out and path.name not in names]
    if left:
        log.warning("%s: not of this campaign, left as they are: %s", out, ", ".join(left))


def _do(
    out: Path, workers: int, resume: Resume, at_work: dict[str, subprocess.Popen], done: set[str], one: Run
) -> None:
    """Do one run in a process of its own, which ends with this one; `done` has its name if it came to its end."""
    settings, told = out / SETTINGS / f"{one.name}.yaml", out / LOGS / f"{one.name}.log"
    write_bytes(settings, yaml.safe_dump(one.cfg.model_dump(mode="json"), sort_keys=False, allow_unicode=True).encode())
    with storage_errors(told):
        told.parent.mkdir(exist_ok=True)
        log_file = told.open("wb")
    words = ["run", str(settings), "--out", str(one.folder), "--until", OF_A_RUN[-1]]
    words += ["--workers", str(one.cfg.workers or workers), "--resume", resume]
    begun_s = time.monotonic()
    log.info("%s: begun", one.name)
    with log_file:
        at_work[one.name] = process = subprocess.Popen(
            [sys.executable, "-m", "cosfly", *words],
            stdin=subprocess.DEVNULL, stdout=log_file, stderr=subprocess.STDOUT,
            preexec_fn=partial(end_with_parent, os.getpid()),
            start_new_session=True,  # a terminal's Ctrl-C is for the campaign, which tells its runs, once
        )  # fmt: skip
        code = process.wait()
    del at_work[one.name]
    if code == 0 and one.is_done():
        done.add(one.name)
        log.info("%s: done, %.0f s", one.name, time.monotonic() - begun_s)
    else:
        log.error("%s: failed: %s", one.name, error_of(out, one.name) or f"exit code {code}; see {told}")


def error_of(out: Path, name: str) -> str | None:
    """Give what a run's log says of its end, None where it says nothing of an error."""
    path = out / LOGS / f"{name}.log"
    if not path.is_file():
        return None
    size = path.stat().st_size
    tail = min(size, LONGEST_TAIL)
    lines = read_span(path, size - tail, tail, what="log").decode(errors="replace").splitlines()
    return next((line.removeprefix("error: ") for line in reversed(lines) if line.startswith("error: ")), None)


# --- how far it is ----------------------------------------------------------------------------------------------------


def table(
    runs: list[Run], out: Path, at_work: Collection[str] = (), done: Collection[str] = ()
) -> list[tuple[str, ...]]:
    """Tell of each run how far it is: name, state, stages complete, what is at hand, flights and captions, seconds.

    Args:
        done: names of runs that are known to be done: to see it takes a tenth of a second each.
    """
    rows = []
    for one in runs:
        complete = {name: read_manifest(folder) for name, folder in one.stages() if (folder / "manifest.json").exists()}
        begun = [(name, folder) for name, folder in one.stages() if name not in complete]
        state, what = "to do", ""
        if not begun:
            state = "done" if one.name in done or one.is_done() else "failed"
        elif one.name in at_work:
            (name, folder), state = begun[0], "at work"
            far = progress_of(read_events(folder))
            what = f"{name}, {far[0].done:,} of {far[0].total:,} {far[0].unit}" if far else name
        elif (out / LOGS / f"{one.name}.log").exists():
            state = "failed" if error_of(out, one.name) else "broken off"
        if state == "failed":
            others = one.other_settings()
            made = f"made with other settings: {', '.join(others[:3])}" if others else "see its log"
            what = error_of(out, one.name) or made
        kept = (sum(m.counts.kept for name, m in complete.items() if name.endswith(of)) for of in ("render", "caption"))
        seconds = sum(manifest.seconds for manifest in complete.values())
        stages = f"{len(complete)} of {len(one.stages())}"
        rows.append((one.name, state, stages, what, *(f"{count:,}" for count in kept), f"{seconds:,.0f}"))
    return rows


HEAD = ("run", "state", "stages", "at hand", "flights", "captions", "seconds")


@contextlib.contextmanager
def _shown(runs: list[Run], out: Path, at_work: Collection[str], done: Collection[str]) -> Iterator[None]:
    """Show the table on a terminal while runs are at work."""
    if not console.is_terminal:
        yield
        return
    from rich.live import Live
    from rich.table import Table

    def drawn() -> Table:
        shown = Table(*HEAD, box=None)
        with contextlib.suppress(CosflyError):  # a stage that begins again has just taken its manifest away
            for row in table(runs, out, at_work, done):
                shown.add_row(*row)
        return shown

    with Live(get_renderable=drawn, console=console, refresh_per_second=0.5, transient=True):
        yield


def tallies(runs: list[Run]) -> dict[str, Tally]:
    """Add up what became of the items of each stage, over all runs that have finished it; each sum is checked."""
    sums = {name: Tally() for name in OF_A_RUN}
    for one in runs:
        for name, folder in one.stages():
            if (folder / "manifest.json").exists():
                counts, of_all = read_manifest(folder).counts, sums[name.rpartition("/")[2]]
                of_all.input += counts.input
                of_all.kept += counts.kept
                of_all.dropped.update(counts.dropped)
                of_all.failed.update(counts.failed)
    for tally in sums.values():
        tally.check()
    return sums


def write_report(cfg: CampaignConfig, runs: list[Run], out: Path) -> Path:
    """Write `report.html`: each run, what became of all items, labels of captions, and a picture of each run."""
    labels = Counter[str]()
    pictures = []
    for one in runs:
        for town in one.cfg.towns or [""]:
            if (captions := one.folder / town / "caption/captions.jsonl").is_file():
                labels.update(caption.label for caption in read_captions(captions) if caption.label)
            if (sheet := one.folder / town / "contact_sheet.png").is_file():
                rgb = read_picture(sheet)[..., ::-1]
                pictures.append((f"{one.name} {town}".strip(), small_jpeg(rgb, min(SHEET_PX, rgb.shape[1]))))
    rows, sums = table(runs, out), tallies(runs)
    text = page(
        "cosfly/app/campaign.html", title=cfg.name, head=HEAD, rows=rows, tallies=sums, pictures=pictures,
        labels=labels.most_common(), num_done=sum(row[1] == "done" for row in rows),
        release=read_manifest(out / "release").counts if (out / "release/manifest.json").exists() else None,
    )  # fmt: skip
    write_bytes(out / REPORT, text.encode())
    return out / REPORT
