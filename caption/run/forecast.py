"""`cosfly caption --plan`: calls, tokens, time and money of a run, with a range, from a few trial windows.

The trial windows are real ones, spread over the flights, asked exactly as the run will ask them; their answers stay in
the journal, so the run does not ask them again.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from caption.run.asking import ANSWERS, READINGS
from caption.run.flights import Allotted, allot, named_flights
from caption.run.own_files import vocabulary_of
from caption.run.progress import duration
from caption.run.stage import open_stage
from caption.run.window_loop import caption_window
from caption.schema import CaptionConfig, Window
from caption.teachers.prompts import Question, make_question
from caption.teachers.reader import Reader, open_reader
from caption.teachers.students import as_taught
from caption.teachers.teacher import AskingTeacher, Teacher, first_budget, open_teacher
from caption.truth.vocabulary import Vocabulary
from cosfly.chat.answers import AnswerBook
from cosfly.chat.budget import BudgetSpent
from cosfly.chat.contract import NoAnswer
from cosfly.chat.interrupts import run_until_interrupted
from cosfly.errors import ConfigError, InputError, TeacherError
from cosfly.products.captions import Caption, Usage
from cosfly.products.places import flight_of
from cosfly.work.stage_folder import Resume

TRIAL_WINDOWS = 6
CONFIDENCE = 0.9


@dataclass(frozen=True)
class Estimate:
    """A figure of the whole run: expected, and a range that holds it with 90 % if the trial windows are like the
    others."""

    low: float
    expected: float
    high: float

    def scaled(self, factor: float) -> Estimate:
        return Estimate(self.low * factor, self.expected * factor, self.high * factor)


@dataclass(frozen=True)
class Forecast:
    """What a run will take. Cost is 0 where no price is set."""

    num_windows: int  # to do, without those of finished flights
    num_finished: int
    num_trials: int
    num_accepted_trials: int
    calls: Estimate
    prompt_tokens: Estimate
    image_tokens: Estimate | None
    completion_tokens: Estimate
    cost: Estimate
    seconds: Estimate
    concurrency: int

    def rows(self) -> list[tuple[str, str]]:
        """Give the table's rows."""
        windows = f"about {self.num_windows:,} to do" + (f", {self.num_finished:,} done" if self.num_finished else "")
        rows = [
            ("windows", windows),
            ("trial", f"{self.num_trials} windows, {self.num_accepted_trials} accepted; their answers are kept"),
            ("calls", _count(self.calls)),
            ("tokens in", _count(self.prompt_tokens)),
            ("of these images", "unknown" if self.image_tokens is None else _count(self.image_tokens)),
            ("tokens out", _count(self.completion_tokens)),
        ]
        cost = self.cost
        priced = f"{cost.expected:,.2f} ({cost.low:,.2f} to {cost.high:,.2f})"
        rows.append(("cost", priced if cost.expected > 0 else "set budget.price_prompt and budget.price_completion"))
        seconds = self.seconds
        low, expected, high = (duration(value) for value in (seconds.low, seconds.expected, seconds.high))
        rows.append(("time", f"{expected} ({low} to {high}) with {self.concurrency} in flight"))
        return rows


def make_forecast(cfg: CaptionConfig, data: Path, out: Path, *, seed: int = 0, resume: Resume = "if-same") -> Forecast:
    """Estimate a run by asking about a few windows."""
    if cfg.teacher_kind != "endpoint" and not cfg.reader.urls:
        expected = "--teacher URL or --reader URL"
        raise ConfigError("a plan needs an endpoint", where="--plan", got=cfg.teacher, expected=expected)
    vocabulary = vocabulary_of(cfg)
    cfg = as_taught(cfg, vocabulary)
    stage = open_stage(cfg, data, out, seed, resume)
    allotted, _ = allot(named_flights(data, cfg.flights), cfg, vocabulary)
    left = [flight for flight in allotted if not stage.is_complete and not flight.part(out).exists()]
    guesses = {flight.name: flight.guess_num_windows(cfg.window) for flight in allotted}
    num_windows = sum(guesses[flight.name] for flight in left)
    windows = _trial_windows([flight for flight in left if guesses[flight.name]], guesses, cfg, vocabulary)
    if not windows:
        raise InputError("no window to plan for", where=data, got=f"{len(left)} flights to do")
    captions, seconds, image_tokens = run_until_interrupted(_rehearse(cfg, vocabulary, out, seed, windows))
    return _scaled(captions, seconds, image_tokens, num_windows, sum(guesses.values()) - num_windows, cfg)


