"""What each answer is worth, sample by sample: `scores.parquet`, from which every figure of an evaluation can be computed again.

A sample that got no answer (`answered` false: a picture could not be read, a server refused) is no wrong answer. An answer that does not
parse is one: it decides nothing, and its texts score 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cosfly.errors import InputError
from cosfly.products.actions import action_tokens, not_in_set
from cosfly.products.captions import Coc, SentenceState, Verdict, verdict_on
from cosfly.products.predictions import FAILED, Prediction
from cosfly.reading.tables import arrow_errors, row_groups
from cosfly.work import in_place
from cosfly.work.store import atomic_file, dump_json, sha256_bytes
from distill.schema import Sample

SCORES = "scores.parquet"
REFERENCE_DIGITS = 16  # of a digest of 64
VERDICTS: tuple[Verdict, ...] = ("CONSISTENT", "SOFT_CONFLICT", "HARD_CONFLICT", "ABSTAIN")
STATES: tuple[SentenceState, ...] = ("proved", "contradicted", "unread")
UNPARSED = -2  # the number of the decision that an answer without one makes
NONE = -1  # the number of a label or verdict that nobody knows
_VERDICT = {name: number for number, name in enumerate(VERDICTS)}


@dataclass(frozen=True)
class Answer:
    """What somebody answered. coc: None where it does not parse; mended: whether punctuation had to be put right first."""

    coc: Coc | None
    is_answered: bool = True
    mended: bool = False
    reason: str | None = None
    num_tokens: int = 0

    @classmethod
    def of(cls, prediction: Prediction) -> Answer:
        reason = prediction.reason
        is_answered = not (reason or "").startswith(FAILED)
        return cls(prediction.coc, is_answered, bool(prediction.recovered), reason, prediction.num_tokens)


@dataclass(frozen=True)
class Scores:
    """Columns over n samples.

    key, walk, language (n,) str; against (n,) str, a digest of what the answer is held against; reference, answer, label (n,) int8 numbers of action_tokens(), UNPARSED, NONE; answered, unmended (n,) bool;
    verdict (n,) int8 number of VERDICTS or NONE; precision, recall, f1 (n,) of BERTScore, NaN where it was not computed;
    proved, contradicted, unread (n,) numbers of sentences, NaN where nobody judged them; num_tokens (n,).
    """

    key: np.ndarray
    walk: np.ndarray
    language: np.ndarray
    against: np.ndarray
    reference: np.ndarray
    answer: np.ndarray
    label: np.ndarray
    answered: np.ndarray
    unmended: np.ndarray
    verdict: np.ndarray
    precision: np.ndarray
    recall: np.ndarray
    f1: np.ndarray
    proved: np.ndarray
    contradicted: np.ndarray
    unread: np.ndarray
    num_tokens: np.ndarray

    def __len__(self) -> int:
        return len(self.key)

    def at(self, where: np.ndarray) -> Scores:
        """Give the samples at some places."""
        return Scores(**{field.name: getattr(self, field.name)[where] for field in fields(self)})


@in_place.kept()
def _numbers() -> dict[str, int]:
    return {token: number for number, token in enumerate(action_tokens())}


def _number_of(decision: str, sample: Sample) -> int:
    """Give the number of a decision.

    Raises:
        InputError: it is none of the closed set.
    """
    if decision not in _numbers():
        raise not_in_set(decision, sample.key)
    return _numbers()[decision]


def digest_of_reference(sample: Sample) -> str:
    """Name what answers to a sample are held against: the teacher's answer, the label, and what the future rules out."""
    return sha256_bytes(dump_json([sample.answer, sample.label, sample.contradicted]).encode())[:REFERENCE_DIGITS]


