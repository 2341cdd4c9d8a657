"""Measure a student: parse rate, decisions, verdicts, BERTScore and evidence, each beside its floors and with its
interval.

The reference is the teacher's accepted answer, as in the paper; agreement with the geometric label and the verdict on
the true future stand beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from cosfly.formats.captions import Language
from cosfly.formats.predictions import Prediction, read_predictions
from cosfly.runtime.config import Config
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import inside, write_bytes
from cosfly.runtime.json_io import write_model
from cosfly.runtime.run_dir import Resume, StageFolder, Tally
from cosfly.viz.frame_views import thumbnail
from distill.evaluation.bertscore import BertScoreConfig, Metric, Scorer, check_encoder, deciding_files
from distill.evaluation.floors import Floors, coc_of
from distill.evaluation.measure import (
    NOTES,
    REPORT,
    REPORT_FORMAT,
    STAGE,
    STUDENT,
    Evaluation,
    JudgedValues,
    Measurement,
    examples_of,
    measure,
    pair_up,
    read_judged,
    score_language,
    speed_of,
    text_of,
)
from distill.evaluation.pages import markdown_of, page_of
from distill.evaluation.scores import CONFIDENCE, SCORES, Scores, join, write_scores
from distill.schema import Sample, open_split, resolve_trees, tree_inputs
from distill.student.model import require

NUM_EXAMPLES = 12  # samples that the page shows next to their answers
THUMBNAIL_PX = 256  # width of a frame on the page


class EvaluateConfig(Config):
    """Settings of `distill evaluate`."""

    resamples: ClassVar[int] = 2000  # draws of walks for the intervals
    bertscore: BertScoreConfig = Field(BertScoreConfig(), description="semantic similarity of the texts")


def run(
    cfg: EvaluateConfig,
    predictions: Path,
    dataset: Path,
    out: Path,
    *,
    data: Sequence[Path] = (),
    bertscore_models: Mapping[Language, Path] | None = None,
    judged: Sequence[Path] = (),
    seed: int = 0,
    resume: Resume = "if-same",
) -> Path:
    """Read `predictions.jsonl` and the training set it was made from; write `report.json`, `scores.parquet` and two
    pages.

    Args:
        bertscore_models: local folders of the encoders; a language without one is not scored, and the report says so.
        judged: captions that `cosfly caption --teacher student:` made of the student's answers, one file per tree.
    Returns:
        The path of `report.json`.
    Raises:
        InputError: an input is missing, or predictions and training set do not belong together.
    """
    models = dict(bertscore_models or {})
    trees = resolve_trees(dataset, data) if data else {}
    inputs = {"predictions": predictions, "dataset": dataset, **tree_inputs(trees)}
    inputs |= {f"judged/{n}": path for n, path in enumerate(judged, 1)}
    for language, folder in models.items():
        require("torch", "transformers", "bert_score")
        check_encoder(getattr(cfg.bertscore, language), folder, language)
        inputs |= {f"bertscore/{language}/{path.name}": path for path in deciding_files(folder)}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs, seed=seed, resume=resume)
    path = out / REPORT
    if stage.is_complete:
        return path
    found = read_predictions(predictions)
    splits = sorted({prediction.split for prediction in found})
    if len(splits) != 1:
        raise InputError("the predictions must be of one split", where=predictions, got=", ".join(splits) or "none")
    samples = list(open_split(dataset, splits[0]))
    pairs = pair_up(samples, found)
    values = read_judged(judged, samples)
    report, scores = _evaluate(cfg, pairs, dataset, models, values, seed)
    num_left = len(samples) - len(pairs)
    report = report.model_copy(update={"not_asked": num_left, "speed": speed_of(predictions, found)})
    write_model(path, report, REPORT_FORMAT)
    write_scores(out / SCORES, scores)
    write_bytes(out / "evaluation.md", markdown_of(report).encode())
    shown = {sample.key: sample for sample, _ in pairs}
    pictures = {example.key: _pictures_of(shown[example.key], trees) for example in report.examples if trees}
    write_bytes(out / "evaluation.html", page_of(report, pictures).encode())
    tally = Tally(input=len(samples), kept=len(pairs), dropped={"not_asked": num_left} if num_left else {})
    files = [path, *(out / name for name in (SCORES, "evaluation.md", "evaluation.html"))]
    stage.finish(files, tally, split=splits[0], model=report.model)
    return path


def _pictures_of(sample: Sample, trees: Mapping[str, Path]) -> list[str]:
    """Return the frames of a sample's window that can be read as small JPEGs in base64."""
    found = (thumbnail(inside(trees[sample.run], frame), THUMBNAIL_PX) for frame in sample.frames)
    return [picture for picture in found if picture is not None]


def _evaluate(
    cfg: EvaluateConfig,
    pairs: Sequence[tuple[Sample, Prediction]],
    dataset: Path,
    models: Mapping[Language, Path],
    judged: JudgedValues,
    seed: int,
) -> tuple[Evaluation, Scores]:
    given: Any = {"resamples": cfg.resamples, "confidence": CONFIDENCE, "seed": seed}
    parts: list[dict[str, Scores]] = []
    measurements: dict[Language, Measurement] = {}
    metrics: dict[Language, Metric | None] = {}
    asked: list[tuple[Sample, Prediction]] = []
    for language in sorted({sample.language for sample, _ in pairs}):
        own = [pair for pair in pairs if pair[0].language == language]
        floors = Floors(open_split(dataset, "train"), language, seed)
        scorer = None
        if language in models:
            references = [text_of(coc_of(sample)) for sample, _ in own]
            scorer = Scorer(cfg.bertscore, language, models[language], references)
        scores = score_language(own, floors, scorer.score if scorer else None, judged)
        metrics[language] = scorer.metric if scorer else None
        measurements[language] = measure(scores, [prediction for _, prediction in own], **given)
        parts.append(scores)
        asked += own
    scores = join(parts)
    predictions = [prediction for _, prediction in asked]
    return Evaluation(
        model=", ".join(sorted({prediction.model or "unknown" for prediction in predictions})),
        split=predictions[0].split,
        **given,
        not_asked=0,
        metrics=metrics,
        judged=bool(judged),
        speed={},
        languages=measurements,
        all=measure(scores, predictions, **given) if len(parts) > 1 else next(iter(measurements.values())),
        examples=list(examples_of(asked, scores[STUDENT], NUM_EXAMPLES, seed)),
        notes=NOTES,
    ), scores[STUDENT]
