"""The two ways in which a student answers samples: in this process by transformers, and through an engine.

Both record an answer in the journal before they yield its outcome, and take recorded answers from there.
"""

import asyncio
import logging
import time
from collections.abc import AsyncGenerator, Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from cosfly.formats.places import flight_of
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.answers import Answer, AnswerBook, KeptAnswers, answer_key
from cosfly.llm.contract import STOP_AFTER_FAILURES, Engine, NoAnswer, Request
from cosfly.llm.student_chat import picture_to_send, student_request
from cosfly.runtime.console import Advance
from cosfly.runtime.errors import ConfigError, InputError, TeacherError
from cosfly.runtime.io import inside, sha256_bytes
from cosfly.runtime.json_io import dump_json
from distill.inference.samples import STAGE, InferConfig, Inputs, SampleOutcome
from distill.schema import Sample, decision_place
from distill.student.chat import EncodedSample, prompt_batch
from distill.student.features import PictureReader, Tensors, pictures_of, read_features, with_encoded_pictures
from distill.student.model import Student, load_student
from distill.student.saving import check_adapter

log = logging.getLogger(__name__)

# Samples taken at once, times those in flight: few are waited for at the end, when the rest has an answer.
WAITING = 16


class Completion(NamedTuple):
    """An answer."""

    text: str
    num_tokens: int  # without its end token
    is_finished: bool  # it ended by itself


def generate(
    student: Student, rows: Sequence[EncodedSample], features: Sequence[Tensors], *,
    max_tokens: int, stop: str = "", advance: Advance = lambda *_: None,
) -> list[Completion]:  # fmt: skip
    """Answer a batch of prompts greedily, in their order; the answers in `rows` are not used.

    Args:
        features: of the pictures of all rows, row after row.
        max_tokens: longest answer, the end token included.
        stop: an answer ends before this text as well.
        advance: gets words about each step.
    """
    import torch
    from transformers import GenerationConfig

    core, end, pad = student.core, student.end_token_id, student.pad_token_id
    inputs = {name: torch.from_numpy(array).to(student.device) for name, array in prompt_batch(student, rows).items()}
    num_prompt = inputs["input_ids"].shape[1]
    # Under autocast keys and values may be of different types, which a static cache does not hold.
    is_one_type = core.get_input_embeddings().weight.dtype == student.dtype
    config = GenerationConfig(
        do_sample=False, max_new_tokens=max_tokens, eos_token_id=end, pad_token_id=pad, stop_strings=stop or None,
        cache_implementation="static" if is_one_type else "dynamic",
        disable_compile=True,  # a compiled step holds for one batch size and length, and costs a minute
    )  # fmt: skip

    def show(tokens: torch.Tensor, *_: object, **__: object) -> bool:
        advance(0, f"the next {len(rows)} answers have {tokens.shape[1] - num_prompt} of at most {max_tokens} tokens")
        return False  # does not end the answers

    core.generation_config = config  # settings for sampling of the model folder would complete those of `config`
    student.model.eval()
    with torch.inference_mode(), student.computing(), with_encoded_pictures(student, features) as picture_inputs:
        sequences = core.generate(**inputs, **picture_inputs, tokenizer=student.tokenizer, stopping_criteria=[show])
    completions = []
    for tokens in sequences[:, num_prompt:].tolist():
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
        self.student = load_student(
            Path(inputs.model), device=cfg.device, adapter=inputs.adapter, allow_code=cfg.allow_code
        )
        if not self.student.has_pictures and inputs.samples and inputs.samples[0].views:
            log.warning("%s: the student takes no pictures: it answers from the text state alone", STAGE)
        self.book = book
        self.model = inputs.name
        self.batch_size = cfg.batch_size
        self.max_tokens = cfg.max_new_tokens
        self.max_pixels = cfg.max_pixels or inputs.training_pixels
        self._stop = stop
        self._reader = PictureReader(self.student, inputs.trees, self.max_pixels)

    async def answers(self, samples: Iterable[Sample], advance: Advance) -> AsyncGenerator[SampleOutcome, None]:
        """Yield the outcome of each sample, in their order; `advance` is called after each token and batch."""
        if not self.student.has_pictures:
            samples = (sample.without_pictures() for sample in samples)
        self._advance, rest = advance, iter(samples)
        while batch := list(islice(rest, self.batch_size)):
            recorded = [self.book.get(flight_of(sample.sample_id), self._key(sample)) for sample in batch]
            # Without one of the answers the whole batch is answered again: rounding may depend on what is in it.
            answered = self._answer(batch) if None in recorded else []
            outcomes = [
                answered[i] if answer is None else SampleOutcome(batch[i], answer) for i, answer in enumerate(recorded)
            ]
            new = [outcome.result for outcome in outcomes if outcome.is_new and isinstance(outcome.result, Answer)]
            await asyncio.gather(*(self.book.put(flight_of(answer.sample_id), answer) for answer in new))
            advance(len(batch))
            for outcome in outcomes:
                yield outcome

    def _key(self, sample: Sample) -> str:
        """Return a digest of what the answer depends on, besides the inputs in the folder's record."""
        asked = sample.model_dump(mode="json", include={"run", "window", "views", "picture_px", "prompt", "language"})
        return sha256_bytes(dump_json([self.model, sample.sample_id, asked, self.max_tokens, self._stop]).encode())

    def _answer(self, batch: list[Sample]) -> list[SampleOutcome]:
        """Answer a batch. A sample with a picture that cannot be read, or that cannot be encoded, fails."""
        pictures = list(dict.fromkeys(picture for sample in batch for picture in pictures_of(sample)))
        by_picture = read_features(self.student, pictures, map(self._reader.try_to_read, pictures))
        rows: dict[int, EncodedSample] = {}  # by the sample's place in the batch, as the following ones
        features: dict[int, list[Tensors]] = {}
        outcomes: dict[int, SampleOutcome] = {}
        for i, sample in enumerate(batch):
            results = [by_picture[picture] for picture in pictures_of(sample)]
            try:
                if errors := [message for message in results if isinstance(message, str)]:
                    raise InputError(errors[0])
                rows[i] = self.student.encode(sample, self.max_pixels)
                features[i] = [tensors for tensors in results if not isinstance(tensors, str)]
            except InputError as error:
                outcomes[i] = SampleOutcome.failed(sample, error.code, error)
        start_s = time.monotonic()
        completions = self._decode([*rows.values()], [*features.values()]) if rows else []
        latency_s = round(time.monotonic() - start_s, 3)
        for (i, row), completion in zip(rows.items(), completions, strict=True):
            answer = Answer(
                key=self._key(batch[i]), sample_id=batch[i].sample_id, purpose=batch[i].language, model=self.model,
                text=completion.text, structured="plain", latency_s=latency_s, time=round(time.time(), 3),
                usage={"prompt_tokens": len(row.prompt_ids), "completion_tokens": completion.num_tokens},
                finish_reason="stop" if completion.is_finished else "length",
            )  # fmt: skip
            outcomes[i] = SampleOutcome(batch[i], answer, is_new=True)
        return [outcomes[i] for i in range(len(batch))]

    def _decode(self, rows: Sequence[EncodedSample], features: Sequence[list[Tensors]]) -> list[Completion]:
        """Answer prompts with the features of their pictures; a batch that does not fit into the memory is halved."""
        import torch

        all_features = [tensors for of_row in features for tensors in of_row]
        try:
            return generate(
                self.student, rows, all_features, max_tokens=self.max_tokens, stop=self._stop, advance=self._advance
            )
        except torch.OutOfMemoryError as error:
            if len(rows) == 1:
                where, fix = f"{STAGE}.max_pixels", "lower max_pixels or max_new_tokens, and choose another --out"
                raise ConfigError("a sample exceeds the memory", where=where, got=str(error)[:120], fix=fix) from error
        torch.cuda.empty_cache()  # not in the handler, because the exception holds references to tensors
        half = len(rows) // 2
        return self._decode(rows[:half], features[:half]) + self._decode(rows[half:], features[half:])


