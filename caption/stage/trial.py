"""`--try`: a few windows before a run, with all that is asked and answered.

The windows are real ones, spread over the tracks. Their answers stay in the journal, so the run does not ask for them
again.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from caption.schema import CaptionConfig
from caption.stage.asking import ANSWERS
from caption.stage.ledger import REASONS
from caption.stage.stage import open_stage
from caption.stage.tracks import find_inputs
from caption.stage.window_loop import caption_window
from caption.teachers.prompt_files import vocabulary_of
from caption.teachers.students import student_settings
from caption.teachers.teacher import EMBEDDED, AskingTeacher, first_budget, open_teacher
from cosfly.formats.captions import Caption
from cosfly.llm.answers import AnswerBook
from cosfly.llm.contract import NoAnswer, Reply, Request, run_until_interrupted
from cosfly.runtime.errors import ConfigError, CosflyError, InputError, TeacherError
from cosfly.runtime.escaping import LONGEST_LOG, for_terminal
from cosfly.runtime.run_dir import Resume


@dataclass
class _Trial:
    """The captions of a few windows. unanswered: Sample id -> error. exchanges: By sample id, in order."""

    captions: list[Caption] = field(default_factory=list)
    unanswered: dict[str, str] = field(default_factory=dict)
    exchanges: dict[str, list[tuple[Request, Reply]]] = field(default_factory=dict)


def _try_windows(cfg: CaptionConfig, data: Path, out: Path, seed: int, resume: Resume, num_windows: int) -> _Trial:
    """Caption a few windows; TeacherError if none gets an answer."""
    vocabulary = vocabulary_of(cfg)
    cfg = student_settings(cfg, vocabulary)
    stage = open_stage(cfg, data, out, seed, resume)
    if stage.is_complete:
        what, fix = "the directory is complete, so no window is left to try", "choose another --out"
        raise InputError(what, where=out, fix=fix)
    tracks, _ = find_inputs(cfg, data)
    left = [track for track in tracks if track.guess_num_windows(cfg.window) and not track.part(out).exists()]
    if not left:
        raise InputError("no window is left to caption", where=data, got=f"{len(tracks)} tracks")
    chosen = [left[number * len(left) // num_windows] for number in range(num_windows)]
    windows = [w for track in dict.fromkeys(chosen) for w in islice(track.windows(cfg), chosen.count(track))]
    trial = _Trial()

    def record(sample_id: str, request: Request, reply: Reply) -> None:
        trial.exchanges.setdefault(sample_id, []).append((request, reply))

    async def ask() -> list[Caption | BaseException]:
        with AnswerBook(out / ANSWERS) as book:
            async with open_teacher(cfg, book, seed, first_budget(cfg, book.totals)) as teacher:
                assert isinstance(teacher, AskingTeacher)
                teacher.kept.listener = record
                asked = [caption_window(window, teacher, cfg, vocabulary) for window in windows]
                return await asyncio.gather(*asked, return_exceptions=True)

    found = run_until_interrupted(ask())
    trial.captions = [one for one in found if isinstance(one, Caption)]
    for window, one in zip(windows, found, strict=True):
        if isinstance(one, NoAnswer | CosflyError):
            trial.unanswered[window.observed.sample_id] = str(one)
        elif isinstance(one, BaseException):
            raise one
    if not trial.captions:
        what, got = "none of the trial windows got an answer", next(iter(trial.unanswered.values()), None)
        raise TeacherError(what, where=cfg.teacher, got=got)
    return trial


def show_windows(
    cfg: CaptionConfig, data: Path, out: Path, num_windows: int, *, seed: int = 0, resume: Resume = "if-same"
) -> Iterator[str]:
    """Yield the lines that show a few windows: each question and answer, and what became of the window."""
    if cfg.teacher_kind in EMBEDDED:
        what = "a trial shows questions and answers, and this teacher asks no model"
        raise ConfigError(what, where="--try", got=cfg.teacher, expected="--teacher URL or vllm:MODEL_DIR")
    trial = _try_windows(cfg, data, out, seed, resume, num_windows)
    for sample_id, message in trial.unanswered.items():
        yield from _exchanges_of(trial, sample_id)
        yield f"no answer: {for_terminal(message)}"
    for caption in trial.captions:
        yield from _exchanges_of(trial, caption.sample_id)
        reason = caption.drop_reason
        yield caption.status if reason is None else f"dropped because of {reason}: {REASONS[reason]}"
        for name, value in (
            ("label", caption.label),
            ("verdict", caption.verdict),
            ("refusal", caption.checks.refusal),
        ):
            if value is not None:
                yield f"{name}: {for_terminal(str(value))}"
        for text in caption.checks.contradictions or ():
            yield f"contradicted: {for_terminal(text)}"
        for language, answer in (("en", caption.en), ("zh", caption.zh)):
            if answer is not None:
                texts = (answer.critical_components, answer.reasoning_trace, answer.flight_decision)
                yield from (f"{language}: {for_terminal(text)}" for text in texts)


def _exchanges_of(trial: _Trial, sample_id: str) -> Iterator[str]:
    """Yield the lines of the questions and answers about a window, and the title of its outcome."""
    yield f"=== {sample_id} ==="
    for number, (request, reply) in enumerate(trial.exchanges.get(sample_id, ()), 1):
        for message in request.messages:
            yield f"--- request {number}, {message['role']} ---"
            yield from _text_of(message["content"])
        usage = reply.usage
        tokens = f"{usage.prompt_tokens} tokens in, {usage.completion_tokens} out" if usage else "tokens not reported"
        yield f"--- answer {number} ({tokens}) ---"
        yield for_terminal(reply.text, LONGEST_LOG)
    yield "--- outcome ---"


def _text_of(content: str | list[dict]) -> Iterator[str]:
    """Yield the lines of a message; a picture is its number and size."""
    if isinstance(content, str):
        yield for_terminal(content, LONGEST_LOG)
        return
    num_pictures = 0
    for part in content:
        if part["type"] == "text":
            yield for_terminal(part["text"], LONGEST_LOG)
        else:
            num_pictures += 1
            yield f"[picture {num_pictures}, {len(part['image_url']['url']) / 1e3:.0f} kB]"
