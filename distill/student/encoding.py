"""Samples as tensors: images, prompt tokens, answer tokens, and batches of them.

Prompt and answer are tokenized apart and joined, which is what inference sees: no token spans the border, so the mask that
keeps the loss on the answer is exact by construction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from cosfly.errors import InputError
from cosfly.products.frames import tree_of
from cosfly.reading.arrays import array_header, picture_size
from cosfly.store import inside
from cosfly.student_chat import IMAGE_PART, chat_messages
from distill.schema import Sample
from distill.student.model import IMAGE_TOKEN, Student

IGNORED = -100  # label of tokens that carry no loss, the convention of PyTorch's cross entropy


@dataclass(frozen=True)
class Encoded:
    """One sample as arrays: prompt_ids, answer_ids (n,) int64, the end token included in the answer; patches of all images
    (p, d) float32 and their grids (k, 3) int64."""

    key: str
    prompt_ids: np.ndarray
    answer_ids: np.ndarray
    pixel_values: np.ndarray
    image_grids: np.ndarray
    weight: float

    def __len__(self) -> int:
        return len(self.prompt_ids) + len(self.answer_ids)


def messages_of(sample: Sample) -> list[dict[str, Any]]:
    """Give the chat of a sample, with a mark for every picture."""
    return chat_messages(sample.prompt, [[IMAGE_PART] * len(sample.views) for _ in sample.frames])


# --- images -----------------------------------------------------------------------------------------------------------


def load_pictures(sample: Sample, trees: Mapping[str, Path]) -> list[np.ndarray]:
    """Load the pictures of a sample as its teacher saw them, each (h, w, 3) uint8 RGB.

    Args:
        trees: run -> playback tree (`resolve_trees`).
    Raises:
        InputError: a picture is missing, damaged or of another size.
    """
    tree = trees[sample.run]
    return [picture for frame in sample.frames for picture in sample.pictures.read(inside(tree, frame))]


def most_pixels(samples: Sequence[Sample]) -> int:
    """Give the pixels of the largest picture."""
    return max(width_px * height_px for width_px, height_px in (sample.picture_px for sample in samples))


def image_size(path: Path) -> tuple[int, int]:
    """Give (width, height) px of a file of a frame, from its header alone."""
    if path.name == "depth.npy":
        height_px, width_px = array_header(path, tree=tree_of(path.parent)).shape
        return width_px, height_px
    size = picture_size(path, tree=tree_of(path.parent))
    if size is None:
        raise InputError("not an image", where=path, expected="a PNG", fix="check --data")
    return size


# --- tokens -----------------------------------------------------------------------------------------------------------


def _prompt_ids(student: Student, sample: Sample, tokens_per_image: Sequence[int]) -> np.ndarray:
    text = student.tokenizer.apply_chat_template(
        messages_of(sample), tokenize=False, add_generation_prompt=True, enable_thinking=False
    )
    pieces = text.split(IMAGE_TOKEN)
    if len(pieces) != len(tokens_per_image) + 1:
        raise InputError(
            "the prompt and its images do not match",
            where=sample.key,
            got=f"{len(pieces) - 1} image marks",
            expected=f"{len(tokens_per_image)}",
            fix=f"the prompt text may not hold {IMAGE_TOKEN}",
        )
    expanded = pieces[0] + "".join(
        IMAGE_TOKEN * count + piece for count, piece in zip(tokens_per_image, pieces[1:], strict=True)
    )
    return np.array(student.tokenizer(expanded, add_special_tokens=False)["input_ids"], dtype=np.int64)


def _answer_ids(student: Student, sample: Sample) -> np.ndarray:
    ids = student.tokenizer(sample.answer, add_special_tokens=False)["input_ids"]
    return np.array([*ids, student.end_token_id], dtype=np.int64)


def count_tokens(student: Student, sample: Sample) -> tuple[int, int]:
    """Give the real numbers of (prompt, answer) tokens, images included, without loading a pixel."""
    processor = student.image_processor
    width_px, height_px = sample.picture_px
    count = processor.get_number_of_image_patches(height_px, width_px, {}) // processor.merge_size**2
    return len(_prompt_ids(student, sample, [count] * len(sample.images))), len(_answer_ids(student, sample))


def encode(student: Student, sample: Sample, trees: Mapping[str, Path]) -> Encoded:
    """Make the arrays of one sample.

    Raises:
        InputError: a picture of its playback tree cannot be read.
    """
    images = [Image.fromarray(picture) for picture in load_pictures(sample, trees)]
    vision = student.image_processor(images, return_tensors="np")
    grids = np.asarray(vision["image_grid_thw"], dtype=np.int64)
    counts = (grids.prod(axis=1) // student.image_processor.merge_size**2).tolist()
    return Encoded(
        key=sample.key,
        prompt_ids=_prompt_ids(student, sample, counts),
        answer_ids=_answer_ids(student, sample),
        pixel_values=np.asarray(vision["pixel_values"], dtype=np.float32),
        image_grids=grids,
        weight=sample.weight,
    )


# --- batches ----------------------------------------------------------------------------------------------------------


def training_batch(student: Student, rows: Sequence[Encoded]) -> tuple[dict[str, Any], Any, Any]:
    """Pad samples on the right: (model inputs, labels (b, n) with IGNORED outside the answers, weights (b,))."""
    import torch

    length = max(len(row) for row in rows)
    ids = np.full((len(rows), length), student.pad_token_id, dtype=np.int64)
    labels = np.full((len(rows), length), IGNORED, dtype=np.int64)
    mask = np.zeros((len(rows), length), dtype=np.int64)
    for i, row in enumerate(rows):
        start = len(row.prompt_ids)
        ids[i, : len(row)] = np.concatenate([row.prompt_ids, row.answer_ids])
        labels[i, start : len(row)] = row.answer_ids
        mask[i, : len(row)] = 1
    weights = torch.tensor([row.weight for row in rows], dtype=torch.float32, device=student.device)
    return _inputs(student, rows, ids, mask), torch.from_numpy(labels).to(student.device), weights


def prompt_batch(student: Student, rows: Sequence[Encoded]) -> dict[str, Any]:
    """Pad prompts on the left, so that all continue at the same place."""
    length = max(len(row.prompt_ids) for row in rows)
    ids = np.full((len(rows), length), student.pad_token_id, dtype=np.int64)
    mask = np.zeros((len(rows), length), dtype=np.int64)
    for i, row in enumerate(rows):
        ids[i, length - len(row.prompt_ids) :] = row.prompt_ids
        mask[i, length - len(row.prompt_ids) :] = 1
    return _inputs(student, rows, ids, mask)


def _inputs(student: Student, rows: Sequence[Encoded], ids: np.ndarray, mask: np.ndarray) -> dict[str, Any]:
    import torch

    arrays = {
        "input_ids": ids,
        "attention_mask": mask,
        "mm_token_type_ids": (ids == student.image_token_id).astype(np.int64),  # 1 marks image tokens
        "pixel_values": np.concatenate([row.pixel_values for row in rows]),
        "image_grid_thw": np.concatenate([row.image_grids for row in rows]),
    }
    tensors = {name: torch.from_numpy(array).to(student.device) for name, array in arrays.items()}
    tensors["pixel_values"] = tensors["pixel_values"].to(student.model.dtype)
    return tensors
