"""distill: greedy decoding against the library's own `generate`, token by token, on a random student in float32."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from later import torch, transformers
from PIL import Image
from specimens_students import features_of

from distill.student import decoding
from distill.student.decoding import Completion
from distill.student.encoding import EncodedSample, prompt_batch
from distill.student.model import IMAGE_TOKEN, Student, load_student
from distill.student.random_student import make_tiny_student

pytestmark = pytest.mark.usefixtures("one_thread")

MOST = 40  # tokens of an answer


@pytest.fixture(scope="module")
def student(tmp_path_factory) -> Student:
    folder = make_tiny_student(tmp_path_factory.mktemp("student") / "tiny", seed=3)
    return load_student(folder, device="cpu", max_pixels=64 * 64)


@pytest.fixture(scope="module")
def rows(student) -> list[Asked]:
    """Prompts of 1 to 140 tokens with 0 to 5 pictures of two sizes."""
    rng = np.random.default_rng(4)
    return [make_row(student, rng, *size) for size in [(5, 2), (40, 1), (120, 5), (17, 3), (1, 0), (60, 0), (2, 1)]]


@dataclass(frozen=True)
class Asked(EncodedSample):
    pictures: dict[str, torch.Tensor]


def decode(student: Student, rows: Sequence[Asked], **more) -> list[Completion]:
    seen = [features_of(student, row.pictures) for row in rows if len(row.image_grids)]
    return decoding.decode(student, rows, torch.cat(seen) if seen else torch.zeros(0, 64), **more)


def make_row(student: Student, rng: np.random.Generator, num_words: int, num_pictures: int) -> Asked:
    start, image, end = student.tokenizer.convert_tokens_to_ids(["<|vision_start|>", IMAGE_TOKEN, "<|vision_end|>"])
    patches, grids = np.zeros((0, 1536), np.float32), np.zeros((0, 3), np.int64)
    if num_pictures:
        sizes = [(64, 64) if i % 2 else (64, 32) for i in range(num_pictures)]
        pictures = [Image.fromarray(rng.integers(0, 255, (*size, 3), dtype=np.uint8)) for size in sizes]
        seen = student.image_processor(pictures, return_tensors="np")
        patches, grids = np.asarray(seen["pixel_values"], np.float32), np.asarray(seen["image_grid_thw"], np.int64)
    ids: list[int] = []
    for count in (grids.prod(axis=1) // 4).tolist():
        ids += [int(rng.integers(20, 200)), start, *[image] * count, end]
    ids += rng.integers(20, 200, num_words).tolist()
    inputs = {"pixel_values": torch.from_numpy(patches), "image_grid_thw": torch.from_numpy(grids)}
    return Asked("row", np.array(ids, np.int64), np.zeros(0, np.int64), grids, 1.0, inputs)


def given(student: Student, rows: Sequence[Asked]) -> dict[str, torch.Tensor]:
    inputs = prompt_batch(student, rows)
    if len(inputs["image_grid_thw"]):
        return inputs | {"pixel_values": torch.cat([row.pictures["pixel_values"] for row in rows])}
    return {name: value for name, value in inputs.items() if name != "image_grid_thw"}


def generated(student: Student, rows: Sequence[Asked], most: int = MOST, **more) -> list[Completion]:
    inputs = given(student, rows)
    with torch.inference_mode():
        output = student.model.generate(
            **inputs, max_new_tokens=most, do_sample=False, eos_token_id=student.end_token_id,
            pad_token_id=student.pad_token_id, **more,
        )  # fmt: skip
    found = []
    for ids in output[:, inputs["input_ids"].shape[1] :].tolist():
        is_finished = student.end_token_id in ids
        kept = ids[: ids.index(student.end_token_id)] if is_finished else ids
        found.append(Completion(student.tokenizer.decode(kept), len(kept), is_finished))
    return found


def test_a_batch_of_different_lengths_has_the_tokens_of_generate(student, rows):
    assert len({len(row.prompt_ids) for row in rows}) == len(rows)
    found = decode(student, rows, max_tokens=MOST)
    assert found == generated(student, rows)
    assert {answer.num_tokens for answer in found} == {MOST}


@pytest.mark.slow
def test_a_row_has_the_same_answer_alone_and_among_others(student, rows):
    together = decode(student, rows, max_tokens=MOST)
    assert [decode(student, [row], max_tokens=MOST)[0] for row in rows] == together
    assert [generated(student, [row])[0] for row in rows] == together
    assert decode(student, rows[::-1], max_tokens=MOST)[::-1] == together


class EvenTokens:
    """Allows even tokens only, and the end after five of them."""

    def __init__(self, end: int, num_rows: int) -> None:
        self.end, self.counts = end, [0] * num_rows

    def allowed(self, rows: Sequence[int], num_tokens: int) -> np.ndarray:
        allowed = np.tile(np.arange(num_tokens) % 2 == 0, (len(rows), 1))
        allowed[:, self.end] = [self.counts[row] > row for row in rows]
        return np.packbits(allowed, axis=1, bitorder="little")

    def consume(self, row: int, token: int) -> None:
        self.counts[row] += 1


class Even:
    def __init__(self, end: int, num_prompt: int) -> None:
        self.end, self.num_prompt = end, num_prompt

    def __call__(self, input_ids, scores):
        scores = scores.clone()
        scores[:, 1::2] = float("-inf")
        count = input_ids.shape[1] - self.num_prompt
        for row in range(len(scores)):
            scores[row, self.end] = scores[row, self.end] if count > row else float("-inf")
        return scores


def test_a_constraint_decides_what_may_come(student, rows):
    own = replace(student)
    own.__dict__["end_token_id"] = 44  # even, so that it comes now and then
    end, num_prompt = own.end_token_id, max(len(row.prompt_ids) for row in rows)
    even = transformers.LogitsProcessorList([Even(end, num_prompt)])
    found = decode(own, rows, max_tokens=MOST, constraint=EvenTokens(end, len(rows)))
    assert found == generated(own, rows, logits_processor=even) != decode(own, rows, max_tokens=MOST)
