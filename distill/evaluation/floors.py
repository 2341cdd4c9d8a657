"""What can be had without a look at a window, answered as a student would: the floors beside every figure.

majority    the decision that train has most often; no text
shuffled    the reference of another sample of the split
constant    one answer of train, with the majority's decision, for every sample
rule        a decision tree of depth two on the past's geometry, fitted on train (CART, Breiman et al. 1984); no text
blind       a small network on the same, exact numbers, fitted on train (cosfly/inspection/blind_baseline.py); no text
teacher     no floor but the reference itself: what it reaches in figures that are measured against the geometry
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from functools import cached_property

import numpy as np

from cosfly.formats.captions import TOKENS, Coc, Language
from cosfly.inspection.blind_baseline import FITTED_ON, Decider, fit_deciders
from cosfly.runtime.json_io import parse_document, validated
from cosfly.runtime.seeding import rng_for
from distill.evaluation.scores import ScoredAnswer, number_of
from distill.schema import Sample

SHUFFLED_AMONG = 1024  # samples that are scored together: what is shuffled within needs no text to be embedded twice
WITH_TEXT = ("shuffled", "constant")  # floors that have texts


def coc_of(sample: Sample) -> Coc:
    """Return a sample's answer."""
    return validated(Coc, parse_document(sample.answer, sample.key), sample.key)


def majority(decisions: Iterable[str]) -> str | None:
    """Return the most frequent decision; a tie goes to the first in the order of the action table."""
    counts = Counter(decisions)
    return max(TOKENS, key=lambda action: counts[action]) if counts else None


def shuffled_groups(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Deal places into groups at random, of SHUFFLED_AMONG to twice as many each."""
    return np.array_split(rng.permutation(count), max(1, count // SHUFFLED_AMONG))


def shuffled_places(groups: Sequence[np.ndarray]) -> np.ndarray:
    """Return each place another place of its group, (count,): one cycle through each group."""
    others = np.empty(sum(map(len, groups)), dtype=int)
    for group in groups:
        others[group] = np.roll(group, 1)
    return others


def _bare(decision: str) -> ScoredAnswer:
    return ScoredAnswer(Coc(critical_components="", reasoning_trace="", flight_decision=decision))


def _pasts(samples: Sequence[Sample]) -> np.ndarray | None:
    """Return the pasts of samples, (n, d); None where one has none."""
    return np.array([sample.past for sample in samples]) if samples and all(s.past for s in samples) else None


class Floors:
    """The floors of one language, from the training split."""

    def __init__(self, train: Collection[Sample], language: Language, seed: int) -> None:
        self._seed = seed
        counts, typical, drawn = Counter[str](), dict[str, tuple[bytes, Sample]](), list[Sample]()
        share = FITTED_ON / max(1, len(train))
        for sample in train:
            if sample.language == language:
                counts[sample.decision] += 1
                rank = hashlib.sha256(f"{seed}/distill.floor/{sample.sample_id}".encode()).digest()
                if sample.decision not in typical or rank < typical[sample.decision][0]:
                    typical[sample.decision] = rank, sample
                if int.from_bytes(rank[:8]) <= share * 2**64:
                    drawn.append(sample)
        self.decision = majority(counts.elements())
        self._constant = None if self.decision is None else coc_of(typical[self.decision][1])
        self._labels = np.array([number_of(sample.decision, sample) for sample in drawn], dtype=int)
        self._pasts = _pasts(drawn)

    @cached_property
    def deciders(self) -> dict[str, Decider]:
        rng = rng_for(self._seed, "distill.floor", "blind")
        return {} if self._pasts is None else fit_deciders(self._pasts, self._labels, rng)

    def groups(self, count: int) -> list[np.ndarray]:
        """Deal samples into groups, within which references are shuffled; in both languages of windows the same."""
        return shuffled_groups(count, rng_for(self._seed, "distill.floor", "shuffled"))

    def answers(self, samples: Sequence[Sample], references: Sequence[Coc]) -> dict[str, list[ScoredAnswer]]:
        """Return what each floor answers to samples with their references, of which there is one at least."""
        found: dict[str, list[ScoredAnswer]] = {"teacher": [ScoredAnswer(reference) for reference in references]}
        if self._constant is not None and self.decision is not None:
            found["majority"] = [_bare(self.decision)] * len(references)
            found["constant"] = [ScoredAnswer(self._constant)] * len(references)
        if len(references) > 1:
            places = shuffled_places(self.groups(len(references))).tolist()
            found["shuffled"] = [ScoredAnswer(references[place]) for place in places]
        bare, pasts = [_bare(token) for token in TOKENS], _pasts(samples)
        if pasts is not None:
            found |= {name: [bare[k] for k in decide(pasts).tolist()] for name, decide in self.deciders.items()}
        return found
