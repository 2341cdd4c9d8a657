"""BERTScore on a local model folder, with the library's traps walked round. Knows texts only, no samples.

Source: Zhang et al. 2020, doi:10.48550/arXiv.1904.09675; settings of sec:appendix_f_caption_distillation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from cosfly.config import Config
from cosfly.errors import ConfigError, InputError
from cosfly.products.captions import Language
from cosfly.reading.documents import read_json, read_object
from distill.student.model import Device, pick_device, quiet_transformers, require

Scorer = Callable[[Sequence[str], Sequence[str]], np.ndarray]  # candidates, references -> (n, 3) precision, recall, F1


class BertScoreConfig(Config):
    """Settings of BERTScore within `distill evaluate`; the model's folder is an argument of the command."""

    layer: int = Field(17, ge=1, description="layer of the embeddings; 17 for roberta-large, as in the paper")
    languages: tuple[Language, ...] = Field(
        ("en", "zh"), description="languages to score; leave out those that the model folder does not know"
    )
    idf: bool = Field(False, description="weigh tokens by their rarity in the references")
    baseline: Path | None = Field(
        None, description="baseline file (.tsv) of the scored model to rescale with; none: no rescaling"
    )
    batch_size: int = Field(64, ge=1, description="texts embedded together")
    device: Device = Field("auto", description="auto, cpu or cuda")


def score_texts(scorer: Scorer, candidates: Sequence[str], references: Sequence[str]) -> np.ndarray:
    """Give (n, 3) precision, recall and F1; an empty candidate or reference scores 0 without asking the scorer."""
    scores = np.zeros((len(candidates), 3))
    asked = [i for i, pair in enumerate(zip(candidates, references, strict=True)) if all(text.strip() for text in pair)]
    if asked:
        scores[asked] = scorer([candidates[i] for i in asked], [references[i] for i in asked])
    return scores


def means_of(scores: np.ndarray) -> dict[str, float]:
    """Give the means of (n, 3) scores by name."""
    return {name: float(scores[:, i].mean()) for i, name in enumerate(("precision", "recall", "f1"))}


def others_of(texts: Sequence[str], rng: np.random.Generator) -> list[str]:
    """Give each place another place's text: one random cycle through all places."""
    order = rng.permutation(len(texts))
    shuffled = [""] * len(texts)
    for here, there in zip(order, np.roll(order, 1), strict=True):
        shuffled[here] = texts[there]
    return shuffled


def bert_scorer(cfg: BertScoreConfig, folder: Path, references: Sequence[str]) -> tuple[Scorer, dict[str, Any]]:
    """Load BERTScore on a local model folder.

    Args:
        references: the texts that idf weights are counted on, if they are used.
    Returns:
        The scorer, and facts for the report: versions, settings, the longest text in tokens that the model reads.
    Raises:
        InputError: the folder does not hold a usable encoder. ConfigError: it has fewer layers than asked for.
    """
    require("torch", "transformers", "bert_score")
    quiet_transformers()
    check_encoder(cfg, folder)
    import bert_score

    try:
        scorer = bert_score.BERTScorer(
            model_type=str(folder),
            num_layers=cfg.layer,
            batch_size=cfg.batch_size,
            nthreads=1,
            idf=cfg.idf,
            device=pick_device(cfg.device),
            rescale_with_baseline=cfg.baseline is not None,
            baseline_path=str(cfg.baseline) if cfg.baseline else None,
            lang="en" if cfg.baseline else None,  # asked for by the library, unused with a baseline file
        )
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError("the BERTScore model does not load", where=folder, got=str(error)[:300]) from error
    # Without this limit in the tokenizer's files the library overflows; two places go to the sentence marks.
    positions = read_object(folder / "config.json", what="BERTScore model").get("max_position_embeddings", 514)
    limit = min(int(min(scorer._tokenizer.model_max_length, 10**9)), positions - 2)
    scorer._tokenizer.model_max_length = limit
    if cfg.idf:
        scorer.compute_idf(list(references))  # after the limit is set: it tokenizes

    def score(candidates: Sequence[str], texts: Sequence[str]) -> np.ndarray:
        return np.stack([part.numpy() for part in scorer.score(list(candidates), list(texts))], axis=1)

    num_cut = sum(len(scorer._tokenizer(text, truncation=False)["input_ids"]) > limit for text in references)
    facts = {
        "model": folder.name,
        "layer": cfg.layer,
        "idf": cfg.idf,
        "rescaled": cfg.baseline is not None,
        "max_tokens": limit,
        "references_cut_at_max_tokens": num_cut,
        "versions": {name: version(name) for name in ("bert-score", "transformers", "torch")},
    }
    return score, facts


def check_encoder(cfg: BertScoreConfig, folder: Path) -> None:
    """Check that a folder holds an encoder that fits the settings.

    Raises:
        InputError, ConfigError: it does not.
    """
    config = read_json(folder / "config.json", what="BERTScore model (a folder with config.json)")
    layers = config.get("num_hidden_layers") if isinstance(config, dict) else None
    if not isinstance(layers, int):
        raise InputError("not a text encoder", where=folder / "config.json", expected="num_hidden_layers")
    if cfg.layer > layers:
        raise ConfigError("the model has fewer layers", where="bertscore.layer", got=cfg.layer, expected=f"<= {layers}")
    if "t5" in str(folder) or str(folder).startswith("scibert"):  # bert-score reads the model's family off its path
        raise InputError(
            "bert-score would take this path for another kind of model",
            where=folder,
            fix="rename or link it without 't5' and not as scibert...",
        )
    if cfg.baseline is not None and not cfg.baseline.is_file():
        raise ConfigError(
            "no such baseline file",
            where="bertscore.baseline",
            got=str(cfg.baseline),
            expected="a .tsv of the scored model",
        )
