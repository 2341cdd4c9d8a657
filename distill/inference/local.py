"""Samples answered in this process: prompts of like length together, each picture looked at once, answers journaled.

Samples are taken a shelf at a time, in their order; within a shelf they are sorted by length and cut into batches.
Which samples are in one batch follows from the samples and the settings alone, since rounding may depend on it: a run
that was killed answers like one that was not.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.formats.captions import Language, Place
from cosfly.formats.places import flight_of
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.answers import Answer, AnswerBook
from cosfly.runtime.console import Advance
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from distill.inference.outcome import OpenFlights, SampleOutcome, failed
from distill.schema import Sample
from distill.student.chat import EncodedSample
from distill.student.features import FramePicture, PictureData, PictureReader, VisionFeatures, pictures_of
from distill.student.generate import Completion, Constraint, generate
from distill.student.model import Student, require

log = logging.getLogger(__name__)

SHELF_BATCHES = 16
READING_THREADS = 4

Constrain = Callable[[Sequence[Language]], Constraint]


class _Shelf:
    """Samples that are sorted together: what became of them, their rows, and what was seen of their pictures."""

    def __init__(self, samples: list[Sample], features: VisionFeatures) -> None:
        self.samples, self.features = samples, features
        self.found: dict[str, SampleOutcome] = {}  # by key of the sample
        self.rows: dict[str, EncodedSample] = {}
        self.damaged: dict[FramePicture, InputError] = {}
        self.plan = features.plan()
        self._num_told = 0

    def tell(self, advance: Advance) -> None:
        """Tell of the samples that something became of since the last time."""
        advance(len(self.found) - self._num_told)
        self._num_told = len(self.found)


class LocalAnswers:
    """One run of a student over samples. Use as a context manager, for its threads."""

    def __init__(
        self,
        student: Student,
        book: AnswerBook,
        trees: Mapping[str, Path],
        *,
        model: str,
        batch_size: int,
        max_tokens: int,
        max_pixels: int,
        constrain: Constrain | None,
        feature_bytes: int,
    ) -> None:
        """
        Args:
            model: its name, for the journal. max_tokens: of an answer. max_pixels: of a picture; 0: no limit.
            constrain: makes a batch's constraint. feature_bytes: most memory for features of the pictures of a shelf.
        """
        self.student, self.book, self.model = student, book, model
        self.batch_size, self.max_tokens, self.constrain = batch_size, max_tokens, constrain
        self.most_rows = batch_size  # fewer once the memory was full
        self._feature_bytes, self._max_pixels = feature_bytes, max_pixels
        self._flights = OpenFlights(book)
        self._reader = PictureReader(student.processor, trees, student.dtype, max_pixels)
        self._threads = ThreadPoolExecutor(READING_THREADS, "pictures")

    def __enter__(self) -> LocalAnswers:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown(wait=True, cancel_futures=True)

    async def answers(self, samples: Iterable[Sample], advance: Advance) -> AsyncGenerator[SampleOutcome, None]:
        """Yield the outcome of each sample, in their order; `advance` is called after each batch."""
        rest = iter(samples if self.student.has_pictures else (sample.without_pictures() for sample in samples))
        kept: Any = {"memory_bytes": self._feature_bytes, "max_pixels": self._max_pixels}
        while chosen := list(islice(rest, SHELF_BATCHES * self.batch_size)):
            shelf = _Shelf(chosen, VisionFeatures(self.student, **kept))
            self._take_kept(shelf)
            shelf.tell(advance)
            if len(shelf.found) < len(shelf.samples):
                await self._answer(shelf, advance)
            for sample in shelf.samples:
                yield shelf.found[sample.key]
                self._flights.done(sample)

    def _take_kept(self, shelf: _Shelf) -> None:
        for sample in shelf.samples:
            known = self.book.get(self._flights.begun(sample), self._key(sample))
            if known is not None:
                shelf.found[sample.key] = SampleOutcome(sample, known)

    def _key(self, sample: Sample) -> str:
        """Name what the answer depends on beside what the folder's records hold: weights, pictures and settings."""
        asked = sample.model_dump(mode="json", include={"run", "window", "views", "picture_px", "prompt", "language"})
        key = [self.model, sample.sample_id, asked, self.max_tokens, self.constrain is not None]
        return sha256_bytes(dump_json(key).encode())

    async def _answer(self, shelf: _Shelf, advance: Advance) -> None:
        """Answer what is not answered. Pictures of all are looked at: which are together may tell in the last bit."""
        batches = self._batches(shelf)
        loading = [self._load(shelf, batch) for batch in batches[:1]]
        for number, batch in enumerate(batches):
            begun_s = time.monotonic()
            self._look(shelf, loading.pop())
            loading += [self._load(shelf, following) for following in batches[number + 1 : number + 2]]  # meanwhile
            whole = [sample for sample in batch if not self._fails(shelf, sample)]
            if any(sample.key not in shelf.found for sample in whole):
                await self._keep(shelf, whole, self._decode(shelf, whole), begun_s)
            shelf.features.end_step()
            shelf.tell(advance)

    def _batches(self, shelf: _Shelf) -> list[list[Sample]]:
        """Cut a shelf into batches of like length; a sample whose prompt cannot be written has failed."""
        for sample in shelf.samples:
            try:
                shelf.rows[sample.key] = self.student.encode(sample, self._max_pixels)
            except InputError as error:
                shelf.found[sample.key] = failed(sample, error.code, error)
        rows = sorted(
            shelf.rows.values(), key=lambda row: (-len(row.prompt_ids), row.key)
        )  # the largest shows what fits
        by_key = {sample.key: sample for sample in shelf.samples}
        ordered = [by_key[row.key] for row in rows]
        return [ordered[start : start + self.batch_size] for start in range(0, len(ordered), self.batch_size)]

    def _load(self, shelf: _Shelf, batch: Sequence[Sample]) -> dict[FramePicture, Future[PictureData]]:
        """Have pictures read that are not known."""
        pictures = [picture for sample in batch for picture in pictures_of(sample) if picture not in shelf.damaged]
        wanted = shelf.features.wanted(shelf.plan, pictures)
        return {picture: self._threads.submit(self._reader.read, picture) for picture in wanted}

    def _look(self, shelf: _Shelf, loading: Mapping[FramePicture, Future[PictureData]]) -> None:
        """Have the vision tower look at what was read."""
        loaded: list[PictureData] = []
        for picture, future in loading.items():
            try:
                loaded.append(future.result())
            except InputError as error:
                shelf.damaged[picture] = error
        shelf.features.take(loaded)

    def _fails(self, shelf: _Shelf, sample: Sample) -> bool:
        """Return whether a picture of a sample cannot be read; it has then failed, and no other with it."""
        error = next((shelf.damaged[picture] for picture in pictures_of(sample) if picture in shelf.damaged), None)
        if error is not None:
            shelf.found[sample.key] = failed(sample, error.code, error)
        return error is not None

    def _decode(self, shelf: _Shelf, samples: Sequence[Sample]) -> list[Completion]:
        """Answer samples together, in halves where the memory does not hold them all."""
        import torch

        answers: list[Completion] = []
        while len(answers) < len(samples):
            chosen = samples[len(answers) : len(answers) + self.most_rows]
            try:
                answers += self._decode_together(shelf, chosen)
                continue
            except torch.OutOfMemoryError as error:
                said = str(error)[:120]
            self._halve(len(chosen), said)  # after the error is let go, and with it what it holds
        return answers

    def _halve(self, num_rows: int, said: str) -> None:
        import torch

        if num_rows == 1:
            fix = "lower max_new_tokens or max_pixels, or use a server (--engine endpoint)"
            words, where = "one sample does not fit into the memory of the accelerator", "distill.infer.max_new_tokens"
            raise ConfigError(words, where=where, got=said, fix=fix)
        self.most_rows = num_rows // 2
        log.warning(
            "distill.infer: %d samples do not fit into memory; the batch size is now %d", num_rows, self.most_rows
        )
        if torch.cuda.is_available():
            torch.cuda.empty_cache()

    def _decode_together(self, shelf: _Shelf, samples: Sequence[Sample]) -> list[Completion]:
        constraint = self.constrain([sample.language for sample in samples]) if self.constrain else None
        features = shelf.features.of([picture for sample in samples for picture in pictures_of(sample)])
        rows = [shelf.rows[sample.key] for sample in samples]
        return generate(self.student, rows, features, max_tokens=self.max_tokens, constraint=constraint)

    async def _keep(self, shelf: _Shelf, samples: list[Sample], decoded: list[Completion], begun_s: float) -> None:
        """Journal new answers; they are on the disk when this returns."""
        latency_s = round(time.monotonic() - begun_s, 3)
        for sample, answer in zip(samples, decoded, strict=True):
            if sample.key not in shelf.found:
                new = self._answer_of(sample, shelf.rows[sample.key], answer, latency_s)
                shelf.found[sample.key] = SampleOutcome(sample, new, is_new=True)
        found = [shelf.found[sample.key] for sample in samples]
        new_ones = [each.found for each in found if each.is_new and isinstance(each.found, Answer)]
        await asyncio.gather(*(self.book.put(flight_of(answer.sample_id), answer) for answer in new_ones))

    def _answer_of(self, sample: Sample, row: EncodedSample, decoded: Completion, latency_s: float) -> Answer:
        return Answer(
            key=self._key(sample), sample_id=sample.sample_id, purpose=sample.language, model=self.model,
            text=decoded.text, usage={"prompt_tokens": len(row.prompt_ids), "completion_tokens": decoded.num_tokens},
            structured="json_schema" if self.constrain else "plain", latency_s=latency_s, time=round(time.time(), 3),
            finish_reason="stop" if decoded.is_finished else "length",
        )  # fmt: skip


