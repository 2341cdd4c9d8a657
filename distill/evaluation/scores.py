"""What each answer is worth, sample by sample (`scores.parquet`), and the figures that are computed from it.

A sample that got no answer (`answered` false: a picture could not be read, a server refused) is no wrong answer. An
answer that does not parse is one: it decides nothing, and its texts score 0.

Windows of a flight overlap, flights of a walk resemble each other and languages share windows, so samples are no
independent draws: intervals are by bootstrap over whole walks (cosfly/geometry/trajectory_metrics.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cosfly.formats.captions import TOKENS, Coc, ValueCounts, Verdict, not_in_set, verdict_on
from cosfly.formats.episodes import Figure
from cosfly.formats.predictions import FAILED, Prediction
from cosfly.geometry.trajectory_metrics import draw_pedestrians, figure_of_draws, interval_of
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import atomic_file, sha256_bytes
from cosfly.runtime.json_io import Record, dump_json
from cosfly.runtime.tables import arrow_errors, row_groups
from distill.schema import Sample

SCORES = "scores.parquet"
CONFIDENCE = 0.95  # level of the intervals
REFERENCE_DIGITS = 16  # of a digest of 64
VERDICTS: tuple[Verdict, ...] = ("CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN")
VALUES = ("values_matched", "values_contradicted")  # of a student's text
UNPARSED = -2  # the number of the decision that an answer without one makes
NONE = -1  # the number of a label or verdict that nobody knows
_VERDICT = {name: number for number, name in enumerate(VERDICTS)}


@dataclass(frozen=True)
class ScoredAnswer:
    """What somebody answered. coc: None where it does not parse. mended: punctuation had to be put right first."""

    coc: Coc | None
    is_answered: bool = True
    mended: bool = False
    num_tokens: int = 0

    @classmethod
    def of(cls, prediction: Prediction) -> ScoredAnswer:
        is_answered = not (prediction.reason or "").startswith(FAILED)
        return cls(prediction.coc, is_answered, bool(prediction.recovered), prediction.num_tokens)


@dataclass(frozen=True)
class Scores:
    """Columns over n samples.

    key, walk, language (n,) str; against (n,) str, a digest of what
    the answer is held against; reference, answer, label (n,) int8 numbers of decisions, UNPARSED, NONE; answered,
    unmended (n,) bool; drawn_ahead (n,) 1, 0, or NaN where it is not known; verdict (n,) int8 number of VERDICTS or
    NONE; precision, recall, f1 (n,) of BERTScore, NaN where it was not computed; values_matched,
    values_contradicted (n,): numbers of values, NaN where nobody compared them; num_tokens (n,).
    """

    key: np.ndarray
    walk: np.ndarray
    language: np.ndarray
    against: np.ndarray
    reference: np.ndarray
    answer: np.ndarray
    label: np.ndarray
    answered: np.ndarray
    drawn_ahead: np.ndarray
    unmended: np.ndarray
    verdict: np.ndarray
    precision: np.ndarray
    recall: np.ndarray
    f1: np.ndarray
    values_matched: np.ndarray
    values_contradicted: np.ndarray
    num_tokens: np.ndarray

    def __len__(self) -> int:
        return len(self.key)

    def at(self, where: np.ndarray) -> Scores:
        """Return the samples at some places."""
        return replace(self, **{name: getattr(self, name)[where] for name in COLUMNS})


COLUMNS = tuple(field.name for field in fields(Scores))


def join(parts: Sequence[Mapping[str, Scores]]) -> dict[str, Scores]:
    """Put the scores of several languages together; who answers in one alone is left out."""
    who = {name: [part[name] for part in parts] for name in parts[0] if all(name in part for part in parts)}

    def joined(own: Sequence[Scores]) -> Scores:
        columns: Any = {name: np.concatenate([getattr(part, name) for part in own]) for name in COLUMNS}
        return replace(own[0], **columns)

    return {name: joined(own) for name, own in who.items()}


def number_of(decision: str, sample: Sample) -> int:
    """Return the number of a decision."""
    if decision not in TOKENS:
        raise not_in_set(decision, sample.key)
    return TOKENS.index(decision)


def digest_of_reference(sample: Sample) -> str:
    """Name what answers are held against: the teacher's answer, the label, and what the future rules out."""
    return sha256_bytes(dump_json([sample.answer, sample.label, sample.contradicted]).encode())[:REFERENCE_DIGITS]


