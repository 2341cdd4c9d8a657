"""Let a student answer the samples of a split: in this process, or through an engine as teachers are asked."""

import asyncio
import contextlib
import logging
import time
from collections import Counter
from collections.abc import AsyncGenerator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

from pydantic import Field

from cosfly.formats.places import flight_of
from cosfly.formats.predictions import FAILED, PREDICTIONS, Prediction, Split
from cosfly.llm.answer_text import answer_schema, parse_answer
from cosfly.llm.answers import Answer, AnswerBook, KeptAnswers, answer_key
from cosfly.llm.client import ChatClient
from cosfly.llm.contract import STOP_AFTER_FAILURES, Engine, NoAnswer, Request, started
from cosfly.llm.student_chat import (
    CHAT_FORMAT_FILE,
    StudentEndpointConfig,
    picture_to_send,
    read_chat_format,
    student_request,
)
from cosfly.llm.vllm_engine import VllmConfig, VllmEngine
from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.console import Advance, progress_bar
from cosfly.runtime.errors import ConfigError, InputError, TeacherError
from cosfly.runtime.io import inside, sha256_bytes, write_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.model_json import CONTEXT_FULL
from cosfly.runtime.run_dir import Failed, Resume, StageFolder, Tally, read_manifest, read_stage_record, write_failures
from distill.schema import Sample, decision_place, open_split, resolve_trees, tree_inputs
from distill.student.chat import EncodedSample, prompt_batch
from distill.student.features import PictureReader, Tensors, pictures_of, read_features, with_encoded_pictures
from distill.student.model import Device, Student, load_student, require, student_path, weight_files
from distill.student.saving import check_adapter

log = logging.getLogger(__name__)

STAGE = "distill.infer"
ANSWERS = "answers"  # the folder of journals
# Samples taken at once, times those in flight: few are waited for at the end, when the rest has an answer.
WAITING = 16


class InferConfig(Config):
    """Settings of `distill infer`."""

    split: Split = Field("test", description="split whose samples are answered")
    max_samples: int = Field(0, ge=0, description="answer only this number of first samples; 0: all")
    max_new_tokens: int = Field(
        512, ge=1, description="longest answer, tokens; a longer answer is cut and does not parse"
    )
    engine: Literal["transformers", "endpoint", "vllm"] = Field(
        "transformers", description="transformers or vLLM in this process, or a server (endpoint) at the URL in --model"
    )
    constrained: bool = Field(
        False, description="endpoint and vllm: enforce the JSON schema of answers; the parse rate then says nothing"
    )
    batch_size: int = Field(
        8, ge=1, description="samples that transformers answers together; rounding may depend on it"
    )
    max_pixels: int = Field(0, ge=0, description="most pixels of a picture; 0: as in training, if that is known")
    allow_code: bool = Field(False, description="run code from the student's repository; only if you trust it")
    device: Device = Field("auto", description="auto, cpu or cuda for transformers; bfloat16 on cuda, float32 on a CPU")
    endpoint: StudentEndpointConfig = Field(
        StudentEndpointConfig(),
        description="requests of endpoint and vllm; max_new_tokens and constrained take precedence",
    )
    vllm: MayDiffer[VllmConfig] = Field(VllmConfig(), description="settings of the engine vllm")

    @property
    def sampling(self) -> StudentEndpointConfig:
        """How engines are asked."""
        return self.endpoint.model_copy(update={"max_tokens": self.max_new_tokens, "json_schema": self.constrained})


# --- outcomes ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SampleOutcome:
    """A sample with its answer, or with the reason why there is none. is_new: not recorded by an earlier run."""

    sample: Sample
    found: Answer | Failed
    is_new: bool = False

    @classmethod
    def failed(cls, sample: Sample, code: str, error: object) -> Self:
        """Return the outcome of a sample that got no answer."""
        return cls(sample, Failed(id=sample.key, code=code, message=str(error)))

    def prediction(self, split: Split, model: str) -> Prediction:
        """Return the record of the sample."""
        if isinstance(self.found, Failed):
            record = make_prediction(self.sample, split, failure=self.found.code)
        else:
            is_finished = self.found.finish_reason not in ("length", CONTEXT_FULL)
            num_tokens = self.found.usage.get("completion_tokens", 0)
            record = make_prediction(self.sample, split, self.found.text, num_tokens, is_finished)
        return record.model_copy(update={"model": model})


