"""`--try`: a few windows of `--limit` before a run, with all that is asked and answered. The run reuses the answers."""

import asyncio
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from caption.schema import CaptionConfig
from caption.stage.asking import ANSWERS
from caption.stage.ledger import REASONS, problems_of
from caption.stage.stage import open_stage
from caption.stage.tracks import find_inputs
from caption.stage.window_loop import MOST_ASKS, caption_window
from caption.teachers.prompt_files import vocabulary_of
from caption.teachers.students import student_settings
from caption.teachers.teacher import EMBEDDED, AskingTeacher, open_teacher
from cosfly.formats.captions import FIELDS, Caption
from cosfly.llm.answers import AnswerBook, Budget, KeptAnswers
from cosfly.llm.contract import NoAnswer, Reply, Request, run_until_interrupted
from cosfly.runtime.console import Advance, progress_bar
from cosfly.runtime.errors import ConfigError, CosflyError, InputError, TeacherError
from cosfly.runtime.escaping import LONGEST_LOG, for_terminal
from cosfly.runtime.model_json import find_object

log = logging.getLogger(__name__)

KINDS = {"free": "English", "mirror": "Chinese"}  # of requests, by the first word of their purpose
MOST_LOGGED = 200  # characters of a request or an answer


@dataclass
class _LoggedAnswers(KeptAnswers):
    """Logs each request and answer, and keeps them by window."""

    exchanges: dict[str, list[tuple[Request, Reply]]] = field(default_factory=dict)
    advance: Advance = lambda *_: None

    async def ask(self, request: Request, track: str, sample_id: str, purpose: str) -> Reply:
        number, (kind, ask, *correction) = len(self.exchanges[sample_id]) + 1, purpose.split("/")
        hint = "a hint" if kind.startswith("hint_") else f"the label {kind}"
        words = KINDS.get(kind, f"regeneration with {hint}") + ("" if ask == "0" else f", ask {int(ask) + 1}")
        if correction:
            words += ", again: " + for_terminal(request.messages[-1]["content"][-1]["text"], MOST_LOGGED)
        log.info("%s: request %d, %s", sample_id, number, words)
        self.advance(0, f"waiting for answer {number}")
        reply = await super().ask(request, track, sample_id, purpose)
        self.exchanges[sample_id].append((request, reply))
        text = for_terminal(reply.text, MOST_LOGGED)
        log.info("%s: answer %d%s: %s", sample_id, number, _problem_of(reply), text)
        self.advance(1)
        return reply


