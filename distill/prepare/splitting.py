"""How samples go to splits, and whether the splits that were written share what they may not."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterable, Mapping
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from cosfly.formats.predictions import Split
from cosfly.geometry.splits import SPLITS, assign_splits, town_family
from cosfly.runtime.config import Config
from cosfly.runtime.errors import VerifyError
from distill.schema import SplitMember


class SplitConfig(Config):
    """What splits may not share, and how large they are."""

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
    too_few: Literal["refuse", "fill"] = Field(
        "refuse",
        description="with fewer pedestrian trajectories (or towns) than splits: refuse, or fill train, then val",
    )

    @model_validator(mode="after")
    def _fractions_leave_something(self) -> SplitConfig:
        if self.val_fraction + self.test_fraction >= 1.0:
            raise ValueError("val_fraction + test_fraction must be below 1, so that samples are left for training")
        return self

    @property
    def fractions(self) -> dict[Split, float]:
        shares: dict[Split, float] = {"val": self.val_fraction, "test": self.test_fraction}
        return {split: shares[split] for split in SPLITS if shares.get(split)}

    def assigned(
        self, keys: Collection[str], walks: Mapping[str, str], seed: int, what: str, fix: str
    ) -> dict[str, tuple[str, Split]]:
        """Return each flight, by its key `run/town/trajectory`, its walk or town and the split that has all of this.

        Args:
            walks: key -> walk. what: those with what are split; fix: what to do where they are too few.
        """
        by_town = self.split_by == "town"
        group_of = {key: town_family(key.split("/")[1]) if by_town else walks[key] for key in keys}
        what = f"{self.split_by}s with {what}"
        groups = group_of.values()
        split_of = assign_splits(groups, self.fractions, seed, too_few=self.too_few, what=what, fix=fix)
        return {key: (group, split_of[group]) for key, group in group_of.items()}


def check_no_leak(
    splits: Mapping[str, Iterable[SplitMember]], split_by: Literal["walk", "town"] = "walk"
) -> dict[str, int]:
    """Check that no walk, trajectory, flight or (if asked) town stands in two splits, no trajectory in two walks, and
    no sample twice.

    A sample's pictures are frames of its own flight, so that splits share no picture either. Holds eight bytes a
    sample.

    Returns:
        split -> number of samples.
    """
    owners: dict[tuple[str, str], str] = {}
    walks: dict[str, str] = {}
    numbers: dict[str, int] = {}  # of flights
    places = array("Q")  # flight, frame and language of each sample
    counts: dict[str, int] = {}
    for split, samples in splits.items():
        counts[split] = 0
        for sample in samples:
            counts[split] += 1
            trajectory = f"{sample.run}/{sample.town}/{sample.trajectory}"
            if (walk := walks.setdefault(trajectory, sample.walk)) != sample.walk:
                raise VerifyError(
                    "a drone trajectory has two pedestrian trajectories",
                    where=sample.key,
                    got=f"{walk} and {sample.walk}",
                )
            flight = f"{trajectory}/{sample.variant}"
            shared = [("walk", sample.walk), ("trajectory", trajectory), ("flight", flight)]
            if split_by == "town":
                shared.append(("town", town_family(sample.town)))
            for what, name in shared:
                if (owner := owners.setdefault((what, name), split)) != split:
                    got = f"{name} in {owner} and in {split}"
                    raise VerifyError(f"two splits share a {what}", where=sample.key, got=got)
            number = numbers.setdefault(flight, len(numbers))
            places.append((number << 32) + (sample.window[-1] << 1) + sample.key.endswith("/zh"))
    _check_once(places, list(numbers))
    return counts


def _check_once(places: array[int], flights: list[str]) -> None:
    ordered = np.frombuffer(places, dtype=np.uint64) if places else np.empty(0, dtype=np.uint64)
    ordered.sort()  # where they lie: of a million samples a copy counts
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(twice):
        place = int(twice[0])
        got = f"frame {(place & 0xFFFFFFFF) >> 1} of {flights[place >> 32]}, language {'zh' if place & 1 else 'en'}"
        raise VerifyError("the training set contains a sample twice", got=got)