def make_prediction(
    sample: Sample, split: Split, text: str = "", num_tokens: int = 0, is_finished: bool = False, *, failure: str = ""
) -> Prediction:
    """Parse an answer and return its record; without an answer, its reason counts as no wrong answer.

    Args:
        failure: code of the reason why there is no answer.
    """
    parsed = parse_answer(text, sample.language, finish_reason=None if is_finished else "length")
    own = sample.model_dump(include={"sample_id", "language", "run", "window_id"})
    answer = {"raw": text, "num_tokens": num_tokens, "is_finished": is_finished}
    reason = f"{FAILED}{failure}" if failure else parsed.reason
    return Prediction(**own, **answer, split=split, coc=parsed.coc, reason=reason, recovered=list(parsed.recovered))


# --- students in this process, and engines ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Inputs:
    """What a run reads. model: a folder, or the URL of a server."""

    samples: Sequence[Sample]
    trees: Mapping[str, Path]
    model: str | Path
    adapter: Path | None

    @property
    def taught_pixels(self) -> int:
        """Most pixels of a picture in training; 0: not known, as of a server or a base."""
        folder = self.adapter or Path(self.model)
        return read_chat_format(folder).max_pixels if (folder / CHAT_FORMAT_FILE).is_file() else 0

    @property
    def name(self) -> str:
        """The model's name where it runs in this process: `model` of `train` and `merge` has that of its folder."""
        folder = Path(self.model).absolute()
        name = folder.parent.name if folder.name == "model" else folder.name
        return name if self.adapter is None else f"{name}+{self.adapter.absolute().parent.name}"


class Completion(NamedTuple):
    """An answer. num_tokens: without its end token. is_finished: it ended by itself."""

    text: str
    num_tokens: int
    is_finished: bool


def generate(
    student: Student, rows: Sequence[EncodedSample], pictures: Sequence[Tensors], *, max_tokens: int, stop: str = ""
) -> list[Completion]:
    """Answer a batch of prompts greedily; the answers in `rows` are not used.

    Args:
        pictures: features of the pictures of all rows, row after row.
        max_tokens: longest answer, the end token included.
        stop: an answer ends before this text as well.

    Returns:
        One answer for each row, in their order.
    """
    import torch
    from transformers import GenerationConfig

    core, end, pad = student.core, student.end_token_id, student.pad_token_id
    inputs = {name: torch.from_numpy(array).to(student.device) for name, array in prompt_batch(student, rows).items()}
    num_prompt = inputs["input_ids"].shape[1]
    # Under autocast keys and values may be of different types, which a static cache does not hold.
    is_one_type = core.get_input_embeddings().weight.dtype == student.dtype
    config = GenerationConfig(
        do_sample=False,
        max_new_tokens=max_tokens,
        eos_token_id=end,
        pad_token_id=pad,
        stop_strings=stop or None,
        cache_implementation="static" if is_one_type else "dynamic",
        disable_compile=True,  # a compiled step holds for one batch size and length, and costs a minute
    )
    core.generation_config = config  # settings for sampling of the model folder would complete those of `config`
    student.model.eval()
    with torch.inference_mode(), student.computing(), with_encoded_pictures(student, pictures) as seen:
        found = core.generate(**inputs, **seen, tokenizer=student.tokenizer)
    completions = []
    for tokens in found[:, num_prompt:].tolist():
        written = tokens[: tokens.index(end)] if end in tokens else [token for token in tokens if token != pad]
        text = student.tokenizer.decode(written, skip_special_tokens=False).removeprefix(student.lead)
        text, stopped, _ = text.partition(stop) if stop else (text, "", "")
        completions.append(Completion(text, len(written), end in tokens or bool(stopped)))
    return completions


