"""Read-only summaries of run directories: which stages are done, what they kept, how much disk they take."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cosfly.formats.inspection import undecided
from cosfly.pipeline.settings import RunConfig
from cosfly.pipeline.settings_guide import Setting, changed
from cosfly.runtime.config import load
from cosfly.runtime.errors import CosflyError, InputError
from cosfly.runtime.run_dir import StageFolder, Tally, is_held, read_manifest

STAGES = ("maps", "simplify", "pedestrians", "plan", "render", "inspect", "caption", "release")  # of a run, in order
TO_LOOK_AT = (
    "contact_sheet.png",
    "viewer.html",
    "inspect/report.html",
    "caption/report.html",
    "release/dataset/README.md",
)


@dataclass(frozen=True)
class StageSummary:
    """One stage of a run, of a town `town/stage`. tally: outcomes of its items so far; None before it began."""

    name: str
    folder: Path
    state: Literal["complete", "begun", "to do"]
    tally: Tally | None = None
    seconds: float | None = None

    @property
    def stage(self) -> str:
        """Its name without the town."""
        return self.name.rpartition("/")[2]

    @property
    def size_bytes(self) -> int:
        """The disk space of its files, links not followed."""
        total = 0
        for place, _, names in os.walk(self.folder):
            for name in names:
                with contextlib.suppress(OSError):  # a file that a running stage removes meanwhile
                    total += os.lstat(os.path.join(place, name)).st_size
        return total


@dataclass(frozen=True)
class RunSummary:
    """One run directory. is_at_work: a process holds it; differing: settings that are not the defaults."""

    path: Path
    cfg: RunConfig
    is_at_work: bool
    stages: list[StageSummary]
    differing: list[Setting]
    to_look_at: list[Path]

    @property
    def num_complete(self) -> int:
        return sum(stage.state == "complete" for stage in self.stages)

    @property
    def size_bytes(self) -> int:
        return sum(stage.size_bytes for stage in self.stages)

    def tally(self, stage: str) -> Tally:
        """Return the outcomes of a stage in all towns."""
        return sum((one.tally for one in self.stages if one.stage == stage and one.tally), Tally())

    def waiting(self) -> dict[Path, int]:
        """Return the inspections with trajectories that wait for a manual decision, and how many."""
        done = [one.folder for one in self.stages if one.stage == "inspect" and one.state == "complete"]
        counts = {folder: len(undecided(folder / "inspect.json")) for folder in done}
        return {folder: count for folder, count in counts.items() if count}


def summarize(run: Path) -> RunSummary:
    """Return what is in a run directory.

    Raises:
        InputError: It is not a run directory. ConfigError: Its `run.yaml` is not of this version.
    """
    if not (run / "run.yaml").is_file():
        raise InputError(
            "not a run directory",
            where=run,
            got="no run.yaml",
            expected="a directory that `cosfly run` made",
            fix="find runs with cosfly list DIR",
        )
    cfg = load(RunConfig, run / "run.yaml")
    names = [f"{town}/{name}" for town in cfg.towns for name in STAGES[:-1]]
    stages = [_stage(name, run / name) for name in ([*names, "release"] if cfg.towns else STAGES)]
    found = [run / name for name in TO_LOOK_AT if (run / name).exists()]
    return RunSummary(run, cfg, is_held(run), stages, changed(cfg), found)


def summaries(root: Path) -> Iterator[RunSummary | CosflyError]:
    """Yield the summary of each run below a folder, or the error of a run that cannot be read.

    Raises:
        InputError: There is no such folder.
    """
    if not root.is_dir():
        raise InputError("no such folder", where=root, expected="a folder with runs")
    for run in _find(root, depth=2):
        try:
            yield summarize(run)
        except CosflyError as error:
            yield error


def _find(root: Path, depth: int) -> Iterator[Path]:
    """Yield the run directories below a folder by name; the towns of a run are part of it."""
    if (root / "run.yaml").is_file():
        yield root
    elif depth:
        for path in sorted(root.iterdir()):
            if path.is_dir() and not path.is_symlink():
                yield from _find(path, depth - 1)


def _stage(name: str, folder: Path) -> StageSummary:
    if (folder / "manifest.json").exists():
        manifest = read_manifest(folder)
        return StageSummary(name, folder, "complete", manifest.counts, manifest.seconds)
    if not (folder / "stage.json").exists():
        return StageSummary(name, folder, "to do")
    outcomes = {record.id: record for record in StageFolder(folder, name, False).items()}
    tally = Tally(input=len(outcomes))
    for record in outcomes.values():
        tally.count(record)
    return StageSummary(name, folder, "begun", tally)
