"""What the steps of `distill` hand on: training samples, with their one reader.

Needs no torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from cosfly.frame_views import VIEW_FILES, Pictures, View
from cosfly.products.captions import Language, Prompt
from cosfly.products.playback import flight_of
from cosfly.products.predictions import Split
from cosfly.reading.documents import model_lines

SPLITS: tuple[Split, ...] = ("train", "val", "test")  # the order in which scarce trajectories are handed out


class Sample(BaseModel):
    """One line of a split file: what the student sees, and what it should answer."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_version: Literal["2.0"] = "2.0"
    sample_id: str
    language: Language
    town: str
    trajectory: str
    variant: str
    frames: list[str]  # folders of the playback tree, oldest first
    views: tuple[View, ...]  # the pictures of each frame, in this order
    picture_px: tuple[int, int]  # (width, height) of each, which pixel values of prompt and answer refer to
    depth_range_m: float  # dark end of depth pictures
    prompt: Prompt  # names these pictures
    answer: str  # JSON text of the three fields
    decision: str  # the answer's flight_decision
    label: str | None  # the decision that the future geometry calls for; None: it cannot tell
    proved: float | None  # share of the answer's sentences that the geometry proves; None: none was judged
    repair: str | None  # strategy of the repair that made the answer; None: as the teacher gave it
    weight: float

    @property
    def key(self) -> str:
        """Unique name of the sample: window and language."""
        return f"{self.sample_id}/{self.language}"

    @property
    def pictures(self) -> Pictures:
        return Pictures(self.views, self.picture_px, "separate", self.depth_range_m)

    @property
    def images(self) -> list[str]:
        """Files of the playback tree in the order of the pictures made of them: frame by frame, its views together."""
        return [f"{frame}/{VIEW_FILES[view]}" for frame in self.frames for view in self.views]

    def group(self, split_by: Literal["trajectory", "town"]) -> str:
        """Name what may not be shared by two splits. `Town03` and `Town03_Opt` are one town: the same map in two builds.

        A trajectory goes by its samples' id, which has the town in front where several towns have one of its name.
        """
        if split_by == "town":
            return self.town.removesuffix("_Opt")
        return flight_of(self.sample_id).removesuffix(f"_{self.variant}")


def split_path(dataset: Path, split: str) -> Path:
    return dataset / f"{split}.jsonl"


def read_split(dataset: Path, split: str) -> Iterator[Sample]:
    """Yield the samples of a split.

    Raises:
        InputError: names the file, the line and the field.
    """
    lines = model_lines(split_path(dataset, split), Sample, what="training set", fix="run cosfly distill prepare first")
    return (sample for _, sample in lines)
