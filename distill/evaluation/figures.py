"""The figures of an evaluation, their intervals, and differences of two students.

Windows of a flight overlap, flights of a walk resemble each other and languages share windows, so samples are no independent draws.
Whole walks are drawn instead, with replacement (Efron and Tibshirani 1993, sec. 8; the cluster bootstrap): a figure's interval are the
percentiles of what it becomes on such draws.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict

from cosfly.products.actions import action_tokens
from distill.evaluation.scores import NONE, STATES, UNPARSED, VERDICTS, Scores

# A share or mean: of which samples (a mask), and what each gives. Macro-F1 is no mean over samples and stands apart.
FIGURES: dict[str, str] = {
    "answered": "samples that got an answer",
    "parsed": "answers that parse",
    "parsed_unmended": "answers that parse without mending",
    "accuracy": "decision accuracy, all answers",
    "accuracy_parsed": "decision accuracy, parsed answers",
    "macro_f1": "macro-F1 over decisions",
    "accuracy_on_labels": "decision is the geometric label",
    "consistent": "true future: consistent",
    "soft_conflict": "true future: soft conflict",
    "hard_conflict": "true future: hard conflict",
    "abstain": "true future: geometry cannot tell",
    "bertscore_precision": "BERTScore precision",
    "bertscore_recall": "BERTScore recall",
    "bertscore_f1": "BERTScore F1",
    "bertscore_f1_parsed": "BERTScore F1, parsed answers",
    "proved": "sentences that the geometry proves",
    "contradicted": "sentences that it contradicts",
    "unread": "sentences that nobody can read",
    "tokens": "tokens of an answer",
}
LESS_IS_BETTER = ("hard_conflict", "contradicted", "unread")
NEITHER = ("soft_conflict", "abstain", "tokens")  # more of it is neither better nor worse


class Figure(BaseModel):
    """A figure over `count` samples with its interval; all None where nothing is known."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    value: float | None
    low: float | None
    high: float | None
    count: int


@dataclass(frozen=True)
class _Sums:
    """Of each walk the sums over its samples: numerators, denominators (walks, figures); confusion (walks, a, a + 1) of a actions, what does not parse last."""

    names: list[str]
    numerators: np.ndarray
    denominators: np.ndarray
    confusion: np.ndarray