def score_answers(
    samples: Sequence[Sample],
    answers: Sequence[Answer],
    texts: np.ndarray | None = None,
    judged: Mapping[str, Sequence[SentenceState]] | None = None,
) -> Scores:
    """Score answers, one a sample.

    Args:
        texts: (n, 3) precision, recall, F1 of BERTScore, NaN where it was not computed. judged: sample's key -> its sentences' states.
    """
    verdicts = []
    for sample, answer in zip(samples, answers, strict=True):
        known = answer.coc is not None and sample.contradicted is not None
        verdicts.append(
            _VERDICT[verdict_on(answer.coc.flight_decision, sample.label, sample.contradicted or ())]  # type: ignore[union-attr]
            if known
            else NONE
        )
    is_answered = np.array([answer.is_answered for answer in answers], dtype=bool)
    bert = np.where(is_answered[:, None], np.nan if texts is None else texts, np.nan) * np.ones((1, 3))
    found = [(judged or {}).get(sample.key) for sample in samples]
    sentences = {
        state: np.array([np.nan if states is None else states.count(state) for states in found], dtype=float)  # type: ignore[attr-defined]
        for state in STATES
    }
    return Scores(
        key=np.array([sample.key for sample in samples], dtype=object),
        walk=np.array([sample.walk for sample in samples], dtype=object),
        language=np.array([sample.language for sample in samples], dtype=object),
        against=np.array([digest_of_reference(sample) for sample in samples], dtype=object),
        reference=np.array([_number_of(sample.decision, sample) for sample in samples], dtype=np.int8),
        answer=np.array(
            [
                _number_of(a.coc.flight_decision, s) if a.coc else UNPARSED
                for s, a in zip(samples, answers, strict=True)
            ],
            dtype=np.int8,
        ),
        label=np.array([_number_of(s.label, s) if s.label else NONE for s in samples], dtype=np.int8),
        answered=is_answered,
        unmended=np.array([a.coc is not None and not a.mended for a in answers], dtype=bool),
        verdict=np.array(verdicts, dtype=np.int8),
        precision=bert[:, 0],
        recall=bert[:, 1],
        f1=bert[:, 2],
        num_tokens=np.array([a.num_tokens for a in answers], dtype=np.int64),
        **sentences,
    )


# --- on disk ----------------------------------------------------------------------------------------------------------

_TEXT, _NAMES = ("key", "walk", "language", "against"), [field.name for field in fields(Scores)]


def _column(name: str, values: np.ndarray) -> pa.Array:
    if name in ("reference", "answer", "label", "verdict"):
        words = (*VERDICTS, None) if name == "verdict" else (*action_tokens(), "(unparsed)", None)
        return pa.array([words[number] for number in values.tolist()], pa.string())
    return pa.array(values.tolist() if name in _TEXT else values, from_pandas=True)


def write_scores(path: Path, scores: Scores) -> None:
    """Write `scores.parquet`: a sample a row, decisions and verdicts in words, null where something is not known."""
    table = pa.table({name: _column(name, getattr(scores, name)) for name in _NAMES})
    with atomic_file(path) as file:
        pq.write_table(table, file, compression="zstd")


def read_scores(path: Path) -> Scores:
    """Read `scores.parquet`.

    Raises:
        InputError: it is damaged, or holds something else.
    """
    columns: dict[str, list[Any]] = {name: [] for name in _NAMES}
    for group in row_groups(path):
        wrong = [name for name in _NAMES if group.column_names.count(name) != 1]
        if wrong:
            got = f"{group.column_names.count(wrong[0])} columns {wrong[0]}"
            fix = "run cosfly distill evaluate anew"
            raise InputError("not the scores of an evaluation", where=path, got=got, expected="one", fix=fix)
        for name in _NAMES:
            with arrow_errors(path):  # text that is no UTF-8 shows here
                columns[name] += group.column(name).to_pylist()
    try:
        return Scores(**{name: _values(name, values) for name, values in columns.items()})
    except (TypeError, ValueError, KeyError) as error:
        raise InputError("not the scores of an evaluation", where=path, got=str(error)[:200]) from None


def _values(name: str, values: list[Any]) -> np.ndarray:
    if name == "verdict":
        return np.array([NONE if word is None else _VERDICT[word] for word in values], dtype=np.int8)
    if name in ("reference", "answer", "label"):
        numbers = _numbers() | {"(unparsed)": UNPARSED}
        return np.array([NONE if word is None else numbers[word] for word in values], dtype=np.int8)
    if name in _TEXT:
        if not all(isinstance(value, str) for value in values):
            raise ValueError(f"{name}: not text")
        return np.array(values, dtype=object)
    if name in ("answered", "unmended"):
        return np.array(values, dtype=bool)
    if name == "num_tokens":
        return np.array(values, dtype=np.int64)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
