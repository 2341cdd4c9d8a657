"""What a training set teaches, for those who ask the student later: `cosfly_student.json` (cosfly/chat/student_chat.py)."""

from __future__ import annotations

from collections.abc import Iterable

from cosfly.chat.student_chat import Look, Taught
from cosfly.errors import InputError
from cosfly.products.captions import Language, Prompt
from distill.schema import Sample


def taught_by(samples: Iterable[Sample], max_pixels: int) -> Taught:
    """Tell what samples teach.

    Args:
        max_pixels: most that the student's image processor keeps of a picture.
    Raises:
        InputError: their windows are of different lengths.
    """
    prompts: dict[Language, Prompt] = {}
    looks: set[Look] = set()
    lengths: set[int] = set()
    for sample in samples:
        prompts.setdefault(sample.language, sample.prompt)
        looks.add(Look(views=sample.views, size_px=sample.picture_px, depth_range_m=sample.depth_range_m))
        lengths.add(len(sample.frames))
    if len(lengths) != 1:
        raise InputError("a training set of windows of different lengths", got=f"{sorted(lengths)} frames")
    ordered = sorted(looks, key=lambda look: (look.views, look.size_px, look.depth_range_m))
    return Taught(prompts=dict(sorted(prompts.items())), num_frames=lengths.pop(), looks=ordered, max_pixels=max_pixels)
