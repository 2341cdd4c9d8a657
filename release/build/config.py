"""The settings of `cosfly release build`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field, model_validator

from cosfly.formats.boxes import LicenceId
from cosfly.formats.frames import FILE_NAMES, FrameFile
from cosfly.formats.places import TrackName
from cosfly.runtime.config import Config, Distinct
from release.columns import SplitName
from release.record import Pairs, Selection, SplitBy

MB = 1024 * 1024


class ReleaseConfig(Config):
    """What is published, and how it is cut into files."""

    name: str = Field("CosFly flights", min_length=1, description="title of the data set card")
    licence: LicenceId | None = Field(
        None,
        description="licence of the data set, as spelled on the Hugging Face Hub (cc-by-4.0); null: that of all maps",
    )
    credits: str = Field("", description="attribution besides that of the maps, which is always included")
    selection: Selection = Field(
        "stride",
        description="frames of each track. stride: a uniform stride, as in the paper; windows: runs of consecutive "
        "frames, for training on the pictures of windows; all",
    )
    num_frames: int = Field(400, ge=1, description="largest number of frames per track; not used with selection all")
    flights: tuple[str, ...] = Field(
        (), description="patterns of track folders, such as Town01/trajectory_17*/ORI; empty: all"
    )
    tracks: Distinct[tuple[TrackName, ...]] = Field(
        ("clean", "perturbed"), min_length=1, description="tracks of a trajectory to release"
    )
    pairs: Pairs = Field(
        "both",
        description="both: release the two tracks of a trajectory together or not at all; any: also a single track",
    )
    include_review: bool = Field(False, description="also release tracks that the inspection sends to review")
    split_by: SplitBy = Field(
        "walk", description="what two splits must not share: a pedestrian trajectory (walk), or a town"
    )
    validation_fraction: float = Field(
        0.1, ge=0, lt=1, description="share of pedestrian trajectories (or towns) for validation; 0: none"
    )
    test_fraction: float = Field(
        0.1, ge=0, lt=1, description="share of pedestrian trajectories (or towns) for the test; 0: none"
    )
    split_seed: ClassVar[int] = 0  # of the division into splits
    modalities: Distinct[tuple[FrameFile, ...]] = Field(
        tuple(FILE_NAMES), min_length=1, description="pictures to include: rgb, depth, instance"
    )
    shard_mb: int = Field(
        500,
        ge=1,
        description="approximate size of a parquet file before compression, MB; exceeded by at most one trajectory",
    )
    row_group_mb: int = Field(
        64, ge=1, le=1024, description="size of a row group before compression, MB; viewers load one at a time"
    )

    @model_validator(mode="after")
    def _fractions_leave_something(self) -> ReleaseConfig:
        if self.validation_fraction + self.test_fraction >= 1.0:
            raise ValueError(
                "validation_fraction + test_fraction must be below 1, so that frames are left for training"
            )
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
