"""The runs that a set of samples is made from, and how their tracks are assigned to splits."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from cosfly.formats.places import folder_name
from cosfly.formats.predictions import Split
from cosfly.geometry.splits import assign_splits, town_family
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import check_stays_below


@dataclass(frozen=True)
class RunSource:
    """The part of one run: its name, playback tree and captions."""

    run: str
    data: Path
    captions: Path

    @classmethod
    def of_run(cls, folder: Path) -> RunSource:
        """Return the source of a run directory, the output of `cosfly run`."""
        if not (folder / "render").is_dir():
            what = "the folder is not a run directory"
            fix = "pass the run that a release was built from, or --data and --captions for other folders"
            raise InputError(what, where=folder, expected="the folders render/ and caption/", fix=fix)
        captions = folder / "caption/captions.jsonl"
        check_stays_below(captions, captions.parent)
        return cls.of_files(folder / "render", captions)

    @classmethod
    def of_files(cls, data: Path, captions: Path) -> RunSource:
        return cls(run_of(data), data, captions)


def run_of(tree: Path) -> str:
    """Return the name of the run of a playback tree: that of the folder that contains it."""
    return folder_name(tree.absolute().parent.name)


def check_names(runs: Sequence[str]) -> None:
    """Check that no two runs have the same name."""
    if len(set(runs)) < len(runs):
        fix = "rename the folder that contains one of the trees"
        raise InputError("two runs have the same name", got=", ".join(runs), fix=fix)


class SplitConfig(Config):
    """What splits must not share, and how large they are."""

    split_by: Literal["walk", "town"] = Field(
        "walk",
        description="what two splits must not share: a pedestrian trajectory (walk), or a town",
    )
    val_fraction: float = Field(
        0.1, ge=0, lt=1, description="share of pedestrian trajectories (or towns) for validation; 0: none"
    )
    test_fraction: float = Field(
        0.1, ge=0, lt=1, description="share of pedestrian trajectories (or towns) for the test; 0: none"
    )

    @model_validator(mode="after")
    def _fractions_leave_something(self) -> SplitConfig:
        if self.val_fraction + self.test_fraction >= 1.0:
            raise ValueError("val_fraction + test_fraction must be below 1, so that samples are left for training")
        return self

    def assigned(self, keys: Collection[str], walks: Mapping[str, str], seed: int) -> dict[str, Split]:
        """Return the split of each track's key, `run/town/trajectory`: all keys of a walk, or of a town, share it.

        With fewer walks (or towns) than splits, train is filled first, then val.

        Args:
            walks: key -> walk.
        """
        by_town = self.split_by == "town"
        group_of = {key: town_family(key.split("/")[1]) if by_town else walks[key] for key in keys}
        fractions: dict[Split, float] = {"val": self.val_fraction, "test": self.test_fraction}
        split_of = assign_splits(group_of.values(), fractions, seed)
        return {key: split_of[group] for key, group in group_of.items()}
