"""Checks before the first step, and their lines in the log."""

from __future__ import annotations

import importlib.util
import logging

from cosfly.formats.captions import TOKENS
from cosfly.runtime.errors import InputError
from distill.schema import Sample
from distill.student.chat import Processor
from distill.student.model import FAST_FAMILIES, Student
from distill.training.loading import DatasetSummary, TrainingContext
from distill.training.loss import output_head
from distill.training.settings import STAGE

log = logging.getLogger(__name__)

# Packages without which Qwen3.5 silently falls back to slow code, and what each is for.
FAST_KERNELS = {
    "fla": ("flash-linear-attention", "the linear attention of three layers of four"),
    "tilelang": ("tilelang", "its backward pass on Hopper, with Triton before 3.7.1"),
    "causal_conv1d": ("causal-conv1d", "the short convolution before it"),
}


def check_before_training(context: TrainingContext) -> None:
    """Log what will be trained, and check that the loss is that of the student's own template and head.

    Raises:
        InputError: the training text or the loss would not be those of the student.
    """
    samples, summary = context.train[0].samples, context.train[1]
    check_template(context.student, samples[summary.used[0].place])
    check_head(context.student)
    if not context.accelerator.is_main_process:
        return
    tokens, answers = sum(s.num_tokens for s in summary.used), sum(s.num_answer_tokens for s in summary.used)
    words = "%s: %d samples with %d tokens, %d of them in answers, %d pictures; %d steps, %d per epoch"
    counts = len(summary), tokens, answers, len(context.features.pictures)
    log.info(words, STAGE, *counts, context.steps.num_steps, context.steps.steps_per_epoch)
    for name, part in (("train", summary), ("val", context.val[1])):
        for reason, count in sorted(part.skip_reasons.items()):
            first = next(sample for sample in part.skipped if sample.skip_reason == reason)
            words = "%s: %d samples of %s are skipped as %s; the first one is %s: %s"
            log.warning(words, STAGE, count, name, reason, first.key, first.skip_detail)
    if missing := decisions_never_shown(summary, context.val[1]):
        log.warning("%s: val has samples of decisions that train lacks: %s", STAGE, ", ".join(missing))
    if context.student.device == "cuda" and context.student.core.config.model_type in FAST_FAMILIES:
        for module, (package, use) in FAST_KERNELS.items():
            if importlib.util.find_spec(module) is None:
                log.warning("%s: %s is slow, because a package is missing: pip install %s", STAGE, use, package)


def decisions_never_shown(train: DatasetSummary, val: DatasetSummary) -> list[str]:
    """Return the decisions of val that no sample of train has."""
    return [action for action in TOKENS if val.decisions[action] and not train.decisions[action]]


def check_template(processor: Processor, sample: Sample) -> None:
    """Check that prompt, answer and end are, character by character, what the chat template writes for the chat."""
    whole = processor.chat_text(sample)
    taught = processor.prompt_text(sample) + processor.lead + sample.answer + processor.end_of_answer
    if taught != whole:
        at = next((i for i, pair in enumerate(zip(taught, whole, strict=False)) if len(set(pair)) > 1), len(taught))
        got, expected = (f"{text[at : at + 40]!r} at character {at}" for text in (taught, whole))
        words = "the training text differs from that of the chat template"
        raise InputError(words, where="student", got=got, expected=expected, fix="correct the template")


def check_head(student: Student) -> None:
    """Check that logits are the product of the last hidden state and the head, from which the loss is computed."""
    import torch

    ids = torch.full((1, 4), student.end_token_id, device=student.device)
    with torch.no_grad(), student.computing():
        logits = student.core(input_ids=ids, use_cache=False).logits.float()
        hidden = student.core.base_model(input_ids=ids, use_cache=False).last_hidden_state
        plain = (hidden.to(student.dtype) @ output_head(student).to(student.dtype).T).float()
    if not torch.allclose(logits, plain, rtol=0.05, atol=0.05 * float(logits.abs().max())):
        words, got = (
            "the student changes its logits after the head, which the loss lacks",
            type(student.core).__name__,
        )
        raise InputError(words, where="student", got=got, fix="use another student")