def score_answers(
    samples: Sequence[Sample],
    answers: Sequence[ScoredAnswer],
    texts: np.ndarray | None = None,
    judged: Mapping[str, ValueCounts] | None = None,
) -> Scores:
    """Score answers, one a sample.

    Args:
        texts: (n, 3) precision, recall, F1 of BERTScore, NaN where it was not computed.
        judged: sample's key -> the values of the student's text.
    """
    verdicts = []
    for sample, answer in zip(samples, answers, strict=True):
        if answer.coc is None or sample.contradicted is None:
            verdicts.append(NONE)
        else:
            verdicts.append(_VERDICT[verdict_on(answer.coc.flight_decision, sample.label, sample.contradicted)])
    both = zip(samples, answers, strict=True)
    decisions = [number_of(a.coc.flight_decision, s) if a.coc else UNPARSED for s, a in both]
    is_answered = np.array([answer.is_answered for answer in answers], dtype=bool)
    bert = np.where(is_answered[:, None], np.nan if texts is None else texts, np.nan) * np.ones((1, 3))
    found = [(judged or {}).get(sample.key) for sample in samples]
    values = {
        name: np.array([np.nan if counts is None else getattr(counts, name) for counts in found], dtype=float)
        for name in VALUES
    }
    return Scores(
        key=np.array([sample.key for sample in samples], dtype=object),
        walk=np.array([sample.walk for sample in samples], dtype=object),
        language=np.array([sample.language for sample in samples], dtype=object),
        against=np.array([digest_of_reference(sample) for sample in samples], dtype=object),
        reference=np.array([number_of(sample.decision, sample) for sample in samples], dtype=np.int8),
        answer=np.array(decisions, dtype=np.int8),
        label=np.array([number_of(s.label, s) if s.label else NONE for s in samples], dtype=np.int8),
        answered=is_answered,
        drawn_ahead=np.array([s.drawn_ahead for s in samples], dtype=np.float64),
        unmended=np.array([a.coc is not None and not a.mended for a in answers], dtype=bool),
        verdict=np.array(verdicts, dtype=np.int8),
        precision=bert[:, 0],
        recall=bert[:, 1],
        f1=bert[:, 2],
        num_tokens=np.array([a.num_tokens for a in answers], dtype=np.int64),
        **values,
    )


_TEXT = ("key", "walk", "language", "against")


def _column(name: str, scores: Scores) -> pa.Array:
    values = getattr(scores, name)
    if name in ("reference", "answer", "label", "verdict"):
        words = (*VERDICTS, None) if name == "verdict" else (*TOKENS, "(unparsed)", None)
        return pa.array([words[number] for number in values.tolist()], pa.string())
    return pa.array(values.tolist() if name in _TEXT else values, from_pandas=True)


def write_scores(path: Path, scores: Scores) -> None:
    """Write `scores.parquet`: a sample a row, decisions and verdicts in words, null where something is not known."""
    table = pa.table({name: _column(name, scores) for name in COLUMNS})
    with atomic_file(path) as file:
        pq.write_table(table, file, compression="zstd")


def read_scores(path: Path) -> Scores:
    """Read `scores.parquet`, whose decisions are of a set."""
    columns: dict[str, list[Any]] = {name: [] for name in COLUMNS}
    for group in row_groups(path):
        if wrong := [name for name in COLUMNS if group.column_names.count(name) != 1]:
            got = f"{group.column_names.count(wrong[0])} columns {wrong[0]}"
            raise InputError(
                "the file is not a table of scores", where=path, got=got, expected="one column of this name"
            )
        for name in COLUMNS:
            with arrow_errors(path):  # text that is no UTF-8 shows here
                columns[name] += group.column(name).to_pylist()
    try:
        found = {name: _column_values(name, values) for name, values in columns.items()}
        return Scores(**found)
    except (TypeError, ValueError, KeyError) as error:
        raise InputError("the file is not a table of scores", where=path, got=str(error)[:200]) from None


