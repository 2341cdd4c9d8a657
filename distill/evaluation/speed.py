"""How fast a student answered: from what stands beside its predictions (the step's manifest, the journals of an engine's answers)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from cosfly.chat.answers import Answer, read_line
from cosfly.products.predictions import Prediction
from cosfly.reading.documents import read_object, validation_errors
from cosfly.work.journal import Journal
from cosfly.work.provenance import MANIFEST_SCHEMA
from cosfly.work.stage_folder import read_manifest


class Speed(BaseModel):
    """seconds: of the last start of `distill infer`, without loading; samples_per_s: answers made in it, a second, None where it made none or
    nothing says. latency_s: of an answer, as who asked saw it: mean, median, 95th percentile."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    seconds: float | None = None
    samples_per_s: float | None = None
    mean_tokens: float | None = None
    latency_s: dict[str, float] | None = None


class _LastStart(BaseModel):
    """Of the manifest of `distill infer`: what it says of its last start."""

    seconds: float | None = None
    answers: int = 0


def speed_of(predictions_path: Path, predictions: Sequence[Prediction]) -> Speed:
    """Measure what can be measured beside `predictions.jsonl`.

    Raises:
        InputError: a record that stands there cannot be read.
    """
    folder = predictions_path.parent
    seconds, num_new = _last_start(folder)
    tokens = [prediction.num_tokens for prediction in predictions if prediction.num_tokens]
    latencies = np.array([answer.latency_s for answer in _answers(folder / "answers")])
    return Speed(
        seconds=seconds,
        samples_per_s=num_new / seconds if seconds and num_new else None,
        mean_tokens=float(np.mean(tokens)) if tokens else None,
        latency_s=None if not len(latencies) else {
            "mean": float(latencies.mean()), "median": float(np.median(latencies)),
            "p95": float(np.quantile(latencies, 0.95)),
        },
    )  # fmt: skip


def _last_start(folder: Path) -> tuple[float | None, int]:
    """Give the seconds of the last start of `distill infer`, and how many answers it made."""
    path = folder / "manifest.json"
    if not path.is_file() or read_object(path, what="manifest").get("schema") != MANIFEST_SCHEMA:
        return None, 0
    with validation_errors(path):
        found = _LastStart.model_validate(read_manifest(folder).facts.get("speed", {}))
    return found.seconds, found.answers


def _answers(folder: Path) -> list[Answer]:
    lines = (line for path in sorted(folder.glob("*.jsonl")) for line in Journal(path).read_as(read_line))
    return [line for line in lines if isinstance(line, Answer)]