class LocalAnswers:
    """A student that answers samples in this process, in batches of consecutive samples.

    Which samples are in one batch follows from the samples and the settings alone, because rounding may depend on it: a
    run that was killed and resumed gives the same answers as one that was not.
    """

    def __init__(self, cfg: InferConfig, inputs: Inputs, book: AnswerBook, stop: str = "") -> None:
        """Load the student. stop: its answers end before this text."""
        if cfg.constrained:
            words, fix = "the engine `transformers` cannot enforce a schema", "pass --engine endpoint or --engine vllm"
            raise ConfigError(words, where=f"{STAGE}.constrained", got="true", expected="false", fix=fix)
        if inputs.adapter is not None:
            check_adapter(inputs.adapter, Path(inputs.model))
        given: Any = {"device": cfg.device, "adapter": inputs.adapter, "allow_code": cfg.allow_code}
        self.student = load_student(Path(inputs.model), **given)
        if not self.student.has_pictures and inputs.samples and inputs.samples[0].views:
            log.warning("%s: the student takes no pictures: it answers from the text state alone", STAGE)
        self.book, self.model, self.batch_size, self.max_tokens = book, inputs.name, cfg.batch_size, cfg.max_new_tokens
        self.max_pixels, self._stop = cfg.max_pixels or inputs.taught_pixels, stop
        self._reader = PictureReader(self.student, inputs.trees, self.max_pixels)

    async def answers(self, samples: Iterable[Sample], advance: Advance) -> AsyncGenerator[SampleOutcome, None]:
        """Yield the outcome of each sample, in their order; `advance` is called after each batch."""
        rest = iter(samples if self.student.has_pictures else (sample.without_pictures() for sample in samples))
        while batch := list(islice(rest, self.batch_size)):
            recorded = [self.book.get(flight_of(sample.sample_id), self._key(sample)) for sample in batch]
            outcomes = self._answer(batch) if None in recorded else []
            new = [one.found for one, old in zip(outcomes, recorded, strict=False) if old is None]
            answers = [answer for answer in new if isinstance(answer, Answer)]
            await asyncio.gather(*(self.book.put(flight_of(answer.sample_id), answer) for answer in answers))
            advance(len(batch))
            for i, (sample, answer) in enumerate(zip(batch, recorded, strict=True)):
                yield outcomes[i] if answer is None else SampleOutcome(sample, answer)

    def _key(self, sample: Sample) -> str:
        """Return a digest of what the answer depends on, besides the inputs in the folder's record."""
        asked = sample.model_dump(mode="json", include={"run", "window", "views", "picture_px", "prompt", "language"})
        return sha256_bytes(dump_json([self.model, sample.sample_id, asked, self.max_tokens, self._stop]).encode())

    def _answer(self, batch: list[Sample]) -> list[SampleOutcome]:
        """Answer a batch."""
        pictures = list(dict.fromkeys(picture for sample in batch for picture in pictures_of(sample)))
        features = read_features(self.student, pictures, map(self._reader.try_to_read, pictures))
        rows: dict[int, tuple[EncodedSample, list[Any]]] = {}
        outcomes: dict[int, SampleOutcome] = {}
        for i, sample in enumerate(batch):
            seen = [features[picture] for picture in pictures_of(sample)]
            try:
                if errors := [words for words in seen if isinstance(words, str)]:
                    raise InputError(errors[0])
                rows[i] = self.student.encode(sample, self.max_pixels), seen
            except InputError as error:
                outcomes[i] = SampleOutcome.failed(sample, error.code, error)
        start_s = time.monotonic()
        completions = self._decode([*rows.values()]) if rows else []
        latency_s = round(time.monotonic() - start_s, 3)
        for (i, (row, _)), completion in zip(rows.items(), completions, strict=True):
            answer = Answer(
                key=self._key(batch[i]), sample_id=batch[i].sample_id, purpose=batch[i].language, model=self.model,
                text=completion.text, structured="plain", latency_s=latency_s, time=round(time.time(), 3),
                usage={"prompt_tokens": len(row.prompt_ids), "completion_tokens": completion.num_tokens},
                finish_reason="stop" if completion.is_finished else "length",
            )  # fmt: skip
            outcomes[i] = SampleOutcome(batch[i], answer, is_new=True)
        return [outcomes[i] for i in range(len(batch))]

    def _decode(self, rows: Sequence[tuple[EncodedSample, list[Tensors]]]) -> list[Completion]:
        """Answer prompts; a batch that does not fit into the memory is halved."""
        import torch

        seen = [tensors for _, pictures in rows for tensors in pictures]
        try:
            inputs = [row for row, _ in rows]
            return generate(self.student, inputs, seen, max_tokens=self.max_tokens, stop=self._stop)
        except torch.OutOfMemoryError as error:
            if len(rows) == 1:
                where, fix = f"{STAGE}.max_pixels", "lower max_pixels or max_new_tokens, and choose another --out"
                raise ConfigError("a sample exceeds the memory", where=where, got=str(error)[:120], fix=fix) from error
        torch.cuda.empty_cache()  # here, because the exception holds what it refers to
        half = len(rows) // 2
        return self._decode(rows[:half]) + self._decode(rows[half:])


