"""Answers by a student in this process: prompts of similar length together, each picture encoded once.

Samples are taken a shelf at a time, in their order; within a shelf they are sorted by length and cut into batches.
Which samples are in one batch follows from the samples and the settings alone, because rounding may depend on it: a run
that was killed and resumed gives the same answers as one that was not.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

from cosfly.formats.captions import Language, Place
from cosfly.formats.places import flight_of
from cosfly.llm.answer_text import answer_schema
from cosfly.llm.answers import Answer, AnswerBook
from cosfly.runtime.console import Advance
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from distill.inference.outcome import SampleOutcome, failed
from distill.schema import Sample
from distill.student.chat import EncodedSample
from distill.student.features import FramePicture, PictureReader, Tensors, encode, pictures_of
from distill.student.generate import Completion, generate
from distill.student.model import Student, require

log = logging.getLogger(__name__)

SHELF_SAMPLES = 256
READING_THREADS = 8
PICTURES_AT_ONCE = 64


class LocalAnswers:
    """A student that answers samples in this process."""

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
        matchers_of: Callable[[Sequence[Language]], list[Any]] | None,
    ) -> None:
        """
        Args:
            model: its name, for the journal. max_tokens: of an answer. max_pixels: of a picture; 0: no limit.
            matchers_of: returns the grammar matchers of a batch (`schema_matchers`); None: answers are free.
        """
        self.student, self.book, self.model, self.matchers_of = student, book, model, matchers_of
        self.batch_size, self.max_tokens, self.max_pixels = batch_size, max_tokens, max_pixels
        self.most_rows = batch_size  # fewer once the memory was full
        self._reader = PictureReader(student.processor, trees, student.dtype, max_pixels)

    async def answers(self, samples: Iterable[Sample], advance: Advance) -> AsyncGenerator[SampleOutcome, None]:
        """Yield the outcome of each sample, in their order; `advance` is called after each batch."""
        rest = iter(samples if self.student.has_pictures else (sample.without_pictures() for sample in samples))
        while shelf := list(islice(rest, self.batch_size * max(1, SHELF_SAMPLES // self.batch_size))):
            found: dict[str, SampleOutcome] = {}
            for sample in shelf:
                known = self.book.get(flight_of(sample.sample_id), self._key(sample))
                if known is not None:
                    found[sample.key] = SampleOutcome(sample, known)
            advance(len(found))
            if len(found) < len(shelf):
                await self._answer(shelf, found, advance)
            for sample in shelf:
                yield found[sample.key]

    def _key(self, sample: Sample) -> str:
        """Return a digest of what the answer depends on, besides the inputs in the folder's record."""
        asked = sample.model_dump(mode="json", include={"run", "window", "views", "picture_px", "prompt", "language"})
        key = [self.model, sample.sample_id, asked, self.max_tokens, self.matchers_of is not None]
        return sha256_bytes(dump_json(key).encode())

    async def _answer(self, shelf: list[Sample], found: dict[str, SampleOutcome], advance: Advance) -> None:
        """Answer a shelf and record new answers; batches never change, so known answers may be computed again."""
        features, errors = self._features(shelf)
        rows: list[tuple[EncodedSample, Sample]] = []
        num_found = len(found)
        for sample in shelf:
            try:
                bad = next((picture for picture in pictures_of(sample) if picture in errors), None)
                if bad is not None:
                    found[sample.key] = failed(sample, InputError.code, errors[bad])
                else:
                    rows.append((self.student.encode(sample, self.max_pixels), sample))
            except InputError as error:
                found[sample.key] = failed(sample, error.code, error)
        advance(len(found) - num_found)
        # The longest first: the first batch shows whether the memory is enough.
        rows.sort(key=lambda row: (-len(row[0].prompt_ids), row[0].key))
        for start in range(0, len(rows), self.batch_size):
            batch = rows[start : start + self.batch_size]
            unknown = [sample.key for _, sample in batch if sample.key not in found]
            if unknown:
                start_s = time.monotonic()
                answers = zip(batch, self._decode(batch, features), strict=True)
                latency_s = round(time.monotonic() - start_s, 3)
                new = [self._answer_of(*row, text, latency_s) for row, text in answers if row[1].key in unknown]
                await asyncio.gather(*(self.book.put(flight_of(answer.sample_id), answer) for _, answer in new))
                found |= {sample.key: SampleOutcome(sample, answer, is_new=True) for sample, answer in new}
                advance(len(unknown))

    def _features(self, shelf: Sequence[Sample]) -> tuple[dict[FramePicture, Tensors], dict[FramePicture, str]]:
        """Return the features of the pictures of a shelf, and why others cannot be read."""
        import torch

        pictures = list(dict.fromkeys(picture for sample in shelf for picture in pictures_of(sample)))
        features, errors = dict[FramePicture, Tensors](), dict[FramePicture, str]()
        with ThreadPoolExecutor(READING_THREADS, "pictures") as threads, torch.no_grad():
            for start in range(0, len(pictures), PICTURES_AT_ONCE):
                part = pictures[start : start + PICTURES_AT_ONCE]
                read = dict(zip(part, threads.map(self._reader.try_to_read, part), strict=True))
                errors |= {picture: words for picture, words in read.items() if isinstance(words, str)}
                good = {picture: tensors for picture, tensors in read.items() if not isinstance(tensors, str)}
                for picture, tensors in zip(good, encode(self.student, list(good.values())), strict=True):
                    features[picture] = {name: tensor.cpu() for name, tensor in tensors.items()}
        return features, errors

    def _decode(
        self, batch: Sequence[tuple[EncodedSample, Sample]], features: Mapping[FramePicture, Tensors]
    ) -> list[Completion]:
        """Answer samples together, in halves where the memory does not hold them all."""
        import torch

        answers: list[Completion] = []
        while len(answers) < len(batch):
            chosen = batch[len(answers) : len(answers) + self.most_rows]
            matchers = self.matchers_of([sample.language for _, sample in chosen]) if self.matchers_of else ()
            seen = [features[picture] for _, sample in chosen for picture in pictures_of(sample)]
            rows = [row for row, _ in chosen]
            try:
                answers += generate(self.student, rows, seen, max_tokens=self.max_tokens, matchers=matchers)
                continue
            except torch.OutOfMemoryError as error:
                text = str(error)[:120]
            # After the error is released, and with it the tensors that it holds.
            if len(chosen) == 1:
                fix = "lower max_new_tokens or max_pixels, or use a server (--engine endpoint)"
                words, where = "one sample does not fit into memory", "distill.infer.max_new_tokens"
                raise ConfigError(words, where=where, got=text, fix=fix)
            self.most_rows = len(chosen) // 2
            words = "distill.infer: %d samples do not fit into memory; the batch size is now %d"
            log.warning(words, len(chosen), self.most_rows)
            if torch.cuda.is_available():
                torch.cuda.empty_cache()
        return answers

    def _answer_of(
        self, row: EncodedSample, sample: Sample, completion: Completion, latency_s: float
    ) -> tuple[Sample, Answer]:
        usage = {"prompt_tokens": len(row.prompt_ids), "completion_tokens": completion.num_tokens}
        answer = Answer(
            key=self._key(sample), sample_id=sample.sample_id, purpose=sample.language, model=self.model,
            text=completion.text, usage=usage, structured="json_schema" if self.matchers_of else "plain",
            finish_reason="stop" if completion.is_finished else "length", latency_s=latency_s,
            time=round(time.time(), 3),
        )  # fmt: skip
        return sample, answer


def schema_matchers(student: Student, place: Place) -> Callable[[Sequence[Language]], list[Any]]:
    """Return a function that makes llguidance's matchers of the answer schemas of some languages.

    Args:
        place: of the decision among the fields.
    """
    require("llguidance")
    from llguidance import LLMatcher
    from llguidance.hf import from_tokenizer

    tokens = from_tokenizer(student.tokenizer, eos_token=student.end_token_id)
    strict: Any = {"whitespace_flexible": False}  # with free white space a student could pad forever
    grammars = {
        language: LLMatcher.grammar_from_json_schema(answer_schema(language=language, place=place), defaults=strict)
        for language in ("en", "zh")
    }
    return lambda languages: [LLMatcher(tokens, grammars[language]) for language in languages]
