"""Greedy answers to a batch of prompts, with transformers' `generate` over a cache of fixed size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from distill.student.chat import EncodedSample, prompt_batch
from distill.student.features import Tensors, shown
from distill.student.model import Student


@dataclass(frozen=True)
class Completion:
    """An answer. num_tokens: without its end token. is_finished: it ended by itself."""

    text: str
    num_tokens: int
    is_finished: bool


@dataclass
class GrammarProcessor:
    """A logits processor of transformers that restricts the answer of each row to the grammar of its matcher.

    num_prompt: tokens of the padded prompts.
    """

    matchers: Sequence[Any]
    num_prompt: int

    def __call__(self, ids: Any, scores: Any) -> Any:
        import torch

        bits = np.full((len(ids), -(-scores.shape[1] // 8)), 255, np.uint8)  # a bit per token, the lowest first
        for row, matcher in enumerate(self.matchers):
            if ids.shape[1] > self.num_prompt and not matcher.is_stopped():
                matcher.consume_token(int(ids[row, -1]))
            if not matcher.is_stopped():
                mask = np.frombuffer(matcher.compute_bitmask(), np.uint8)[: bits.shape[1]]
                bits[row] = 0
                bits[row, : len(mask)] = mask
        packed = torch.from_numpy(bits).to(scores.device)[:, :, None]
        allowed = (packed >> torch.arange(8, dtype=torch.uint8, device=scores.device)) & 1
        return scores.masked_fill(allowed.flatten(1)[:, : scores.shape[1]] == 0, float("-inf"))


def generate(
    student: Student,
    rows: Sequence[EncodedSample],
    pictures: Sequence[Tensors],
    *,
    max_tokens: int,
    matchers: Sequence[Any] = (),
) -> list[Completion]:
    """Answer a batch of prompts greedily; the answers in `rows` are not used.

    Args:
        pictures: features of the pictures of all rows, row after row.
        max_tokens: longest answer, the end token included.
        matchers: llguidance's grammar matcher of each row; none: answers are free.

    Returns:
        One answer for each row, in their order.
    """
    import torch
    from transformers import GenerationConfig, LogitsProcessorList

    core, end = student.core, student.end_token_id
    inputs = {name: torch.from_numpy(array).to(student.device) for name, array in prompt_batch(student, rows).items()}
    num_prompt = inputs["input_ids"].shape[1]
    # Under autocast keys and values may be of different types, which a static cache does not hold.
    is_one_type = core.get_input_embeddings().weight.dtype == student.dtype
    config = GenerationConfig(
        do_sample=False,
        max_new_tokens=max_tokens,
        eos_token_id=end,
        pad_token_id=student.pad_token_id,
        cache_implementation="static" if is_one_type else "dynamic",
        disable_compile=True,  # a compiled step holds for one batch size and length, and costs a minute
    )
    processors = LogitsProcessorList([GrammarProcessor(matchers, num_prompt)] if matchers else [])
    # Settings for sampling that a model folder may bring would complete those of `config`.
    own, was_training = core.generation_config, student.model.training
    core.generation_config = config
    student.model.eval()
    try:
        with torch.inference_mode(), student.computing(), shown(student, pictures) as seen:
            found = core.generate(**inputs, **seen, logits_processor=processors)
    finally:
        core.generation_config = own
        student.model.train(was_training)
    completions = []
    for tokens in found[:, num_prompt:].tolist():
        written = tokens[: tokens.index(end)] if end in tokens else tokens
        text = student.tokenizer.decode(written, skip_special_tokens=False).removeprefix(student.lead)
        completions.append(Completion(text, len(written), end in tokens))
    return completions
