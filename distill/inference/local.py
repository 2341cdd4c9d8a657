"""Answers by a student in this process, in batches of consecutive samples; each encodes a picture once.

Which samples are in one batch follows from the samples and the settings alone, because rounding may depend on it: a run
that was killed and resumed gives the same answers as one that was not.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Iterable, Mapping, Sequence
from itertools import islice
from pathlib import Path

from cosfly.formats.places import flight_of
from cosfly.llm.answers import Answer, AnswerBook
from cosfly.runtime.console import Advance
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from distill.inference.outcome import SampleOutcome, failed
from distill.schema import Sample
from distill.student.chat import EncodedSample
from distill.student.features import FramePicture, PictureReader, Tensors, pictures_of, read_features
from distill.student.generate import Completion, generate
from distill.student.model import Student


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
    ) -> None:
        """
        Args:
            model: its name, for the journal. max_tokens: of an answer. max_pixels: of a picture; 0: no limit.
        """
        self.student, self.book, self.model = student, book, model
        self.batch_size, self.max_tokens, self.max_pixels = batch_size, max_tokens, max_pixels
        self._reader = PictureReader(student.processor, trees, student.dtype, max_pixels)

    async def answers(self, samples: Iterable[Sample], advance: Advance) -> AsyncGenerator[SampleOutcome, None]:
        """Yield the outcome of each sample, in their order; `advance` is called after each batch."""
        rest = iter(samples if self.student.has_pictures else (sample.without_pictures() for sample in samples))
        while batch := list(islice(rest, self.batch_size)):
            answers = {sample.key: self.book.get(flight_of(sample.sample_id), self._key(sample)) for sample in batch}
            found = {s.key: SampleOutcome(s, known) for s in batch if (known := answers[s.key]) is not None}
            if len(found) < len(batch):
                found = await self._answer(batch) | found
            advance(len(batch))
            for sample in batch:
                yield found[sample.key]

    def _key(self, sample: Sample) -> str:
        """Return a digest of what the answer depends on, besides the inputs in the folder's record."""
        asked = sample.model_dump(mode="json", include={"run", "window", "views", "picture_px", "prompt", "language"})
        return sha256_bytes(dump_json([self.model, sample.sample_id, asked, self.max_tokens]).encode())

    async def _answer(self, batch: list[Sample]) -> dict[str, SampleOutcome]:
        """Answer a batch, and record the answers that are new; they are on the disk when this returns."""
        pictures = list(dict.fromkeys(picture for sample in batch for picture in pictures_of(sample)))
        features, errors = read_features(self.student, pictures, map(self._reader.try_to_read, pictures))
        found: dict[str, SampleOutcome] = {}
        rows: list[tuple[EncodedSample, Sample]] = []
        for sample in batch:
            try:
                bad = next((picture for picture in pictures_of(sample) if picture in errors), None)
                if bad is None:
                    rows.append((self.student.encode(sample, self.max_pixels), sample))
                else:
                    found[sample.key] = failed(sample, InputError.code, errors[bad])
            except InputError as error:
                found[sample.key] = failed(sample, error.code, error)
        start_s = time.monotonic()
        completions = self._decode(rows, features) if rows else []
        latency_s = round(time.monotonic() - start_s, 3)
        for (row, sample), completion in zip(rows, completions, strict=True):
            answer = Answer(
                key=self._key(sample), sample_id=sample.sample_id, purpose=sample.language, model=self.model,
                text=completion.text, structured="plain", latency_s=latency_s, time=round(time.time(), 3),
                usage={"prompt_tokens": len(row.prompt_ids), "completion_tokens": completion.num_tokens},
                finish_reason="stop" if completion.is_finished else "length",
            )  # fmt: skip
            found[sample.key] = SampleOutcome(sample, answer, is_new=True)
        new = [outcome.found for outcome in found.values() if isinstance(outcome.found, Answer)]
        new = [answer for answer in new if self.book.get(flight_of(answer.sample_id), answer.key) is None]
        await asyncio.gather(*(self.book.put(flight_of(answer.sample_id), answer) for answer in new))
        return found

    def _decode(
        self, rows: Sequence[tuple[EncodedSample, Sample]], features: Mapping[FramePicture, Tensors]
    ) -> list[Completion]:
        import torch

        seen = [features[picture] for _, sample in rows for picture in pictures_of(sample)]
        try:
            return generate(self.student, [row for row, _ in rows], seen, max_tokens=self.max_tokens)
        except torch.OutOfMemoryError as error:
            where, fix = "distill.infer.batch_size", "lower batch_size or max_pixels; recorded answers are kept"
            got = f"batch_size {self.batch_size}: {str(error)[:120]}"
            raise ConfigError("the memory is full", where=where, got=got, fix=fix) from error
