"""An evaluation's report: what a student's answers are worth beside what the floors' are, by language and over all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel

from cosfly.formats.captions import FIELDS, TOKENS, Coc, Language, ValueCounts, read_captions
from cosfly.formats.episodes import Figure
from cosfly.formats.predictions import FAILED, Prediction, Split
from cosfly.geometry.trajectory_metrics import draw_pedestrians
from cosfly.inspection.blind_baseline import DRAWN_AHEAD, FITTED_ON, LEAST_WINDOWS, LOOKS_BACK
from cosfly.llm.answers import read_answers
from cosfly.runtime.errors import InputError
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import FileFormat, Record, read_model, read_object, validated
from cosfly.runtime.run_dir import MANIFEST_FORMAT, read_manifest
from cosfly.runtime.seeding import rng_for
from distill.evaluation.bertscore import Metric, score_beside_floors
from distill.evaluation.floors import WITH_TEXT, Floors, coc_of
from distill.evaluation.scores import UNPARSED, ScoredAnswer, Scores, figures_of, score_answers
from distill.schema import Sample


class Speed(Record):
    """How fast a student answered, None where nothing says.

    seconds: of the last start of `distill infer`, without loading. samples_per_s: answers made in it. latency_s: of an
    answer, as who asked saw it: mean, median, 95th percentile.
    """

    seconds: float | None = None
    samples_per_s: float | None = None
    mean_tokens: float | None = None
    latency_s: dict[str, float] | None = None


class _LastStart(BaseModel):
    """Of the manifest of `distill infer`: what it says of its last start."""

    seconds: float | None = None
    answers: int = 0


def speed_of(predictions_path: Path, predictions: Sequence[Prediction]) -> Speed:
    """Measure what can be measured beside `predictions.jsonl`."""
    folder = predictions_path.parent
    seconds, num_new = _last_start(folder)
    tokens = [prediction.num_tokens for prediction in predictions if prediction.num_tokens]
    journals = sorted((folder / "answers").glob("*.jsonl"))
    latencies = np.array([answer.latency_s for path in journals for answer in read_answers(Journal(path))])
    return Speed(
        seconds=seconds,
        samples_per_s=num_new / seconds if seconds and num_new else None,
        mean_tokens=float(np.mean(tokens)) if tokens else None,
        latency_s=_latency(latencies) if len(latencies) else None,
    )


def _latency(times_s: np.ndarray) -> dict[str, float]:
    median, p95 = np.quantile(times_s, [0.5, 0.95]).tolist()
    return {"mean": float(times_s.mean()), "median": median, "p95": p95}


def _last_start(folder: Path) -> tuple[float | None, int]:
    """Return the seconds of the last start of `distill infer`, and how many answers it made."""
    path = folder / "manifest.json"
    if not path.is_file() or read_object(path, what="manifest").get("schema") != MANIFEST_FORMAT.schema:
        return None, 0
    found = validated(_LastStart, read_manifest(folder).facts.get("speed", {}), path)
    return found.seconds, found.answers


REPORT, REPORT_FORMAT = "report.json", FileFormat("cosfly.distill_report", "3.0", "report")
STAGE = "distill.evaluate"
STUDENT = "student"
UNPARSED_NAME = "(unparsed)"  # column of the confusion table beside the decisions
JudgedValues = Mapping[str, ValueCounts]  # sample's key -> values of the student's text
TextScorer = Callable[[Sequence[tuple[str, str]]], np.ndarray]  # (candidate, reference) -> (n, 3)


class FigureSet(Record):
    """Of one who answers: figures by name (FIGURES), accuracy by decision, reference -> answers."""

    figures: dict[str, Figure]
    by_decision: dict[str, Figure]
    confusion: dict[str, dict[str, int]]


class Measurement(Record):
    """Of one language, or over all. who: `student`, then the floors. failed: samples without an answer, by reason."""

    samples: int
    walks: int
    failed: dict[str, int]
    unparsed: dict[str, int]
    histogram_f1: list[int] | None  # of the student's parsed answers, in hundredths from 0 to 1
    who: dict[str, FigureSet]


class Example(Record):
    """A sample with its answer, side by side."""

    key: str
    walk: str
    reference: Coc
    answer: Coc | None
    raw: str
    label: str | None
    f1: float | None


class Evaluation(Record):
    """`report.json`."""

    model: str
    split: Split
    confidence: float
    resamples: int
    seed: int
    not_asked: int
    metrics: dict[Language, Metric | None]  # None: BERTScore was not computed
    judged: bool  # whether the values of the student's texts were compared with the facts
    speed: Speed
    languages: dict[Language, Measurement]
    all: Measurement
    examples: list[Example]
    notes: list[str]


NOTES = [
    "reference: the teacher's accepted answer; an answer that does not parse is wrong and scores 0 in BERTScore",
    "a sample without an answer is not a wrong answer: it counts under `answered` only",
    "intervals: bootstrap over pedestrian trajectories, because windows of the same trajectory are similar",
    "baselines rule and blind: a decision tree of depth two and a network with one hidden layer, without pictures, on "
    f"the exact geometry of the last {LOOKS_BACK} frames of a window; fitted on up to {FITTED_ON:,} samples of train, "
    f"the network on at least {LEAST_WINDOWS}; `teacher`: the reference itself",
    f"drawn after the window: in the future of the label, {DRAWN_AHEAD}; the window does not show this",
    "verdicts: from the motion after the window, by the same rules as for captions",
]


def read_report(folder: Path) -> Evaluation:
    """Read an evaluation's report; raises as `read_model`."""
    path = folder / REPORT
    return read_model(path, Evaluation, REPORT_FORMAT, tree=folder)