def _terms(scores: Scores) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Give of each mean what a sample adds to it, and of how many: two (n,) arrays."""
    answered = scores.answered
    parsed = answered & (scores.answer != UNPARSED)
    right = parsed & (scores.answer == scores.reference)
    labelled = answered & (scores.label != NONE)
    judged = answered & (scores.verdict != NONE)
    known = answered & ~np.isnan(scores.f1)
    sentences = sum((np.nan_to_num(getattr(scores, state)) for state in STATES), np.zeros(len(scores)))
    terms: dict[str, tuple[np.ndarray, np.ndarray]] = {
        "answered": (answered, np.ones(len(scores))),
        "parsed": (parsed, answered),
        "parsed_unmended": (scores.unmended & answered, answered),
        "accuracy": (right, answered),
        "accuracy_parsed": (right, parsed),
        "accuracy_on_labels": (labelled & (scores.answer == scores.label), labelled),
        "tokens": (scores.num_tokens * answered, answered & (scores.num_tokens > 0)),
    }
    for number, verdict in enumerate(VERDICTS):
        terms[verdict.lower()] = (judged & (scores.verdict == number), judged)
    for name in ("precision", "recall", "f1"):
        terms[f"bertscore_{name}"] = (np.where(known, getattr(scores, name), 0.0), known)
    terms["bertscore_f1_parsed"] = (np.where(known & parsed, scores.f1, 0.0), known & parsed)
    for state in STATES:
        terms[state] = (np.nan_to_num(getattr(scores, state)) * answered, sentences * answered)
    return terms


def _sums(scores: Scores, walk: np.ndarray, num_walks: int) -> _Sums:
    terms = _terms(scores)
    per_walk = [
        [np.bincount(walk, weights=part.astype(float), minlength=num_walks) for part in pair] for pair in terms.values()
    ]
    answered = scores.answered
    count = len(action_tokens())
    answer = np.where(scores.answer == UNPARSED, count, scores.answer)
    cell = (walk * count + scores.reference) * (count + 1) + answer
    confusion = np.bincount(cell[answered], minlength=num_walks * count * (count + 1))
    return _Sums(
        list(terms),
        np.array([pair[0] for pair in per_walk]).T,
        np.array([pair[1] for pair in per_walk]).T,
        confusion.reshape(num_walks, count, count + 1).astype(float),
    )


def macro_f1(confusion: np.ndarray) -> np.ndarray:
    """Give the mean F1 over the decisions that the references have, (...,) from (..., a, a + 1) counts; NaN without any.

    F1 = 2 tp / (2 tp + fp + fn); an answer that does not parse is a miss of its reference and nobody's false alarm.
    """
    hits = np.diagonal(confusion[..., :-1], axis1=-2, axis2=-1)
    references, answers = confusion.sum(axis=-1), confusion[..., :-1].sum(axis=-2)
    occurs = references > 0
    scores = np.where(occurs, 2 * hits / np.maximum(references + answers, 1), 0.0)
    return np.where(occurs.any(axis=-1), scores.sum(axis=-1) / np.maximum(occurs.sum(axis=-1), 1), np.nan)


def _values(sums: _Sums, draws: np.ndarray) -> dict[str, np.ndarray]:
    """Give each figure on each draw, (draws,); draws: (draws, walks) how often each walk was drawn."""
    numerators, denominators = draws @ sums.numerators, draws @ sums.denominators
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = np.where(denominators > 0, numerators / denominators, np.nan)
    found = dict(zip(sums.names, shares.T, strict=True))
    counted = (draws @ sums.confusion.reshape(len(sums.confusion), -1)).reshape(-1, *sums.confusion.shape[1:])
    found["macro_f1"] = macro_f1(counted)
    diagonal = np.diagonal(counted[..., :-1], axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        recall = diagonal / counted.sum(axis=-1)
    return found | {f"decision/{token}": recall[:, number] for number, token in enumerate(action_tokens())}


def draw_walks(num_walks: int, resamples: int, rng: np.random.Generator) -> np.ndarray:
    """Draw as many walks as there are, with replacement, `resamples` times: (resamples, walks) counts."""
    return rng.multinomial(num_walks, np.full(num_walks, 1.0 / num_walks), size=resamples).astype(float)


def figures_of(scores: Scores, draws: np.ndarray, *, confidence: float) -> tuple[dict[str, Figure], dict[str, Figure]]:
    """Give all figures, and the accuracy of each decision that the references have; draws: of the walks (`draw_walks`)."""
    names, walk = np.unique(scores.walk.astype(str), return_inverse=True)
    sums = _sums(scores, walk, len(names))
    whole = _values(sums, np.ones((1, len(names))))
    drawn = _values(sums, draws)
    counts = dict(zip(sums.names, sums.denominators.sum(axis=0), strict=True))
    references = sums.confusion.sum(axis=(0, 2))
    counts |= {"macro_f1": references.sum(), **{f"decision/{a}": references[i] for i, a in enumerate(action_tokens())}}
    found = {
        name: _figure(float(whole[name][0]), drawn[name], int(counts[name]), len(names), confidence) for name in whole
    }
    decisions = {token: found[f"decision/{token}"] for i, token in enumerate(action_tokens()) if references[i]}
    return {name: found[name] for name in FIGURES}, decisions


def _figure(value: float, drawn: np.ndarray, count: int, num_walks: int, confidence: float) -> Figure:
    if count == 0 or np.isnan(value):
        return Figure(value=None, low=None, high=None, count=count)
    low, high = _interval(drawn, confidence) if num_walks > 1 else (None, None)  # one walk tells nothing of others
    return Figure(value=value, low=low, high=high, count=count)


def _interval(drawn: np.ndarray, confidence: float) -> tuple[float | None, float | None]:
    drawn = drawn[~np.isnan(drawn)]  # draws in which nothing of the kind occurs
    if not len(drawn):
        return None, None
    low, high = np.quantile(drawn, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


# --- two students -----------------------------------------------------------------------------------------------------


class Difference(BaseModel):
    """One student's figure less another's on the samples that both were asked.

    p: two-sided, the share of draws on the other side of zero, doubled; no smaller than one draw can tell.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    value: float | None
    low: float | None
    high: float | None
    p: float | None


def differences_of(
    one: Scores, other: Scores, *, resamples: int, confidence: float, rng: np.random.Generator
) -> tuple[int, dict[str, Difference]]:
    """Compare two students on the same draws of walks; gives the number of samples that both have, and the differences."""
    places: Mapping[str, int] = {key: place for place, key in enumerate(other.key)}
    here = np.array([place for place, key in enumerate(one.key) if key in places], dtype=int)
    if not len(here):
        return 0, {}
    one, other = one.at(here), other.at(np.array([places[key] for key in one.key[here]], dtype=int))
    names, walk = np.unique(one.walk.astype(str), return_inverse=True)
    sums = [_sums(scores, walk, len(names)) for scores in (one, other)]
    whole = [_values(each, np.ones((1, len(names)))) for each in sums]
    draws = draw_walks(len(names), resamples, rng)
    drawn = [_values(each, draws) for each in sums]
    return len(here), {
        name: _difference(
            whole[0][name][0] - whole[1][name][0], drawn[0][name] - drawn[1][name], len(names), confidence
        )
        for name in FIGURES
    }


def _difference(value: float, drawn: np.ndarray, num_walks: int, confidence: float) -> Difference:
    if np.isnan(value):
        return Difference(value=None, low=None, high=None, p=None)
    drawn = drawn[~np.isnan(drawn)]
    if num_walks < 2 or not len(drawn):
        return Difference(value=float(value), low=None, high=None, p=None)
    low, high = _interval(drawn, confidence)
    beyond = min((drawn <= 0).mean(), (drawn >= 0).mean())
    return Difference(value=float(value), low=low, high=high, p=float(min(1.0, max(2 * beyond, 1 / len(drawn)))))
