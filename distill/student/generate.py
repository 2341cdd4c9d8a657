"""Greedy answers to a batch of prompts, with transformers' `generate` over a cache of fixed size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from distill.student.chat import EncodedSample, prompt_batch
from distill.student.features import Tensors, shown
from distill.student.model import Student


class Completion(NamedTuple):
    """An answer. num_tokens: without its end token. is_finished: it ended by itself."""

    text: str
    num_tokens: int
    is_finished: bool


def generate(
    student: Student, rows: Sequence[EncodedSample], pictures: Sequence[Tensors], *, max_tokens: int
) -> list[Completion]:
    """Answer a batch of prompts greedily; the answers in `rows` are not used.

    Args:
        pictures: features of the pictures of all rows, row after row.
        max_tokens: longest answer, the end token included.

    Returns:
        One answer for each row, in their order.
    """
    import torch
    from transformers import GenerationConfig

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
    core.generation_config = config  # settings for sampling of the model folder would complete those of `config`
    student.model.eval()
    with torch.inference_mode(), student.computing(), shown(student, pictures) as seen:
        found = core.generate(**inputs, **seen)
    completions = []
    for tokens in found[:, num_prompt:].tolist():
        written = tokens[: tokens.index(end)] if end in tokens else tokens
        text = student.tokenizer.decode(written, skip_special_tokens=False).removeprefix(student.lead)
        completions.append(Completion(text, len(written), end in tokens))
    return completions
