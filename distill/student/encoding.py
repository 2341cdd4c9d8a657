"""Samples as tensors: images, prompt tokens, answer tokens, and batches of them.

Prompt and answer are tokenized apart and joined, which is what inference sees: no token spans the border, so the mask
that keeps the loss on the answer is exact by construction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from cosfly.formats.frames import tree_of
from cosfly.llm.student_chat import IMAGE_PART, chat_messages
from cosfly.runtime.arrays import array_header
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import inside
from cosfly.runtime.png import picture_size
from distill.schema import Sample
from distill.student.model import END_OF_TURN, IMAGE_TOKEN, Processor, Student

# What a chat template writes after an answer; the end of the turn is taught, the line is not.
END_OF_ANSWER = f"{END_OF_TURN}\n"
IGNORED = -100  # label of tokens that carry no loss, the convention of PyTorch's cross entropy


@dataclass(frozen=True)
class EncodedSample:
    """The texts of a sample as arrays: prompt_ids, answer_ids (n,) int64, the end token included in the answer; the
    grids of its pictures (k, 3) int64, without a look at one."""

    key: str
    prompt_ids: np.ndarray
    answer_ids: np.ndarray
    image_grids: np.ndarray
    weight: float

    def __len__(self) -> int:
        return len(self.prompt_ids) + len(self.answer_ids)


def messages_of(sample: Sample) -> list[dict[str, Any]]:
    """Return the chat of a sample, with a mark for every picture."""
    return chat_messages(sample.prompt, [[IMAGE_PART] * len(sample.views) for _ in sample.frames])


def load_pictures(sample: Sample, trees: Mapping[str, Path]) -> list[np.ndarray]:
    """Load the pictures of a sample as its teacher saw them, each (h, w, 3) uint8 RGB.

    Args:
        trees: run -> playback tree (`resolve_trees`).
    """
    tree = trees[sample.run]
    return [picture for frame in sample.frames for picture in sample.pictures.read(inside(tree, frame))]


def most_pixels(samples: Sequence[Sample]) -> int:
    """Return the pixels of the largest picture."""
    return max(width_px * height_px for width_px, height_px in (sample.picture_px for sample in samples))


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) px of a file of a frame, from its header alone."""
    if path.name == "depth.npy":
        height_px, width_px = array_header(path, tree=tree_of(path.parent)).shape
        return width_px, height_px
    size = picture_size(path, tree=tree_of(path.parent))
    if size is None:
        raise InputError("the file is not an image", where=path, expected="a PNG", fix="render the frame again")
    return size


def prompt_text(processor: Processor, sample: Sample, tokens_per_image: Sequence[int]) -> str:
    """Return the prompt as the chat template writes it, without thinking, each picture's mark repeated for its
    tokens."""
    text = processor.tokenizer.apply_chat_template(
        messages_of(sample), tokenize=False, add_generation_prompt=True, enable_thinking=False
    )
    pieces = text.split(IMAGE_TOKEN)
    if len(pieces) != len(tokens_per_image) + 1:
        got, fix = (
            f"{len(pieces) - 1} image tokens for {len(tokens_per_image)} images",
            f"remove {IMAGE_TOKEN} from the text of the prompt",
        )
        raise InputError("the prompt has the wrong number of image tokens", where=sample.key, got=got, fix=fix)
    marks = [IMAGE_TOKEN * count for count in tokens_per_image]
    return pieces[0] + "".join(mark + piece for mark, piece in zip(marks, pieces[1:], strict=True))


def chat_text(processor: Processor, sample: Sample) -> str:
    """Return the whole chat as the chat template writes it: what prompt, answer and end must add up to."""
    answered = [*messages_of(sample), {"role": "assistant", "content": sample.answer}]
    return processor.tokenizer.apply_chat_template(answered, tokenize=False, enable_thinking=False)


def special_token_in(processor: Processor, sample: Sample) -> str | None:
    """Name a token of the chat's own that stands in a text: in an answer an early end, in a prompt a picture or a
    turn."""
    texts = (sample.prompt.system, sample.prompt.user, sample.answer)
    return next((t for t in processor.chat_tokens if any(t in text for text in texts)), None)


