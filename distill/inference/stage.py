"""Let a student answer the samples of a split: here in left-padded batches, or through an engine as teachers are asked."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field

from cosfly.chat.answers import AnswerBook, KeptAnswers
from cosfly.chat.client import ChatClient
from cosfly.chat.contract import CONTEXT_FULL, Engine, NoAnswer, Request, started
from cosfly.chat.vllm_engine import VllmConfig, VllmEngine
from cosfly.config import Config, MayDiffer
from cosfly.errors import ConfigError, InputError, TeacherError
from cosfly.products.captions import answer_schema, parse_answer
from cosfly.products.playback import flight_of
from cosfly.products.predictions import FAILED, PREDICTIONS, Prediction, Split
from cosfly.runner import Item, Outcome, Work, run_items
from cosfly.stage_folder import Failed, Resume, StageFolder, Tally, result_of, write_failures
from cosfly.store import dump_json, write_bytes
from cosfly.student_chat import StudentEndpointConfig, picture_to_send, student_request
from distill.schema import Sample, open_split, resolve_trees, tree_inputs
from distill.student.checkpoint import read_adapter_facts
from distill.student.decoding import decode
from distill.student.encoding import encode, load_pictures, most_pixels
from distill.student.model import Device, load_student, require, weight_files

STAGE = "distill.infer"


class InferConfig(Config):
    """Settings of `distill infer`."""

    split: Split = Field("test", description="samples to answer")
    max_samples: int = Field(0, ge=0, description="answer only the first so many; 0: all")
    max_new_tokens: int = Field(512, ge=1, description="longest answer, tokens; a longer one is cut and will not parse")
    engine: Literal["transformers", "endpoint", "vllm"] = Field(
        "transformers",
        description="who computes: transformers in this process, a server at the URL --model, or vLLM in this process",
    )
    batch_size: int = Field(
        8, ge=1, description="samples that transformers answers together; part of the result where rounding matters"
    )
    max_pixels: int = Field(
        0, ge=0, description="most pixels kept of a picture; 0: as in training, and with an engine all"
    )
    device: Device = Field("auto", description="auto, cpu or cuda for transformers; bfloat16 on cuda, float32 on a CPU")
    endpoint: StudentEndpointConfig = Field(
        StudentEndpointConfig(), description="how the engines endpoint and vllm are asked"
    )
    vllm: MayDiffer[VllmConfig] = Field(VllmConfig(), description="the engine vllm")


# --- transformers -----------------------------------------------------------------------------------------------------


def make_prediction(sample: Sample, split: Split, text: str, num_tokens: int, is_finished: bool) -> Prediction:
    """Check an answer and give its record."""
    parsed = parse_answer(text, sample.language, finish_reason=None if is_finished else "length")
    return Prediction(
        sample_id=sample.sample_id,
        language=sample.language,
        split=split,
        raw=text,
        num_tokens=num_tokens,
        is_finished=is_finished,
        coc=parsed.coc,
        reason=parsed.reason,
        recovered=list(parsed.recovered),
    )


def failed_prediction(sample: Sample, split: Split, code: str) -> Prediction:
    """Give the record of a sample that could not be answered: an empty answer, which evaluation counts as wrong."""
    return make_prediction(sample, split, "", 0, False).model_copy(update={"reason": f"{FAILED}{code}"})


def make_worker(
    cfg: InferConfig, trees: Mapping[str, Path], model: Path, adapter: Path | None, max_pixels: int
) -> Work:
    student = load_student(model, device=cfg.device, max_pixels=max_pixels, adapter=adapter)

    def work(item: Item) -> Outcome:
        samples: list[Sample] = item.payload
        rows = [encode(student, sample, trees) for sample in samples]
        answers = decode(student, rows, max_tokens=cfg.max_new_tokens)
        records = [
            make_prediction(sample, cfg.split, answer.text, answer.num_tokens, answer.is_finished)
            for sample, answer in zip(samples, answers, strict=True)
        ]
        return Outcome({"predictions": [record.model_dump(mode="json") for record in records]})

    return work


class _Predicted(BaseModel):
    """What the journal holds of a batch."""

    predictions: list[Prediction]


def _infer(
    cfg: InferConfig,
    stage: StageFolder,
    samples: list[Sample],
    trees: Mapping[str, Path],
    model: Path,
    adapter: Path | None,
) -> tuple[list[Prediction], Tally]:
    trained = read_adapter_facts(adapter, model).max_pixels if adapter else most_pixels(samples)
    # Whole batches are the unit of resumption: rounding may depend on what else is in a batch.
    batches = [samples[start : start + cfg.batch_size] for start in range(0, len(samples), cfg.batch_size)]
    items = [Item(f"batch_{number:06d}", batch) for number, batch in enumerate(batches)]
    max_pixels = cfg.max_pixels or trained
    finished = run_items(stage, items, make_worker, (cfg, trees, model, adapter, max_pixels), label=STAGE)
    tally = Tally(input=len(samples))
    predictions: list[Prediction] = []
    for record, batch in zip(finished.records, batches, strict=True):
        if isinstance(record, Failed):
            tally.failed[record.code] += len(batch)
            predictions += [failed_prediction(sample, cfg.split, record.code) for sample in batch]
        else:
            tally.kept += len(batch)
            predictions += result_of(record, _Predicted).predictions
    return predictions, tally


# --- engines ----------------------------------------------------------------------------------------------------------


def make_request(sample: Sample, trees: Mapping[str, Path], cfg: InferConfig) -> Request:
    """Give a sample as chat messages: its pictures as the student was taught to see them, then the question.

    Raises:
        InputError: a picture of its playback tree cannot be read.
    """
    pictures = iter([picture_to_send(picture, cfg.max_pixels) for picture in load_pictures(sample, trees)])
    frames = [[next(pictures) for _ in sample.views] for _ in sample.frames]
    sampling = cfg.endpoint.model_copy(update={"max_tokens": cfg.max_new_tokens})
    return student_request(sample.prompt, frames, answer_schema(language=sample.language), sampling)


async def _ask(
    cfg: InferConfig, stage: StageFolder, engine: Engine, samples: list[Sample], trees: Mapping[str, Path]
) -> tuple[list[Prediction], Tally]:
    """Ask an engine about every sample; answers are kept in `answers/`, so nothing answered is asked twice.

    Raises:
        TeacherError: it cannot be used, or a sample got no answer.
    """
    in_flight = asyncio.Semaphore(cfg.vllm.batch if cfg.engine == "vllm" else cfg.endpoint.concurrency)
    tally, failures = Tally(input=len(samples)), list[Failed]()

    async def answer(sample: Sample) -> Prediction:
        async with in_flight:
            try:
                request = await asyncio.to_thread(make_request, sample, trees, cfg)
                reply = await kept.ask(request, flight_of(sample.sample_id), sample.sample_id, sample.language)
            except InputError as error:
                failed = Failed(id=sample.key, code=error.code, message=str(error))
            except NoAnswer as error:
                if not error.is_final:
                    fix = "see to the server, then run the same command again: nothing answered is asked twice"
                    raise TeacherError("a sample got no answer", where=engine.where, got=str(error), fix=fix) from None
                failed = Failed(id=sample.key, code=error.cause, message=str(error))
            else:
                tally.kept += 1
                num_tokens = reply.usage.completion_tokens if reply.usage else 0
                is_finished = reply.finish_reason not in ("length", CONTEXT_FULL)
                return make_prediction(sample, cfg.split, reply.text, num_tokens, is_finished)
            tally.failed[failed.code] += 1
            failures.append(failed)
            return failed_prediction(sample, cfg.split, failed.code)

    with AnswerBook(stage.path / "answers") as book:
        try:
            async with started(engine), asyncio.TaskGroup() as group:
                kept = KeptAnswers(engine, book)
                tasks = [group.create_task(answer(sample)) for sample in samples]
        except ExceptionGroup as found:  # the first one tells why
            raise found.exceptions[0] from None
    write_failures(stage.path / "failures.jsonl", failures)
    return [task.result() for task in tasks], tally


def _make_engine(cfg: InferConfig, model: str, samples: list[Sample]) -> Engine:
    if cfg.engine == "endpoint":
        return ChatClient(model, cfg.endpoint)
    num_images = max(len(sample.images) for sample in samples)
    return VllmEngine(Path(model), cfg.vllm, cfg.endpoint, num_images=num_images, settings="distill.infer")


# --- the step ---------------------------------------------------------------------------------------------------------


def run(
    cfg: InferConfig,
    dataset: Path,
    data: Sequence[Path],
    model: str | Path,
    out: Path,
    *,
    adapter: Path | None = None,
    resume: Resume = "if-same",
) -> Path:
    """Read a split, its playback trees `data`, the model and (if given) its adapter; write `predictions.jsonl`.

    Args:
        model: a folder, or with engine `endpoint` a URL.
    Returns:
        The path of `predictions.jsonl`: one line per sample, in the order of the split.
    Raises:
        InputError: an input is missing or does not fit. ConfigError: the engine takes no adapter.
        EnvironmentMissing: torch, transformers, peft or vllm is missing. TeacherError: the engine does not answer.
    """
    trees = resolve_trees(dataset, data)
    inputs = {"dataset": dataset, **tree_inputs(trees)}
    if cfg.engine == "transformers":
        require("torch", "transformers", "peft")
    elif adapter is not None:
        raise ConfigError(
            "an adapter is read by transformers alone",
            where="distill.infer.engine",
            got=cfg.engine,
            fix="merge it into the weights (peft's merge_and_unload), or --engine transformers",
        )
    if cfg.engine != "endpoint":
        inputs |= weight_files(Path(model))
    if adapter is not None:
        read_adapter_facts(adapter, Path(model))
        inputs |= {f"adapter/{path.name}": path for path in sorted(adapter.iterdir()) if path.is_file()}
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=inputs, seed=0, resume=resume)
    path = out / PREDICTIONS
    if stage.is_complete:
        return path
    samples = open_split(dataset, cfg.split)[: cfg.max_samples or None]
    if not samples:
        raise InputError("the split is empty", where=dataset, got=cfg.split, fix="choose another split")
    if cfg.engine == "transformers":
        predictions, tally = _infer(cfg, stage, samples, trees, Path(model), adapter)
        name = Path(model).name if adapter is None else f"{Path(model).name}+{adapter.absolute().parent.name}"
    else:
        engine = _make_engine(cfg, str(model), samples)
        predictions, tally = asyncio.run(_ask(cfg, stage, engine, samples, trees))
        name = engine.model
    predictions = [prediction.model_copy(update={"model": name}) for prediction in predictions]
    if not tally.kept:
        raise stage.nothing_kept(tally)
    write_bytes(path, "".join(dump_json(p.model_dump(mode="json")) + "\n" for p in predictions).encode())
    num_parsed = sum(prediction.coc is not None for prediction in predictions)
    stage.finish([path], tally, split=cfg.split, parsed=num_parsed, has_adapter=adapter is not None)
    return path