class EngineAnswers:
    """An engine that answers samples."""

    def __init__(self, engine: Engine, book: AnswerBook, inputs: Inputs, cfg: InferConfig) -> None:
        """Take an engine that was started."""
        self.engine = engine
        self.book = book
        self.trees = inputs.trees
        self.sampling = cfg.sampling
        self.max_pixels = cfg.max_pixels or (inputs.training_pixels if cfg.engine == "vllm" else 0)
        self._most_in_flight = cfg.endpoint.concurrency if cfg.engine == "endpoint" else cfg.vllm.batch
        self._slots = asyncio.Semaphore(self._most_in_flight)
        self._kept = KeptAnswers(engine, book)
        self._failed_in_row = 0

    async def answers(self, samples: Iterable[Sample], advance: Advance) -> AsyncGenerator[SampleOutcome, None]:
        """Yield the outcome of each sample, in their order; `advance` is called for each when it is there."""
        rest = iter(samples)
        while part := list(islice(rest, WAITING * self._most_in_flight)):
            for outcome in await asyncio.gather(*(self._ask(sample, advance) for sample in part)):
                yield outcome

    def _request(self, sample: Sample) -> Request:
        """Return a sample as chat messages: its pictures as in the student's training, then the question."""
        frames = []
        for frame in sample.frames if sample.views else ():  # a set without pictures needs no tree
            views = sample.pictures.read(inside(self.trees[sample.run], frame))
            frames.append([picture_to_send(picture, self.max_pixels) for picture in views])
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
                if not error.is_final:  # a final one is an answer of the server, a refusal
                    self._failed_in_row += 1
                if self._failed_in_row >= STOP_AFTER_FAILURES:
                    words = f"{self._failed_in_row} samples in a row got no answer"
                    fix = "fix the server, then run the same command again; answered samples are not asked again"
                    raise TeacherError(words, where=self.engine.where, got=str(error), fix=fix) from error
                return SampleOutcome.failed(sample, error.cause, error)
            finally:
                advance(1)
        self._failed_in_row = 0
        answer = self.book.get(flight, answer_key(self.engine.model, request))
        assert answer is not None, "the answer was recorded"
        return SampleOutcome(sample, answer, is_new=not reply.is_kept)
