"""What a frozen vision tower makes of pictures, kept in memory: each picture is read and looked at once.

A frame stands in up to five windows, in two languages, in every epoch, and a frozen tower always says the same of it.
What is kept is never thrown out: once the bound is reached, further pictures are looked at each time. Orders are drawn
anew each epoch, so no other rule would find more of them, and who asks can tell beforehand what will be there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from cosfly.runtime.io import inside
from cosfly.viz.frame_views import VIEW_FILES, Pictures, View
from distill.schema import Sample
from distill.student.encoding import patches_of, picture_grid
from distill.student.model import Processor, Student


class FramePicture(NamedTuple):
    """One picture that a student is shown: a view of a frame of a run's playback tree, in the size and the colours of
    the prompt."""

    run: str
    frame: str
    view: View
    size_px: tuple[int, int]
    depth_range_m: float

    @property
    def name(self) -> str:
        return f"{self.run}/{self.frame}/{VIEW_FILES[self.view]}"


@dataclass(frozen=True)
class PictureData:
    """A picture that was read: patches (p, d), a torch tensor."""

    picture: FramePicture
    patches: Any


def pictures_of(sample: Sample) -> list[FramePicture]:
    """Return the pictures of a sample in the order of its prompt."""
    return [
        FramePicture(sample.run, frame, view, sample.picture_px, sample.depth_range_m)
        for frame in sample.frames
        for view in sample.views
    ]


@dataclass(frozen=True)
class PictureReader:
    """Reads pictures, in worker processes. dtype: torch's name of what patches are given in."""

    processor: Processor
    trees: Mapping[str, Path]
    dtype: Any

    def read(self, picture: FramePicture) -> PictureData:
        """Read a picture.

        Raises:
            InputError: a file of the playback tree is missing, damaged, or of another size than the prompt says.
        """
        import torch

        shown = Pictures((picture.view,), picture.size_px, "separate", picture.depth_range_m)
        values = patches_of(self.processor, shown.read(inside(self.trees[picture.run], picture.frame)))
        return PictureData(picture, torch.from_numpy(values).to(self.dtype))


class VisionFeatures:
    """Features of pictures, in memory up to `memory_bytes`.

    For each step of a plan: `wanted` tells what must be read, `take` is given it, `of` gives features, `end_step`
    forgets what is not kept. With a tower that learns nothing is kept, and `of` has the tower look at the pictures each
    time.
    """

    def __init__(self, student: Student, *, memory_bytes: int = 0, is_frozen: bool = True) -> None:
        self.student, self.is_frozen = student, is_frozen
        self.memory_bytes = memory_bytes if is_frozen else 0
        # One at a time, features do not depend on what else is looked at, to the last bit.
        self.encode_batch = 1 if student.device == "cpu" else 16
        self._kept: dict[FramePicture, Any] = {}  # features
        self._here: dict[FramePicture, Any] = {}  # of the step at hand; what was read, of a tower that learns
        self._has_room: set[FramePicture] = set()
        self._room_bytes = 0
        self.num_encoded = 0

    def bytes_of(self, picture: FramePicture) -> int:
        """Return what the features of a picture take."""
        width = self.student.core.config.text_config.hidden_size
        return self._tokens_of(picture) * width * self.student.dtype.itemsize

    def _tokens_of(self, picture: FramePicture) -> int:
        grid = picture_grid(self.student, picture.size_px)
        return math.prod(grid) // self.student.image_processor.merge_size**2

    def plan(self) -> set[FramePicture]:
        """Begin to plan steps: gives the pictures that need not be read any more."""
        return set(self._kept)

    def wanted(self, plan: set[FramePicture], pictures: Iterable[FramePicture]) -> list[FramePicture]:
        """Return those of a step's pictures that must be read, and add to the plan those of them that will stay.

        The steps of one plan are asked about in their order; earlier ones need not have been taken yet.
        """
        wanted = [picture for picture in dict.fromkeys(pictures) if picture not in plan]
        for picture in wanted:
            size = self.bytes_of(picture)
            if picture not in self._has_room and self._room_bytes + size <= self.memory_bytes:
                self._has_room.add(picture)
                self._room_bytes += size
            if picture in self._has_room:
                plan.add(picture)
        return wanted

    def take(self, loaded: Sequence[PictureData]) -> None:
        """Take what was read: look at what is new, and keep it."""
        if not self.is_frozen:
            self._here |= {item.picture: item for item in loaded}
            return
        import torch

        new = [item for item in loaded if item.picture not in self._kept]
        with torch.no_grad():
            for start in range(0, len(new), self.encode_batch):
                group = new[start : start + self.encode_batch]
                for item, features in zip(group, self._look_at(group), strict=True):
                    place = self._kept if item.picture in self._has_room else self._here
                    place[item.picture] = features.cpu()
        self.num_encoded += len(new)

    def _look_at(self, items: Sequence[PictureData]) -> Sequence[Any]:
        """Have the tower look at pictures: for each (t, width)."""
        import torch

        student = self.student
        grids = torch.tensor([picture_grid(student, item.picture.size_px) for item in items], device=student.device)
        patches = torch.cat([item.patches for item in items]).to(student.device)
        with student.computing():
            found = student.core.get_image_features(patches, grids).pooler_output
        counts = [self._tokens_of(item.picture) for item in items]
        return torch.cat(tuple(found)).to(student.dtype).split(counts)

    def of(self, pictures: Sequence[FramePicture]) -> Any:
        """Return the features of pictures that were taken, below each other: (tokens, width) on the student's
        device."""
        import torch

        if not pictures:
            width = self.student.core.config.text_config.hidden_size
            return torch.zeros((0, width), dtype=self.student.dtype, device=self.student.device)
        if not self.is_frozen:
            distinct = list(dict.fromkeys(pictures))
            looks = dict(zip(distinct, self._look_at([self._here[one] for one in distinct]), strict=True))
            return torch.cat([looks[picture] for picture in pictures])
        found = [self._kept[one] if one in self._kept else self._here[one] for one in pictures]
        return torch.cat(found).to(self.student.device)

    def end_step(self) -> None:
        """Forget what is not kept."""
        self._here.clear()
