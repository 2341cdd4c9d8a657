"""The settings of `cosfly release build`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field, field_validator, model_validator

from cosfly.formats.boxes import LicenceId
from cosfly.formats.frames import FILE_NAMES, FrameFile
from cosfly.formats.places import TrackName
from cosfly.runtime.config import Config
from release.columns import SplitName
from release.record import Pairs, SplitBy

MB = 1024 * 1024


class ReleaseConfig(Config):
    """What is published, and how it is cut into files."""

    name: str = Field("CosFly flights", min_length=1, description="title of the data-set card")
    licence: LicenceId | None = Field(
        None, description="licence of the data set, as the hub spells it (cc-by-4.0); null: its maps', if they agree"
    )
    credits: str = Field("", description="who else must be named; the maps' own licences and credits always are")
    num_frames: int | None = Field(
        400,
        ge=1,
        description="frames per flight, in runs that keep captions' windows whole; shorter ones are whole; null: all",
    )
    uniform_stride: bool = Field(
        False,
        description="choose frames one by one, as the paper does; captions whose windows lack frames are left out",
    )
    flights: tuple[str, ...] = Field(
        (),
        description="patterns for the folders of flights in their trees, as Town01/trajectory_17*/ORI; empty: all",
    )
    tracks: tuple[TrackName, ...] = Field(
        ("clean", "perturbed"), min_length=1, description="which flights of a trajectory"
    )
    pairs: Pairs = Field(
        "both",
        description="both: of two wanted tracks neither without the other; any: also flights whose twin is left out",
    )
    include_review: bool = Field(False, description="also release flights that the inspection routed to manual review")
    unbound: str = Field(
        "refuse",
        pattern="^(refuse|accept)$",
        description="captions of which no record says from which tree they were made: refuse or accept",
    )
    split_by: SplitBy = Field("walk", description="what two splits may not share: a walk, or a town in all its builds")
    validation_fraction: float = Field(0.1, ge=0, lt=1, description="share of walks (towns) for validation; 0: none")
    test_fraction: float = Field(0.1, ge=0, lt=1, description="share of walks (towns) for the test; 0: none")
    split_seed: ClassVar[int] = 0  # of the division into splits
    modalities: tuple[FrameFile, ...] = Field(
        tuple(FILE_NAMES), min_length=1, description="pictures to include: rgb, depth, instance"
    )
    shard_mb: int = Field(
        500, ge=1, description="size that a parquet file should not pass by more than one flight, MB before compression"
    )
    row_group_mb: int = Field(
        64, ge=1, le=1024, description="size of a row group before compression, MB; viewers load one at a time"
    )

    @field_validator("tracks", "modalities")
    @classmethod
    def _distinct(cls, values: tuple) -> tuple:
        if len(set(values)) != len(values):
            raise ValueError("an entry is listed twice")
        return values

    @model_validator(mode="after")
    def _fractions_leave_something(self) -> ReleaseConfig:
        if self.validation_fraction + self.test_fraction >= 1.0:
            raise ValueError("validation_fraction + test_fraction must stay below 1, or nothing is left to train on")
        return self

    @property
    def fractions(self) -> dict[SplitName, float]:
        train = round(1.0 - self.validation_fraction - self.test_fraction, 9)
        return {"train": train, "validation": self.validation_fraction, "test": self.test_fraction}

    @property
    def shard_bytes(self) -> int:
        return self.shard_mb * MB

    @property
    def row_group_bytes(self) -> int:
        return self.row_group_mb * MB