def show_windows(cfg: CaptionConfig, data: Path, out: Path, num_windows: int, *, seed: int = 0) -> Iterator[str]:
    """Yield the lines that show a few windows: each question and answer, and the outcome of the window; TeacherError if
    no window gets an answer."""
    if cfg.teacher_kind in EMBEDDED:
        what, expected = "this teacher asks no model", "--teacher URL or --teacher vllm:MODEL_DIR"
        raise ConfigError(what, where="--try", got=f"--teacher {cfg.teacher}", expected=expected)
    vocabulary = vocabulary_of(cfg)
    cfg = student_settings(cfg, vocabulary)
    if open_stage(cfg, data, out, seed).is_complete:
        what, fix = "the directory is complete, so no window is left to try", "choose another --out"
        raise InputError(what, where=out, fix=fix)
    limit = min(num_windows, cfg.limit or num_windows)  # windows of which any larger limit reuses the answers
    tracks, _ = find_inputs(cfg.model_copy(update={"limit": limit}), data)
    windows = [window for track in tracks for window in track.windows(cfg)]
    if not windows:
        raise InputError("all tracks are too short", where=data, got=f"{len(tracks)} tracks")
    exchanges: dict[str, list[tuple[Request, Reply]]] = {window.observed.sample_id: [] for window in windows}

    async def ask(advance: Advance) -> list[Caption | BaseException]:
        with AnswerBook(out / ANSWERS) as book:
            budget = Budget(cfg.budget, cfg.most_in_flight, book.totals)
            async with open_teacher(cfg, book, seed, budget) as teacher:
                assert isinstance(teacher, AskingTeacher)
                teacher.kept = _LoggedAnswers(teacher.kept.engine, book, budget, exchanges=exchanges, advance=advance)
                asked = [caption_window(window, teacher, cfg, vocabulary) for window in windows]
                return await asyncio.gather(*asked, return_exceptions=True)

    log.info("a window takes 2 answers, up to %d if some are rejected, more after a wrong decision or value", MOST_ASKS)
    with progress_bar("answers", None) as advance:
        outcomes = run_until_interrupted(ask(advance))
    for outcome in outcomes:
        if not isinstance(outcome, Caption | NoAnswer | CosflyError):
            raise outcome
    if not any(isinstance(outcome, Caption) for outcome in outcomes):
        what, got = "none of the trial windows got an answer", next(map(str, outcomes), "no window")
        raise TeacherError(what, where=cfg.teacher, got=got)
    for (sample_id, of_window), outcome in zip(exchanges.items(), outcomes, strict=True):
        yield f"=== {sample_id} ==="
        shown: dict[str, int] = {}
        for number, (request, reply) in enumerate(of_window, 1):
            yield from _question_lines(number, request, shown)
            yield from _answer_lines(number, reply)
        yield "--- outcome ---"
        if isinstance(outcome, Caption):
            yield from _outcome_lines(outcome)
        else:
            yield f"no answer: {for_terminal(str(outcome))}"
    num_accepted = sum(isinstance(outcome, Caption) and outcome.status == "accepted" for outcome in outcomes)
    if not num_accepted:
        yield "fix: no window was accepted; use a larger model, or one that was trained on such captions"
    yield f"=== {num_accepted} of {len(windows)} windows accepted, {sum(map(len, exchanges.values()))} answers ==="


def _outcome_lines(caption: Caption) -> Iterator[str]:
    """Yield the lines about a caption: its status, what was checked, and its texts."""
    reason = caption.drop_reason
    yield caption.status if reason is None else f"dropped because of {reason}: {REASONS[reason]}"
    facts = [("label", caption.label), ("verdict", caption.verdict), *problems_of(caption)]
    for language, answer in (("en", caption.en), ("zh", caption.zh)):
        if answer is not None:
            facts += [(language, text) for text in answer.model_dump().values()]
    yield from (f"{name}: {for_terminal(text)}" for name, text in facts if text is not None)


def _question_lines(number: int, request: Request, shown: dict[str, int]) -> Iterator[str]:
    """Yield the lines of a question: for a picture its number and size, for a long text of an earlier request (`shown`)
    the number of that request."""
    for message in request.messages:
        yield f"--- request {number}, {message['role']} ---"
        content, num_pictures = message["content"], 0
        parts: list[dict] = [{"type": "text", "text": content}] if isinstance(content, str) else content
        for part in parts:
            if part["type"] == "text":
                text = part["text"]
                first = shown.setdefault(text, number) if len(text) > MOST_LOGGED else number
                yield for_terminal(text, LONGEST_LOG) if first == number else f"[as in request {first}]"
            else:
                num_pictures += 1
                yield f"[picture {num_pictures}, {len(part['image_url']['url']) / 1e3:.0f} kB]"


def _answer_lines(number: int, reply: Reply) -> Iterator[str]:
    usage = reply.usage
    tokens = f"{usage.prompt_tokens} tokens in, {usage.completion_tokens} out" if usage else "tokens not reported"
    yield f"--- answer {number} ({tokens}{_problem_of(reply)}) ---"
    yield for_terminal(reply.text, LONGEST_LOG)
    if reply.cut_advice:
        yield f"fix: the answer is cut at caption.endpoint.max_tokens: {reply.cut_advice}"


def _problem_of(reply: Reply) -> str:
    """Return why an answer has no JSON object, after a comma; "" if it has one."""
    reason = find_object(reply.text, FIELDS, reply.finish_reason).reason
    return f", {reason.replace('_', ' ')}" if reason else ""
