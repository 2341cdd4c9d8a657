"""How good a student is on samples that it does not learn from: the loss, and whether its answers decide right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel

from cosfly.products.answer_text import parse_answer
from cosfly.work.console import progress_bar
from distill.schema import Sample
from distill.student.decoding import decode
from distill.student.model import Student
from distill.training.census import Census
from distill.training.loading import Row, Supply
from distill.training.loss import answer_loss
from distill.training.ranks import Ranks
from distill.training.settings import TrainConfig
from distill.training.steps import STAGE


class Validation(BaseModel):
    """What a validation found. loss: nats an answer token. accuracy: share of samples with the right decision, an answer that does not
    parse being wrong; None where answers are not asked for. parsed: share of answers that parse."""

    samples: int
    loss: float
    accuracy: float | None = None
    parsed: float | None = None

    @property
    def score(self) -> tuple[float, float]:
        """What the best checkpoint has most of: decisions first, then likelihood."""
        return (self.accuracy if self.accuracy is not None else 0.0, -self.loss)

    def __str__(self) -> str:
        told = f"loss {self.loss:.4f}"
        return (
            told if self.accuracy is None else f"{told}, decisions right {self.accuracy:.3f}, parsed {self.parsed:.3f}"
        )


def validate(
    student: Student, samples: Sequence[Sample], census: Census, supply: Supply, cfg: TrainConfig, ranks: Ranks
) -> Validation:
    """Validate on the samples of a census, each process on its share."""
    import torch

    # By length, so that little is padded, and dealt out so that all have about the same to do.
    order = np.argsort(-census.tokens, kind="stable")[ranks.rank :: ranks.size].tolist()
    batches = [order[start : start + cfg.batch_size] for start in range(0, len(order), cfg.batch_size)]
    sums = np.zeros(5)  # nats, their weight, samples, right, parsed
    shares = [(number, census.indices[batch].tolist()) for number, batch in enumerate(batches)]
    student.model.eval()
    with torch.no_grad(), progress_bar(f"{STAGE}: validation", total=len(order)) as advance:
        for ready in supply.steps(samples, census.pictures_of, shares):
            if ready.rows:
                sums += _validate_batch(student, ready.rows, supply, cfg)
            advance(len(ready.rows))
    nats, weight, count, right, parsed = ranks.total(sums.tolist())
    asked = cfg.validation_answers and count
    return Validation(
        samples=int(count),
        loss=nats / weight if weight else 0.0,
        accuracy=right / count if asked else None,
        parsed=parsed / count if asked else None,
    )


def _validate_batch(student: Student, rows: Sequence[Row], supply: Supply, cfg: TrainConfig) -> Any:
    features = supply.features.of([picture for row in rows for picture in row.pictures])
    encoded = [row.encoded for row in rows]
    nats, _ = answer_loss(student, encoded, features, cfg.logit_chunk)
    weight = sum(len(row.answer_ids) * row.weight for row in encoded)
    right = parsed = 0
    if cfg.validation_answers:
        with student.computing():
            answers = decode(student, encoded, max_tokens=cfg.max_new_tokens, features=features)
        for row, answer in zip(rows, answers, strict=True):
            reason = None if answer.is_finished else "length"
            coc = parse_answer(answer.text, row.sample.language, finish_reason=reason).coc
            parsed += coc is not None
            right += coc is not None and coc.flight_decision == row.sample.decision
    return np.array([float(nats), weight, len(rows), right, parsed])
