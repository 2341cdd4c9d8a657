"""Asks a model (an endpoint or an engine) about the windows of all tracks, from one process.

Windows are sent in order of track and time, a bounded number at once, across the borders of tracks. A track is written
when its last window is done. Windows without an answer, and those that the server refused, are in `quarantine.jsonl`
until a later run gets an answer.
"""

import asyncio
import logging
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from caption.schema import CaptionConfig, Window
from caption.stage.ledger import explain_drops, rejections_of
from caption.stage.tracks import TrackInput
from caption.stage.window_loop import caption_window
from caption.teachers.judge import Judge, open_judge
from caption.teachers.prompt_files import Vocabulary
from caption.teachers.teacher import AskingTeacher, Teacher, open_teacher
from cosfly.formats.captions import Caption, Usage, read_captions, write_captions
from cosfly.formats.places import flight_of
from cosfly.llm.answers import AnswerBook, Budget, BudgetSpent
from cosfly.llm.client import ChatClient
from cosfly.llm.contract import STOP_AFTER_FAILURES, NoAnswer
from cosfly.runtime.console import SECONDS_BETWEEN_LINES, Advance, duration, progress_bar
from cosfly.runtime.errors import CosflyError, InputError, TeacherError, counts_text
from cosfly.runtime.run_dir import Failed, StageFolder, Tally, read_failures, write_failures

log = logging.getLogger(__name__)

ANSWERS, JUDGEMENTS = "answers", "judgements"  # folders
QUARANTINE, FAILURES = "quarantine.jsonl", "failures.jsonl"
NOT_ASKED = "not_asked"  # the code of windows that this run does not ask about
# Most windows beyond the requests at once, so that pictures are encoded and answers checked while others are asked.
WAITING_WINDOWS = 16
ANSWERS_PER_WINDOW = 2  # English and Chinese, until windows are finished


@dataclass
class AskingOutcome:
    """The outcome of a run."""

    tracks: Tally = field(default_factory=Tally)
    unanswered: list[Failed] = field(default_factory=list)  # windows
    stopped: str | None = None  # why the run stopped before it asked about all windows
    judge_usage: Usage | None = None  # of all runs into the directory

    @property
    def causes(self) -> str:
        """Why windows have no answer, with their counts, and the last message."""
        counts = counts_text(Counter(failure.code for failure in self.unanswered))
        return f"{counts}; the last: {self.unanswered[-1].message}"