def _scaled(
    captions: list[Caption],
    seconds: list[float],
    image_tokens: int | None,
    num_windows: int,
    num_finished: int,
    cfg: CaptionConfig,
) -> Forecast:
    """Scale what the trial windows took to all windows."""
    usages = [caption.usage + (caption.reader.usage if caption.reader else Usage()) for caption in captions]
    prompt = estimate([usage.prompt_tokens for usage in usages]).scaled(num_windows)
    completion = estimate([usage.completion_tokens for usage in usages]).scaled(num_windows)
    # Every ask but the mirror's carries the pictures; a mirror is at least one ask of an answered window.
    asks_with_pictures = [caption.attempts - (caption.zh is not None) for caption in captions]
    pictures = None if image_tokens is None else estimate(asks_with_pictures).scaled(image_tokens * num_windows)
    which = ("low", "expected", "high")
    cost = Estimate(*(cfg.budget.cost(getattr(prompt, name), getattr(completion, name)) for name in which))
    per_window = estimate(seconds).scaled(num_windows)
    in_flight = cfg.most_in_flight if cfg.teacher_kind == "endpoint" else cfg.reader.concurrency
    # At best every slot works as fast as in the trial; at worst the server is no faster than it was with the trial's
    # windows.
    time_s = Estimate(
        per_window.low / in_flight, per_window.expected / in_flight, per_window.high / min(len(captions), in_flight)
    )
    return Forecast(
        num_windows=num_windows,
        num_finished=num_finished,
        num_trials=len(captions),
        num_accepted_trials=sum(caption.status == "accepted" for caption in captions),
        calls=estimate([_num_calls(caption, cfg) for caption in captions]).scaled(num_windows),
        prompt_tokens=prompt,
        image_tokens=pictures,
        completion_tokens=completion,
        cost=cost,
        seconds=time_s,
        concurrency=in_flight,
    )


def _num_calls(caption: Caption, cfg: CaptionConfig) -> int:
    readings = [] if caption.reader is None else caption.reader.num_claims.values()
    return (caption.attempts if cfg.teacher_kind == "endpoint" else 0) + sum(map(len, readings))


def estimate(values: Sequence[float]) -> Estimate:
    """Give the mean and its Student confidence interval, not below 0; of one value the interval is 0 to twice the
    value."""
    array = np.asarray(values, dtype=np.float64)
    mean = float(array.mean())
    if len(array) == 1:
        return Estimate(0.0, mean, 2.0 * mean)
    from scipy.stats import t  # slow to import, and needed here only

    half = float(t.ppf((1 + CONFIDENCE) / 2, len(array) - 1) * array.std(ddof=1) / np.sqrt(len(array)))
    return Estimate(max(0.0, mean - half), mean, mean + half)


def _trial_windows(
    flights: list[Allotted], guesses: dict[str, int], cfg: CaptionConfig, vocabulary: Vocabulary
) -> list[Window]:
    """Take windows from flights spread over all, each from another part of its flight."""
    count = min(TRIAL_WINDOWS, sum(guesses[flight.name] for flight in flights))
    windows: dict[str, Window] = {}
    for number in range(count):
        flight = flights[number * len(flights) // count]
        position = min(guesses[flight.name] - 1, (2 * number + 1) * guesses[flight.name] // (2 * count))
        try:
            found = next(itertools.islice(flight.windows(cfg, vocabulary), position, None), None)
        except InputError:
            continue  # the run itself records it
        if found is not None:
            windows[found.observed.sample_id] = found
    return list(windows.values())


async def _rehearse(
    cfg: CaptionConfig, vocabulary: Vocabulary, out: Path, seed: int, windows: list[Window]
) -> tuple[list[Caption], list[float], int | None]:
    """Give the trial captions, the seconds of each, and the tokens of all pictures of one question."""
    with AnswerBook(out / ANSWERS) as answers, AnswerBook(out / READINGS) as readings:
        budget = first_budget(cfg, answers.totals, readings.totals)
        async with (
            open_teacher(cfg, answers, seed, budget) as teacher,
            open_reader(cfg.reader, vocabulary, seed, readings, budget) as reader,
        ):
            image_tokens = None
            if isinstance(teacher, AskingTeacher):
                question = make_question(windows[0].observed, cfg.image, cfg.writing, vocabulary)
                image_tokens = await _image_tokens(question, teacher)
            results = await asyncio.gather(*(_answered(window, teacher, cfg, vocabulary, reader) for window in windows))
        captions = [result for result in results if isinstance(result, Caption)]
        ids = [caption.sample_id for caption in captions]
        seconds = [sum(book.latency_s(flight_of(name), name) for book in (answers, readings)) for name in ids]
    if not captions:
        raise TeacherError("no trial window got an answer", where=cfg.teacher, got=str(results[0]))
    return captions, seconds, image_tokens


async def _answered(
    window: Window, teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary, reader: Reader | None
) -> Caption | str:
    try:
        return await caption_window(window, teacher, cfg, vocabulary, reader=reader)
    except (NoAnswer, BudgetSpent) as error:
        return str(error)


async def _image_tokens(question: Question, teacher: AskingTeacher) -> int | None:
    """Ask one prompt with and without its pictures, for one token each: the difference is theirs."""
    request = await teacher.request(question)
    counts: list[int] = []
    for messages in (request.messages, [_without_images(message) for message in request.messages]):
        try:
            reply = await teacher.engine.answer(
                replace(request, messages=messages, sampling=request.sampling | {"max_tokens": 1})
            )
        except NoAnswer:
            return None
        if reply.usage is None or not reply.usage.prompt_tokens:
            return None
        counts.append(reply.usage.prompt_tokens)
    return counts[0] - counts[1]


def _without_images(message: dict) -> dict:
    content = message["content"]
    if isinstance(content, str):
        return message
    return message | {"content": [part for part in content if part["type"] != "image_url"]}


def _count(value: Estimate) -> str:
    return f"{value.expected:,.0f} ({value.low:,.0f} to {value.high:,.0f})"
