"""Let a student answer the samples of a split: greedy, left-padded batches, resumable by batch."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from cosfly.config import Config
from cosfly.errors import InputError
from cosfly.products.captions import Coc, Language, parse_answer
from cosfly.runner import Item, Outcome, Work, run_items
from cosfly.stage_folder import Failed, Resume, StageFolder, Tally
from cosfly.store import dump_json, model_lines, write_bytes
from distill.checkpoint import read_adapter_facts
from distill.dataset import Sample, read_split, split_path
from distill.encoding import encode, prompt_batch
from distill.student import Device, Student, load_student, require, weight_files

log = logging.getLogger(__name__)

STAGE = "distill.infer"
PREDICTIONS = "predictions.jsonl"
DEFAULT_MAX_PIXELS = 640 * 352


class InferConfig(Config):
    """Settings of `distill infer`."""

    split: Literal["train", "val", "test"] = Field("test", description="samples to answer")
    max_samples: int = Field(0, ge=0, description="answer only the first so many; 0: all")
    max_new_tokens: int = Field(512, ge=1, description="longest answer, tokens; a longer one is cut and will not parse")
    batch_size: int = Field(8, ge=1, description="samples answered together; part of the result where rounding matters")
    max_pixels: int = Field(
        0, ge=0, description=f"pixels of one image; 0: as in training ({DEFAULT_MAX_PIXELS} if none)"
    )
    device: Device = Field("auto", description="auto, cpu or cuda; bfloat16 on cuda, float32 on a CPU")


class Prediction(BaseModel):
    """One line of `predictions.jsonl`. `coc` is None when the answer is not of the right structure, for the `reason`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_version: Literal["1.0"] = "1.0"
    sample_id: str
    language: Language
    split: Literal["train", "val", "test"]
    raw: str
    num_tokens: int
    is_finished: bool  # False: cut at max_new_tokens
    coc: Coc | None
    reason: str | None
    recovered: list[str]

    @property
    def key(self) -> str:
        return f"{self.sample_id}/{self.language}"


def generate(student: Student, samples: list[Sample], data: Path, max_new_tokens: int) -> list[tuple[str, int, bool]]:
    """Answer a batch greedily.

    Returns:
        For each sample: text, number of tokens (the end token not counted), whether it ended by itself.
    """
    import torch

    inputs = prompt_batch(student, [encode(student, sample, data) for sample in samples])
    student.model.eval()
    with torch.inference_mode():
        output = student.model.generate(
            **inputs,
            max_new_tokens=max_new_tokens,
            do_sample=False,
            num_beams=1,
            temperature=None,  # a model folder's own sampling settings would otherwise warn or act
            top_p=None,
            top_k=None,
            repetition_penalty=1.0,
            eos_token_id=student.end_token_id,
            pad_token_id=student.pad_token_id,
        )
    answers = []
    for row in output[:, inputs["input_ids"].shape[1] :].tolist():
        is_finished = student.end_token_id in row
        ids = row[: row.index(student.end_token_id)] if is_finished else row
        answers.append((student.tokenizer.decode(ids, skip_special_tokens=False), len(ids), is_finished))
    return answers


def make_prediction(sample: Sample, split: str, text: str, num_tokens: int, is_finished: bool) -> Prediction:
    """Check an answer and give its record."""
    parsed = parse_answer(text, sample.language)
    return Prediction(
        sample_id=sample.sample_id,
        language=sample.language,
        split=split,  # type: ignore[arg-type]  # checked by the model
        raw=text,
        num_tokens=num_tokens,
        is_finished=is_finished,
        coc=parsed.coc,
        reason=parsed.reason,
        recovered=list(parsed.recovered),
    )


def failed_prediction(sample: Sample, split: str, code: str) -> Prediction:
    """Give the record of a sample that could not be answered: an empty answer, which evaluation counts as wrong."""
    return make_prediction(sample, split, "", 0, False).model_copy(update={"reason": f"failed_{code}"})


def _batch_factory(cfg: InferConfig, data: Path, model: Path, adapter: Path | None, max_pixels: int) -> Work:
    student = load_student(model, device=cfg.device, max_pixels=max_pixels, adapter=adapter)

    def work(item: Item) -> Outcome:
        samples: list[Sample] = item.payload
        answers = generate(student, samples, data, cfg.max_new_tokens)
        records = [make_prediction(s, cfg.split, *answer) for s, answer in zip(samples, answers, strict=True)]
        return Outcome({"predictions": [record.model_dump(mode="json") for record in records]})

    return work


def run(
    cfg: InferConfig,
    dataset: Path,
    data: Path,
    model: Path,
    out: Path,
    *,
    adapter: Path | None = None,
    resume: Resume = "if-same",
) -> Path:
    """Read a split, the playback tree `data`, the model folder and (if given) its adapter; write `predictions.jsonl`.

    Returns:
        The path of `predictions.jsonl`: one line per sample, in the order of the split.
    Raises:
        InputError: an input is missing or does not fit.
        EnvironmentMissing: torch, transformers or peft is missing.
    """
    require("torch", "transformers", "peft")
    inputs = {"dataset": dataset, "data": data, **weight_files(model)}
    facts: dict[str, Any] = {}
    if adapter is not None:
        facts = read_adapter_facts(adapter, model)
        inputs |= {f"adapter/{path.name}": path for path in sorted(adapter.iterdir()) if path.is_file()}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs, seed=0, resume=resume)
    path = out / PREDICTIONS
    if stage.is_complete:
        return path
    samples = list(read_split(dataset, cfg.split))[: cfg.max_samples or None]
    if not samples:
        raise InputError("the split is empty", where=split_path(dataset, cfg.split), fix="choose another split")
    # Whole batches are the unit of resumption: rounding may depend on what else is in a batch.
    batches = [samples[start : start + cfg.batch_size] for start in range(0, len(samples), cfg.batch_size)]
    items = [Item(f"batch_{number:06d}", batch) for number, batch in enumerate(batches)]
    max_pixels = cfg.max_pixels or int(facts.get("max_pixels", DEFAULT_MAX_PIXELS))
    finished = run_items(stage, items, _batch_factory, (cfg, data, model, adapter, max_pixels), label=STAGE)
    tally = Tally(input=len(samples))
    records = []
    for record, batch in zip(finished.records, batches, strict=True):
        if isinstance(record, Failed):
            tally.fail(record.code, len(batch))
            records += [failed_prediction(s, cfg.split, record.code).model_dump(mode="json") for s in batch]
        else:
            tally.kept += len(batch)
            records += record.result["predictions"]
    if not tally.kept:
        raise stage.nothing_kept(tally)
    write_bytes(path, "".join(dump_json(record) + "\n" for record in records).encode())
    num_parsed = sum(record["coc"] is not None for record in records)
    stage.finish([path], tally, split=cfg.split, parsed=num_parsed, has_adapter=adapter is not None)
    return path


def read_predictions(path: Path) -> list[Prediction]:
    """Read `predictions.jsonl`.

    Raises:
        InputError: names the file, the line and the field, or a prediction that stands there twice.
    """
    predictions: dict[str, Prediction] = {}
    lines = model_lines(path, Prediction, what="predictions", fix="run cosfly distill infer first")
    for number, (_, prediction) in enumerate(lines, 1):
        if prediction.key in predictions:
            raise InputError("a sample is answered twice", where=f"{path}:{number}", got=prediction.key)
        predictions[prediction.key] = prediction
    return list(predictions.values())
