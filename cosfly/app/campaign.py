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
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import filter as matching
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field, StringConstraints, field_validator

from cosfly.app import pipeline
from cosfly.app.estimate import other_settings
from cosfly.app.runs import STAGES, RunLook, find, look
from cosfly.app.settings import RunConfig, merged
from cosfly.errors import ConfigError, CosflyError, nearest
from cosfly.look.frame_views import small_jpeg
from cosfly.look.page import page
from cosfly.reading.arrays import read_picture
from cosfly.reading.files import read_tail
from cosfly.work.config import Config, apply_overrides, build, config_file, load, read_yaml
from cosfly.work.console import Advance, progress_bar
from cosfly.work.folder_lock import hold_folder
from cosfly.work.provenance import checked_inputs, read_stage_record
from cosfly.work.server_process import start_process
from cosfly.work.stage_folder import Resume, Tally
from cosfly.work.store import storage_errors, write_bytes
from release.package.config import ReleaseConfig
from release.package.sources import Source, choose_licence
from release.stats.stats import TABLE_LOOK
from release.stats.tables import Cell, Table

log = logging.getLogger(__name__)

FILE, REPORT, LOGS, SETTINGS = "campaign.yaml", "report.html", "logs", "settings"
NOT_A_RUN = ("release", LOGS, SETTINGS)
HEAD = ("run", "state", "stages", "at hand", "flights", "captions", "seconds")
SHEET_PX = 960
LOOK_S = 0.5
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
    workers: int = Field(
        0,
        ge=0,
        description="worker processes of all runs together; 0 takes one per core, on Ray all there is room for",
    )
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

    def towns(self) -> dict[str, RunConfig]:
        """Give the settings of its towns by their folders; without any it is one itself."""
        return {name: self.cfg.of_town(name) for name in self.cfg.towns} or {"": self.cfg}

    def look(self) -> RunLook:
        """Look at its stages, which are all but the release."""
        seen = look(self.folder, self.cfg)
        return replace(seen, stages=[stage for stage in seen.stages if stage.stage != "release"])

    def is_done(self) -> bool:
        """Tell whether all stages are complete with these very settings and maps, and what failed is accepted."""
        seen = self.look()
        others = [name for name in other_settings(self.cfg, self.folder) if not name.startswith("release.")]
        if seen.num_complete < len(seen.stages) or others:
            return False
        num_failed = sum(seen.tally(stage).failed.total() for stage in STAGES)
        return num_failed <= self.cfg.max_failed and all(self._has_map(*town) for town in self.towns().items())

    def _has_map(self, town: str, cfg: RunConfig) -> bool:
        """Tell whether the files of a town's map are those that it was made of; what cannot be read its stage tells."""
        try:
            made_of = read_stage_record(self.folder / town / "maps").inputs
            now = checked_inputs(getattr(cfg.maps, cfg.maps.source).inputs())
        except CosflyError:
            return False
        return {name: one.sha256 for name, one in made_of.items()} == {name: one.sha256 for name, one in now.items()}


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
    every = {
        "-".join(filter(None, (place, config, str(seed)))): (place, config, seed)
        for place, config, seed in product(cfg.maps or [""], cfg.configs, cfg.seeds)
    }
    left_out = {pattern: matching(every, pattern) for pattern in cfg.leave_out}
    runs, problems = [], dict[str, str]()  # a mistake of all runs is one: its words -> the first run with it
    for pattern in (pattern for pattern, names in left_out.items() if not names):
        problems[f"no run is called {pattern!r}{nearest(pattern, every)}"] = "leave_out"
    for name in [name for name in every if not any(name in names for names in left_out.values())]:
        try:
            runs.append(Run(name, _settings(cfg, name, *every[name]), out / name))
            pipeline.check_with_files(runs[-1].cfg)
        except CosflyError as error:
            problems.setdefault(str(error), name)
    if problems:
        raise ConfigError.of_all([f"{name}: {words}" for words, name in problems.items()], where=path)
    if not runs:
        raise ConfigError("every run is left out", where=f"{path}: leave_out", got=", ".join(cfg.leave_out))
    maps = [(town.name, town.maps.licence) for one in runs for town in one.towns().values()]
    choose_licence(cfg.release.licence, maps)
    return cfg, runs, out


