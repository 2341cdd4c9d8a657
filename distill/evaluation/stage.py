"""Measure students: parse rate, decisions, verdicts, BERTScore and values, next to the baselines, with intervals.

The reference is the teacher's accepted answer, as in the paper. Agreement with the geometric label and the verdict on
the motion after the window are measured too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from cosfly.formats.captions import Language, ValueCounts, read_captions
from cosfly.formats.predictions import PREDICTIONS, Prediction, read_predictions
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import inside, write_bytes
from cosfly.runtime.json_io import validated, write_model
from cosfly.runtime.run_dir import Resume, StageFolder, Tally, read_manifest
from cosfly.runtime.seeding import rng_for
from cosfly.viz.frame_views import thumbnail
from distill.evaluation.bertscore import Metric, Scorer, encoder_files
from distill.evaluation.figures import (
    CONFIDENCE,
    RESAMPLES,
    UNPARSED,
    Answers,
    Measurement,
    coc_of,
    decision_number,
    measure,
    text_of,
)
from distill.evaluation.floors import floors_of
from distill.evaluation.report import (
    REPORT,
    REPORT_FORMAT,
    Evaluation,
    Example,
    ExampleAnswer,
    StudentRecord,
    markdown_of,
    page_of,
)
from distill.schema import Sample, open_split, resolve_trees, tree_inputs

STAGE = "distill.evaluate"
NUM_EXAMPLES = 12  # samples that the page shows with their answers
THUMBNAIL_PX = 256  # width of a frame on the page
MOST_RAW = 2000  # characters of an answer in an example
Predictions = Mapping[str, Mapping[str, Prediction]]  # student -> sample's key -> its prediction
# (run or None, window, language, text) -> values of this text
JudgedValues = dict[tuple[str | None, str, str, str], ValueCounts]


def run(
    predictions: Sequence[Path],
    dataset: Path,
    out: Path,
    *,
    data: Sequence[Path] = (),
    encoders: Mapping[Language, Path] | None = None,
    judged: Sequence[Path] = (),
    seed: int = 0,
    resume: Resume = "if-same",
) -> Path:
    """Read the predictions of students and their training set; write `report.json` and two pages.

    Args:
        predictions: `predictions.jsonl` of each student or its folder; the folder's name is the student's. Students are
            measured on the samples that all of them were asked.
        encoders: folders of the encoders of BERTScore; a language without one is not scored, and the report says so.
        judged: captions that `cosfly caption --teacher student:PATH` made of the answers.

    Returns:
        The path of `report.json`.

    Raises:
        InputError: an input is missing, or predictions and training set do not belong together.
    """
    files = {folder.absolute().name: folder / PREDICTIONS for folder in map(_folder_of, predictions)}
    if len(files) < len(predictions):
        fix = "rename the folder of one of them, because it is the name of a column"
        raise InputError("two students have the same name", got=", ".join(map(str, predictions)), fix=fix)
    encoders, trees = dict(encoders or {}), resolve_trees(dataset, data) if data else {}
    inputs = {"dataset": dataset, **{f"predictions/{name}": path for name, path in files.items()}, **tree_inputs(trees)}
    inputs |= {f"judged/{n}": path for n, path in enumerate(judged, 1)}
    inputs |= {
        f"bertscore/{language}/{path.name}": path
        for language, folder in encoders.items()
        for path in encoder_files(folder)
    }
    stage = StageFolder.open(out, STAGE, config=Config(), inputs=inputs, seed=seed, resume=resume)
    if stage.is_complete:
        return out / REPORT
    found = {name: {p.key: p for p in read_predictions(path)} for name, path in files.items()}
    splits = sorted({p.split for own in found.values() for p in own.values()})
    if len(splits) != 1:
        fix = "pass predictions of one split"
        raise InputError("the predictions are not of one split", got=", ".join(splits) or "none", fix=fix)
    samples = list(open_split(dataset, splits[0]))
    asked = asked_samples(samples, found)
    students = {
        name: _student_record(asked, own, len(samples) - len(own), _samples_per_s(files[name].parent))
        for name, own in found.items()
    }
    report = evaluate(asked, students, found, dataset, encoders, read_judged(judged), seed)
    write_model(out / REPORT, report, REPORT_FORMAT)
    write_bytes(out / "evaluation.md", markdown_of(report).encode())
    of_key = {sample.key: sample for sample in asked}
    pictures = {example.key: _pictures_of(of_key[example.key], trees) for example in report.examples if trees}
    write_bytes(out / "evaluation.html", page_of(report, pictures).encode())
    num_left = len(samples) - len(asked)
    tally = Tally(input=len(samples), kept=len(asked), dropped={"not_asked": num_left} if num_left else {})
    products = [out / name for name in (REPORT, "evaluation.md", "evaluation.html")]
    stage.finish(products, tally, split=splits[0], models={name: one.model for name, one in report.students.items()})
    return out / REPORT


def _folder_of(predictions: Path) -> Path:
    return predictions if predictions.is_dir() else predictions.parent


class _Speed(BaseModel):
    """Facts of the last run in the manifest of `distill infer`."""

    seconds: float = 0
    answers: int = 0


def _samples_per_s(folder: Path) -> float | None:
    """Return the speed of the last run of `distill infer`; None if there is no record."""
    path = folder / "manifest.json"
    if not path.is_file():
        return None
    speed = validated(_Speed, read_manifest(folder).facts.get("speed", {}), path)
    return speed.answers / speed.seconds if speed.seconds and speed.answers else None


def _pictures_of(sample: Sample, trees: Mapping[str, Path]) -> list[str]:
    """Return the readable frames of a sample's window as small JPEGs in base64."""
    found = (thumbnail(inside(trees[sample.run], frame), THUMBNAIL_PX) for frame in sample.frames)
    return [picture for picture in found if picture is not None]


