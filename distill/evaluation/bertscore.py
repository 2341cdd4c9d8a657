"""BERTScore with a local encoder for each language, computed by the library `bert_score`.

Source: Zhang et al. 2020, doi:10.48550/arXiv.1904.09675; settings of sec:appendix_f_caption_distillation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import Record
from distill.student.model import pick_device, quiet_transformers, require

BATCH_SIZE = 64  # texts embedded together
GROUP = 1024  # pairs of texts whose embeddings are in memory at the same time
UNLIMITED = 10**6  # a tokenizer without a limit of its own has a larger number


class Metric(Record):
    """What a score was measured with; `stage.json` has the digests. cut: References longer than max_tokens."""

    model: str
    layer: int
    max_tokens: int
    cut: int
    versions: dict[str, str]


def encoder_files(folder: Path) -> list[Path]:
    """Return the files that decide an encoder's scores: configuration, tokenizer, weights."""
    if not (folder / "config.json").is_file():
        expected = "a folder with config.json, tokenizer and weights"
        raise InputError("the folder is not an encoder of transformers", where=folder, expected=expected)
    kinds = ("*.json", "*.txt", "*.safetensors", "*.bin", "*.model")
    return sorted({path for kind in kinds for path in folder.glob(kind) if path.is_file()})


class Scorer:
    """BERTScore with one encoder."""

    def __init__(self, folder: Path, references: Sequence[str]) -> None:
        """Load the encoder.

        The layer is that of the library for the folder's name (17 for `roberta-large`, 8 for `bert-base-chinese`). For
        a name that the library does not know, or an encoder with fewer layers, it is the last one.

        Args:
            references: texts that are counted if they are too long.
        """
        require("torch", "transformers", "bert_score")
        quiet_transformers()
        import bert_score
        import torch
        import transformers

        if "t5" in str(folder) or str(folder).startswith("scibert"):
            what = "bert-score takes every path with 't5' for a T5 model, and every 'scibert' for a download"
            raise InputError(what, where=folder, fix="rename the folder")
        encoder_files(folder)
        try:
            config = transformers.AutoConfig.from_pretrained(folder)
            layers = config.num_hidden_layers
            layer = min(bert_score.utils.model2layers.get(folder.name, layers), layers)
            self._library = bert_score.BERTScorer(
                model_type=str(folder), num_layers=layer, batch_size=BATCH_SIZE, nthreads=1, device=pick_device("auto")
            )
        except (OSError, ValueError, RuntimeError, AttributeError) as error:
            raise InputError("the encoder cannot be loaded", where=folder, got=str(error)[:300]) from error
        tokenizer = self._library._tokenizer
        if tokenizer.model_max_length > UNLIMITED:  # the library would overflow the positions; RoBERTa reserves two
            tokenizer.model_max_length = config.max_position_embeddings - 2
        limit = tokenizer.model_max_length
        self.metric = Metric(
            model="/".join(folder.absolute().parts[-2:]),
            layer=layer,
            max_tokens=limit,
            cut=sum(len(tokenizer(text, truncation=False)["input_ids"]) > limit for text in references),
            versions={"bert-score": version("bert-score"), "torch": torch.__version__}
            | {"transformers": transformers.__version__},
        )

    def score(self, candidates: Mapping[str, Sequence[str]], references: Sequence[str]) -> dict[str, np.ndarray]:
        """Score several authors' texts on the same references.

        Returns:
            author -> (n, 3) precision, recall and F1; 0 for an empty text.
        """
        scores = {name: np.zeros((len(references), 3)) for name in candidates}
        pairs = [(k, name) for k, text in enumerate(references) for name in candidates if text and candidates[name][k]]
        with progress_bar(f"BERTScore, {self.metric.model}", total=len(pairs)) as advance:
            for first in range(0, len(pairs), GROUP):
                part = pairs[first : first + GROUP]
                texts = [candidates[name][k] for k, name in part]
                found = self._library.score(texts, [references[k] for k, _ in part], batch_size=BATCH_SIZE)
                for (k, name), row in zip(part, np.stack([values.numpy() for values in found], axis=1), strict=True):
                    scores[name][k] = row
                advance(len(part))
        return scores