class Asking:
    """One run of a teacher over tracks. Captions of a finished track are its part file, of others its gap file."""

    # Opened by `run`.
    teacher: Teacher
    judge: Judge | None
    books: tuple[AnswerBook, AnswerBook]  # journals of the teacher's answers and of the judgements
    progress: "RunProgress"

    def __init__(
        self, stage: StageFolder, cfg: CaptionConfig, vocabulary: Vocabulary, seed: int, *, retry_failed: bool = False
    ) -> None:
        self.stage = stage
        self.cfg = cfg
        self.vocabulary = vocabulary
        self.seed = seed
        self.outcome = AskingOutcome()
        self.failures: list[Failed] = []  # tracks that cannot be read
        self.quarantine = read_quarantine(stage.path)
        # An answer that had filled the context, or in which the model declined, is asked for again.
        self.retried = frozenset(self.quarantine) if retry_failed else frozenset[str]()
        self.retried_tracks = {flight_of(sample_id) for sample_id in self.retried}
        self.num_judging = cfg.judge.concurrency if cfg.judge.url else 0
        self.num_in_work = 0  # windows; each has one request in flight, to the teacher or to the judge
        self.window_is_done = asyncio.Event()
        self.begun: dict[TrackInput, list[asyncio.Task[Caption | None]]] = {}  # the windows of tracks in work
        self.num_failed_in_row = 0
        self.has_accepted = False  # a caption, in this run or an earlier one
        # Captions of this run by reason, and rejected answers by code, before the first accepted caption.
        self.dropped = Counter[str]()
        self.rejected = Counter[str]()

    async def run(self, tracks: list[TrackInput]) -> AskingOutcome:
        """Ask about every window that has no answer yet; TeacherError if no window would get one. Answers are kept."""
        path = self.stage.path
        guesses = [track.guess_num_windows(self.cfg.window) for track in tracks]
        total = sum(guesses)
        try:
            with AnswerBook(path / ANSWERS) as answers, AnswerBook(path / JUDGEMENTS) as judgements:
                self.books = (answers, judgements)
                most_in_flight = self.cfg.most_in_flight + self.num_judging  # when a limit of the budget is reached
                budget = Budget(self.cfg.budget, most_in_flight, answers.totals, judgements.totals)
                with progress_bar("caption", total) as advance:
                    async with (
                        open_teacher(self.cfg, answers, self.seed, budget, self.retried) as teacher,
                        open_judge(self.cfg.judge, self.vocabulary, self.seed, judgements, budget) as judge,
                    ):
                        self.teacher, self.judge = teacher, judge
                        self.progress = RunProgress(advance, total, budget)
                        if self.cfg.most_in_flight == 1 and (num_answers := answers.totals["answers"]):
                            left_s = answers.latency_s / num_answers * max(0, ANSWERS_PER_WINDOW * total - num_answers)
                            what = "caption: %d answers are stored; two for each of %d windows take about %s more"
                            log.info(what, num_answers, total, duration(left_s))
                        await self._ask_all(tracks, guesses)
                if self.progress.windows.input:
                    log.info("caption: %s", self.progress.figures())
                if judgements.totals:
                    self.outcome.judge_usage = Usage(**{name: judgements.totals[name] for name in Usage.model_fields})
        finally:
            failed_windows = [failure for failure in self.outcome.unanswered if failure.code != NOT_ASKED]
            write_failures(path / FAILURES, self.failures + failed_windows)
            write_failures(path / QUARANTINE, self.quarantine.values())
        return self.outcome

    async def _show_progress(self) -> None:
        """Update the progress regularly, even if no window is finished."""
        while True:
            await asyncio.sleep(SECONDS_BETWEEN_LINES)
            self.progress.show()

    async def _ask_all(self, tracks: list[TrackInput], guesses: list[int]) -> None:
        """Ask about the tracks that are not finished, in their order, as many windows at once as there are slots."""
        heartbeat = asyncio.create_task(self._show_progress())
        try:
            async with asyncio.TaskGroup() as tasks:  # an error in one task cancels the others
                self.tasks = tasks
                for track, guess in zip(tracks, guesses, strict=True):
                    part = track.part(self.stage.path)
                    if part.exists() and track.name in self.retried_tracks:  # it is unfinished again
                        part.replace(track.gap(self.stage.path))
                    if part.exists():
                        self._skip_finished(part, guess)
                    elif not self.outcome.stopped:
                        await self._ask_track(track, tasks)
        except BaseExceptionGroup as errors:
            raise errors.exceptions[0] from None  # the first one caused the others
        finally:
            heartbeat.cancel()
            for track in self.begun:
                try:
                    self._write_gap(track)
                except (CosflyError, OSError) as error:  # the run already ends with another error
                    log.error("caption: %s: %s", track.name, error)

    def _skip_finished(self, part: Path, num_windows: int) -> None:
        """Count a track that an earlier run finished."""
        if not self.has_accepted:
            self.has_accepted = any(caption.status == "accepted" for caption in read_captions(part))
        self.outcome.tracks.input += 1
        self.outcome.tracks.kept += 1
        self.progress.skip(num_windows)

    async def _ask_track(self, track: TrackInput, tasks: asyncio.TaskGroup) -> None:
        """Begin the windows of a track; another task writes it after the last of them."""
        tally = self.outcome.tracks
        tally.input += 1
        tally.kept += 1  # until it fails or is too short, so that the counts add up if the run is interrupted
        windows = self.begun[track] = []
        is_cut = False
        try:
            for window in track.windows(self.cfg):
                while self.num_in_work >= self._most_in_work():
                    self.window_is_done.clear()
                    await self.window_is_done.wait()
                if self.outcome.stopped:
                    is_cut = True
                    break
                self.num_in_work += 1
                windows.append(tasks.create_task(self._ask_window(window)))
        except InputError as error:
            del self.begun[track]
            self.failures.append(Failed(id=track.name, code=error.code, message=str(error)))
            tally.kept -= 1
            tally.failed[error.code] += 1
            log.error("caption: %s: %s", track.name, error)
            return
        if not windows and not is_cut:
            tally.kept -= 1
            tally.dropped["too_short"] += 1
        tasks.create_task(self._write_track(track, is_cut))

    def _most_in_work(self) -> int:
        """Return how many windows may be in work: about twice the requests at once, so that a slow server finishes
        windows early instead of giving the first answers of many."""
        engine = self.teacher.kept.engine if isinstance(self.teacher, AskingTeacher) else None
        num_at_once = max(self.cfg.most_in_flight, self.num_judging)
        if isinstance(engine, ChatClient):
            num_at_once = int(engine.concurrency.limit)
        return num_at_once + min(num_at_once, WAITING_WINDOWS)

    async def _write_track(self, track: TrackInput, is_cut: bool) -> None:
        """Write the part of a track after its last window, or its gap if a window has no answer."""
        answers = await asyncio.gather(*self.begun[track])
        captions = [caption for caption in answers if caption is not None]
        if is_cut or len(captions) < len(answers):
            self._write_gap(track)
        else:
            if captions:
                write_captions(track.part(self.stage.path), captions)
            track.gap(self.stage.path).unlink(missing_ok=True)
        del self.begun[track]
        for book in self.books:
            book.forget(track.name)

    def _write_gap(self, track: TrackInput) -> None:
        """Write the captions of a track that stays unfinished, for the report."""
        gap = track.gap(self.stage.path)
        done = [task for task in self.begun[track] if task.done() and not task.cancelled() and not task.exception()]
        captions = [caption for caption in (window.result() for window in done) if caption is not None]
        if captions:
            write_captions(gap, captions)
        elif done:  # a window without an answer may have a caption of an earlier run there
            gap.unlink(missing_ok=True)

    async def _ask_window(self, window: Window) -> Caption | None:
        """Return the caption of a window; None without an answer."""
        sample_id = window.observed.sample_id
        try:
            caption = await caption_window(window, self.teacher, self.cfg, self.vocabulary, self.judge)
        except BudgetSpent as error:
            self.outcome.stopped = self.outcome.stopped or error.what
            self.outcome.unanswered.append(Failed(id=sample_id, code=NOT_ASKED, message=error.what))
        except (NoAnswer, CosflyError) as error:
            if isinstance(error, CosflyError) and error.fatal:
                raise
            code = error.cause if isinstance(error, NoAnswer) else error.code
            failure = Failed(id=sample_id, code=code, message=str(error))
            self.outcome.unanswered.append(failure)
            self.progress.add(None)
            self._count_failure(failure, self.outcome.causes)
        else:
            self._record_refusal(caption)
            self._stop_if_hopeless(caption)
            self.progress.add(caption)
            return caption
        finally:
            self.num_in_work -= 1
            self.window_is_done.set()
        return None

    def _record_refusal(self, caption: Caption) -> None:
        """Keep a window that was refused or declined, or that did not fit the context, for `--retry-failed`."""
        refusal, sample_id = caption.checks.refusal, caption.sample_id
        if refusal is None or caption.status == "accepted":
            self.num_failed_in_row = 0
            self.quarantine.pop(sample_id, None)
        else:
            code, _, message = refusal.partition(": ")
            self._count_failure(Failed(id=sample_id, code=code, message=message), refusal)

    def _count_failure(self, failure: Failed, got: str) -> None:
        """Record a window that was refused or got no answer; many in a row are a fault of the server."""
        self.quarantine[failure.id] = failure
        self.num_failed_in_row += 1
        if self.num_failed_in_row >= STOP_AFTER_FAILURES:
            what = f"{self.num_failed_in_row} windows in a row got no answer or were refused"
            fix = "fix the server, then run the same command again; answered windows are not asked again"
            raise TeacherError(what, where=self.cfg.teacher, got=got, fix=fix)

    def _stop_if_hopeless(self, caption: Caption) -> None:
        """End the run if none of the first answers is accepted: the rest would be no better."""
        if caption.status == "accepted":
            self.has_accepted = True
        limit = self.cfg.stop_after_dropped if self.cfg.teacher_kind in ("endpoint", "vllm") else 0
        self.progress.ends_after = 0 if self.has_accepted else limit
        if self.has_accepted or not limit or not caption.attempts:
            return
        self.dropped[str(caption.drop_reason)] += 1
        self.rejected.update(rejections_of(caption))
        if self.dropped.total() == limit:
            what = f"none of the first {limit} windows was accepted"
            see = f"to see why, open {self.stage.path / 'report.html'}; use a larger model"
            fix = f"{see}, or to continue anyway, pass --set caption.stop_after_dropped=0"
            got = explain_drops(self.dropped, self.rejected)
            self.tasks.create_task(self._end(TeacherError(what, where=self.cfg.teacher, got=got, fix=fix)))

    async def _end(self, error: TeacherError) -> None:
        raise error  # outside the task of a window, whose caption is kept