def asked_samples(samples: Sequence[Sample], predictions: Predictions) -> list[Sample]:
    """Return the samples that every student was asked, in the order of the split."""
    keys = {sample.key for sample in samples}
    for name, own in predictions.items():
        if unknown := own.keys() - keys:
            what, fix = (
                "the split does not contain the sample of a prediction",
                "pass the training set of the predictions",
            )
            raise InputError(what, where=f"{name}: {min(unknown)}", got=f"{len(unknown)} such predictions", fix=fix)
    asked = [sample for sample in samples if all(sample.key in own for own in predictions.values())]
    if not asked:
        raise InputError("no sample was asked of all students", got=", ".join(predictions))
    return asked


def read_judged(paths: Sequence[Path]) -> JudgedValues:
    """Read the counts of values in students' texts from the captions that were made of them."""
    found: JudgedValues = {}
    for path in paths:
        for caption in read_captions(path):
            for language, counts in (caption.checks.values or {}).items():
                text = text_of(caption.en if language == "en" else caption.zh)
                found[caption.teacher.run, caption.sample_id, language, text] = counts
    return found


def _values_of(sample: Sample, prediction: Prediction, judged: JudgedValues) -> ValueCounts | None:
    rest = (sample.window_id, sample.language, text_of(prediction.coc))
    return judged.get((sample.run, *rest)) or judged.get((None, *rest))


def evaluate(
    samples: Sequence[Sample],
    students: dict[str, StudentRecord],
    predictions: Predictions,
    dataset: Path,
    encoders: Mapping[Language, Path],
    judged: JudgedValues,
    seed: int,
) -> Evaluation:
    """Measure students, teacher and baselines on samples that all students were asked, in each language."""
    metrics: dict[Language, Metric | None] = {}
    measurements: dict[Language, Measurement] = {}
    examples: list[Example] = []
    languages = sorted({sample.language for sample in samples})
    for language in languages:
        own = [sample for sample in samples if sample.language == language]
        everyone: dict[str, Answers] = {}
        for name, of_key in predictions.items():
            asked = [of_key[sample.key] for sample in own]
            values = [_values_of(sample, answer, judged) for sample, answer in zip(own, asked, strict=True)]
            everyone[name] = Answers.of_student(asked, values)
        everyone |= floors_of(open_split(dataset, "train"), own, language, seed)
        metrics[language] = None
        if language in encoders:
            references = [text_of(coc_of(sample)) for sample in own]
            scorer = Scorer(encoders[language], references)
            metrics[language] = scorer.metric
            written = {name: answers.texts.tolist() for name, answers in everyone.items() if any(answers.texts)}
            for name, scores in scorer.score(written, references).items():
                everyone[name].scores[:] = np.where(everyone[name].is_answered[:, None], scores, np.nan)
        measurements[language] = measure(own, everyone, predictions, rng_for(seed, STAGE, "draws"))
        examples += _examples(own, predictions, everyone, NUM_EXAMPLES // len(languages), seed)
    return Evaluation(
        split=next(iter(next(iter(predictions.values())).values())).split,
        seed=seed,
        confidence=CONFIDENCE,
        resamples=RESAMPLES,
        students=students,
        metrics=metrics,
        languages=measurements,
        examples=examples,
    )


def _student_record(
    samples: Sequence[Sample], own: Mapping[str, Prediction], not_asked: int, samples_per_s: float | None
) -> StudentRecord:
    answers = [own[sample.key] for sample in samples]
    reasons = Counter(answer.reason or "unknown" for answer in answers if answer.coc is None)
    model = ", ".join(sorted({answer.model or "unknown" for answer in answers}))
    return StudentRecord(
        model=model, not_asked=not_asked, without_decision=dict(sorted(reasons.items())), samples_per_s=samples_per_s
    )


def _examples(
    samples: Sequence[Sample], predictions: Predictions, everyone: Mapping[str, Answers], most: int, seed: int
) -> list[Example]:
    """Choose samples to show: by the first student's outcome (no answer, unparsed, wrong, right) in turn."""
    first = everyone[next(iter(predictions))]
    right = first.decision == np.array([decision_number(sample.decision, sample.key) for sample in samples])
    outcomes = np.where(~first.is_answered, 0, np.where(first.decision == UNPARSED, 1, np.where(right, 3, 2)))
    kinds: dict[int, list[int]] = {kind: [] for kind in range(4)}
    for place in rng_for(seed, STAGE, "examples").permutation(len(samples)).tolist():
        kinds[int(outcomes[place])].append(place)
    chosen: list[int] = []
    while len(chosen) < min(most, len(samples)):
        chosen += [places.pop() for places in kinds.values() if places]
    return [
        Example(
            key=samples[place].key,
            walk=samples[place].walk,
            label=samples[place].label,
            reference=coc_of(samples[place]),
            answers={
                name: _example_answer(own[samples[place].key], everyone[name].scores[place, 2])
                for name, own in predictions.items()
            },
        )
        for place in chosen[:most]
    ]


def _example_answer(prediction: Prediction, f1: float) -> ExampleAnswer:
    return ExampleAnswer(coc=prediction.coc, raw=prediction.raw[:MOST_RAW], f1=None if np.isnan(f1) else float(f1))
