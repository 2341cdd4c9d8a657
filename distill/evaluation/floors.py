"""Baselines that see no picture, and the teacher itself: the columns next to a student's in every table.

majority    one answer of the training split, with its most frequent decision, for every sample
rule        a decision tree of depth two on the geometry of the past frames, fitted on the training split
blind       a small network on the same numbers (cosfly/inspection/blind_baseline.py)
teacher     the reference answers, for the figures that are measured against the geometry
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from cosfly.formats.captions import TOKENS, Language
from cosfly.inspection.blind_baseline import FITTED_ON, fit_deciders
from cosfly.runtime.seeding import rng_for
from distill.evaluation.figures import Answers, coc_of, decision_number, text_of
from distill.schema import Sample

TEACHER = "teacher"


def majority(decisions: Iterable[str]) -> str | None:
    """Return the most frequent decision; a tie goes to the first in the order of the action table."""
    counts = Counter(decisions)
    return max(TOKENS, key=lambda action: counts[action]) if counts else None


def floors_of(
    train: Collection[Sample], samples: Sequence[Sample], language: Language, seed: int
) -> dict[str, Answers]:
    """Return the answers of the teacher and of each baseline to samples of one language.

    Args:
        train: samples of the training split, in any language. Without one in `language` there are no baselines; without
            the geometry of the past there is no rule and no network.
    """
    counts, typical, fitted = Counter[str](), dict[str, tuple[bytes, Sample]](), list[Sample]()
    share = FITTED_ON / max(1, len(train))
    for sample in train:
        if sample.language == language:
            counts[sample.decision] += 1
            rank = hashlib.sha256(f"{seed}/distill.floor/{sample.sample_id}".encode()).digest()
            if sample.decision not in typical or rank < typical[sample.decision][0]:
                typical[sample.decision] = rank, sample
            if int.from_bytes(rank[:8]) <= share * 2**64:
                fitted.append(sample)
    found = {TEACHER: Answers.of(np.array([decision_number(s.decision, s.key) for s in samples]))}
    decision = majority(counts.elements())
    if decision is not None:
        constant = np.full(len(samples), TOKENS.index(decision))
        found["majority"] = Answers.of(constant, [text_of(coc_of(typical[decision][1]))] * len(samples))
    if fitted and all(sample.past for sample in (*fitted, *samples)):
        pasts, asked = (np.array([sample.past for sample in part]) for part in (fitted, samples))
        decisions = np.array([decision_number(sample.decision, sample.key) for sample in fitted])
        deciders = fit_deciders(pasts, decisions, rng_for(seed, "distill.floor", "blind"))
        found |= {name: Answers.of(decide(asked)) for name, decide in deciders.items()}
    return found