def picture_grid(processor: Processor, size_px: tuple[int, int]) -> tuple[int, int, int]:
    """Return the grid of patches (1, rows, columns) that a picture of (width, height) px becomes."""
    from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import smart_resize

    images, (width_px, height_px) = processor.image_processor, size_px
    bounds = {"min_pixels": images.size["shortest_edge"], "max_pixels": images.size["longest_edge"]}
    rows_px, columns_px = smart_resize(height_px, width_px, images.patch_size * images.merge_size, **bounds)
    return 1, rows_px // images.patch_size, columns_px // images.patch_size


def encode_text(processor: Processor, sample: Sample) -> EncodedSample:
    """Make the arrays of one sample."""
    grid = picture_grid(processor, sample.picture_px)
    count = math.prod(grid) // processor.image_processor.merge_size**2
    texts = [prompt_text(processor, sample, [count] * len(sample.images)), sample.answer]
    prompt_ids, answer_ids = processor.tokenizer(texts, add_special_tokens=False)["input_ids"]
    return EncodedSample(
        key=sample.key,
        prompt_ids=np.array(prompt_ids, dtype=np.int64),
        answer_ids=np.array([*answer_ids, processor.end_token_id], dtype=np.int64),
        image_grids=np.array([grid] * len(sample.images), dtype=np.int64).reshape(-1, 3),
        weight=sample.weight,
    )


def patches_of(processor: Processor, pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Cut pictures, each (h, w, 3) uint8, one at least, into the patches of the vision tower: (p, d) float32, of all in
    a row."""
    images = [Image.fromarray(picture) for picture in pictures]
    return np.asarray(processor.image_processor(images, return_tensors="np")["pixel_values"], dtype=np.float32)


def positions_of(processor: Processor, ids: np.ndarray, grids: np.ndarray) -> np.ndarray:
    """Return the rotary positions of a row's tokens, (3, n) int64: time, height, width.

    Text counts on by one in all three. A picture's tokens share the time at which it begins and count its rows and
    columns from there; what follows begins after the longer side.
    """
    merge, positions, next_position, start = processor.image_processor.merge_size, [], 0, 0
    marks = np.flatnonzero(ids == processor.image_token_id)
    for _, rows, columns in (grids // [1, merge, merge]).tolist():
        first, marks = int(marks[0]), marks[rows * columns :]
        text = np.arange(next_position, next_position + first - start)
        begin = next_position + len(text)
        height, width = np.divmod(np.arange(rows * columns), columns)
        positions += [np.tile(text, (3, 1)), begin + np.stack([np.zeros_like(height), height, width])]
        next_position, start = begin + max(rows, columns), first + rows * columns
    positions.append(np.tile(np.arange(next_position, next_position + len(ids) - start), (3, 1)))
    return np.concatenate(positions, axis=1)


def padded(student: Student, rows: Sequence[EncodedSample]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pad samples on the right: (tokens (b, n), labels (b, n) with IGNORED outside the answers, rotary positions (3, b,
    n)).

    Causal layers, of either kind of attention, never see what stands on the right, so no mask is needed.
    """
    length = max(len(row) for row in rows)
    ids = np.full((len(rows), length), student.pad_token_id, dtype=np.int64)
    labels = np.full((len(rows), length), IGNORED, dtype=np.int64)
    positions = np.zeros((3, len(rows), length), dtype=np.int64)
    for i, row in enumerate(rows):
        tokens = np.concatenate([row.prompt_ids, row.answer_ids])
        ids[i, : len(row)] = tokens
        labels[i, len(row.prompt_ids) : len(row)] = row.answer_ids
        positions[:, i, : len(row)] = positions_of(student, tokens, row.image_grids)
    return ids, labels, positions


def prompt_batch(student: Student, rows: Sequence[EncodedSample]) -> dict[str, Any]:
    """Pad prompts on the left, so that all continue at the same place; the model's inputs but for pictures."""
    import torch

    length = max(len(row.prompt_ids) for row in rows)
    ids = np.full((len(rows), length), student.pad_token_id, dtype=np.int64)
    mask = np.zeros((len(rows), length), dtype=np.int64)
    for i, row in enumerate(rows):
        ids[i, length - len(row.prompt_ids) :] = row.prompt_ids
        mask[i, length - len(row.prompt_ids) :] = 1
    arrays = {
        "input_ids": ids,
        "attention_mask": mask,
        "mm_token_type_ids": (ids == student.image_token_id).astype(np.int64),  # 1 marks image tokens
        "image_grid_thw": np.concatenate([row.image_grids for row in rows]),
    }
    return {name: torch.from_numpy(array).to(student.device) for name, array in arrays.items()}
