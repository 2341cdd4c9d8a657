"""Run folders looked at, without a hand on them: which stages are done, what they kept, what they take on the disk."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cosfly.formats.review import undecided
from cosfly.pipeline.settings import RunConfig
from cosfly.pipeline.settings_guide import Setting, changed
from cosfly.runtime.config import load
from cosfly.runtime.errors import CosflyError, InputError
from cosfly.runtime.run_dir import Failed, StageFolder, Tally, is_held, read_manifest

STAGES = ("maps", "simplify", "pedestrians", "plan", "render", "inspect", "caption", "release")  # of a run, in order
TO_LOOK_AT = (
    "contact_sheet.png",
    "viewer.html",
    "inspect/report.html",
    "caption/report.html",
    "release/dataset/README.md",
)


@dataclass(frozen=True)
class StageLook:
    """One stage of a run.

    Attributes:
        name: of a town's stage: `town/stage`. folder: where it stands.
        state: whether it has ended, has begun, or has not.
        tally: what became of its items; of one that has begun, of those that are done.
    """

    name: str
    folder: Path
    state: Literal["complete", "begun", "to do"]
    tally: Tally | None = None
    seconds: float | None = None

    @property
    def stage(self) -> str:
        """Its name without that of a town."""
        return self.name.rpartition("/")[2]

    @property
    def size_bytes(self) -> int:
        """What it takes on the disk: looks at each of its files."""
        return _size(self.folder)


@dataclass(frozen=True)
class RunLook:
    """One run folder. `is_at_work`: a process holds it now. `differing`: settings that are not the defaults."""

    path: Path
    cfg: RunConfig
    is_at_work: bool
    stages: list[StageLook]
    differing: list[Setting]
    to_look_at: list[Path]

    @property
    def num_complete(self) -> int:
        return sum(stage.state == "complete" for stage in self.stages)

    @property
    def size_bytes(self) -> int:
        return sum(stage.size_bytes for stage in self.stages)

    def tally(self, stage: str) -> Tally:
        """Add up what became of a stage's items, in all towns."""
        return sum((one.tally for one in self.stages if one.stage == stage and one.tally), Tally())

    def waiting(self) -> dict[Path, int]:
        """Return the folders of finished inspections that left flights to a person, and how many are still
        undecided."""
        done = [one.folder for one in self.stages if one.stage == "inspect" and one.state == "complete"]
        counts = {folder: len(undecided(folder / "inspect.json")) for folder in done}
        return {folder: count for folder, count in counts.items() if count}


def look(run: Path) -> RunLook:
    """Return what is in a run folder.

    Raises:
        InputError: it is none. ConfigError: its `run.yaml` is not of this version.
    """
    if not (run / "run.yaml").is_file():
        raise InputError(
            "not a run folder",
            where=run,
            got="no run.yaml",
            expected="a folder that `cosfly run` made",
            fix="cosfly list DIR finds them",
        )
    cfg = load(RunConfig, run / "run.yaml")
    folders = [(f"{town}/{name}", run / town / name) for town in cfg.towns for name in STAGES[:-1]]
    folders = [*folders, ("release", run / "release")] if cfg.towns else [(name, run / name) for name in STAGES]
    found = [run / name for name in TO_LOOK_AT if (run / name).exists()]
    return RunLook(run, cfg, is_held(run), [_stage(*one) for one in folders], changed(cfg), found)


def find(root: Path, *, depth: int = 2) -> Iterator[Path]:
    """Find run folders below a folder, in order of their names; a run's towns are not runs of their own.

    Raises:
        InputError: there is no such folder.
    """
    if not root.is_dir():
        raise InputError("no such folder", where=root, expected="a folder with runs")
    if (root / "run.yaml").is_file():
        yield root
    elif depth:
        for path in sorted(root.iterdir()):
            if path.is_dir() and not path.is_symlink():
                yield from find(path, depth=depth - 1)


def _stage(name: str, folder: Path) -> StageLook:
    if (folder / "manifest.json").exists():
        manifest = read_manifest(folder)
        return StageLook(name, folder, "complete", manifest.counts, manifest.seconds)
    if not (folder / "stage.json").exists():
        return StageLook(name, folder, "to do")
    tally = Tally()
    outcomes = {record.id: record for record in StageFolder(folder, name, False).items()}
    for record in outcomes.values():
        tally.input += 1
        if isinstance(record, Failed):
            tally.failed[record.code] += 1
        elif record.status == "dropped":
            tally.dropped[record.reason] += 1
        else:
            tally.kept += 1
    return StageLook(name, folder, "begun", tally)


def _size(folder: Path) -> int:
    """Add up the sizes of the files of a folder, links not followed; what goes meanwhile is not counted."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(place, name)).st_size
            except OSError:
                continue
    return total


def looks(root: Path) -> Iterator[RunLook | CosflyError]:
    """Look at all runs below a folder; one that cannot be read gives its error."""
    for run in find(root):
        try:
            yield look(run)
        except CosflyError as error:
            yield error