def pair_up(samples: Sequence[Sample], predictions: Sequence[Prediction]) -> list[tuple[Sample, Prediction]]:
    """Return each sample that was asked its prediction, in the order of the samples."""
    by_key = {prediction.key: prediction for prediction in predictions}
    if unknown := by_key.keys() - {sample.key for sample in samples}:
        words = "the split does not have the sample of a prediction"
        fix = "pass the training set that the predictions were made for"
        raise InputError(words, where=min(unknown), got=f"{len(unknown)} such predictions", fix=fix)
    return [(sample, by_key[sample.key]) for sample in samples if sample.key in by_key]


def read_judged(paths: Sequence[Path], samples: Iterable[Sample]) -> JudgedValues:
    """Read the values that `cosfly caption --teacher student:` counted in a student's texts, by the sample's key.

    Args:
        paths: one file a tree.
    """
    keys: dict[str, dict[str, str]] = {}  # window and language -> run -> sample's key
    for sample in samples:
        keys.setdefault(f"{sample.window_id}/{sample.language}", {})[sample.run] = sample.key
    found: dict[str, ValueCounts] = {}
    for path, caption in ((file, caption) for file in paths for caption in read_captions(file)):
        where, kind = f"{path}: {caption.sample_id}", caption.teacher.kind
        if kind != "student":
            fix = "pass the output of cosfly caption --teacher student:PREDICTIONS"
            raise InputError("the captions are not those of a student", where=where, got=kind, fix=fix)
        for language, counts in (caption.checks.values or {}).items():
            by_run = keys.get(f"{caption.sample_id}/{language}", {})
            if caption.teacher.run is None and len(by_run) > 1:
                got, fix = ", ".join(sorted(by_run)), "caption each tree with --set caption.student.run=NAME"
                raise InputError("several playback trees have a window with this id", where=where, got=got, fix=fix)
            of_run = by_run.values() if caption.teacher.run is None else filter(None, [by_run.get(caption.teacher.run)])
            found |= dict.fromkeys(of_run, counts)
    return found


def text_of(coc: Coc | None) -> str:
    """Join the fields into the text that BERTScore compares (sec:appendix_f_caption_distillation); "" for none."""
    if coc is None or not coc.reasoning_trace:
        return ""
    return " ".join(getattr(coc, name) for name in FIELDS).strip()


