"""What a frozen vision tower makes of pictures, kept in memory: each picture is read and encoded once.

A frame is part of up to five windows, in two languages, in every epoch, and a frozen tower always encodes it the same.
Kept features are never removed: once the memory limit is reached, further pictures are encoded at each use. Samples are
shuffled in each epoch, so no other rule would find more of them, and it is known beforehand what will be there.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from cosfly.llm.student_chat import limited_picture, limited_size
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import inside
from cosfly.viz.frame_views import VIEW_FILES, Pictures, View
from distill.schema import Sample
from distill.student.chat import Processor
from distill.student.model import Student


class FramePicture(NamedTuple):
    """One picture of a sample: a view of a frame of a run's playback tree, in the size and the colours of the
    prompt."""

    run: str
    frame: str
    view: View
    size_px: tuple[int, int]
    depth_range_m: float
    is_alone: bool = False  # the only picture of its sample, which some families encode in more detail

    @property
    def name(self) -> str:
        return f"{self.run}/{self.frame}/{VIEW_FILES[self.view]}"


@dataclass(frozen=True)
class PictureData:
    """A picture that was read: what the model takes of it, torch tensors by name."""

    picture: FramePicture
    inputs: dict[str, Any]


def pictures_of(sample: Sample) -> list[FramePicture]:
    """Return the pictures of a sample in the order of its prompt."""
    is_alone = len(sample.frames) * len(sample.views) == 1
    return [
        FramePicture(sample.run, frame, view, sample.picture_px, sample.depth_range_m, is_alone)
        for frame in sample.frames
        for view in sample.views
    ]


@dataclass(frozen=True)
class PictureReader:
    """Reads pictures, in worker processes.

    dtype: torch type of the pixels. max_pixels: limit of a picture, as in `limited_picture`; 0: none.
    """

    processor: Processor
    trees: Mapping[str, Path]
    dtype: Any
    max_pixels: int = 0

    def read(self, picture: FramePicture) -> PictureData:
        """Read a picture.

        Raises:
            InputError: a file of the playback tree is missing, damaged, or of another size than the prompt says.
        """
        import torch

        shown = Pictures((picture.view,), picture.size_px, "separate", picture.depth_range_m)
        (pixels,) = shown.read(inside(self.trees[picture.run], picture.frame))
        found = self.processor.picture_inputs(limited_picture(pixels, self.max_pixels), is_alone=picture.is_alone)
        tensors = {name: torch.from_numpy(array) for name, array in found.items()}
        return PictureData(picture, {n: t.to(self.dtype) if t.is_floating_point() else t for n, t in tensors.items()})


def pack(loaded: Sequence[PictureData]) -> tuple[Any, list[Any]]:
    """Put the numbers of pictures of one type into one tensor, because each tensor that goes from one process to
    another holds a file open. Returns what `unpack` takes."""
    import torch

    parts: dict[Any, list[Any]] = {}
    layout = []
    for item in loaded:
        layout.append((item.picture, {n: (t.dtype, tuple(t.shape)) for n, t in item.inputs.items()}))
        for tensor in item.inputs.values():
            parts.setdefault(tensor.dtype, []).append(tensor.reshape(-1))
    return {dtype: torch.cat(tensors) for dtype, tensors in parts.items()}, layout


def unpack(packed: tuple[Any, list[Any]]) -> list[PictureData]:
    """Return the pictures that were packed."""
    tensors, layout = packed
    begins, found = dict.fromkeys(tensors, 0), []
    for picture, inputs in layout:
        own = {}
        for name, (dtype, shape) in inputs.items():
            begin = begins[dtype]
            begins[dtype] = end = begin + math.prod(shape)
            own[name] = tensors[dtype][begin:end].view(shape)
        found.append(PictureData(picture, own))
    return found


@dataclass(frozen=True)
class Encoded:
    """The features of one picture, and the inputs that describe it without its pixels, such as its grid.

    pooled: (tokens, width), or as the family shapes it; is_listed: the family gives a list, one entry a picture.
    deep: features for deeper layers of the language model, one entry a layer; () for most families.
    """

    pooled: Any
    is_listed: bool
    deep: tuple[Any, ...]
    is_deep_listed: bool
    inputs: dict[str, Any]

    def to(self, device: str) -> Encoded:
        deep = tuple(part.to(device) for part in self.deep)
        return Encoded(self.pooled.to(device), self.is_listed, deep, self.is_deep_listed, self.inputs)

    def num_bytes(self) -> int:
        return sum(part.numel() * part.element_size() for part in (self.pooled, *self.deep))


def encode(student: Student, loaded: Sequence[PictureData]) -> list[Encoded]:
    """Encode pictures of one size together."""
    import torch

    if not student.has_image_features:
        words, got = "the family of the student encodes no pictures apart", type(student.core).__name__
        fix = "use another student, or a training set without pictures (distill.prepare.modalities=[])"
        raise InputError(words, where="get_image_features", got=got, fix=fix)
    inputs = {n: torch.cat([item.inputs[n] for item in loaded]).to(student.device) for n in loaded[0].inputs}
    with student.computing():
        found = student.core.base_model.get_image_features(**inputs)
    deep, count = getattr(found, "deepstack_features", None) or (), len(loaded)
    pooled, is_listed = _split(found.pooler_output, count)
    layers = [_split(layer, count) for layer in deep]
    described = [{n: t for n, t in item.inputs.items() if not n.startswith("pixel_")} for item in loaded]
    return [
        Encoded(
            pooled[i].to(student.dtype),
            is_listed,
            tuple(parts[i].to(student.dtype) for parts, _ in layers),
            any(listed for _, listed in layers),
            described[i],
        )
        for i in range(count)
    ]


def _split(features: Any, count: int) -> tuple[Sequence[Any], bool]:
    """Return the features of each picture, and whether the family lists them."""
    if isinstance(features, list | tuple):
        if len(features) != count:
            words = "the vision tower returns features of another number of pictures"
            raise InputError(words, got=len(features), expected=f"{count}")
        return features, True
    return features.chunk(count), False


@contextlib.contextmanager
def shown(student: Student, pictures: Sequence[Encoded]) -> Iterator[dict[str, Any]]:
    """Let the model's own forward find these features where it would encode pixels; yields the inputs to give it."""
    import torch

    if not pictures:
        yield {}
        return
    dtype = student.core.get_input_embeddings().weight.dtype
    at = student.device

    def joined(parts: Sequence[Any], is_listed: bool) -> Any:
        parts = [part.to(at, dtype) for part in parts]
        return parts if is_listed else torch.cat(parts)

    first = pictures[0]
    found = SimpleNamespace(pooler_output=joined([one.pooled for one in pictures], first.is_listed))
    layers = zip(*(one.deep for one in pictures), strict=True)
    found.deepstack_features = [joined(parts, first.is_deep_listed) for parts in layers]
    model = student.core.base_model
    inputs = {n: torch.cat([one.inputs[n] for one in pictures]).to(at) for n in first.inputs}

    @functools.wraps(model.get_image_features)  # `generate` reads its signature
    def kept(*_: Any, **__: Any) -> Any:
        return found

    model.__dict__["get_image_features"] = kept
    try:
        yield {"pixel_values": torch.zeros(1, dtype=dtype, device=at), **inputs}
    finally:
        del model.__dict__["get_image_features"]