def _column_values(name: str, values: list[Any]) -> np.ndarray:
    if name in ("reference", "answer", "label", "verdict"):
        tokens = {token: number for number, token in enumerate(TOKENS)}
        numbers: dict[Any, int] = {None: NONE, **(_VERDICT if name == "verdict" else tokens | {"(unparsed)": UNPARSED})}
        return np.array([numbers[word] for word in values], dtype=np.int8)
    if name in _TEXT:
        if not all(isinstance(value, str) for value in values):
            raise ValueError(f"the column {name} is not text")
        return np.array(values, dtype=object)
    if name in ("answered", "unmended"):
        return np.array(values, dtype=bool)
    if name == "num_tokens":
        return np.array(values, dtype=np.int64)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


# A share or mean: of which samples (a mask), and what each gives. Macro-F1 is no mean over samples and stands apart.
FIGURES: dict[str, str] = {
    "answered": "samples with an answer",
    "parsed": "answers that parse",
    "parsed_unmended": "answers that parse without corrections",
    "accuracy": "decision accuracy, all answers",
    "accuracy_parsed": "decision accuracy, parsed answers",
    "macro_f1": "macro-F1 over decisions",
    "accuracy_on_labels": "decisions that are the geometric label",
    "drawn_ahead": "samples whose label may depend on draws after the window",
    "accuracy_settled": "decision accuracy, all other samples",
    "consistent": "true future: consistent",
    "soft_conflict": "true future: soft conflict",
    "hard_conflict": "true future: hard conflict",
    "abstain": "true future: geometry cannot decide",
    "bertscore_precision": "BERTScore precision",
    "bertscore_recall": "BERTScore recall",
    "bertscore_f1": "BERTScore F1",
    "bertscore_f1_parsed": "BERTScore F1, parsed answers",
    "values_matched": "values that match a measured fact",
    "values_contradicted": "values that match no fact",
    "tokens": "tokens of an answer",
}
LESS_IS_BETTER = ("hard_conflict", "values_contradicted")
NEITHER = ("soft_conflict", "abstain", "drawn_ahead", "tokens")  # more of it is neither better nor worse


@dataclass(frozen=True)
class _Sums:
    """Of each walk the sums over its samples: numerators, denominators (walks, figures).

    names: of the figures; tokens: of the decisions. confusion: (walks, a, a + 1) of a decisions, what does not parse
    last.
    """

    names: list[str]
    tokens: tuple[str, ...]
    numerators: np.ndarray
    denominators: np.ndarray
    confusion: np.ndarray


