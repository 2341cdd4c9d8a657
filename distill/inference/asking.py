"""Samples answered by an engine, a server or vLLM, as teachers are asked; every answer is journaled before it is handed on."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Iterable, Mapping
from pathlib import Path

from cosfly.chat.answers import Answer, AnswerBook, KeptAnswers
from cosfly.chat.contract import Engine, NoAnswer, Request
from cosfly.chat.protocol import answer_key
from cosfly.chat.student_chat import StudentEndpointConfig, picture_to_send, student_request
from cosfly.errors import InputError, TeacherError
from cosfly.products.answer_text import answer_schema
from cosfly.work.console import Advance
from cosfly.work.stage_folder import Failed
from distill.inference.outcome import Answered, OpenFlights
from distill.schema import Sample
from distill.student.encoding import load_pictures

# Begun beyond those in flight, so that pictures are read while others are asked and a slow answer does not hold up the rest.
WAITING = 4


def make_request(
    sample: Sample, trees: Mapping[str, Path], sampling: StudentEndpointConfig, max_pixels: int
) -> Request:
    """Give a sample as chat messages: its pictures as the student was taught to see them, then the question.

    Raises:
        InputError: a picture of its playback tree cannot be read.
    """
    pictures = iter([picture_to_send(picture, max_pixels) for picture in load_pictures(sample, trees)])
    frames = [[next(pictures) for _ in sample.views] for _ in sample.frames]
    return student_request(sample.prompt, frames, answer_schema(language=sample.language), sampling)


class Asking:
    """One run of an engine over samples."""

    def __init__(
        self,
        engine: Engine,
        book: AnswerBook,
        trees: Mapping[str, Path],
        sampling: StudentEndpointConfig,
        *,
        max_pixels: int,
        in_flight: int,
    ) -> None:
        """
        Args:
            engine: started. sampling: as its requests say. max_pixels: most of a picture; 0: all. in_flight: most at once.
        """
        self.engine, self.book, self.trees, self.sampling = engine, book, trees, sampling
        self.max_pixels, self._most = max_pixels, in_flight
        self._slots = asyncio.Semaphore(in_flight)
        self._kept = KeptAnswers(engine, book)
        self._flights = OpenFlights(book)
        self._failed_in_row = 0

    async def answers(self, samples: Iterable[Sample], advance: Advance) -> AsyncGenerator[Answered, None]:
        """Yield what becomes of each sample, in their order; `advance` is told of them as they come.

        Raises:
            TeacherError: the engine cannot be used, or too many samples in a row got no answer.
        """
        waiting: deque[asyncio.Task[Answered]] = deque()
        try:
            for sample in samples:
                waiting.append(asyncio.create_task(self._answer(sample, advance)))
                if len(waiting) >= WAITING * self._most:
                    yield await self._next(waiting)
            while waiting:
                yield await self._next(waiting)
        finally:
            for task in waiting:
                task.cancel()
            await asyncio.gather(*waiting, return_exceptions=True)

    async def _next(self, waiting: deque[asyncio.Task[Answered]]) -> Answered:
        answered = await waiting[0]
        waiting.popleft()
        self._flights.done(answered.sample)
        return answered

    async def _answer(self, sample: Sample, advance: Advance) -> Answered:
        answered = await self._asked(sample)
        advance(1)
        return answered

    async def _asked(self, sample: Sample) -> Answered:
        flight = self._flights.begun(sample)
        async with self._slots:
            try:
                request = await asyncio.to_thread(make_request, sample, self.trees, self.sampling, self.max_pixels)
                reply = await self._kept.ask(request, flight, sample.sample_id, sample.language)
            except InputError as error:
                return Answered(sample, Failed(id=sample.key, code=error.code, message=str(error)))
            except NoAnswer as error:
                self._note_failure(error)
                return Answered(sample, Failed(id=sample.key, code=error.cause, message=str(error)))
        self._failed_in_row = 0
        found = self.book.get(flight, answer_key(self.engine.model, request))
        assert isinstance(found, Answer), "what was asked is kept"
        return Answered(sample, found, is_new=not reply.is_kept)

    def _note_failure(self, error: NoAnswer) -> None:
        if error.is_final:  # the server answers, if only with a refusal
            return
        self._failed_in_row += 1
        if self._failed_in_row >= self.sampling.stop_after_failures:
            raise TeacherError(
                f"{self._failed_in_row} samples in a row got no answer",
                where=self.engine.where,
                got=str(error),
                fix="see to the server, then run the same command again: nothing answered is asked twice",
            )