class SchemaConstraint:
    """Holds the answers of a batch to the schema of their language; see `Constraint` in distill/student/generate.py."""

    def __init__(self, tokens: Any, grammars: Sequence[str]) -> None:
        """
        Args:
            tokens: llguidance's view of the tokenizer. grammars: of each row.
        """
        from llguidance import LLMatcher

        self._matchers = [LLMatcher(tokens, grammar) for grammar in grammars]

    def allowed(self, rows: Sequence[int], num_tokens: int) -> np.ndarray:
        bits = np.zeros((len(rows), -(-num_tokens // 8)), np.uint8)
        for place, row in enumerate(rows):
            mask = np.frombuffer(self._matchers[row].compute_bitmask(), np.uint8)[: bits.shape[1]]
            bits[place, : len(mask)] = mask
        return bits

    def consume(self, row: int, token: int) -> None:
        matcher = self._matchers[row]
        assert matcher.consume_token(token), matcher.get_error()


class AnswerSchemas:
    """Makes the constraints of batches; texts of a language share their grammar."""

    def __init__(self, student: Student, place: Place) -> None:
        """
        Args:
            place: of the decision among the fields.
        """
        require("llguidance")
        from llguidance import LLMatcher
        from llguidance.hf import from_tokenizer

        self._tokens = from_tokenizer(student.tokenizer, eos_token=student.end_token_id)
        languages: tuple[Language, ...] = ("en", "zh")
        # Free whitespace would let a student pad for ever.
        strict: Any = {"whitespace_flexible": False}
        schemas = {language: answer_schema(language=language, place=place) for language in languages}
        grammar_of = LLMatcher.grammar_from_json_schema
        self._grammars = {language: grammar_of(schema, defaults=strict) for language, schema in schemas.items()}

    def __call__(self, languages: Sequence[Language]) -> SchemaConstraint:
        return SchemaConstraint(self._tokens, [self._grammars[language] for language in languages])
