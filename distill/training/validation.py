"""Validation during a training: the loss of samples of val, and how often their decisions are right."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel

from cosfly.formats.captions import verdict_on
from cosfly.llm.answer_text import parse_answer
from cosfly.runtime.console import progress_bar
from distill.schema import Sample
from distill.student.generate import Completion, generate
from distill.training.loading import TrainingContext
from distill.training.loss import answer_loss
from distill.training.settings import LOGIT_CHUNK, STAGE, share_of


class Validation(BaseModel):
    """Result of a validation. loss: nats per answer token.

    Shares of the samples, None where no answers are asked for; an answer that does not parse counts against both.
    accuracy: the decision is the teacher's. consistent: the decision agrees with the true future, of samples whose
    future is known. parsed: the answer parses.
    """

    samples: int
    loss: float
    accuracy: float | None = None
    consistent: float | None = None
    parsed: float | None = None

    def __str__(self) -> str:
        shares = {"decisions right": self.accuracy, "consistent": self.consistent, "parsed": self.parsed}
        words = [f"{name} {share:.3f}" for name, share in shares.items() if share is not None]
        return ", ".join([f"loss {self.loss:.4f}", *words])


def validate(context: TrainingContext) -> Validation | None:
    """Validate on the chosen samples of val, each process on its share; None if there are none."""
    import torch

    cfg, summary, accelerator = context.cfg, context.val[1], context.accelerator
    if not len(summary):
        return None
    # By length, so that little is padded, and dealt out so that all processes have about the same to do.
    order = share_of(range(len(summary)), summary.lengths, accelerator.process_index, accelerator.num_processes)
    batches = [order[start : start + cfg.batch_size] for start in range(0, len(order), cfg.batch_size)]
    sums = np.zeros(7)  # nats, their weight, samples, parsed, right, with a known future, consistent with it
    context.student.model.eval()
    with torch.no_grad(), progress_bar(f"{STAGE}: validation", total=len(order)) as advance:
        for rows in context.rows(context.val, batches):
            encoded, features = [row for row, _ in rows], context.features_of(rows)
            nats, _ = answer_loss(context.student, encoded, features, LOGIT_CHUNK)
            sums[:3] += float(nats), sum(float(row.weights.sum()) for row in encoded), len(rows)
            if cfg.validation_answers:
                answers = generate(context.student, encoded, features, max_tokens=cfg.max_new_tokens)
                sums[3:] += sum(_judged_answer(row[1], answer) for row, answer in zip(rows, answers, strict=True))
            advance(len(rows))
    nats, weight, count, parsed, right, known, consistent = context.total(sums.tolist())
    found = Validation(samples=int(count), loss=nats / weight if weight else 0.0)
    if not cfg.validation_answers:
        return found
    of_future = consistent / known if known else None
    return found.model_copy(update={"accuracy": right / count, "parsed": parsed / count, "consistent": of_future})


def _judged_answer(sample: Sample, answer: Completion) -> Any:
    """Return what an answer adds to the counts: parsed, right, with a known future, consistent with it."""
    finish_reason = None if answer.is_finished else "length"
    coc = parse_answer(answer.text, sample.language, finish_reason=finish_reason).coc
    decision, ruled_out = coc and coc.flight_decision, sample.contradicted
    is_known, is_right = ruled_out is not None, decision == sample.decision
    verdict = verdict_on(decision, sample.label, ruled_out or ()) if decision and is_known else None
    return np.array([coc is not None, is_right, is_known, verdict == "CONSISTENT"], float)
