"""Figures of students and baselines, with bootstrap intervals over pedestrian trajectories.

A sample without an answer (a picture could not be read, a server refused) does not count as a wrong answer. An answer
that does not parse does: it has no decision, and its texts score 0. Windows of a track overlap and languages share
windows, so whole pedestrian trajectories are drawn, and everybody is measured on the same draws.
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
    """The figures of one author."""

    figures: dict[str, Figure]  # by name (FIGURES)
    by_decision: dict[str, Figure]  # accuracy by the teacher's decision
    confusion: dict[str, dict[str, int]]  # the teacher's decision -> the answer -> samples; of students only


class Pairing(Record):
    """The figures of one student minus those of another."""

    first: str
    second: str
    differences: dict[str, Figure]


class Measurement(Record):
    """Figures on the samples of one language."""

    samples: int
    walks: int
    who: dict[str, FigureSet]  # of students, teacher, baselines
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
    """The answers of one author to n samples."""

    decision: np.ndarray  # (n,) number in TOKENS, or UNPARSED
    is_answered: np.ndarray  # (n,) bool
    is_unchanged: np.ndarray  # (n,) bool, the answer parses without corrections
    num_tokens: np.ndarray  # (n,), 0 if unknown
    values: np.ndarray  # (n, 2) numbers of matched and contradicted values, NaN if unknown
    scores: np.ndarray  # (n, 3) BERTScore, NaN if not computed
    texts: np.ndarray  # (n,) str, "" for none

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
        "answered": (answered, np.ones(len(samples))), "parsed": (parsed, answered),
        "parsed_unchanged": (answers.is_unchanged & answered, answered), "accuracy": (right, answered),
        "accuracy_parsed": (right, parsed), "accuracy_on_labels": (labelled & (answer == labels), labelled),
        "values_matched": (values[:, 0], values.sum(axis=1)), "values_contradicted": (values[:, 1], values.sum(axis=1)),
        "tokens": (answers.num_tokens * answered, answered & (answers.num_tokens > 0)),
    }  # fmt: skip
    ratios |= {verdict.lower(): (judged & (verdicts == verdict), judged) for verdict in VERDICTS}
    for k, name in enumerate(BERTSCORE):
        ratios[name] = (np.where(scored, answers.scores[:, k], 0.0), scored)
    for number, token in enumerate(TOKENS):
        asked, given = answered & (reference == number), parsed & (answer == number)
        ratios[f"decision/{token}"] = (right & asked, asked)
        ratios[f"f1/{token}"] = (2 * (right & asked), asked.astype(int) + given)
    return ratios


def values_of(ratios: Ratios, walk: np.ndarray, draws: np.ndarray) -> dict[str, np.ndarray]:
    """Return each figure on each draw, (draws,); NaN if nothing of the kind occurs. walk: (n,) number of each sample's
    pedestrian trajectory. draws: (draws, walks), how often each of these is drawn."""
    num_walks = draws.shape[1]
    sums = np.array([[np.bincount(walk, part, num_walks) for part in pair] for pair in ratios.values()])
    numerators, denominators = (draws @ sums[:, k].T for k in range(2))
    with np.errstate(invalid="ignore", divide="ignore"):
        values = np.where(denominators > 0, numerators / denominators, np.nan)
    figures = dict(zip(ratios, values.T, strict=True))
    occurs = ~np.isnan([figures[f"decision/{token}"] for token in TOKENS])  # in the references of a draw
    scores = np.where(occurs, [figures[f"f1/{token}"] for token in TOKENS], 0.0)
    num_decisions = occurs.sum(axis=0)
    figures["macro_f1"] = np.where(num_decisions > 0, scores.sum(axis=0) / np.maximum(num_decisions, 1), np.nan)
    return figures


def measure(
    samples: Sequence[Sample], everyone: Mapping[str, Answers], students: Collection[str], rng: np.random.Generator
) -> Measurement:
    """Measure everybody on the same samples and the same draws, and compare the students in pairs."""
    names, walk = np.unique([sample.walk for sample in samples], return_inverse=True)
    draws = np.vstack([np.ones(len(names)), draw_pedestrians(len(names), RESAMPLES, rng)])  # the first: all samples
    ratios = {name: ratios_of(samples, answers) for name, answers in everyone.items()}
    values = {name: values_of(ratios_of_one, walk, draws) for name, ratios_of_one in ratios.items()}

    def figure(on_draws: np.ndarray, count: float) -> Figure:
        return figure_of_draws(float(on_draws[0]), on_draws[1:], int(count), len(names), CONFIDENCE)

    who = {}
    pairings = []
    for name, by_key in values.items():
        counts = {key: denominator.sum() for key, (_, denominator) in ratios[name].items()}
        counts["macro_f1"] = counts["accuracy"]
        by_decision = {token: figure(by_key[f"decision/{token}"], counts[f"decision/{token}"]) for token in TOKENS}
        who[name] = FigureSet(
            figures={key: figure(by_key[key], counts[key]) for key in FIGURES},
            by_decision={token: accuracy for token, accuracy in by_decision.items() if accuracy.count},
            confusion=_confusion(samples, everyone[name]) if name in students else {},
        )
    for first, second in combinations(students, 2):
        differences = {key: figure(values[first][key] - values[second][key], len(samples)) for key in FIGURES}
        pairings.append(Pairing(first=first, second=second, differences=differences))
    return Measurement(samples=len(samples), walks=len(names), who=who, pairings=pairings)


def _confusion(samples: Sequence[Sample], answers: Answers) -> dict[str, dict[str, int]]:
    """Return the teacher's decision -> the answer -> number of samples, without zeros."""
    names = (*TOKENS, UNPARSED_NAME)  # UNPARSED, -1, is the last index
    table: dict[str, Counter[str]] = {token: Counter() for token in TOKENS}
    for sample, number, is_answered in zip(samples, answers.decision.tolist(), answers.is_answered, strict=True):
        if is_answered:
            table[sample.decision][names[number]] += 1
    return {token: {name: row[name] for name in names if row[name]} for token, row in table.items() if row}
