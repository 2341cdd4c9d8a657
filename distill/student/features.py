"""Features of pictures: a frozen vision tower encodes each picture once, and the model finds the result in its forward.

A frame is part of up to five windows, in two languages, in every epoch, and a frozen tower always encodes it the same.
"""

import contextlib
import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from cosfly.llm.student_chat import limited_picture
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import inside
from cosfly.viz.frame_views import Pictures
from distill.schema import Sample
from distill.student.model import Student

PICTURES_PER_BATCH = 16  # that are read, and then encoded together
# Tensors of one picture by name. Before encoding: the inputs of the model. After it: those without PIXELS, such as
# `image_grid_thw`, and the features: POOLED, (tokens, width) or as the family shapes it, and DEEP + "00", ..., for
# deeper layers of the language model; names end with LISTED where the family returns a list, an entry per picture.
Tensors = dict[str, Any]
POOLED, DEEP, LISTED, PIXELS = "pooled", "deep.", "[]", "pixel_"


class FramePicture(NamedTuple):
    """One picture of a sample: a view of a frame of a run's playback tree, in the size and colors of the prompt."""

    run: str
    frame: str
    picture: Pictures
    is_alone: bool = False  # the only picture of its sample, which some families encode in more detail


def pictures_of(sample: Sample) -> list[FramePicture]:
    """Return the pictures of a sample in the order of its prompt."""
    views = [replace(sample.pictures, views=(view,)) for view in sample.views]
    is_alone = len(sample.frames) * len(views) == 1
    return [FramePicture(sample.run, frame, view, is_alone) for frame in sample.frames for view in views]


@dataclass(frozen=True)
class PictureReader:
    """Reads pictures, also in worker processes."""

    student: Student
    trees: Mapping[str, Path]  # run -> playback tree
    max_pixels: int = 0  # limit of a picture; 0: none

    def read(self, picture: FramePicture) -> Tensors:
        """Read a picture as the inputs of the model.

        Raises:
            InputError: a file of the playback tree is missing, damaged, or of another size than the prompt says.
        """
        import torch

        (pixels,) = picture.picture.read(inside(self.trees[picture.run], picture.frame))
        arrays = self.student.picture_inputs(limited_picture(pixels, self.max_pixels), is_alone=picture.is_alone)
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        return {name: t.to(self.student.dtype) if t.is_floating_point() else t for name, t in tensors.items()}

    def try_to_read(self, picture: FramePicture) -> Tensors | str:
        """Read a picture; return the message of the error if that fails."""
        try:
            return self.read(picture)
        except InputError as error:
            return str(error)


def encode(student: Student, pictures: Sequence[Tensors]) -> list[Tensors]:
    """Encode pictures, those of equal shapes together; on a CPU one at a time, so that results never differ."""
    groups: dict[Any, list[int]] = {}
    for i, picture in enumerate(pictures):
        shapes = tuple((name, tuple(tensor.shape)) for name, tensor in picture.items())
        groups.setdefault(i if student.device == "cpu" else shapes, []).append(i)
    features: dict[int, Tensors] = {}
    for group in groups.values():
        features |= zip(group, _encode_together(student, [pictures[i] for i in group]), strict=True)
    return [features[i] for i in range(len(pictures))]


def read_features(
    student: Student,
    pictures: Sequence[FramePicture],
    results: Iterable[Tensors | str],
    *,
    is_frozen: bool = True,
    most_bytes: float = math.inf,
) -> dict[FramePicture, Tensors | str]:
    """Encode pictures as they are read, and return their features, on the CPU, or the message of an error.

    Args:
        results: what `try_to_read` returns for each picture.
        is_frozen: False keeps the inputs of a tower that is trained.
        most_bytes: of the features; once they are more, the other pictures are read for their errors alone.
    """
    import torch

    features: dict[FramePicture, Tensors | str] = {}
    num_bytes = 0
    pairs = zip(pictures, results, strict=True)
    while batch := dict(islice(pairs, PICTURES_PER_BATCH)):
        features |= {picture: message for picture, message in batch.items() if isinstance(message, str)}
        inputs = {picture: tensors for picture, tensors in batch.items() if not isinstance(tensors, str)}
        if num_bytes >= most_bytes:
            continue
        with torch.no_grad():
            encoded = encode(student, list(inputs.values())) if is_frozen else list(inputs.values())
        for picture, tensors in zip(inputs, encoded, strict=True):
            # A copy, because a tensor of a worker process holds a file open as long as it lives.
            features[picture] = {name: tensor.to("cpu", copy=True) for name, tensor in tensors.items()}
            num_bytes += sum(tensor.nbytes for tensor in tensors.values())
    return features


def _encode_together(student: Student, pictures: Sequence[Tensors]) -> list[Tensors]:
    import torch

    if not hasattr(student.core.base_model, "get_image_features"):
        words, got = "the student has no method get_image_features to encode pictures", type(student.core).__name__
        fix = "use another student, or a training set without pictures (distill.prepare.modalities=[])"
        raise InputError(words, where="get_image_features", got=got, fix=fix)
    inputs = {name: torch.cat([tensors[name] for tensors in pictures]).to(student.device) for name in pictures[0]}
    with student.computing():
        output = student.core.base_model.get_image_features(**inputs)
    layers = getattr(output, "deepstack_features", None) or ()
    outputs = {POOLED: output.pooler_output} | {f"{DEEP}{i:02d}": layer for i, layer in enumerate(layers)}
    features = [{name: t for name, t in tensors.items() if not name.startswith(PIXELS)} for tensors in pictures]
    for name, values in outputs.items():
        is_listed = isinstance(values, list | tuple)
        for tensors, value in zip(features, values if is_listed else values.chunk(len(pictures)), strict=True):
            tensors[name + LISTED if is_listed else name] = value.to(student.dtype)
    return features


@contextlib.contextmanager
def with_encoded_pictures(student: Student, pictures: Sequence[Tensors]) -> Iterator[dict[str, Any]]:
    """Replace the encoder in the model's own forward by features of pictures; yield the further inputs of forward."""
    import torch

    if not pictures:
        yield {}
        return
    dtype, device = student.core.get_input_embeddings().weight.dtype, student.device

    def joined(name: str) -> Any:
        parts = [tensors[name].to(device, dtype) for tensors in pictures]
        return parts if name.endswith(LISTED) else torch.cat(parts)

    (pooled,) = (name for name in pictures[0] if name.startswith(POOLED))
    deep = sorted(name for name in pictures[0] if name.startswith(DEEP))  # in the order of the layers
    output = SimpleNamespace(pooler_output=joined(pooled), deepstack_features=[joined(name) for name in deep])
    names = pictures[0].keys() - {pooled, *deep}
    inputs = {name: torch.cat([tensors[name] for tensors in pictures]).to(device) for name in names}
    model = student.core.base_model

    @functools.wraps(model.get_image_features)  # `generate` reads its signature
    def encoded(*_: Any, **__: Any) -> Any:
        return output

    # An attribute of the instance hides the method of its class.
    model.__dict__["get_image_features"] = encoded
    try:
        # Forward asks for the features only if it is given pixels, whose values are not used then.
        yield {"pixel_values": torch.zeros(1, dtype=dtype, device=device), **inputs}
    finally:
        del model.__dict__["get_image_features"]
