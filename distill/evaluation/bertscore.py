"""BERTScore on local model folders, one for each language: the library scores, its traps are avoided here.

Source: Zhang et al. 2020, doi:10.48550/arXiv.1904.09675; settings of sec:appendix_f_caption_distillation.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
from pydantic import Field

from cosfly.formats.captions import Language
from cosfly.runtime.config import Config
from cosfly.runtime.console import progress_bar
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import sha256_file
from cosfly.runtime.json_io import Record, read_json, read_object
from distill.student.model import pick_device, quiet_transformers, require

log = logging.getLogger(__name__)

BATCH_SIZE = 64  # texts embedded together
FOREIGN_TOKENS = 1.5  # tokens a character of Chinese: bert-base-chinese has 1, a byte-level English vocabulary 2 to 3


class LanguageMetric(Config):
    """BERTScore of one language; the model's folder is an argument of the command."""

    layer: int = Field(17, ge=1, description="layer of the embeddings")


class BertScoreConfig(Config):
    """Settings of BERTScore within `distill evaluate`."""

    en: LanguageMetric = Field(LanguageMetric(), description="English: layer 17 of roberta-large, as in the paper")
    zh: LanguageMetric = Field(LanguageMetric(layer=8), description="Chinese: layer 8 of bert-base-chinese")


class Metric(Record):
    """What a score was measured with: two scores can be compared where all of it is equal.

    sha256: of the folder's files that decide. cut: references longer than max_tokens, of which the rest was not read.
    """

    model: str
    layer: int
    max_tokens: int
    cut: int
    sha256: dict[str, str]
    versions: dict[str, str]


def deciding_files(folder: Path) -> list[Path]:
    """Return the files of a model's folder that decide its scores: configuration, tokenizer, weights."""
    kinds = ("*.json", "*.txt", "*.safetensors", "*.bin", "*.model")
    return sorted({path for kind in kinds for path in folder.glob(kind) if path.is_file()})


class Scorer:
    """BERTScore of one language."""

    def __init__(self, cfg: BertScoreConfig, language: Language, folder: Path, references: Sequence[str]) -> None:
        """Load the model.

        Args:
            references: the texts whose lengths and languages are checked.
        """
        require("torch", "transformers", "bert_score")
        quiet_transformers()
        own: LanguageMetric = getattr(cfg, language)
        check_encoder(own, folder, language)
        import bert_score

        try:
            self._library = bert_score.BERTScorer(
                model_type=str(folder), num_layers=own.layer, batch_size=BATCH_SIZE, nthreads=1,
                device=pick_device("auto"), rescale_with_baseline=False,
            )  # fmt: skip
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError("the BERTScore model cannot be loaded", where=folder, got=str(error)[:300]) from error
        # Without this limit in the tokenizer's files the library overflows; two places go to the sentence marks.
        positions = read_object(folder / "config.json", what="BERTScore model").get("max_position_embeddings", 514)
        tokenizer = self._library._tokenizer
        limit = min(int(min(tokenizer.model_max_length, 10**9)), positions - 2)
        tokenizer.model_max_length = limit
        lengths = [len(tokenizer(text, truncation=False)["input_ids"]) for text in references]
        _warn_of_foreign(language, references, sum(lengths), folder)
        self.metric = Metric(
            model=folder.name,
            layer=own.layer,
            max_tokens=limit,
            cut=sum(length > limit for length in lengths),
            sha256={path.name: sha256_file(path) for path in deciding_files(folder)},
            versions={name: version(name) for name in ("bert-score", "transformers", "torch")},
        )

    def score(self, pairs: Sequence[tuple[str, str]]) -> np.ndarray:
        """Score candidates against references, (n, 3) precision, recall, F1; an empty text scores 0 and is not read.

        Of the texts of one call the library embeds each once.
        """
        scores = np.zeros((len(pairs), 3))
        asked = [number for number, pair in enumerate(pairs) if all(text.strip() for text in pair)]
        if asked:
            candidates, references = zip(*(pairs[number] for number in asked), strict=True)
            found = self._library.score(list(candidates), list(references), batch_size=self._library.batch_size)
            scores[asked] = np.stack([part.numpy() for part in found], axis=1)
        return scores


def score_beside_floors(
    scorer: Callable[[Sequence[tuple[str, str]]], np.ndarray],
    groups: Sequence[np.ndarray],
    candidates: Mapping[str, Sequence[str]],
    references: Sequence[str],
    label: str,
) -> dict[str, np.ndarray]:
    """Score several who answer on the same references: name -> (n, 3).

    Args:
        groups: places that are scored together; what is embedded of them is let go before the next.
    """
    found = {name: np.zeros((len(references), 3)) for name in candidates}
    with progress_bar(f"BERTScore, {label}", total=len(references)) as advance:
        for group in groups:
            pairs = [(texts[place], references[place]) for texts in candidates.values() for place in group]
            scores = scorer(pairs)
            for number, name in enumerate(found):
                found[name][group] = scores[number * len(group) : (number + 1) * len(group)]
            advance(len(group))
    return found


def _warn_of_foreign(language: Language, references: Sequence[str], num_tokens: int, folder: Path) -> None:
    num_characters = sum(map(len, references))
    if language == "zh" and num_tokens > FOREIGN_TOKENS * num_characters:
        share = num_tokens / num_characters
        log.warning(
            "%s: %.1f tokens per Chinese character (bert-base-chinese: 1), so the scores mean little", folder, share
        )


def check_encoder(own: LanguageMetric, folder: Path, language: Language) -> None:
    """Check that a folder holds an encoder that fits the settings.

    Raises:
        InputError, ConfigError: it does not.
    """
    config = read_json(folder / "config.json", what="BERTScore model (a folder with config.json)")
    layers = config.get("num_hidden_layers") if isinstance(config, dict) else None
    where = f"bertscore.{language}"
    if not isinstance(layers, int):
        expected = "the field num_hidden_layers"
        raise InputError("the model is not a text encoder", where=folder / "config.json", expected=expected)
    if own.layer > layers:
        raise ConfigError(
            "the model does not have this layer", where=f"{where}.layer", got=own.layer, expected=f"at most {layers}"
        )
    if "t5" in str(folder) or str(folder).startswith("scibert"):  # bert-score reads the model's family off its path
        words = "bert-score would mistake this path for that of another kind of model"
        fix = "rename the folder, so that its path has no 't5' and does not begin with 'scibert'"
        raise InputError(words, where=folder, fix=fix)