class VisionFeatures:
    """Features of pictures, in memory up to `memory_bytes`.

    For each step of a plan: `wanted` returns what must be read, `take` is given it, `of` returns features, `end_step`
    drops what is not kept. With a tower that is trained nothing is kept, and `of` encodes the pictures each time.
    """

    def __init__(self, student: Student, *, memory_bytes: int = 0, is_frozen: bool = True, max_pixels: int = 0) -> None:
        self.student, self.is_frozen, self.max_pixels = student, is_frozen, max_pixels
        self.memory_bytes = memory_bytes if is_frozen else 0
        # One at a time, features do not depend on what else is encoded, to the last bit.
        self.encode_batch = 1 if student.device == "cpu" else 16
        self._kept: dict[FramePicture, Encoded] = {}
        self._here: dict[FramePicture, Any] = {}  # of the current step; with a tower that is trained, what was read
        self._has_room: set[FramePicture] = set()
        self._room_bytes = 0
        self.num_encoded = 0

    def bytes_of(self, picture: FramePicture) -> int:
        """Return what the features of a picture take."""
        student, config = self.student, self.student.core.config
        layers = 1 + len(getattr(config.vision_config, "deepstack_visual_indexes", ()) or ())
        tokens = student.picture_tokens(limited_size(picture.size_px, self.max_pixels))
        return tokens * student.width * student.dtype.itemsize * layers

    def plan(self) -> set[FramePicture]:
        """Begin to plan steps: return the pictures that need not be read any more."""
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
        """Take what was read: encode what is new, and keep it."""
        if not self.is_frozen:
            self._here |= {item.picture: item for item in loaded}
            return
        import torch

        new = [item for item in loaded if item.picture not in self._kept]
        with torch.no_grad():
            for item, features in zip(new, self._encode(new), strict=True):
                place = self._kept if item.picture in self._has_room else self._here
                place[item.picture] = features.to("cpu")
        self.num_encoded += len(new)

    def _encode(self, items: Sequence[PictureData]) -> list[Encoded]:
        """Encode pictures, those of one size together."""
        groups: dict[Any, list[int]] = {}
        for place, item in enumerate(items):
            groups.setdefault(tuple((n, tuple(t.shape)) for n, t in item.inputs.items()), []).append(place)
        found: dict[int, Encoded] = {}
        for places in groups.values():
            for start in range(0, len(places), self.encode_batch):
                part = places[start : start + self.encode_batch]
                found |= dict(zip(part, encode(self.student, [items[place] for place in part]), strict=True))
        return [found[place] for place in range(len(items))]

    def of(self, pictures: Sequence[FramePicture]) -> list[Encoded]:
        """Return the features of pictures that were taken."""
        if self.is_frozen or not pictures:
            return [self._kept[one] if one in self._kept else self._here[one] for one in pictures]
        distinct = list(dict.fromkeys(pictures))
        found = dict(zip(distinct, self._encode([self._here[one] for one in distinct]), strict=True))
        return [found[picture] for picture in pictures]

    def end_step(self) -> None:
        """Drop what is not kept."""
        self._here.clear()