class EngineAnswers:
    """An engine that answers samples."""

    def __init__(self, engine: Engine, book: AnswerBook, inputs: Inputs, cfg: InferConfig) -> None:
        """Take an engine that was started."""
        self.engine, self.book, self.trees, self.sampling = engine, book, inputs.trees, cfg.sampling
        self.max_pixels = cfg.max_pixels or (inputs.taught_pixels if cfg.engine == "vllm" else 0)
        self._most = cfg.endpoint.concurrency if cfg.engine == "endpoint" else cfg.vllm.batch
        self._slots = asyncio.Semaphore(self._most)
        self._kept = KeptAnswers(engine, book)
        self._failed_in_row = 0

    async def answers(self, samples: Iterable[Sample], advance: Advance) -> AsyncGenerator[SampleOutcome, None]:
        """Yield the outcome of each sample, in their order; `advance` is called for each when it is there."""
        rest = iter(samples)
        while part := list(islice(rest, WAITING * self._most)):
            for outcome in await asyncio.gather(*(self._ask(sample, advance) for sample in part)):
                yield outcome

    def _request(self, sample: Sample) -> Request:
        """Return a sample as chat messages: its pictures as the student was taught to see them, then the question."""
        # A set without pictures needs no tree.
        folders = [inside(self.trees[sample.run], frame) for frame in sample.frames] if sample.views else []
        pictures = [sample.pictures.read(folder) for folder in folders]
        frames = [[picture_to_send(picture, self.max_pixels) for picture in views] for views in pictures]
        schema = answer_schema(language=sample.language, place=decision_place(sample.answer))
        return student_request(sample.prompt, frames, schema, self.sampling)

    async def _ask(self, sample: Sample, advance: Advance) -> SampleOutcome:
        flight = flight_of(sample.sample_id)
        async with self._slots:
            try:
                request = await asyncio.to_thread(self._request, sample)
                reply = await self._kept.ask(request, flight, sample.sample_id, sample.language)
            except InputError as error:
                return SampleOutcome.failed(sample, error.code, error)
            except NoAnswer as error:
                self._failed_in_row += not error.is_final  # otherwise the server answers, if only with a refusal
                if self._failed_in_row >= STOP_AFTER_FAILURES:
                    words = f"{self._failed_in_row} samples in a row got no answer"
                    fix = "fix the server, then run the same command again; answered samples are not asked again"
                    raise TeacherError(words, where=self.engine.where, got=str(error), fix=fix) from error
                return SampleOutcome.failed(sample, error.cause, error)
            finally:
                advance(1)
        self._failed_in_row = 0
        found = self.book.get(flight, answer_key(self.engine.model, request))
        assert found is not None, "the answer was recorded"
        return SampleOutcome(sample, found, is_new=not reply.is_kept)