def read_quarantine(stage_path: Path) -> dict[str, Failed]:
    """Return the windows that got no answer or were refused, by sample id."""
    path = stage_path / QUARANTINE
    return {failure.id: failure for failure in read_failures(path)} if path.exists() else {}


# --- progress ---------------------------------------------------------------------------------------------------------


class RunProgress:
    """Counts the outcomes of windows and moves the progress bar."""

    def __init__(self, advance: Advance, total: int, budget: Budget) -> None:
        self._advance = advance
        self.num_left = total
        self.budget = budget
        self.windows = Tally()  # of this run
        self.num_repaired = 0
        self.ends_after = 0  # dropped windows, if none is accepted
        self._num_answered = self._num_used = 0  # windows of this run with a caption, and their answers, old and new
        self._start_s = self._answered_s = time.monotonic()
        self._num_answers = 0
        self._totals_before = budget.totals

    def skip(self, num_windows: int) -> None:
        """Count windows of an earlier run."""
        self.num_left -= num_windows
        self.show(num_windows)

    def add(self, caption: Caption | None) -> None:
        """Count a caption, None for a window without an answer."""
        self.num_left -= 1
        self.windows.input += 1
        if caption is not None:
            self._num_answered += 1
            self._num_used += caption.attempts + (caption.judge is not None)
        if caption is None or caption.drop_reason == "refused":
            self.windows.failed["no_answer"] += 1
        elif caption.status == "accepted":
            self.windows.kept += 1
            self.num_repaired += caption.repair is not None
        else:
            self.windows.dropped[str(caption.drop_reason)] += 1
        self.show(1)

    def show(self, num_windows: int = 0) -> None:
        """Move the progress bar by so many windows, and update its text."""
        if self._answers["answers"] != self._num_answers:
            self._num_answers, self._answered_s = self._answers["answers"], time.monotonic()
        self._advance(num_windows, self.figures())

    @property
    def _answers(self) -> Counter[str]:
        """The answers of this run and their tokens."""
        return self.budget.totals - self._totals_before

    def figures(self) -> str:
        """Return the figures of the run as a text."""
        prices, windows, answers = self.budget.cfg, self.windows, self._answers
        reasons = ", ".join(f"{reason} {count}" for reason, count in windows.dropped.most_common(4))
        elapsed_s = time.monotonic() - self._start_s
        waiting_s = time.monotonic() - self._answered_s
        waiting = f", waiting for {duration(waiting_s)}" if waiting_s >= SECONDS_BETWEEN_LINES else ""
        figures = [
            f"accepted {windows.kept:,} (repaired {self.num_repaired:,})",
            f"dropped {windows.dropped.total():,}" + (f" ({reasons})" if reasons else ""),
            *([f"ends after {self.ends_after:,} dropped windows"] if self.ends_after else []),
            f"no answer {windows.failed.total():,}",
            f"new answers {answers['answers']:,} in {duration(elapsed_s)}{waiting}",
            f"tokens {answers['prompt_tokens']:,} read {answers['completion_tokens']:,} written",
        ]
        if answers["cut"]:
            figures.append(f"cut at max_tokens {answers['cut']:,}")
        if prices.price_prompt or prices.price_completion:
            figures.append(f"cost {prices.cost(answers['prompt_tokens'], answers['completion_tokens']):.2f}")
        if answers["answers"]:  # without those of earlier runs, which take no time
            per_window = self._num_used / self._num_answered if self._num_used else ANSWERS_PER_WINDOW
            window_s = max(self._answered_s - self._start_s, 1e-9) / answers["answers"] * per_window
            figures.append(f"{window_s:.0f} s per window" if window_s > 1.0 else f"{1 / window_s:.1f} windows/s")
            figures += [f"about {duration(self.num_left * window_s)} left"] if self.num_left else []
        return ", ".join(figures)
