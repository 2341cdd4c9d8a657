"""A training set of small pictures, a tiny student, and settings under which it learns in seconds."""

import importlib
import importlib.util
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from specimens_distill import make_captions, prepared

from distill.schema import Sample, open_split, resolve_trees
from distill.student.chat import EncodedSample, prompt_batch
from distill.student.features import PictureReader, Tensors, encode, pictures_of
from distill.student.model import Student, load_student
from distill.student.random_student import make_random_student
from distill.training.loss import answer_loss
from specimens import make_playback_tree

if not all(map(importlib.util.find_spec, ("torch", "transformers", "peft"))):
    pytest.skip("needs the extra distill", allow_module_level=True)


class Later:
    """A library that is imported when a test first uses it: a worker without such a test does not load it."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self._module), name)


safetensors, torch = Later("safetensors.torch"), Later("torch")
qwen = Later("transformers.models.qwen3_5.modeling_qwen3_5")
MAX_PIXELS = 64 * 64
FAST = {
    "max_pixels": MAX_PIXELS, "lora_rank": 4, "learning_rate": 1e-2, "device": "cpu",
    "data_workers": 0,
}  # fmt: skip
TWELVE = {**FAST, "samples_per_step": 4, "batch_size": 2, "epochs": 6, "max_steps": 12, "save_every_steps": 5}


def make_place(root: Path, **settings: Any) -> Path:
    """Write tree/ of three walks, captions.jsonl, set/ as the settings of `distill prepare` say, and student/."""
    make_playback_tree(root / "tree", num_flights=3, num_points=7)
    make_captions(root / "captions.jsonl", root / "tree")
    prepared(root / "tree", root / "captions.jsonl", root / "set", **settings)
    make_random_student(root / "student")
    return root


def load(place: Path) -> Student:
    return load_student(place / "student", device="cpu")


def samples_of(place: Path, split: str = "train") -> list[Sample]:
    return list(open_split(place / "set", split))


def trees_of(place: Path) -> dict[str, Path]:
    return resolve_trees(place / "set", [place / "tree"])


def inputs_of(own: Student, samples: Sequence[Sample], trees: Mapping[str, Path]) -> dict[str, Any]:
    """All that a model is given of some samples, with their pictures, each looked at anew."""
    rows = [own.encode(sample, MAX_PIXELS) for sample in samples]
    tokens = {name: torch.from_numpy(array) for name, array in prompt_batch(own, rows).items()}
    return tokens | pixels_of(own, samples, trees)


def pixels_of(own: Student, samples: Sequence[Sample], trees: Mapping[str, Path]) -> dict[str, Any]:
    """The inputs of the pictures of some samples, as they are read."""
    reader = PictureReader(own, trees, MAX_PIXELS)
    read = [reader.read(picture) for sample in samples for picture in pictures_of(sample)]
    return {name: torch.cat([one[name] for one in read]) for name in (read[0] if read else ())}


def features_of(own: Student, samples: Sequence[Sample], trees: Mapping[str, Path]) -> list[Tensors]:
    """The features of the pictures of some samples, each encoded by itself."""
    reader = PictureReader(own, trees, MAX_PIXELS)
    with torch.no_grad():
        return [encode(own, [reader.read(picture)])[0] for sample in samples for picture in pictures_of(sample)]


def nats_of(own: Student, rows: Sequence[EncodedSample], features: Sequence[Tensors], chunk: int = 64) -> list[float]:
    """The loss of each row in a batch: all other rows weigh nothing."""
    found = []
    for number in range(len(rows)):
        weighed = [
            replace(row, weights=np.full(len(row.answer_ids), float(i == number), np.float32))
            for i, row in enumerate(rows)
        ]
        with torch.no_grad():
            found.append(float(answer_loss(own, weighed, features, chunk)))
    return found


def log_of(out: Path, kind: str = "loss") -> list[dict]:
    """The log of a training without what depends on the machine."""
    records = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return [{k: v for k, v in record.items() if k != "speed"} for record in records if kind in record]


def losses_of(out: Path) -> list[float]:
    return [record["loss"] for record in log_of(out)]


def run(
    place: Path, out: Path, student: str | Path | None = None, dataset: Path | None = None, **settings: Any
) -> Path:
    """Train in twelve steps, or as the settings say."""
    from distill.training import stage as train
    from distill.training.settings import TrainConfig

    cfg = TrainConfig.model_validate({**TWELVE, **settings})
    return train.run(cfg, dataset or place / "set", [place / "tree"], student or place / "student", out)


def begun(place: Path, out: Path, num_steps: int = 7, **settings: Any) -> None:
    from distill.training import fit

    steps, real = [], fit.train_step

    def stop(*args: Any) -> Any:
        if len(steps) == num_steps:
            raise KeyboardInterrupt
        steps.append(1)
        return real(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "train_step", stop)
        with pytest.raises(KeyboardInterrupt):
            run(place, out, **settings)
