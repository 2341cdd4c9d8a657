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
# One picture as tensors by name. Before encoding, its inputs: those of the model, `pixel_...` and others such as
# `image_grid_thw`. After encoding, its features: the inputs without pixels, and what the vision tower returned:
#     pooled              (tokens, width), or as the family shapes it
#     deep.00, deep.01    the same for deeper layers of the language model, if the family has them
# Both names end with `[]` if the family returns a list with an entry for each picture instead of one tensor.
Tensors = dict[str, Any]
POOLED, DEEP, LISTED, PIXELS = "pooled", "deep.", "[]", "pixel_"


class _PictureOutput(SimpleNamespace):
    """The output of `get_image_features`, with the one method of transformers' outputs that a forward may call."""

    def to_tuple(self) -> tuple:
        return tuple(vars(self).values())


class FramePicture(NamedTuple):
    """One picture of a sample."""

    run: str  # of the playback tree
    frame: str  # folder in the tree
    view: Pictures  # which view of the frame, in the size and colours of the prompt
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
        """Read the inputs of a picture; InputError if its file is missing, damaged or of an unexpected size."""
        import torch

        (pixels,) = picture.view.read(inside(self.trees[picture.run], picture.frame))
        arrays = self.student.picture_inputs(limited_picture(pixels, self.max_pixels), is_alone=picture.is_alone)
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        return {name: t.to(self.student.dtype) if t.is_floating_point() else t for name, t in tensors.items()}

    def try_to_read(self, picture: FramePicture) -> Tensors | str:
        """Read a picture; return the message of the error if that fails."""
        try:
            return self.read(picture)
        except InputError as error:
            return str(error)


def encode(student: Student, inputs: Sequence[Tensors]) -> list[Tensors]:
    """Return the features of pictures. Those of equal shapes are encoded together; on a CPU each one alone, so that the
    results do not depend on the others."""
    groups: dict[Any, list[int]] = {}
    for i, picture in enumerate(inputs):
        shapes = tuple((name, tuple(tensor.shape)) for name, tensor in picture.items())
        groups.setdefault(i if student.device == "cpu" else shapes, []).append(i)
    features: dict[int, Tensors] = {}
    for group in groups.values():
        features |= zip(group, _encode_together(student, [inputs[i] for i in group]), strict=True)
    return [features[i] for i in range(len(inputs))]


def read_features(
    student: Student, pictures: Sequence[FramePicture], results: Iterable[Tensors | str], *,
    is_frozen: bool = True, most_bytes: float = math.inf,
) -> dict[FramePicture, Tensors | str]:  # fmt: skip
    """Return the features of pictures, on the CPU, or the message of an error; they are encoded as they are read.

    Args:
        results: what `try_to_read` returns for each picture.
        is_frozen: False returns the inputs, for a vision tower that is trained.
        most_bytes: of the features; once they are more, the other pictures are only read for their errors.
    """
    import torch

    features: dict[FramePicture, Tensors | str] = {}
    num_bytes = 0
    pairs = zip(pictures, results, strict=True)
    while batch := dict(islice(pairs, PICTURES_PER_BATCH)):
        features |= {picture: message for picture, message in batch.items() if isinstance(message, str)}
        if num_bytes >= most_bytes:
            continue
        inputs = {picture: tensors for picture, tensors in batch.items() if not isinstance(tensors, str)}
        new = list(inputs.values())
        if is_frozen:
            with torch.no_grad():
                new = encode(student, new)
        for picture, tensors in zip(inputs, new, strict=True):
            # A copy, because a tensor of a worker process holds a file open as long as it lives.
            features[picture] = {name: tensor.to("cpu", copy=True) for name, tensor in tensors.items()}
            num_bytes += sum(tensor.nbytes for tensor in tensors.values())
    return features


def _encode_together(student: Student, pictures: Sequence[Tensors]) -> list[Tensors]:
    """Return the features of pictures of equal shapes, given their inputs."""
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
        if isinstance(values, list | tuple):
            stored_name, by_picture = name + LISTED, values
        else:
            stored_name, by_picture = name, values.chunk(len(pictures))
        for tensors, value in zip(features, by_picture, strict=True):
            tensors[stored_name] = value.to(student.dtype)
    return features


@contextlib.contextmanager
def with_encoded_pictures(student: Student, features: Sequence[Tensors]) -> Iterator[dict[str, Any]]:
    """Make the model's own forward use the features of pictures instead of encoding them; yield its further inputs.

    That relies on three facts of transformers' families with pictures: forward calls the model's method
    `get_image_features` if it gets `pixel_values`; it uses the pixels for nothing else; and an attribute of the
    instance hides that method.
    """
    import torch

    if not features:
        yield {}
        return
    dtype, device = student.core.get_input_embeddings().weight.dtype, student.device

    def joined(name: str) -> Any:
        parts = [tensors[name].to(device, dtype) for tensors in features]
        return parts if name.endswith(LISTED) else torch.cat(parts)

    (pooled,) = (name for name in features[0] if name.startswith(POOLED))
    deep = sorted(name for name in features[0] if name.startswith(DEEP))  # in the order of the layers
    output = _PictureOutput(pooler_output=joined(pooled), deepstack_features=[joined(name) for name in deep])
    further_names = features[0].keys() - {pooled, *deep}
    further = {name: torch.cat([tensors[name] for tensors in features]).to(device) for name in further_names}
    model = student.core.base_model

    @functools.wraps(model.get_image_features)  # `generate` reads its signature
    def known_features(*_: Any, **__: Any) -> Any:
        return output

    model.__dict__["get_image_features"] = known_features
    try:
        yield {"pixel_values": torch.zeros(1, dtype=dtype, device=device), **further}
    finally:
        del model.__dict__["get_image_features"]
