"""Greedy answers to a batch of prompts, with transformers' `generate` over a cache of fixed size."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from distill.student.chat import EncodedSample, prompt_batch
from distill.student.features import Encoded, shown
from distill.student.model import Student


@dataclass(frozen=True)
class Completion:
    """An answer. num_tokens: without its end token. is_finished: it ended by itself."""

    text: str
    num_tokens: int
    is_finished: bool


class Constraint(Protocol):
    """Says which tokens may come next in each row."""

    def allowed(self, rows: Sequence[int], num_tokens: int) -> np.ndarray:
        """Return (len(rows), num_tokens / 8, rounded up) uint8, a bit a token, the lowest first; each row allows
        one."""

    def consume(self, row: int, token: int) -> None:
        """Record the token that a row was continued with."""


@dataclass
class _Masking:
    """A logits processor of transformers that holds answers to a constraint."""

    constraint: Constraint
    num_prompt: int
    end_token_id: int

    def __call__(self, ids: Any, scores: Any) -> Any:
        import torch

        written = ids[:, self.num_prompt :].tolist()
        live = [row for row, tokens in enumerate(written) if self.end_token_id not in tokens]
        for row in live:
            if written[row]:
                self.constraint.consume(row, written[row][-1])
        bits = np.full((len(ids), -(-scores.shape[1] // 8)), 255, np.uint8)
        if live:
            bits[live] = self.constraint.allowed(live, scores.shape[1])
        packed = torch.from_numpy(bits).to(scores.device)[:, :, None]
        allowed = (packed >> torch.arange(8, dtype=torch.uint8, device=scores.device)) & 1
        return scores.masked_fill(allowed.flatten(1)[:, : scores.shape[1]] == 0, float("-inf"))


def generate(
    student: Student,
    rows: Sequence[EncodedSample],
    pictures: Sequence[Encoded],
    *,
    max_tokens: int,
    constraint: Constraint | None = None,
) -> list[Completion]:
    """Answer a batch of prompts greedily; the answers in `rows` are not used.

    Args:
        pictures: features of the pictures of all rows, row after row.
        max_tokens: longest answer, the end token included.
    Returns:
        One answer for each row, in their order.
    """
    import torch
    from transformers import LogitsProcessorList

    inputs = {name: torch.from_numpy(array).to(student.device) for name, array in prompt_batch(student, rows).items()}
    num_prompt, end = inputs["input_ids"].shape[1], student.end_token_id
    masks = [] if constraint is None else [_Masking(constraint, num_prompt, end)]
    with _answering(student, max_tokens), torch.inference_mode(), student.computing(), shown(student, pictures) as seen:
        found = student.core.generate(**inputs, **seen, logits_processor=LogitsProcessorList(masks))
    return [_completion(student, tokens, end) for tokens in found[:, num_prompt:].tolist()]


def _completion(student: Student, tokens: list[int], end: int) -> Completion:
    is_finished = end in tokens
    own = tokens[: tokens.index(end)] if is_finished else tokens
    text = student.tokenizer.decode(own, skip_special_tokens=False)
    return Completion(text.removeprefix(student.lead), len(own), is_finished)


@contextlib.contextmanager
def _answering(student: Student, max_tokens: int) -> Iterator[None]:
    """Decode greedily, without the settings for sampling that a model folder may bring, and without dropout."""
    from transformers import GenerationConfig

    core = student.core
    # Under autocast keys and values may be of different types, which a static cache does not hold.
    is_one_type = core.get_input_embeddings().weight.dtype == student.dtype
    before, was_training = core.generation_config, student.model.training
    core.generation_config = GenerationConfig(
        do_sample=False,
        max_new_tokens=max_tokens,
        eos_token_id=student.end_token_id,
        pad_token_id=student.pad_token_id,
        cache_implementation="static" if is_one_type else "dynamic",
        disable_compile=True,  # a compiled step holds for one batch size and length, and costs a minute
    )
    student.model.eval()
    try:
        yield
    finally:
        core.generation_config = before
        student.model.train(was_training)
