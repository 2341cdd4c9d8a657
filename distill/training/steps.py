"""Which samples each step sees, in which process, and at what learning rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosfly.work.chance import rng_for
from distill.training.settings import TrainConfig

STAGE = "distill.train"


@dataclass(frozen=True)
class Steps:
    """Steps of one epoch follow a permutation of their own; neither processes nor batches have a part in it."""

    num_samples: int
    samples_per_step: int
    num_steps: int
    seed: int

    @classmethod
    def make(cls, cfg: TrainConfig, num_samples: int, seed: int) -> Steps:
        num_steps = cfg.epochs * math.ceil(num_samples / cfg.samples_per_step)
        return cls(num_samples, cfg.samples_per_step, min(num_steps, cfg.max_steps or num_steps), seed)

    @property
    def steps_per_epoch(self) -> int:
        return math.ceil(self.num_samples / self.samples_per_step)

    def samples_of(self, step: int) -> list[int]:
        """Give the sample indices of a step; the last step of an epoch may be smaller."""
        epoch, position = divmod(step, self.steps_per_epoch)
        order = rng_for(self.seed, STAGE, f"epoch_{epoch}").permutation(self.num_samples)
        return order[position * self.samples_per_step : (position + 1) * self.samples_per_step].tolist()


def share_of(chosen: Sequence[int], lengths: np.ndarray, rank: int, num_ranks: int) -> list[int]:
    """Give a process's samples of a step, longest first: dealt out by length, so that all have about the same to do.

    Args:
        chosen: the step's samples. lengths: (n,) tokens of every sample.
    """
    by_length = sorted(chosen, key=lambda index: (-int(lengths[index]), index))
    return by_length[rank::num_ranks]


def learning_rate_at(cfg: TrainConfig, step: int, num_steps: int) -> float:
    """Give the rate of a step: a linear rise, then a half cosine to zero or a constant."""
    warmup = math.ceil(cfg.warmup_fraction * num_steps)
    if step < warmup:
        return cfg.learning_rate * (step + 1) / warmup
    if cfg.schedule == "constant":
        return cfg.learning_rate
    share = (step - warmup) / max(1, num_steps - warmup)
    return cfg.learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))


def is_validated(cfg: TrainConfig, steps: Steps, done: int) -> bool:
    """Tell whether there is a validation after so many steps."""
    return done == steps.num_steps or done % (cfg.validate_every_steps or steps.steps_per_epoch) == 0