def _settings(cfg: CampaignConfig, name: str, place: str, config: str, seed: int) -> RunConfig:
    """Give the settings of a run; of one of the campaign's maps as a town of that name has them."""
    where, changes = f"configs.{config}", dict(cfg.configs[config])
    file = changes.pop("base", None)
    base = load(RunConfig, config_file(None if file is None else Path(str(file))))
    if "release" in changes:
        fix = "set it in `release` of the campaign"
        raise ConfigError("the runs of a campaign have one release", where=f"{where}.release", fix=fix)
    # With the release's settings a run is asked before its first stage what the release will ask after all.
    own = {"name": name, "seed": seed, "release": cfg.release.model_dump(mode="json")}
    data = merged(base, base.model_dump(mode="json"), changes) | own
    if not place:
        return build(RunConfig, data, where)
    if data["towns"]:
        raise ConfigError("towns have maps of their own", where=where, fix="leave out `maps`, or the towns")
    town = build(RunConfig, data | {"towns": {place: {"maps": cfg.maps[place]}}}, where).of_town(place)
    return town.model_copy(update={"name": name})


# --- at work ----------------------------------------------------------------------------------------------------------


def run(cfg: CampaignConfig, runs: list[Run], out: Path, *, resume: Resume = "if-same") -> dict[str, str]:
    """Do all runs that are not done, then the release of all; writes `report.html`.

    Returns:
        What went wrong, by the names of the runs that failed; where none did, there is a release.
    """
    stood = (out / FILE).exists()
    with hold_folder(out, nothing=() if stood else (FILE,)):
        settings = yaml.safe_dump(cfg.model_dump(mode="json", exclude_unset=True), sort_keys=False)
        write_bytes(out / FILE, settings.encode())
        names = {one.name for one in runs} | {*NOT_A_RUN}
        if left := [path.name for path in find(out, depth=1) if path != out and path.name not in names]:
            log.warning("%s: not of this campaign, left as they are: %s", out, ", ".join(left))
        todo = [one for one in runs if not one.is_done()]
        log.info("%s: %d of %d runs are done", cfg.name, len(runs) - len(todo), len(runs))
        with progress_bar(cfg.name, total=len(runs), done=len(runs) - len(todo)) as advance:
            failed = _do(cfg, todo, out, resume, advance)
        try:
            if failed:
                log.error("%s: no release is made: %d runs failed: %s", cfg.name, len(failed), ", ".join(failed))
            else:
                joint = RunConfig(name=cfg.name, workers=cfg.workers, release=cfg.release)
                sources = [
                    replace(Source.of_run(one.folder / town), run=f"{one.name}_{town}".rstrip("_"))
                    for one in runs
                    for town in one.cfg.towns or [""]
                ]  # towns of seeds have one name
                pipeline.joint_release(joint, sources, out, resume).work()
        finally:
            write_report(cfg, runs, out, failed)
    return failed


def _do(cfg: CampaignConfig, todo: list[Run], out: Path, resume: Resume, advance: Advance) -> dict[str, str]:
    """Do runs, each in a process of its own that ends with this one; gives what went wrong, by their names."""
    waiting, at_work, failed = todo[::-1], list[tuple[Run, subprocess.Popen]](), dict[str, str]()
    try:
        while waiting or at_work:
            while waiting and len(at_work) < cfg.at_once:
                one = waiting.pop()
                log.info("%s: begun", one.name)
                workers = one.cfg.workers or share_of(cfg, one, len(todo))
                at_work.append((one, _start(one, out, workers, resume)))
            time.sleep(LOOK_S)
            for one, process in [pair for pair in at_work if pair[1].poll() is not None]:
                at_work.remove((one, process))
                if code := process.returncode:
                    told = out / LOGS / f"{one.name}.log"
                    failed[one.name] = _error_in(told) or f"exit code {code}, see {told}"
                    log.error("%s: failed: %s", one.name, failed[one.name])
                else:
                    log.info("%s: done", one.name)
                advance(1)
            advance(0, "; ".join(f"{one.name} {_at_hand(one.look())}" for one, _ in at_work))
    finally:
        for _, process in at_work:
            process.terminate()
        for _, process in at_work:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE_S)
            process.kill()
    return failed


