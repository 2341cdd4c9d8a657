"""What a frozen vision tower makes of pictures, kept by content: each picture is decoded and looked at once, in memory first, then on disk.

A frame stands in up to five windows, in two languages, in every epoch, and a frozen tower always says the same of it. What is kept is
never thrown out: once the bounds are reached, further pictures are looked at each time. Orders are drawn anew each epoch, so no other
rule would find more of them, and who asks can tell beforehand what will be there.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosfly.errors import InputError
from cosfly.look.frame_views import VIEW_FILES, Pictures, View
from cosfly.reading.arrays import read_array
from cosfly.reading.files import sha256_file
from cosfly.work.store import inside, storage_errors
from distill.schema import Sample
from distill.student.encoding import patches_of, picture_grid
from distill.student.model import Processor, Student

KEY_DIGITS = 32  # of a digest of 64


class Picture(NamedTuple):
    """One picture that a student is shown: a view of a frame of a run's playback tree, in the size and the colours of the prompt."""

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
    """A picture that was read: patches (p, d), or features (t, width) where they were found on disk; both torch tensors."""

    picture: Picture
    key: str
    patches: Any = None
    features: Any = None


def pictures_of(sample: Sample) -> list[Picture]:
    """Give the pictures of a sample in the order of its prompt."""
    return [
        Picture(sample.run, frame, view, sample.picture_px, sample.depth_range_m)
        for frame in sample.frames
        for view in sample.views
    ]


# --- keys -------------------------------------------------------------------------------------------------------------


def tower_key(student: Student) -> str:
    """Name what features depend on beside the picture: weights of the tower, what it computes in, how pictures are cut and scaled."""
    import torch

    digest = hashlib.sha256(f"{student.dtype}\n".encode())
    images = student.image_processor
    names = (
        "patch_size",
        "merge_size",
        "temporal_patch_size",
        "image_mean",
        "image_std",
        "rescale_factor",
        "resample",
        "size",
    )
    digest.update("".join(f"{name}={getattr(images, name, None)!r}\n" for name in names).encode())
    for name, tensor in sorted(student.tower.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.detach().to(student.dtype).cpu().contiguous().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:KEY_DIGITS]


def content_key(picture: Picture, trees: Mapping[str, Path]) -> str:
    """Name a picture by what stands in its files, and by how it is shown.

    Raises:
        InputError: a file of the playback tree cannot be read.
    """
    tree = trees[picture.run]
    folder = inside(tree, picture.frame)
    digest = hashlib.sha256(repr(picture[2:]).encode())
    paths = [folder / VIEW_FILES[picture.view]]
    if picture.view == "segmentation" and (told := folder / "meta.json").exists():  # which of the people is the target
        paths.append(told)
    for path in paths:
        digest.update(f"{path.name} {sha256_file(path, tree=tree)}\n".encode())
    return digest.hexdigest()[:KEY_DIGITS]


def folder_bytes(folder: Path) -> int:
    """Give what stands in a folder of features already."""
    return sum(path.stat().st_size for path in folder.rglob("*.npy"))


# --- worker processes -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PictureReader:
    """Reads pictures, in worker processes: their features where these stand on disk, else their patches.

    features: the folder of features of the tower; None: none are kept. dtype: torch's name of what patches are given in.
    """

    processor: Processor
    trees: Mapping[str, Path]
    features: Path | None
    dtype: Any

    def read(self, picture: Picture) -> PictureData:
        """Read a picture.

        Raises:
            InputError: a file of the playback tree is missing, damaged, or of another size than the prompt says.
        """
        import torch

        key = content_key(picture, self.trees)
        if self.features is not None and (found := read_features(self.features, key, self.dtype)) is not None:
            return PictureData(picture, key, features=found)
        shown = Pictures((picture.view,), picture.size_px, "separate", picture.depth_range_m)
        values = patches_of(self.processor, shown.read(inside(self.trees[picture.run], picture.frame)))
        return PictureData(picture, key, patches=torch.from_numpy(values).to(self.dtype))


def read_features(folder: Path, key: str, dtype: Any) -> Any:
    """Give features from disk; None where there are none, or a damaged file, which is then made anew."""
    import torch

    path = _feature_file(folder, key)
    if not path.exists():
        return None
    try:
        array = read_array(path, dtype=np.int16, ndim=2, what="features", tree=folder)
    except InputError:
        return None
    return torch.from_numpy(array).view(dtype)


def _feature_file(folder: Path, key: str) -> Path:
    return folder / key[:2] / f"{key}.npy"