def _terms(scores: Scores) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return of each mean what a sample adds to it, and of how many: two (n,) arrays."""
    answered = scores.answered
    parsed = answered & (scores.answer != UNPARSED)
    right = parsed & (scores.answer == scores.reference)
    labelled = answered & (scores.label != NONE)
    judged = answered & (scores.verdict != NONE)
    known, ahead = answered & ~np.isnan(scores.f1), scores.drawn_ahead
    values = sum((np.nan_to_num(getattr(scores, name)) for name in VALUES), np.zeros(len(scores)))
    terms: dict[str, tuple[np.ndarray, np.ndarray]] = {
        "answered": (answered, np.ones(len(scores))),
        "parsed": (parsed, answered),
        "parsed_unmended": (scores.unmended & answered, answered),
        "accuracy": (right, answered),
        "accuracy_parsed": (right, parsed),
        "accuracy_on_labels": (labelled & (scores.answer == scores.label), labelled),
        "drawn_ahead": (ahead == 1, ~np.isnan(ahead)),
        "accuracy_settled": (right & (ahead == 0), answered & (ahead == 0)),
        "tokens": (scores.num_tokens * answered, answered & (scores.num_tokens > 0)),
    }
    for number, verdict in enumerate(VERDICTS):
        terms[verdict.lower()] = (judged & (scores.verdict == number), judged)
    for name in ("precision", "recall", "f1"):
        terms[f"bertscore_{name}"] = (np.where(known, getattr(scores, name), 0.0), known)
    terms["bertscore_f1_parsed"] = (np.where(known & parsed, scores.f1, 0.0), known & parsed)
    for name in VALUES:
        terms[name] = (np.nan_to_num(getattr(scores, name)) * answered, values * answered)
    return terms


def _sums(scores: Scores, walk: np.ndarray, num_walks: int) -> _Sums:
    terms = _terms(scores)
    per_walk = [[np.bincount(walk, part.astype(float), num_walks) for part in pair] for pair in terms.values()]
    answered = scores.answered
    count = len(TOKENS)
    answer = np.where(scores.answer == UNPARSED, count, scores.answer)
    cell = (walk * count + scores.reference) * (count + 1) + answer
    confusion = np.bincount(cell[answered], minlength=num_walks * count * (count + 1))
    return _Sums(
        list(terms),
        TOKENS,
        np.array([pair[0] for pair in per_walk]).T,
        np.array([pair[1] for pair in per_walk]).T,
        confusion.reshape(num_walks, count, count + 1).astype(float),
    )


def macro_f1(confusion: np.ndarray) -> np.ndarray:
    """Return the mean F1 over the decisions that references have, (...,) from (..., a, a + 1) counts; NaN without any.

    F1 = 2 tp / (2 tp + fp + fn); an answer that does not parse is a miss of its reference and nobody's false alarm.
    """
    hits = np.diagonal(confusion[..., :-1], axis1=-2, axis2=-1)
    references, answers = confusion.sum(axis=-1), confusion[..., :-1].sum(axis=-2)
    occurs = references > 0
    scores = np.where(occurs, 2 * hits / np.maximum(references + answers, 1), 0.0)
    return np.where(occurs.any(axis=-1), scores.sum(axis=-1) / np.maximum(occurs.sum(axis=-1), 1), np.nan)


def _values(sums: _Sums, draws: np.ndarray) -> dict[str, np.ndarray]:
    """Return each figure on each draw, (draws,); draws: (draws, walks) how often each walk was drawn."""
    numerators, denominators = draws @ sums.numerators, draws @ sums.denominators
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = np.where(denominators > 0, numerators / denominators, np.nan)
    found = dict(zip(sums.names, shares.T, strict=True))
    counted = (draws @ sums.confusion.reshape(len(sums.confusion), -1)).reshape(-1, *sums.confusion.shape[1:])
    found["macro_f1"] = macro_f1(counted)
    diagonal = np.diagonal(counted[..., :-1], axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        recall = diagonal / counted.sum(axis=-1)
    return found | {f"decision/{token}": recall[:, number] for number, token in enumerate(sums.tokens)}


def figures_of(scores: Scores, draws: np.ndarray, *, confidence: float) -> tuple[dict[str, Figure], dict[str, Figure]]:
    """Return all figures, and the accuracy of each decision that references have; draws: of the walks
    (`draw_pedestrians`)."""
    names, walk = np.unique(scores.walk.astype(str), return_inverse=True)
    sums = _sums(scores, walk, len(names))
    whole = _values(sums, np.ones((1, len(names))))
    drawn = _values(sums, draws)
    counts = dict(zip(sums.names, sums.denominators.sum(axis=0), strict=True))
    references = sums.confusion.sum(axis=(0, 2))
    counts |= {"macro_f1": references.sum(), **{f"decision/{a}": references[i] for i, a in enumerate(sums.tokens)}}
    found = {
        name: figure_of_draws(float(v[0]), drawn[name], int(counts[name]), len(names), confidence)
        for name, v in whole.items()
    }
    decisions = {token: found[f"decision/{token}"] for i, token in enumerate(sums.tokens) if references[i]}
    return {name: found[name] for name in FIGURES}, decisions


class Difference(Record):
    """One student's figure less another's on the samples that both were asked.

    p: two-sided, the share of draws on the other side of zero, doubled; no smaller than one draw can tell.
    """

    value: float | None
    low: float | None
    high: float | None
    p: float | None


def differences_of(
    one: Scores, other: Scores, *, resamples: int, confidence: float, rng: np.random.Generator
) -> tuple[int, dict[str, Difference]]:
    """Compare two students on the same draws of walks: the number of samples that both have, and the differences."""
    places: Mapping[str, int] = {key: place for place, key in enumerate(other.key)}
    here = np.array([place for place, key in enumerate(one.key) if key in places], dtype=int)
    if not len(here):
        return 0, {}
    one, other = one.at(here), other.at(np.array([places[key] for key in one.key[here]], dtype=int))
    names, walk = np.unique(one.walk.astype(str), return_inverse=True)
    sums = [_sums(scores, walk, len(names)) for scores in (one, other)]
    whole = [_values(each, np.ones((1, len(names)))) for each in sums]
    draws = draw_pedestrians(len(names), resamples, rng)
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
    low, high = interval_of(drawn, confidence)
    beyond = min((drawn <= 0).mean(), (drawn >= 0).mean())
    return Difference(value=float(value), low=low, high=high, p=float(min(1.0, max(2 * beyond, 1 / len(drawn)))))
