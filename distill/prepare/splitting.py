"""How samples go to splits: settings that all kinds of training sets share."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from cosfly.products.splits import SPLITS, Split
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