# --- the cache --------------------------------------------------------------------------------------------------------


class VisionFeatures:
    """Features of pictures by content: in memory up to `memory_bytes`, what that has no room for on disk up to `disk_bytes`.

    For each step of a plan: `wanted` tells what must be read, `take` is given it, `of` gives features, `end_step` forgets what is
    not kept.
    With a tower that learns nothing is kept, and `of` has the tower look at the pictures each time.
    """

    def __init__(
        self,
        student: Student,
        *,
        folder: Path | None = None,
        memory_bytes: int = 0,
        disk_bytes: int = 0,
        is_frozen: bool = True,
    ) -> None:
        self.student, self.is_frozen = student, is_frozen
        self.folder = folder / tower_key(student) if folder is not None and is_frozen else None
        self.memory_bytes, self.disk_bytes = memory_bytes if is_frozen else 0, disk_bytes
        # One at a time, features do not depend on what else is looked at, to the last bit.
        self.encode_batch = 1 if student.device == "cpu" else 16
        self._kept: dict[str, Any] = {}  # key -> features
        self._here: dict[str, Any] = {}  # of the step at hand; patches of a tower that learns
        self._keys: dict[Picture, str] = {}
        self._has_room: set[Picture] = set()
        self._room_bytes = self._stored_bytes = 0
        self.num_encoded = self.num_from_disk = 0

    def bytes_of(self, picture: Picture) -> int:
        """Give what the features of a picture take."""
        width = self.student.core.config.text_config.hidden_size
        return self._tokens_of(picture) * width * self.student.dtype.itemsize

    def _tokens_of(self, picture: Picture) -> int:
        grid = picture_grid(self.student, picture.size_px)
        return math.prod(grid) // self.student.image_processor.merge_size**2

    def plan(self) -> set[Picture]:
        """Begin to plan steps: gives the pictures that need not be read any more."""
        return {picture for picture in self._has_room if self._keys.get(picture) in self._kept}

    def wanted(self, plan: set[Picture], pictures: Iterable[Picture]) -> list[Picture]:
        """Give those of a step's pictures that must be read, and add to the plan those of them that will stay.

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
        new: dict[str, PictureData] = {}
        for item in loaded:
            key = self._keys[item.picture] = item.key
            if key in self._kept or key in self._here:
                continue
            if item.features is not None:
                self._here[key] = item.features
                self.num_from_disk += 1
            elif self.is_frozen:
                new.setdefault(key, item)
            else:
                self._here[key] = item
        self._look_at_all(list(new.values()))
        for item in loaded:
            if item.picture in self._has_room and item.key not in self._kept:
                self._kept[item.key] = self._here[item.key]
            elif item.key in new and item.key not in self._kept:
                self._store(item.key, self._here[item.key])

    def _look_at_all(self, items: Sequence[PictureData]) -> None:
        import torch

        with torch.no_grad():
            for start in range(0, len(items), self.encode_batch):
                group = items[start : start + self.encode_batch]
                for item, features in zip(group, self._look_at(group), strict=True):
                    self._here[item.key] = features.cpu()
        self.num_encoded += len(items)

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

    def _store(self, key: str, features: Any) -> None:
        """Write to disk, where there is room, what memory has no room for."""
        import torch

        size = features.numel() * features.element_size()
        if self.folder is None or self._stored_bytes + size > self.disk_bytes:
            return
        path = _feature_file(self.folder, key)
        partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                with open(partial, "xb") as file:  # not synchronized: what a crash damages is made anew
                    np.save(file, features.contiguous().view(torch.int16).numpy())  # the bits: NumPy has no bfloat16
                os.replace(partial, path)
            except BaseException:
                partial.unlink(missing_ok=True)
                raise
        self._stored_bytes += size

    def of(self, pictures: Sequence[Picture]) -> Any:
        """Give the features of pictures that were taken, below each other: (tokens, width) on the student's device."""
        import torch

        if not pictures:
            width = self.student.core.config.text_config.hidden_size
            return torch.zeros((0, width), dtype=self.student.dtype, device=self.student.device)
        keys = [self._keys[picture] for picture in pictures]
        if not self.is_frozen:
            distinct = list(dict.fromkeys(keys))
            looks = dict(zip(distinct, self._look_at([self._here[key] for key in distinct]), strict=True))
            return torch.cat([looks[key] for key in keys])
        found = [self._kept[key] if key in self._kept else self._here[key] for key in keys]
        return torch.cat(found).to(self.student.device)

    def end_step(self) -> None:
        """Forget what is not kept."""
        self._here.clear()
