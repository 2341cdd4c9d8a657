"""How fast a student answered: from what stands beside its predictions (the step's manifest, the journals of an engine's answers)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from cosfly.chat.answers import Answer, read_line
from cosfly.journal import Journal
from cosfly.products.predictions import Prediction
from cosfly.provenance import MANIFEST_SCHEMA
from cosfly.reading.documents import read_json
from cosfly.stage_folder import read_manifest


class Speed(BaseModel):
    """seconds: of the last start of `distill infer`, which a resumed one shares with earlier ones; samples_per_s from it, None where it was
    resumed or nothing says. latency_s: of an answer, as the engine's client saw it: mean, median, 95th percentile."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    seconds: float | None = None
    samples_per_s: float | None = None
    mean_tokens: float | None = None
    latency_s: dict[str, float] | None = None


def speed_of(predictions_path: Path, predictions: Sequence[Prediction]) -> Speed:
    """Measure what can be measured beside `predictions.jsonl`.

    Raises:
        InputError: a record that stands there cannot be read.
    """
    folder = predictions_path.parent
    seconds = _seconds(folder)
    tokens = [prediction.num_tokens for prediction in predictions if prediction.num_tokens]
    latencies = np.array([answer.latency_s for answer in _answers(folder / "answers")])
    return Speed(
        seconds=seconds,
        samples_per_s=len(predictions) / seconds if seconds else None,
        mean_tokens=float(np.mean(tokens)) if tokens else None,
        latency_s=None if not len(latencies) else {
            "mean": float(latencies.mean()), "median": float(np.median(latencies)),
            "p95": float(np.quantile(latencies, 0.95)),
        },
    )  # fmt: skip


def _seconds(folder: Path) -> float | None:
    path = folder / "manifest.json"
    if not path.is_file() or read_json(path, what="manifest").get("schema") != MANIFEST_SCHEMA:
        return None
    return read_manifest(folder).seconds


def _answers(folder: Path) -> list[Answer]:
    lines = (line for path in sorted(folder.glob("*.jsonl")) for line in Journal(path).read_as(read_line))
    return [line for line in lines if isinstance(line, Answer)]
