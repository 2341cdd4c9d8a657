"""Measure a student: parse rate, decision accuracy beside the majority floors, BERTScore beside a shuffled floor.

The reference is the teacher's accepted answer, as in the paper; accuracy against the geometric label stands beside it. A sample
whose answer does not parse, or could not be made, counts as wrong and scores 0.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
from pydantic import Field

from cosfly.chance import rng_for
from cosfly.config import Config
from cosfly.errors import InputError
from cosfly.products.captions import ACTIONS, FIELDS, Coc, Language
from cosfly.products.predictions import Prediction, read_predictions
from cosfly.reading.documents import parse_document, validation_errors
from cosfly.stage_folder import Resume, StageFolder, Tally
from cosfly.store import write_bytes, write_json
from distill.evaluation.bertscore import (
    BertScoreConfig,
    Scorer,
    bert_scorer,
    check_encoder,
    means_of,
    others_of,
    score_texts,
)
from distill.schema import Sample, open_split
from distill.student.model import require

STAGE = "distill.evaluate"
UNPARSED = "(unparsed)"  # column of the confusion table beside the decisions
NOT_COMPUTED = "not computed: no model folder"


class EvaluateConfig(Config):
    """Settings of `distill evaluate`."""

    confidence: float = Field(0.95, gt=0, lt=1, description="level of the Wilson intervals")
    bertscore: BertScoreConfig = Field(BertScoreConfig(), description="semantic similarity of the texts")


# --- counting ---------------------------------------------------------------------------------------------------------


def wilson_interval(num_right: int, num_all: int, confidence: float = 0.95) -> tuple[float, float] | None:
    """Give the Wilson score interval of a share, None for no samples.

    Source: Wilson 1927, doi:10.1080/01621459.1927.10502953.
    """
    if num_all == 0:
        return None
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    share, spread = num_right / num_all, z * z / num_all
    center = (share + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(share * (1 - share) / num_all + spread / (4 * num_all))
    return max(0.0, center - half), min(1.0, center + half)


def share_of(num_right: int, num_all: int, confidence: float) -> dict[str, Any]:
    """Give a share with its counts and interval; the share of nothing is None."""
    interval = wilson_interval(num_right, num_all, confidence)
    return {
        "right": num_right,
        "of": num_all,
        "share": num_right / num_all if num_all else None,
        "interval": [round(bound, 6) for bound in interval] if interval else None,
    }


def majority(decisions: Sequence[str]) -> str | None:
    """Give the most frequent decision; a tie goes to the first in the order of the action table."""
    counts = Counter(decisions)
    return max(ACTIONS, key=lambda action: counts[action]) if counts else None


@dataclass(frozen=True)
class Pair:
    """A sample of the split with its prediction."""

    sample: Sample
    prediction: Prediction

    @property
    def coc(self) -> Coc | None:
        return self.prediction.coc

    @property
    def decision(self) -> str:
        """The predicted decision, or UNPARSED."""
        return self.coc.flight_decision if self.coc else UNPARSED


def pair_up(samples: Sequence[Sample], predictions: Sequence[Prediction]) -> list[Pair]:
    """Give each sample that was asked its prediction, in the order of the samples.

    Raises:
        InputError: a prediction is for a sample that the split does not have.
    """
    by_key = {prediction.key: prediction for prediction in predictions}
    unknown = by_key.keys() - {sample.key for sample in samples}
    if unknown:
        raise InputError(
            "a prediction is for a sample that the split does not have",
            where=min(unknown),
            got=f"{len(unknown)} such predictions",
            fix="give the training set that the predictions were made from",
        )
    return [Pair(sample, by_key[sample.key]) for sample in samples if sample.key in by_key]


def measure(pairs: Sequence[Pair], train_decisions: Sequence[str], confidence: float = 0.95) -> dict[str, Any]:
    """Give parse rate, accuracies, floors, per-decision accuracy and confusion of a set of pairs.

    Args:
        train_decisions: the decisions of the training split, for the floor that a constant answer reaches.
    """
    decisions = [pair.sample.decision for pair in pairs]
    num_parsed = sum(pair.coc is not None for pair in pairs)
    num_clean = sum(pair.coc is not None and not pair.prediction.recovered for pair in pairs)
    labelled = [pair for pair in pairs if pair.sample.label is not None]
    reasons = Counter(pair.prediction.reason or "unknown" for pair in pairs if pair.coc is None)
    confusion: dict[str, Counter[str]] = {}
    for pair in pairs:
        confusion.setdefault(pair.sample.decision, Counter())[pair.decision] += 1

    def floor(decision: str | None) -> dict[str, Any]:
        return {"decision": decision, **share_of(decisions.count(decision or ""), len(pairs), confidence)}

    return {
        "samples": len(pairs),
        "parsed": share_of(num_parsed, len(pairs), confidence),
        "parsed_without_mending": share_of(num_clean, len(pairs), confidence),
        "unparsed_reasons": dict(sorted(reasons.items())),
        "accuracy": share_of(sum(p.decision == p.sample.decision for p in pairs), len(pairs), confidence),
        "accuracy_on_labels": share_of(sum(p.decision == p.sample.label for p in labelled), len(labelled), confidence),
        "floor_train_majority": floor(majority(train_decisions)),
        "floor_split_majority": floor(majority(decisions)),
        "by_decision": {
            action: share_of(confusion[action][action], confusion[action].total(), confidence)
            for action in ACTIONS
            if action in confusion
        },
        "confusion": {action: dict(sorted(confusion[action].items())) for action in ACTIONS if action in confusion},
    }


# --- semantic similarity ------------------------------------------------------------------------------------------------


def text_of(coc: Coc) -> str:
    """Join the three fields into the text that BERTScore compares (sec:appendix_f_caption_distillation)."""
    return " ".join(getattr(coc, name) for name in FIELDS).strip()


def reference_of(sample: Sample) -> str:
    """Give the text that a sample's prediction is compared with.

    Raises:
        InputError: the sample's answer is none.
    """
    with validation_errors(sample.key):
        return text_of(Coc.model_validate(parse_document(sample.answer, sample.key, what="answer")))


def semantic_scores(pairs: Sequence[Pair], scorer: Scorer, rng: np.random.Generator) -> dict[str, Any]:
    """Score predictions against references, and against the references of other samples (the shuffled floor)."""
    references = [reference_of(pair.sample) for pair in pairs]
    candidates = [text_of(pair.coc) if pair.coc else "" for pair in pairs]
    scores = score_texts(scorer, candidates, references)
    parsed = np.array([pair.coc is not None for pair in pairs], dtype=bool)
    return {
        **means_of(scores),
        "samples": len(pairs),
        "scored_zero": int((~parsed).sum()),
        "parsed_only": means_of(scores[parsed]) if parsed.any() else None,
        "shuffled_floor": means_of(score_texts(scorer, candidates, others_of(references, rng)))
        if len(pairs) > 1
        else None,
    }


# --- report -----------------------------------------------------------------------------------------------------------


def evaluate(
    cfg: EvaluateConfig,
    pairs: Sequence[Pair],
    train_decisions: Mapping[Language, Sequence[str]],
    split: str,
    scorer: Scorer | None = None,
    *,
    seed: int = 0,
) -> dict[str, Any]:
    """Give the report of a set of pairs, per language and over all.

    Args:
        train_decisions: language -> decisions of the training split.
        scorer: None: BERTScore is not computed, and the report says so.
    """
    report: dict[str, Any] = {
        "schema": "cosfly.distill_report",
        "schema_version": "1.0",
        "split": split,
        "confidence": cfg.confidence,
        "notes": [
            "reference: the teacher's accepted answer; answers that do not parse count as wrong and score 0 in BERTScore",
            "intervals take samples as independent; windows of one flight overlap and languages share windows, "
            "so they are narrower than the truth",
        ],
        "languages": {},
    }
    for language in sorted({pair.sample.language for pair in pairs}):
        chosen = [pair for pair in pairs if pair.sample.language == language]
        measured = measure(chosen, train_decisions.get(language, ()), cfg.confidence)
        if scorer is None:
            measured["bertscore"] = NOT_COMPUTED
        elif language not in cfg.bertscore.languages:
            measured["bertscore"] = "not computed: not in bertscore.languages"
        else:
            measured["bertscore"] = semantic_scores(chosen, scorer, rng_for(seed, STAGE, language))
        report["languages"][language] = measured
    everything = [decision for decisions in train_decisions.values() for decision in decisions]
    report["all"] = measure(pairs, everything, cfg.confidence)
    return report


def _percent(share: Mapping[str, Any]) -> str:
    if share["share"] is None:
        return "none"
    low, high = share["interval"]
    return f"{share['share']:.2%} ({share['right']}/{share['of']}; {low:.1%} to {high:.1%})"


def markdown_of(report: Mapping[str, Any]) -> str:
    """Give the report as a short Markdown page."""
    languages = {**report["languages"], "all": report["all"]} if len(report["languages"]) > 1 else report["languages"]
    rows: dict[str, list[str]] = {}
    for measured in languages.values():
        train, own = measured["floor_train_majority"], measured["floor_split_majority"]
        cells = {
            "samples": str(measured["samples"]),
            "answers that parse": _percent(measured["parsed"]),
            "answers that parse without mending": _percent(measured["parsed_without_mending"]),
            "decision accuracy": _percent(measured["accuracy"]),
            "floor: majority of train": f"{_percent(train)}, always {train['decision']}",
            f"floor: majority of {report['split']}": f"{_percent(own)}, always {own['decision']}",
            "accuracy against geometric labels": _percent(measured["accuracy_on_labels"]),
            **_semantic_cells(measured.get("bertscore", "per language only")),
        }
        for name, cell in cells.items():
            rows.setdefault(name, []).append(cell)
    lines = [
        f"# Evaluation on {report['split']}",
        "",
        f"| | {' | '.join(languages)} |",
        "|---" * (len(languages) + 1) + "|",
    ]
    lines += [f"| {name} | {' | '.join(cells)} |" for name, cells in rows.items()]
    lines += ["", f"- intervals: Wilson, {report['confidence']:.0%}", *(f"- {note}" for note in report["notes"])]
    lines += ["", "| decision | accuracy | most frequent answers |", "|---|---|---|"]
    for action, share in report["all"]["by_decision"].items():
        answers = Counter(report["all"]["confusion"][action]).most_common(3)
        lines.append(f"| {action} | {_percent(share)} | {', '.join(f'{name} {count}' for name, count in answers)} |")
    return "\n".join(lines) + "\n"


def _semantic_cells(scores: Any) -> dict[str, str]:
    names = ("precision", "recall", "f1")
    if isinstance(scores, str):
        return {"BERTScore precision / recall / F1": scores, "floor: shuffled references, F1": scores}
    floor = scores["shuffled_floor"]
    return {
        "BERTScore precision / recall / F1": " / ".join(f"{scores[name]:.4f}" for name in names),
        "floor: shuffled references, F1": f"{floor['f1']:.4f}" if floor else "none: one sample",
    }


def run(
    cfg: EvaluateConfig,
    predictions: Path,
    dataset: Path,
    out: Path,
    *,
    bertscore_model: Path | None = None,
    seed: int = 0,
    resume: Resume = "if-same",
) -> Path:
    """Read `predictions.jsonl` and the training set it was made from; write `report.json` and `evaluation.md`.

    Args:
        bertscore_model: local folder of the encoder; None: the report says that BERTScore was not computed.
    Returns:
        The path of `report.json`.
    Raises:
        InputError: an input is missing, or predictions and training set do not belong together.
    """
    inputs = {"predictions": predictions, "dataset": dataset}
    if bertscore_model is not None:
        require("torch", "transformers", "bert_score")
        check_encoder(cfg.bertscore, bertscore_model)
        weights = sorted([*bertscore_model.glob("*.safetensors"), *bertscore_model.glob("*.bin")])
        inputs |= {f"bertscore/{path.name}": path for path in (bertscore_model / "config.json", *weights)}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs, seed=seed, resume=resume)
    path = out / "report.json"
    if stage.is_complete:
        return path
    found = read_predictions(predictions)
    splits = sorted({prediction.split for prediction in found})
    if len(splits) != 1:
        raise InputError("predictions of one split are needed", where=predictions, got=", ".join(splits) or "none")
    samples = list(open_split(dataset, splits[0]))
    pairs = pair_up(samples, found)
    train_decisions: dict[Language, list[str]] = {}
    for sample in open_split(dataset, "train"):
        train_decisions.setdefault(sample.language, []).append(sample.decision)
    scorer, facts = None, None
    if bertscore_model is not None:
        scored = [pair for pair in pairs if pair.sample.language in cfg.bertscore.languages]
        scorer, facts = bert_scorer(cfg.bertscore, bertscore_model, [reference_of(pair.sample) for pair in scored])
    report = evaluate(cfg, pairs, train_decisions, splits[0], scorer, seed=seed)
    report["bertscore"] = facts or NOT_COMPUTED
    report["not_asked"] = len(samples) - len(pairs)
    write_json(path, report)
    write_bytes(out / "evaluation.md", markdown_of(report).encode())
    num_left = len(samples) - len(pairs)
    tally = Tally(input=len(samples), kept=len(pairs), dropped={"not_asked": num_left} if num_left else {})
    stage.finish([path, out / "evaluation.md"], tally, split=splits[0])
    return path
