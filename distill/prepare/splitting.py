"""How samples go to splits, and whether the splits that were written share what they may not."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping
from typing import Literal, Protocol

import numpy as np
from pydantic import Field, model_validator

from cosfly.errors import VerifyError
from cosfly.products.splits import SPLITS, Split, town_family
from cosfly.work.config import Config


class SplitConfig(Config):
    """What splits may not share, and how large they are."""

    split_by: Literal["walk", "town"] = Field(
        "walk",
        description="what may not be shared by two splits: all flights after one person on one way, or all builds of a town",
    )
    val_fraction: float = Field(0.1, ge=0, lt=1, description="share of walks (towns) for validation; 0: none")
    test_fraction: float = Field(0.1, ge=0, lt=1, description="share of walks (towns) for the test; 0: none")
    too_few: Literal["refuse", "fill"] = Field(
        "refuse",
        description="with fewer walks (towns) than splits: refuse, or fill train, then val, and leave the rest empty",
    )

    @model_validator(mode="after")
    def _fractions_leave_something(self) -> SplitConfig:
        if self.val_fraction + self.test_fraction >= 1.0:
            raise ValueError("val_fraction + test_fraction must stay below 1, or nothing is left to train on")
        return self

    @property
    def fractions(self) -> dict[Split, float]:
        shares: dict[Split, float] = {"val": self.val_fraction, "test": self.test_fraction}
        return {split: shares[split] for split in SPLITS if shares.get(split)}


class Placed(Protocol):
    """Of any kind of sample, what says whose it is; `window` are the frames of its pictures."""

    @property
    def key(self) -> str: ...
    @property
    def run(self) -> str: ...
    @property
    def town(self) -> str: ...
    @property
    def trajectory(self) -> str: ...
    @property
    def variant(self) -> str: ...
    @property
    def walk(self) -> str: ...
    @property
    def window(self) -> tuple[int, ...]: ...
    @property
    def language(self) -> str: ...


def check_no_leak(splits: Mapping[str, Iterable[Placed]], split_by: Literal["walk", "town"] = "walk") -> dict[str, int]:
    """Check that no walk, trajectory, flight or (if asked) town stands in two splits, no trajectory in two walks, and no sample twice.

    A sample's pictures are frames of its own flight, so that splits share no picture either. Holds eight bytes a sample.

    Returns:
        split -> number of samples.
    Raises:
        VerifyError: names what is shared and by which splits.
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
                raise VerifyError("a trajectory is of two walks", where=sample.key, got=f"{walk} and {sample.walk}")
            flight = f"{trajectory}/{sample.variant}"
            shared = [("walk", sample.walk), ("trajectory", trajectory), ("flight", flight)]
            if split_by == "town":
                shared.append(("town", town_family(sample.town)))
            for what, name in shared:
                if (owner := owners.setdefault((what, name), split)) != split:
                    raise VerifyError(
                        f"two splits share a {what}", where=sample.key, got=f"{name} in {owner} and in {split}"
                    )
            number = numbers.setdefault(flight, len(numbers))
            places.append((number << 32) + (sample.window[-1] << 1) + (sample.language == "zh"))
    _check_once(places, list(numbers))
    return counts


def _check_once(places: array[int], flights: list[str]) -> None:
    ordered = np.frombuffer(places, dtype=np.uint64) if places else np.empty(0, dtype=np.uint64)
    ordered.sort()  # where they lie: of a million samples a copy counts
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(twice):
        place = int(twice[0])
        got = f"frame {(place & 0xFFFFFFFF) >> 1} of {flights[place >> 32]}, language {'zh' if place & 1 else 'en'}"
        raise VerifyError("a sample stands twice in the training set", got=got)
