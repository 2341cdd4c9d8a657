"""Validation during a training: the loss of samples of val, and how often their decisions are right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel

from cosfly.formats.captions import verdict_on
from cosfly.llm.answer_text import parse_answer
from cosfly.runtime.console import progress_bar
from distill.schema import Sample, Samples
from distill.student.generate import Completion, generate
from distill.student.model import Student
from distill.training.loading import Census, Row, Supply
from distill.training.loss import answer_loss
from distill.training.ranks import Ranks
from distill.training.settings import LOGIT_CHUNK, STAGE, TrainConfig


class Validation(BaseModel):
    """What a validation found. loss: nats an answer token.

    Shares of the samples, None where answers are not asked for; an answer that does not parse counts against both.
    accuracy: the decision is the teacher's. consistent: it is what the true future calls for, of samples whose future
    is known. parsed: it parses.
    """

    samples: int
    loss: float
    accuracy: float | None = None
    consistent: float | None = None
    parsed: float | None = None

    def score(self) -> tuple[float, float]:
        """Return what the best checkpoint has most of: decisions or verdicts first, then likelihood."""
        return (self.accuracy or 0.0, -self.loss)

    def __str__(self) -> str:
        shares = {"decisions right": self.accuracy, "consistent": self.consistent, "parsed": self.parsed}
        words = [f"{name} {share:.3f}" for name, share in shares.items() if share is not None]
        return ", ".join([f"loss {self.loss:.4f}", *words])


def validate(
    student: Student, samples: Samples, census: Census, supply: Supply, cfg: TrainConfig, ranks: Ranks
) -> Validation:
    """Validate on the samples of a census, each process on its share."""
    import torch

    # By length, so that little is padded, and dealt out so that all have about the same to do.
    order = np.argsort(-census.tokens, kind="stable")[ranks.rank :: ranks.size].tolist()
    batches = [order[start : start + cfg.batch_size] for start in range(0, len(order), cfg.batch_size)]
    sums = np.zeros(7)  # nats, their weight, samples, parsed, right, with a known future, consistent with it
    shares = [(number, census.indices[batch].tolist()) for number, batch in enumerate(batches)]
    student.model.eval()
    with torch.no_grad(), progress_bar(f"{STAGE}: validation", total=len(order)) as advance:
        for ready in supply.steps(samples, census.pictures_of, shares):
            if ready.rows:
                sums += _validate_batch(student, ready.rows, supply, cfg)
            advance(len(ready.rows))
    nats, weight, count, parsed, right, known, consistent = ranks.total(sums.tolist())
    found = Validation(samples=int(count), loss=nats / weight if weight else 0.0)
    if not cfg.validation_answers or not count:
        return found
    of_future = consistent / known if known else None
    return found.model_copy(update={"accuracy": right / count, "parsed": parsed / count, "consistent": of_future})


def _validate_batch(student: Student, rows: Sequence[Row], supply: Supply, cfg: TrainConfig) -> Any:
    features = supply.features.of([picture for row in rows for picture in row.pictures])
    encoded = [row.encoded for row in rows]
    nats, _ = answer_loss(student, encoded, features, LOGIT_CHUNK)
    weight = sum(float(row.weights.sum()) for row in encoded)
    counts = np.zeros(4)
    if cfg.validation_answers:
        answers = generate(student, encoded, features, max_tokens=cfg.max_new_tokens)
        both = zip(rows, answers, strict=True)
        counts = sum((_judged_answer(row.sample, answer) for row, answer in both), counts)
    return np.array([float(nats), weight, len(rows), *counts])


def _judged_answer(sample: Sample, answer: Completion) -> Any:
    """Return what an answer adds to the counts: parsed, right, with a known future, consistent with it."""
    finish_reason = None if answer.is_finished else "length"
    coc = parse_answer(answer.text, sample.language, finish_reason=finish_reason).coc
    decision, ruled_out = coc and coc.flight_decision, sample.contradicted
    is_known, is_right = ruled_out is not None, decision == sample.decision
    verdict = verdict_on(decision, sample.label, ruled_out or ()) if decision and is_known else None
    return np.array([coc is not None, is_right, is_known, verdict == "CONSISTENT"], float)
