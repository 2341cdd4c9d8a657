"""Asks a model (an endpoint or an engine) about the windows of all tracks, from one process.

Windows are sent in order of track and time, a bounded number at once, across the borders of tracks. A track is written
when its last window is done. Windows without an answer, and those that the server refused, are in `quarantine.jsonl`
until a later run gets an answer.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from caption.schema import CaptionConfig, Window
from caption.stage.ledger import explain_drops, most_common
from caption.stage.progress import show_progress
from caption.stage.tracks import TrackInput
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
NOT_ASKED = "not_asked"  # the code of windows that this run does not ask about
# Windows beyond `concurrency`, so that pictures are encoded and answers checked while others are asked.
WAITING_WINDOWS = 16


@dataclass
class AskingOutcome:
    """The outcome of a run.

    unanswered: Windows without an answer. num_tracks_left: Tracks that were not begun. stopped: Why the run stopped
    early. judge_usage: Of all runs into the directory.
    """

    tracks: Tally = field(default_factory=Tally)
    unanswered: list[Failed] = field(default_factory=list)
    num_tracks_left: int = 0
    stopped: str | None = None
    judge_usage: Usage | None = None


@dataclass
class _OpenTrack:
    """A track whose windows are being asked. num_pending: Windows in work."""

    source: TrackInput
    captions: list[Caption] = field(default_factory=list)
    num_pending: int = 0
    is_read: bool = False
    has_gap: bool = False


class Asking:
    """One run of a teacher over tracks."""

    def __init__(
        self,
        stage: StageFolder,
        cfg: CaptionConfig,
        vocabulary: Vocabulary,
        seed: int,
        *,
        retry_failed: bool = False,
        was_complete: bool = False,
    ) -> None:
        """
        Args:
            retry_failed: Ask only about the windows in quarantine.
            was_complete: The directory was complete before `retry_failed`, so that every track has been asked.
        """
        self.stage, self.cfg, self.vocabulary, self.seed = stage, cfg, vocabulary, seed
        self.outcome = AskingOutcome()
        self.failures: list[Failed] = []  # tracks that cannot be read
        self.quarantine = read_quarantine(stage.path)
        self.only = frozenset(self.quarantine) if retry_failed else None
        self.tracks_to_retry: set[str] | None = None
        if self.only is not None and not was_complete:
            self.tracks_to_retry = {flight_of(sample_id) for sample_id in self.only}
        self.most_open = max(cfg.most_in_flight, cfg.judge.concurrency if cfg.judge.url else 0) + WAITING_WINDOWS
        self.num_failed_in_row = 0
        self.dropped: Counter[str] | None = Counter()  # of the windows that were asked; None once one was accepted

    async def run(self, tracks: list[TrackInput]) -> AskingOutcome:
        """Ask about every window that has no answer yet.

        Raises:
            TeacherError: No window would get an answer. Earlier answers are kept.
        """
        path, troubles = self.stage.path, Troubles()
        guesses = [track.guess_num_windows(self.cfg.window) for track in tracks]
        try:
            with AnswerBook(path / ANSWERS) as answers, AnswerBook(path / JUDGEMENTS) as judgements:
                self.books = (answers, judgements)
                budget = first_budget(self.cfg, answers.totals, judgements.totals)
                total = None if self.cfg.window.keyframes else sum(guesses)
                with show_progress(total, budget, troubles) as self.progress:
                    async with (
                        open_teacher(self.cfg, answers, self.seed, budget, self.only, troubles) as teacher,
                        open_judge(self.cfg.judge, self.vocabulary, self.seed, judgements, budget, troubles) as judge,
                    ):
                        self.judge = judge
                        await self._ask_all(tracks, guesses, teacher)
                if judgements.totals:
                    self.outcome.judge_usage = Usage(**{name: judgements.totals[name] for name in Usage.model_fields})
        finally:
            windows = [failure for failure in self.outcome.unanswered if failure.code != NOT_ASKED]
            write_failures(path / FAILURES, self.failures + windows)
            write_failures(path / QUARANTINE, self.quarantine.values())
        self.outcome.tracks.input = len(tracks) - self.outcome.num_tracks_left
        return self.outcome

    async def _show_progress(self) -> None:
        """Update the progress regularly, even if no window is finished."""
        while True:
            await asyncio.sleep(SECONDS_BETWEEN_LINES)
            self.progress.show()

    async def _ask_all(self, tracks: list[TrackInput], guesses: list[int], teacher: Teacher) -> None:
        """Keep `concurrency` requests in flight, whatever track they belong to."""
        running: set[asyncio.Task] = set()
        heartbeat = asyncio.create_task(self._show_progress())
        try:
            for track, guess in zip(tracks, guesses, strict=True):
                part = track.part(self.stage.path)
                if part.exists():
                    if self.dropped is not None and any(one.status == "accepted" for one in read_captions(part)):
                        self.dropped = None
                    self.outcome.tracks.kept += 1
                    self.progress.skip(guess)
                    continue
                is_for_later = self.tracks_to_retry is not None and track.name not in self.tracks_to_retry
                if self.outcome.stopped or (is_for_later and guess):
                    self.outcome.num_tracks_left += 1
                    continue
                running = await self._ask_track(track, teacher, running)
            while running:
                running = await _wait_for_one(running)
        finally:
            running.add(heartbeat)
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)

    async def _ask_track(self, source: TrackInput, teacher: Teacher, running: set[asyncio.Task]) -> set[asyncio.Task]:
        """Begin the windows of a track; return the tasks that are not done."""
        track, tally = _OpenTrack(source), self.outcome.tracks
        num_windows = 0
        try:
            for window in source.windows(self.cfg):
                num_windows += 1
                track.num_pending += 1
                running.add(asyncio.create_task(self._ask_window(track, window, teacher)))
                if len(running) >= self.most_open:
                    running = await _wait_for_one(running)
                if self.outcome.stopped:
                    track.has_gap = True
                    break
        except InputError as error:
            self.failures.append(Failed(id=source.name, code=error.code, message=str(error)))
            tally.failed[error.code] += 1
            log.error("caption: %s: %s", source.name, error)
        else:
            if num_windows:
                tally.kept += 1
            else:
                tally.dropped["too_short"] += 1
        track.is_read = True
        self._write_if_done(track)
        return running

    async def _ask_window(self, track: _OpenTrack, window: Window, teacher: Teacher) -> None:
        sample_id = window.observed.sample_id
        try:
            caption = await caption_window(window, teacher, self.cfg, self.vocabulary, self.judge)
        except BudgetSpent as error:
            self.outcome.stopped = self.outcome.stopped or error.what
            self._record_gap(track, Failed(id=sample_id, code=NOT_ASKED, message=error.what))
        except NoAnswer as error:
            self._record_gap(track, Failed(id=sample_id, code=error.cause, message=str(error)))
        except CosflyError as error:
            if error.fatal:
                raise
            self._record_gap(track, Failed(id=sample_id, code=error.code, message=str(error)))
        else:
            track.captions.append(caption)
            self._record_refusal(caption)
            self._stop_if_hopeless(caption)
            self.progress.finish(caption)
        track.num_pending -= 1
        self._write_if_done(track)

    def _record_gap(self, track: _OpenTrack, failure: Failed) -> None:
        """Record a window without an answer; those that were not asked are no failures."""
        track.has_gap = True
        self.outcome.unanswered.append(failure)
        if failure.code != NOT_ASKED:
            self.quarantine[failure.id] = failure
            self.progress.miss()
            self._count_failure(f"{common_causes(self.outcome.unanswered)}; the last: {failure.message}")

    def _record_refusal(self, caption: Caption) -> None:
        """Keep a window that the server refused, or that did not fit its context, for `--retry-failed`."""
        refusal, sample_id = caption.checks.refusal, caption.sample_id
        if refusal is None or caption.status == "accepted":
            self.num_failed_in_row = 0
            self.quarantine.pop(sample_id, None)
        else:
            code, _, message = refusal.partition(": ")
            self.quarantine[sample_id] = Failed(id=sample_id, code=code, message=message)
            self._count_failure(refusal)

    def _count_failure(self, got: str) -> None:
        """Count a window that was refused or got no answer; many in a row are a fault of the server."""
        self.num_failed_in_row += 1
        if self.num_failed_in_row >= STOP_AFTER_FAILURES:
            raise TeacherError(
                f"{self.num_failed_in_row} windows in a row got no answer",
                where=self.cfg.teacher,
                got=got,
                fix="check the server, then run the same command again: nothing answered is asked twice",
            )

    def _stop_if_hopeless(self, caption: Caption) -> None:
        """End the run if none of the first answers is accepted: the rest would be no better."""
        if caption.status == "accepted":
            self.dropped = None
        limit = self.cfg.stop_after_dropped if self.cfg.teacher_kind in ("endpoint", "vllm") else 0
        if self.dropped is None or not limit or not caption.attempts:
            return
        self.dropped[str(caption.drop_reason)] += 1
        if self.dropped.total() == limit:
            raise TeacherError(
                f"none of the first {limit} answers was accepted",
                where=self.cfg.teacher,
                got=explain_drops(self.dropped),
                fix=f"read {self.stage.path / ANSWERS}/*.jsonl, run `cosfly caption doctor`, or continue with "
                "--set caption.stop_after_dropped=0",
            )

    def _write_if_done(self, track: _OpenTrack) -> None:
        """Write the part of a track after its last window. One with a gap stays unfinished, for the next run."""
        if not track.is_read or track.num_pending:
            return
        part, gap = track.source.part(self.stage.path), track.source.gap(self.stage.path)
        if track.captions:
            track.captions.sort(key=lambda caption: caption.frame_index)
            write_captions(gap if track.has_gap else part, track.captions)
        if not track.has_gap:
            gap.unlink(missing_ok=True)
        for book in self.books:
            book.forget(track.source.name)


async def _wait_for_one(running: set[asyncio.Task]) -> set[asyncio.Task]:
    """Wait until a task is done; return the others. Raises the error of a task, which ends the run."""
    done, pending = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
    for task in done:
        task.result()
    return pending


def read_quarantine(stage_path: Path) -> dict[str, Failed]:
    """Return the windows that got no answer or were refused, by sample id."""
    path = stage_path / QUARANTINE
    return {failure.id: failure for failure in read_failures(path)} if path.exists() else {}


def common_causes(failures: list[Failed]) -> str:
    """Return the three most common causes with their counts."""
    causes = most_common(Counter(failure.code for failure in failures))
    return ", ".join(f"{cause} {count}" for cause, count in list(causes.items())[:3])
