"""Asks a teacher that takes its time (an endpoint, an engine) about all flights, from one process.

Windows go out in order of flight and time, a bounded number at once, across the borders of flights. A flight is written
when its last window is done. Windows without an answer, and those that the server refused, sit in `quarantine.jsonl`
until a later run gets one.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path

from caption.schema import CaptionConfig, Window
from caption.stage.flights import Allotted
from caption.stage.progress import Display
from caption.stage.reasons import explained
from caption.stage.window_loop import caption_window
from caption.teachers.judge import open_judge
from caption.teachers.teacher import Teacher, first_budget, open_teacher
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import Caption, Usage, read_captions, write_captions
from cosfly.formats.places import flight_of
from cosfly.llm.answers import AnswerBook, BudgetSpent
from cosfly.llm.contract import STOP_AFTER_FAILURES, NoAnswer, Troubles
from cosfly.runtime.console import SECONDS_BETWEEN_LINES
from cosfly.runtime.errors import CosflyError, InputError, TeacherError
from cosfly.runtime.run_dir import Failed, StageFolder, Tally, read_failures, write_failures

log = logging.getLogger(__name__)

ANSWERS, JUDGEMENTS = "answers", "judgements"  # folders
QUARANTINE, FAILURES = "quarantine.jsonl", "failures.jsonl"
# Begun beyond `concurrency`, so that pictures are encoded and answers checked while others are asked.
WAITING_WINDOWS = 16


@dataclass
class Asked:
    """What came of a run: flights, windows without an answer, flights not begun, and why it stopped early (None:
    not)."""

    flights: Tally
    unanswered: list[Failed] = field(default_factory=list)
    num_flights_left: int = 0
    stopped: str | None = None
    judge_usage: Usage | None = None  # of all runs into the folder


@dataclass
class _OpenFlight:
    """A flight whose windows are being asked."""

    allotted: Allotted
    captions: list[Caption] = field(default_factory=list)
    pending: int = 0
    is_read: bool = False
    has_gap: bool = False


class Asking:
    """One run of a teacher over the allotted flights."""

    def __init__(
        self,
        stage: StageFolder,
        cfg: CaptionConfig,
        vocabulary: Vocabulary,
        seed: int,
        *,
        retry_failed: bool = False,
        was_whole: bool = False,
    ) -> None:
        """
        Args:
            was_whole: the folder was complete before `retry_failed`: of a flight without a part nothing can be asked.
        """
        self.stage, self.cfg, self.vocabulary, self.seed = stage, cfg, vocabulary, seed
        self.asked = Asked(Tally())
        self.failures: list[Failed] = []  # flights that cannot be read
        self.quarantine = read_quarantine(stage.path)
        self.only = frozenset(self.quarantine) if retry_failed else None
        beside = [cfg.judge.concurrency] * bool(cfg.judge.url)
        in_flight = max(cfg.most_in_flight, *beside, 0)
        self.most_open = in_flight + WAITING_WINDOWS
        self.was_whole = was_whole
        self.failed_in_row = 0
        self.dropped: Counter[str] | None = Counter()  # of the windows that were asked; None once one was accepted

    async def run(self, allotted: list[Allotted]) -> Asked:
        """Ask about every window that has no answer yet.

        Raises:
            TeacherError: no window would get an answer. What was answered is kept.
        """
        guesses = {flight.name: flight.guess_num_windows(self.cfg.window) for flight in allotted}
        self.books = tuple(AnswerBook(self.stage.path / name) for name in (ANSWERS, JUDGEMENTS))
        answers, judgements = self.books
        budget, troubles = first_budget(self.cfg, *(book.totals for book in self.books)), Troubles()
        display = Display(sum(guesses.values()), budget, troubles=troubles)
        try:
            with answers, judgements, display as self.display:
                async with (
                    open_teacher(self.cfg, answers, self.seed, budget, self.only, troubles) as teacher,
                    open_judge(self.cfg.judge, self.vocabulary, self.seed, judgements, budget, troubles) as self.judge,
                    self._heartbeat(),
                ):
                    await self._ask_all(allotted, teacher, guesses)
        finally:
            self._write_failures()
        self.asked.flights.input = len(allotted) - self.asked.num_flights_left
        if judgements.totals:
            self.asked.judge_usage = Usage(**{name: judgements.totals[name] for name in Usage.model_fields})
        return self.asked

    @contextlib.asynccontextmanager
    async def _heartbeat(self) -> AsyncIterator[None]:
        """Have the display show itself now and then even while no window is finished."""

        async def beat() -> None:
            while True:
                await asyncio.sleep(SECONDS_BETWEEN_LINES)
                self.display.update()

        beating = asyncio.create_task(beat())
        try:
            yield
        finally:
            beating.cancel()

    async def _ask_all(self, allotted: list[Allotted], teacher: Teacher, guesses: dict[str, int]) -> None:
        """Keep `concurrency` requests in flight, whatever flight they belong to."""
        running: set[asyncio.Task] = set()
        flights_to_retry = (
            None if self.only is None or self.was_whole else {flight_of(sample_id) for sample_id in self.only}
        )
        try:
            for flight in allotted:
                if flight.part(self.stage.path).exists():
                    if self.dropped is not None and _has_accepted(flight.part(self.stage.path)):
                        self.dropped = None
                    self.asked.flights.kept += 1
                    self.display.skip(guesses[flight.name])
                    continue
                is_left = flights_to_retry is not None and flight.name not in flights_to_retry
                if self.asked.stopped or (is_left and guesses[flight.name]):
                    self.asked.num_flights_left += 1
                    continue
                running = await self._ask_flight(flight, teacher, guesses[flight.name], running)
            while running:
                running = await _some_done(running)
        finally:
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)

    async def _ask_flight(
        self, allotted: Allotted, teacher: Teacher, guessed: int, running: set[asyncio.Task]
    ) -> set[asyncio.Task]:
        flight, tally = _OpenFlight(allotted), self.asked.flights
        num_windows = 0
        try:
            for window in allotted.windows(self.cfg):
                num_windows += 1
                flight.pending += 1
                running.add(asyncio.create_task(self._one(flight, window, teacher)))
                if len(running) >= self.most_open:
                    running = await _some_done(running)
                if self.asked.stopped:
                    flight.has_gap = True
                    break
        except InputError as error:
            self.failures.append(Failed(id=allotted.name, code=error.code, message=str(error)))
            tally.failed[error.code] += 1
            log.error("caption: %s: %s", allotted.name, error)
        else:
            if num_windows:
                tally.kept += 1
            else:
                tally.dropped["too_short"] += 1
        self.display.correct_total(guessed, num_windows if not self.asked.stopped else guessed)
        flight.is_read = True
        self._close_if_done(flight)
        return running

    async def _one(self, flight: _OpenFlight, window: Window, teacher: Teacher) -> None:
        with self.display.window():
            await self._caption(flight, window, teacher)
        flight.pending -= 1
        self._close_if_done(flight)

    async def _caption(self, flight: _OpenFlight, window: Window, teacher: Teacher) -> None:
        sample_id, begun_s = window.observed.sample_id, time.monotonic()
        try:
            caption = await caption_window(window, teacher, self.cfg, self.vocabulary, self.judge)
        except BudgetSpent as error:
            self.asked.stopped = self.asked.stopped or error.what
            self._leave_out(flight, Failed(id=sample_id, code="not_asked", message=error.what))
        except NoAnswer as error:
            failure = Failed(id=sample_id, code=error.cause, message=str(error))
            if error.cause == "not_asked":
                self._leave_out(flight, failure)
            else:
                self._record_gap(flight, failure)
        except CosflyError as error:
            if error.fatal:
                raise
            self._record_gap(flight, Failed(id=sample_id, code=error.code, message=str(error)))
        else:
            flight.captions.append(caption)
            self._note_refusal(caption)
            self._note_outcome(caption)
            self.display.finish(caption, time.monotonic() - begun_s)

    def _note_refusal(self, caption: Caption) -> None:
        """Keep a window that the server refused, or had no room for, for `--retry-failed`; its caption is dropped all
        the same."""
        refusal, sample_id = caption.checks.refusal, caption.sample_id
        if refusal is None or caption.status == "accepted":
            self.failed_in_row = 0
            self.quarantine.pop(sample_id, None)
        else:
            code, _, message = refusal.partition(": ")
            self.quarantine[sample_id] = Failed(id=sample_id, code=code, message=message)
            self._note_failure(refusal)

    def _note_outcome(self, caption: Caption) -> None:
        """End the run where nothing of what a teacher answered first is accepted: the rest would be no better."""
        if caption.status == "accepted":
            self.dropped = None
        most = self.cfg.stop_after_dropped if self.cfg.teacher_kind in ("endpoint", "vllm") else 0
        if self.dropped is None or not most or not caption.attempts:
            return
        self.dropped[str(caption.drop_reason)] += 1
        if self.dropped.total() == most:
            raise TeacherError(
                f"none of the first {most} answers was accepted",
                where=self.cfg.teacher,
                got=explained(self.dropped),
                fix=f"read {self.stage.path / ANSWERS}/*.jsonl, ask `cosfly caption doctor`, or go on with "
                "--set caption.stop_after_dropped=0",
            )

    def _leave_out(self, flight: _OpenFlight, failure: Failed) -> None:
        flight.has_gap = True
        self.asked.unanswered.append(failure)

    def _record_gap(self, flight: _OpenFlight, failure: Failed) -> None:
        self._leave_out(flight, failure)
        self.quarantine[failure.id] = failure
        self.display.miss()
        self._note_failure(f"{common_causes(self.asked.unanswered)}; the last: {failure.message}")

    def _note_failure(self, got: str) -> None:
        """Note a window without an answer, or refused; so many in a row are the server's fault."""
        self.failed_in_row += 1
        if self.failed_in_row >= STOP_AFTER_FAILURES:
            raise TeacherError(
                f"{self.failed_in_row} windows in a row got no answer",
                where=self.cfg.teacher,
                got=got,
                fix="see to the server, then run the same command again: nothing answered is asked twice",
            )

    def _close_if_done(self, flight: _OpenFlight) -> None:
        """Write a flight's part once its last window is done. One with a gap stays unfinished, for the next run."""
        if not flight.is_read or flight.pending:
            return
        allotted = flight.allotted
        gap = allotted.gap(self.stage.path)
        if flight.captions:
            flight.captions.sort(key=lambda caption: caption.frame_index)
            write_captions(gap if flight.has_gap else allotted.part(self.stage.path), flight.captions)
        if not flight.has_gap:
            gap.unlink(missing_ok=True)
        for book in self.books:
            book.forget(allotted.name)

    def _write_failures(self) -> None:
        """Write what failed: flights and windows of this run, and the quarantine of all runs."""
        windows = [failure for failure in self.asked.unanswered if failure.code != "not_asked"]
        write_failures(self.stage.path / FAILURES, self.failures + windows)
        write_failures(self.stage.path / QUARANTINE, self.quarantine.values())


def read_quarantine(stage_path: Path) -> dict[str, Failed]:
    """Return the windows that no answer came for or that the server refused, by sample id."""
    path = stage_path / QUARANTINE
    return {failure.id: failure for failure in read_failures(path)} if path.exists() else {}


async def _some_done(running: set[asyncio.Task]) -> set[asyncio.Task]:
    done, pending = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        task.result()  # raises what ends the run
    return pending


def _has_accepted(part: Path) -> bool:
    return any(caption.status == "accepted" for caption in read_captions(part))


def common_causes(failures: list[Failed]) -> str:
    """Return the three most common causes with their counts."""
    counts = Counter(failure.code for failure in failures)
    ordered = sorted(counts.items(), key=lambda pair: (-pair[1], pair[0]))
    return ", ".join(f"{cause} {count}" for cause, count in ordered[:3])