def share_of(cfg: CampaignConfig, one: Run, num_runs: int) -> int:
    """Give the workers of one run of those that share them; 0: as many as a cluster has room for."""
    here = 0 if one.cfg.engine == "ray" else len(os.sched_getaffinity(0))
    most = cfg.workers or here
    return most and max(1, most // min(cfg.at_once, num_runs))


def _start(one: Run, out: Path, workers: int, resume: Resume) -> subprocess.Popen:
    settings, told = out / SETTINGS / f"{one.name}.yaml", out / LOGS / f"{one.name}.log"
    write_bytes(settings, yaml.safe_dump(one.cfg.model_dump(mode="json"), sort_keys=False, allow_unicode=True).encode())
    words = ["run", str(settings), "--out", str(one.folder), "--until", STAGES[-2]]
    words += ["--workers", str(workers), "--resume", resume]
    with storage_errors(told):
        told.parent.mkdir(exist_ok=True)
        log_file = told.open("wb")
    with log_file:
        return start_process([sys.executable, "-m", "cosfly", *words], log_file)


def _error_in(log_file: Path) -> str | None:
    """Give what a log says last of an error; None where it says nothing."""
    errors = [line for line in read_tail(log_file).splitlines() if line.startswith("error: ")]
    return errors[-1].removeprefix("error: ") if errors else None


# --- how far it is ----------------------------------------------------------------------------------------------------


def table(runs: list[Run], failed: Mapping[str, str]) -> list[list[Cell]]:
    """Tell of each run how far it is, in columns of HEAD.

    Args:
        failed: what went wrong, by the names of the runs.
    """
    rows = list[list[Cell]]()
    for one in runs:
        seen = one.look()
        is_complete = seen.num_complete == len(seen.stages)
        state = "failed" if one.name in failed else "done" if is_complete else "to do"
        kept = [seen.tally(stage).kept for stage in ("render", "caption")]
        seconds = round(sum(stage.seconds or 0.0 for stage in seen.stages))
        stages, what = f"{seen.num_complete} of {len(seen.stages)}", failed.get(one.name) or _at_hand(seen)
        rows.append([one.name, state, stages, what, *kept, seconds])
    return rows


def _at_hand(seen: RunLook) -> str:
    return next((f"{one.name}, {one.items_in_words()}" for one in seen.stages if one.state == "begun"), "")


def tallies(runs: list[Run]) -> dict[str, Tally]:
    """Add up what became of the items of each stage, over all runs."""
    looks = [one.look() for one in runs]
    return {stage: sum((seen.tally(stage) for seen in looks), Tally()) for stage in STAGES[:-1]}


def write_report(cfg: CampaignConfig, runs: list[Run], out: Path, failed: Mapping[str, str]) -> None:
    """Write `report.html`: each run, what became of all items, and a picture of each run."""
    pictures = {}
    for one in runs:
        for town in one.cfg.towns or [""]:
            if (sheet := one.folder / town / "contact_sheet.png").is_file():
                rgb = read_picture(sheet)[..., ::-1]
                pictures[f"{one.name} {town}"] = small_jpeg(rgb, min(SHEET_PX, rgb.shape[1]))
    items: list[list[Cell]] = [[stage, str(tally)] for stage, tally in tallies(runs).items()]
    tables = [
        Table(key="runs", title="Runs", head=list(HEAD), rows=table(runs, failed)),
        Table(key="items", title="What became of all items", head=["stage", "items"], rows=items),
    ]
    text = page("cosfly/app/campaign.html", title=cfg.name, tables=tables, pictures=pictures, look=TABLE_LOOK)
    write_bytes(out / REPORT, text.encode())