def _with_model_name(cfg: InferConfig, url: str, out: Path) -> InferConfig:
    """Return the settings with the name of the model that a server serves: a folder has the answers of one student.

    The server of a complete folder may be gone: its record has the name.
    """

    async def ask() -> str:
        client = ChatClient(url, cfg.sampling)
        async with started(client):
            return client.model

    is_complete = (out / "manifest.json").is_file() and not read_manifest(out).counts.failed
    try:
        name = cfg.endpoint.model if is_complete and cfg.endpoint.model else asyncio.run(ask())
    except TeacherError:
        if not is_complete:
            raise
        name = read_stage_record(out).config.get("endpoint", {}).get("model")
    return cfg.model_copy(update={"endpoint": cfg.endpoint.model_copy(update={"model": name})})


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

    Every answer is recorded in a journal in `answers/` first, so nothing answered is asked twice.

    Args:
        model: a folder, the name of a repository, or with engine `endpoint` a URL.

    Returns:
        The path of `predictions.jsonl`: one line per sample, in the order of the split. A sample without an answer has
        a line with the reason, and the manifest counts it as failed; a later run tries it again.

    Raises:
        InputError: an input is missing or does not fit. EnvironmentMissing: a package is missing.
        ConfigError: the engine takes no adapter, or the memory is full.
        TeacherError: the engine does not answer. NothingKept: no sample was answered.
    """
    if cfg.engine == "transformers":
        require("torch", "transformers", "peft")
    trees = resolve_trees(dataset, data)
    files: dict[str, Path] = {"dataset": dataset, **tree_inputs(trees.values())}
    if adapter is not None and cfg.engine != "transformers":
        fix = "merge the adapter into its model with cosfly distill merge, or pass --engine transformers"
        words = "only the engine `transformers` can load an adapter"
        raise ConfigError(words, where=f"{STAGE}.engine", got=cfg.engine, fix=fix)
    if cfg.engine == "endpoint":
        cfg = _with_model_name(cfg, str(model), out)
    else:
        model = student_path(str(model), allow_code=cfg.allow_code)
        files |= weight_files(model)
    if adapter is not None:
        files |= check_adapter(adapter, Path(model))
    stage = StageFolder.open(out, STAGE, config=cfg, inputs=files, seed=0, resume=resume)
    if stage.is_complete:
        return out / PREDICTIONS
    samples = open_split(dataset, cfg.split)[: cfg.max_samples or None]
    if not samples:
        fix = "set distill.infer.split to another split, or prepare more pedestrian trajectories"
        raise InputError("the split is empty", where=dataset, got=f"the split `{cfg.split}`", fix=fix)
    given = Inputs(samples, trees, model, adapter)
    start_s = time.monotonic()
    name = str(cfg.endpoint.model) if cfg.engine == "endpoint" else given.name
    outcomes, new = asyncio.run(_answer_all(cfg, given, out))
    speed = {"seconds": round(time.monotonic() - start_s, 3), **new}
    predictions = [outcome.prediction(cfg.split, name) for outcome in outcomes]
    lines = (dump_json(prediction.model_dump(mode="json")) + "\n" for prediction in predictions)
    write_bytes(out / PREDICTIONS, "".join(lines).encode())
    failures = [outcome.found for outcome in outcomes if isinstance(outcome.found, Failed)]
    write_failures(out / "failures.jsonl", failures)
    failed = Counter(failure.code for failure in failures)
    tally = Tally(input=len(outcomes), kept=len(outcomes) - len(failures), failed=failed)
    num_parsed = sum(prediction.coc is not None for prediction in predictions)
    facts = {"split": cfg.split, "has_adapter": adapter is not None, "model": name, "parsed": num_parsed}
    outputs = [out / PREDICTIONS, *sorted((out / ANSWERS).glob("*.jsonl"))]
    stage.finish(outputs, tally, **facts, speed=speed)
    return out / PREDICTIONS


async def _answer_all(cfg: InferConfig, inputs: Inputs, out: Path) -> tuple[list[SampleOutcome], Counter[str]]:
    """Answer all samples; return their outcomes, and the numbers of answers and tokens of this run."""
    async with contextlib.AsyncExitStack() as stack:
        book = stack.enter_context(AnswerBook(out / ANSWERS))
        before = book.totals.copy()
        advance = stack.enter_context(progress_bar(STAGE, total=len(inputs.samples)))
        answering: LocalAnswers | EngineAnswers
        if cfg.engine == "transformers":
            answering = LocalAnswers(cfg, inputs, book)
        else:
            engine: Engine
            if cfg.engine == "endpoint":
                engine = ChatClient(str(inputs.model), cfg.sampling)
            else:
                most = max(len(sample.images) for sample in inputs.samples)
                engine = VllmEngine(Path(inputs.model), cfg.vllm, cfg.sampling, num_images=most, settings=STAGE)
            await stack.enter_async_context(started(engine))
            answering = EngineAnswers(engine, book, inputs, cfg)
        outcomes = [outcome async for outcome in answering.answers(inputs.samples, advance)]
        return outcomes, book.totals - before
