"""Figures of students and baselines, with bootstrap intervals over pedestrian trajectories.

A sample without an answer (a picture could not be read, a server refused) is not a wrong answer. An answer that does
not parse is one: it decides nothing, and its texts score 0. Windows of a track overlap and languages share windows, so
whole pedestrian trajectories are drawn, and everybody is measured on the same draws.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Self

import numpy as np

from cosfly.formats.captions import FIELDS, TOKENS, Coc, ValueCounts, Verdict, not_in_set, verdict_on
from cosfly.formats.episodes import Figure
from cosfly.formats.predictions import FAILED, Prediction
from cosfly.geometry.trajectory_metrics import draw_pedestrians, figure_of_draws
from cosfly.runtime.json_io import Record, parse_document, validated
from distill.schema import Sample

CONFIDENCE = 0.95  # level of the intervals
RESAMPLES = 2000  # draws of pedestrian trajectories
UNPARSED = -1  # the number of the decision of an answer that does not parse
UNPARSED_NAME = "(unparsed)"
TEACHER = "teacher"
VERDICTS: tuple[Verdict, ...] = ("CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN")
BERTSCORE = ("bertscore_precision", "bertscore_recall", "bertscore_f1")
FIGURES = {
    "answered": "samples with an answer",
    "parsed": "answers that parse",
    "parsed_unchanged": "answers that parse without corrections",
    "accuracy": "decision is the teacher's, all answers",
    "accuracy_parsed": "decision is the teacher's, parsed answers",
    "macro_f1": "macro-F1 over the teacher's decisions",
    "accuracy_on_labels": "decision is the geometric label",
    "consistent": "verdict: consistent",
    "soft_conflict": "verdict: soft conflict",
    "hard_conflict": "verdict: hard conflict",
    "abstain": "verdict: abstain",
    "bertscore_precision": "BERTScore precision",
    "bertscore_recall": "BERTScore recall",
    "bertscore_f1": "BERTScore F1",
    "values_matched": "values that match a measured fact",
    "values_contradicted": "values that match no fact",
    "tokens": "tokens of an answer",
}


class FigureSet(Record):
    """Figures of one author by name (FIGURES), accuracy by decision, reference -> answers (students only)."""

    figures: dict[str, Figure]
    by_decision: dict[str, Figure]
    confusion: dict[str, dict[str, int]]


class Pairing(Record):
    """The figures of one student minus those of another."""

    first: str
    second: str
    differences: dict[str, Figure]


class Measurement(Record):
    """Figures on the samples of one language. who: students, teacher, baselines."""

    samples: int
    walks: int
    who: dict[str, FigureSet]
    pairings: list[Pairing]


def coc_of(sample: Sample) -> Coc:
    """Return the reference answer of a sample."""
    return validated(Coc, parse_document(sample.answer, sample.key), sample.key)


def text_of(coc: Coc | None) -> str:
    """Join the fields into the text that BERTScore compares (sec:appendix_f_caption_distillation); "" for none."""
    if coc is None or not coc.reasoning_trace:
        return ""
    return " ".join(getattr(coc, name) for name in FIELDS).strip()


def decision_number(decision: str, where: str) -> int:
    """Return the number of a decision in TOKENS."""
    if decision not in TOKENS:
        raise not_in_set(decision, where)
    return TOKENS.index(decision)


@dataclass(frozen=True)
class Answers:
    """The answers of one author to n samples.

    decision: (n,) number in TOKENS, or UNPARSED. is_answered, is_unchanged: (n,) bool, the second if an answer parses
    without corrections. num_tokens: (n,), 0 if unknown. values: (n, 2) numbers of matched and contradicted values, NaN
    if unknown. scores: (n, 3) BERTScore, NaN if not computed. texts: (n,) str, "" for none.
    """

    decision: np.ndarray
    is_answered: np.ndarray
    is_unchanged: np.ndarray
    num_tokens: np.ndarray
    values: np.ndarray
    scores: np.ndarray
    texts: np.ndarray

    @classmethod
    def of(cls, decision: np.ndarray, texts: Sequence[str] = ()) -> Self:
        """Return the answers of a baseline."""
        n = len(decision)
        known, values, scores = np.ones(n, dtype=bool), np.full((n, 2), np.nan), np.full((n, 3), np.nan)
        return cls(decision, known, known, np.zeros(n), values, scores, np.array(texts or [""] * n, dtype=object))

    @classmethod
    def of_student(cls, predictions: Sequence[Prediction], values: Sequence[ValueCounts | None]) -> Self:
        """Return the answers of a student. values: Of each text, None if nobody compared them with the facts."""
        decisions = [UNPARSED if p.coc is None else decision_number(p.coc.flight_decision, p.key) for p in predictions]
        counts = [(v.values_matched, v.values_contradicted) if v else (np.nan, np.nan) for v in values]
        return replace(
            cls.of(np.array(decisions), [text_of(prediction.coc) for prediction in predictions]),
            is_answered=np.array([not (p.reason or "").startswith(FAILED) for p in predictions]),
            is_unchanged=np.array([p.coc is not None and not p.recovered for p in predictions]),
            num_tokens=np.array([p.num_tokens for p in predictions], dtype=float),
            values=np.array(counts).reshape(-1, 2),
        )


Ratios = dict[str, tuple[np.ndarray, np.ndarray]]  # figure -> what each sample adds to numerator and denominator, (n,)


def ratios_of(samples: Sequence[Sample], answers: Answers) -> Ratios:
    """Return the figures of an author as ratios of sums over samples, with `decision/` and `f1/` of each decision."""
    reference = np.array([decision_number(sample.decision, sample.key) for sample in samples])
    answered, answer = answers.is_answered, answers.decision
    parsed = answered & (answer != UNPARSED)
    right = parsed & (answer == reference)
    labels = np.array([decision_number(s.label, s.key) if s.label else UNPARSED for s in samples])
    labelled = answered & (labels != UNPARSED)
    verdicts = np.array([
        "" if number == UNPARSED or s.contradicted is None else verdict_on(TOKENS[number], s.label, s.contradicted)
        for s, number in zip(samples, answer.tolist(), strict=True)
    ])  # fmt: skip
    judged = answered & (verdicts != "")
    scored = answered & ~np.isnan(answers.scores[:, 0])
    values = np.nan_to_num(answers.values) * answered[:, None]
    ratios: Ratios = {
        "answered": (answered, np.ones(len(samples))),
        "parsed": (parsed, answered),
        "parsed_unchanged": (answers.is_unchanged & answered, answered),
        "accuracy": (right, answered),
        "accuracy_parsed": (right, parsed),
        "accuracy_on_labels": (labelled & (answer == labels), labelled),
        "values_matched": (values[:, 0], values.sum(axis=1)),
        "values_contradicted": (values[:, 1], values.sum(axis=1)),
        "tokens": (answers.num_tokens * answered, answered & (answers.num_tokens > 0)),
    }
    ratios |= {verdict.lower(): (judged & (verdicts == verdict), judged) for verdict in VERDICTS}
    for k, name in enumerate(BERTSCORE):
        ratios[name] = (np.where(scored, answers.scores[:, k], 0.0), scored)
    for number, token in enumerate(TOKENS):
        asked, given = answered & (reference == number), parsed & (answer == number)
        ratios[f"decision/{token}"] = (right & asked, asked)
        ratios[f"f1/{token}"] = (2 * (right & asked), asked.astype(int) + given)
    return ratios


def values_of(ratios: Ratios, walk: np.ndarray, draws: np.ndarray) -> dict[str, np.ndarray]:
    """Return each figure on each draw, (draws,); NaN if nothing of the kind occurs.

    Args:
        walk: (n,) number of each sample's pedestrian trajectory. draws: (draws, walks) how often each is drawn.
    """
    num_walks = draws.shape[1]
    sums = np.array([[np.bincount(walk, part, num_walks) for part in pair] for pair in ratios.values()])
    numerators, denominators = (draws @ sums[:, k].T for k in range(2))
    with np.errstate(invalid="ignore", divide="ignore"):
        values = np.where(denominators > 0, numerators / denominators, np.nan)
    found = dict(zip(ratios, values.T, strict=True))
    occurs = ~np.isnan([found[f"decision/{token}"] for token in TOKENS])  # in the references of a draw
    scores = np.where(occurs, [found[f"f1/{token}"] for token in TOKENS], 0.0)
    num_decisions = occurs.sum(axis=0)
    found["macro_f1"] = np.where(num_decisions > 0, scores.sum(axis=0) / np.maximum(num_decisions, 1), np.nan)
    return found


def measure(
    samples: Sequence[Sample], everyone: Mapping[str, Answers], students: Collection[str], rng: np.random.Generator
) -> Measurement:
    """Measure everybody on the same samples and the same draws, and compare the students in pairs."""
    names, walk = np.unique([sample.walk for sample in samples], return_inverse=True)
    draws = np.vstack([np.ones(len(names)), draw_pedestrians(len(names), RESAMPLES, rng)])  # the first: all samples
    ratios = {name: ratios_of(samples, answers) for name, answers in everyone.items()}
    values = {name: values_of(own, walk, draws) for name, own in ratios.items()}

    def figure(name: str, drawn: np.ndarray, count: float) -> Figure:
        return figure_of_draws(float(drawn[0]), drawn[1:], int(count), len(names), CONFIDENCE)

    who = {}
    pairings = []
    for name, own in values.items():
        counts = {key: pair[1].sum() for key, pair in ratios[name].items()}
        counts["macro_f1"] = counts["accuracy"]
        figures = {key: figure(key, own[key], counts[key]) for key in FIGURES}
        found = {token: figure(token, own[f"decision/{token}"], counts[f"decision/{token}"]) for token in TOKENS}
        by_decision = {token: one for token, one in found.items() if one.count}
        confusion = _confusion(samples, everyone[name]) if name in students else {}
        who[name] = FigureSet(figures=figures, by_decision=by_decision, confusion=confusion)
    for first, second in combinations(students, 2):
        differences = {key: values[first][key] - values[second][key] for key in FIGURES}
        found = {key: figure(key, drawn, len(samples)) for key, drawn in differences.items()}
        pairings.append(Pairing(first=first, second=second, differences=found))
    return Measurement(samples=len(samples), walks=len(names), who=who, pairings=pairings)


def _confusion(samples: Sequence[Sample], answers: Answers) -> dict[str, dict[str, int]]:
    names = (*TOKENS, UNPARSED_NAME)  # UNPARSED is the last place
    cells = Counter(
        (sample.decision, names[number])
        for sample, number, is_answered in zip(samples, answers.decision.tolist(), answers.is_answered, strict=True)
        if is_answered
    )
    rows = [token for token in TOKENS if any(reference == token for reference, _ in cells)]
    return {row: {name: cells[row, name] for name in names if cells[row, name]} for row in rows}