def score_language(
    pairs: Sequence[tuple[Sample, Prediction]], floors: Floors, scorer: TextScorer | None, judged: JudgedValues
) -> dict[str, Scores]:
    """Score the student and the floors on the samples of one language: who -> scores."""
    samples = [sample for sample, _ in pairs]
    references = [coc_of(sample) for sample in samples]
    who = {STUDENT: [ScoredAnswer.of(prediction) for _, prediction in pairs], **floors.answers(samples, references)}
    texts: dict[str, np.ndarray] = {}
    if scorer is not None:
        written = {name: [text_of(a.coc) for a in who[name]] for name in (STUDENT, *WITH_TEXT) if name in who}
        groups = floors.groups(len(samples))
        texts = score_beside_floors(scorer, groups, written, [text_of(c) for c in references], samples[0].language)
    return {
        name: score_answers(samples, answers, texts.get(name), judged if name == STUDENT else None)
        for name, answers in who.items()
    }


def measure(
    scores: Mapping[str, Scores], predictions: Sequence[Prediction], *, resamples: int, confidence: float, seed: int
) -> Measurement:
    """Measure everyone on the same samples and the same draws."""
    student = scores[STUDENT]
    found = {}
    draws = draw_pedestrians(len(set(student.walk)), resamples, rng_for(seed, STAGE, "draws"))
    for name, own in scores.items():
        figures, decisions = figures_of(own, draws, confidence=confidence)
        found[name] = FigureSet(figures=figures, by_decision=decisions, confusion=_confusion(own))
    reasons = Counter(p.reason or "unknown" for p in predictions if p.coc is None)
    failed = {reason for reason in reasons if reason.startswith(FAILED)}
    known = student.answered & (student.answer != UNPARSED) & ~np.isnan(student.f1)
    histogram = np.histogram(np.clip(student.f1[known], 0, 1), bins=100, range=(0, 1))[0].tolist()
    counts = sorted(reasons.items())
    return Measurement(
        samples=len(student),
        walks=len(set(student.walk)),
        failed={reason: count for reason, count in counts if reason in failed},
        unparsed={reason: count for reason, count in counts if reason not in failed},
        histogram_f1=histogram if known.any() else None,
        who=found,
    )


def _confusion(scores: Scores) -> dict[str, dict[str, int]]:
    names = {UNPARSED: UNPARSED_NAME, **dict(enumerate(TOKENS))}
    pairs = np.stack([scores.reference, scores.answer], axis=1)[scores.answered]
    cells = Counter(map(tuple, pairs.tolist()))
    found: dict[str, dict[str, int]] = {}
    for (reference, answer), count in sorted(cells.items()):
        found.setdefault(names[reference], {})[names[answer]] = count
    return found


def examples_of(pairs: Sequence[tuple[Sample, Prediction]], scores: Scores, count: int, seed: int) -> Iterator[Example]:
    """Choose samples to show: of each kind of outcome (no answer, unparsed, wrong, right) some, drawn by the seed."""
    kinds: dict[str, list[int]] = {"failed": [], "unparsed": [], "wrong": [], "right": []}
    for place in rng_for(seed, STAGE, "examples").permutation(len(pairs)).tolist():
        kinds[_kind(scores, place)].append(place)
    chosen: list[int] = []
    while len(chosen) < min(count, len(pairs)):
        for places in kinds.values():
            if places and len(chosen) < count:
                chosen.append(places.pop())
    for place in chosen:
        (sample, prediction), f1 = pairs[place], float(scores.f1[place])
        yield Example(
            key=sample.key, walk=sample.walk, reference=coc_of(sample), answer=prediction.coc,
            raw=prediction.raw[:2000], label=sample.label, f1=None if np.isnan(f1) else f1,
        )  # fmt: skip


def _kind(scores: Scores, place: int) -> Literal["failed", "unparsed", "wrong", "right"]:
    if not scores.answered[place]:
        return "failed"
    if scores.answer[place] == UNPARSED:
        return "unparsed"
    return "right" if scores.answer[place] == scores.reference[place] else "wrong"
