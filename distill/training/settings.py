"""Settings of `distill train`, and what follows from them: the samples of each step and process, and the learning
rate."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.seeding import rng_for
from distill.student.model import Device, Dtype
from distill.student.random_student import RandomStudent

STAGE = "distill.train"
LOGIT_CHUNK = 512  # answer tokens whose logits exist at a time
MAX_GRADIENT_NORM = 1.0  # gradients are scaled down to this norm
WARMUP_FRACTION = 0.03  # share of the steps with a rising learning rate


class TrainConfig(Config):
    """Settings of `distill train`. Those that are MayDiffer change how it is computed and, but for rounding, not
    what."""

    method: Literal["lora", "full"] = Field(
        "lora", description="lora: train small matrices next to frozen weights; full: train all weights"
    )
    train_vision: bool = Field(
        False, description="with method full: also train the vision tower, which then encodes pictures at each use"
    )
    lora_rank: int = Field(16, ge=1, description="rank of the LoRA update")
    lora_alpha: ClassVar[float] = 32.0  # the LoRA update is multiplied by alpha / rank
    epochs: int = Field(3, ge=1, description="passes over the training split")
    max_steps: int = Field(0, ge=0, description="stop after this many optimizer steps; 0: no limit")
    samples_per_step: int = Field(16, ge=1, description="samples of an optimizer step, over all processes")
    learning_rate: float = Field(
        1e-4, gt=0, description="peak learning rate of AdamW; it rises over 3 % of the steps, then falls as a cosine"
    )
    decision_weight: float = Field(
        20.0, gt=0, le=1000, description="weight of the decision's tokens in the loss; other tokens have weight 1"
    )
    reason_weight: float = Field(
        1.0, ge=0, le=1000, description="weight of the tokens of the reasoning trace in the loss; 0: not learnt"
    )
    chat_template: str = Field("", description="file with a chat template for a base model without one; empty: its own")
    allow_code: bool = Field(False, description="run code from the student's repository; only if you trust it")
    max_pixels: int = Field(
        0, ge=0, description="most pixels of a picture; 0: no limit, so that pixel values in texts are right"
    )
    max_tokens: int = Field(
        4096, ge=16, description="longest sample with images and answer, tokens; longer samples are skipped"
    )
    dtype: Dtype = Field("auto", description="number type of the computation; auto: bfloat16 on cuda, float32 on a CPU")
    random_student: RandomStudent = Field(RandomStudent(), description="size of the student of `--student random`")

    validation_samples: int = Field(64, ge=0, description="number of samples of val, chosen at random; 0: none")
    validate_every_steps: int = Field(0, ge=0, description="steps between validations; 0: at the end of each epoch")
    patience: int = Field(
        3, ge=0, description="number of validations without an improvement after which training ends; 0: never"
    )
    keep: Literal["best", "last"] = Field(
        "best", description="weights to keep: those of the best validation, or the last"
    )

    batch_size: MayDiffer[int] = Field(1, ge=1, description="number of samples in one forward pass of one process")
    gradient_checkpointing: MayDiffer[bool] = Field(False, description="recompute activations: less memory, slower")
    data_workers: MayDiffer[int] = Field(
        -1, ge=-1, description="number of processes that read pictures; -1: one per core, at most 16"
    )
    compile: MayDiffer[bool] = Field(
        False,
        description="compile the layers of the language model: faster after some minutes; needs a C compiler",
    )
    report_to: MayDiffer[tuple[str, ...]] = Field(
        (), description="loggers of accelerate that get the curves, such as tensorboard or wandb; empty: none"
    )
    save_every_steps: MayDiffer[int] = Field(50, ge=1, description="steps between checkpoints")
    keep_checkpoints: ClassVar[int] = 2  # newest checkpoints that are kept, besides the best one
    device: MayDiffer[Device] = Field("auto", description="auto, cpu or cuda")

    @model_validator(mode="after")
    def _fits(self) -> TrainConfig:
        if self.train_vision and self.method != "full":
            raise ValueError("train_vision needs method=full, because adapters do not change the vision tower")
        return self


def count_steps(cfg: TrainConfig, num_samples: int) -> tuple[int, int]:
    """Return the number of steps, and of those of an epoch."""
    per_epoch = math.ceil(num_samples / cfg.samples_per_step)
    return min(cfg.epochs * per_epoch, cfg.max_steps or cfg.epochs * per_epoch), per_epoch


def steps_from(cfg: TrainConfig, num_samples: int, seed: int, first: int) -> Iterator[list[int]]:
    """Yield the sample indices of each step from one on: an epoch is a permutation, cut into steps."""
    size, (num_steps, per_epoch) = cfg.samples_per_step, count_steps(cfg, num_samples)
    for epoch in range(first // per_epoch, cfg.epochs):
        order = rng_for(seed, STAGE, f"epoch_{epoch}").permutation(num_samples).tolist()
        for step in range(max(first, epoch * per_epoch), min(num_steps, (epoch + 1) * per_epoch)):
            start = step % per_epoch * size
            yield order[start : start + size]


def share_of(chosen: Sequence[int], lengths: np.ndarray, rank: int, num_ranks: int) -> list[int]:
    """Return a process's samples of a step, longest first: dealt out by length, so that all have about the same to do.

    Args:
        chosen: the step's samples. lengths: (n,) tokens of every sample.
    """
    return sorted(chosen, key=lambda index: (-int(lengths[index]), index))[rank::num_ranks]


def learning_rate_at(cfg: TrainConfig, step: int, num_steps: int) -> float:
    """Return the learning rate of a step: a linear rise, then a half cosine to zero."""
    warmup = math.ceil(WARMUP_FRACTION * num_steps)
    if step < warmup:
        return cfg.learning_rate * (step + 1) / warmup
    share = (step - warmup) / max(1, num_steps - warmup)
    return cfg.learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))
