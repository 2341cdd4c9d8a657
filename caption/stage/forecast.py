"""`cosfly caption --plan`: calls, tokens, time and money of a run, estimated from a few trial windows.

The trial windows are real ones, spread over the tracks. Their answers stay in the journal, so the run does not ask for
them again.
"""

from __future__ import annotations

import asyncio
from itertools import islice
from pathlib import Path

from caption.schema import CaptionConfig
from caption.stage.asking import ANSWERS
from caption.stage.progress import duration
from caption.stage.stage import open_stage
from caption.stage.tracks import find_inputs
from caption.stage.window_loop import caption_window
from caption.teachers.prompt_files import vocabulary_of
from caption.teachers.students import student_settings
from caption.teachers.teacher import first_budget, open_teacher
from cosfly.formats.captions import Caption, Usage
from cosfly.formats.places import flight_of
from cosfly.llm.answers import AnswerBook
from cosfly.llm.contract import run_until_interrupted
from cosfly.runtime.errors import ConfigError, InputError, TeacherError
from cosfly.runtime.run_dir import Resume

TRIAL_WINDOWS = 6


def make_forecast(
    cfg: CaptionConfig, data: Path, out: Path, *, seed: int = 0, resume: Resume = "if-same"
) -> list[tuple[str, str]]:
    """Return the rows of a table: the cost of a run, scaled from the means of a few windows."""
    if cfg.teacher_kind != "endpoint":
        raise ConfigError(
            "an estimate needs a server as the teacher", where="--plan", got=cfg.teacher, expected="--teacher URL"
        )
    vocabulary = vocabulary_of(cfg)
    cfg = student_settings(cfg, vocabulary)
    stage = open_stage(cfg, data, out, seed, resume)
    tracks, _ = find_inputs(cfg, data)
    guesses = {track: track.guess_num_windows(cfg.window) for track in tracks}
    left = [track for track in tracks if guesses[track] and not stage.is_complete and not track.part(out).exists()]
    num_windows = sum(guesses[track] for track in left)
    if not num_windows:
        raise InputError("no window is left to caption", where=data, got=f"{len(left)} unfinished tracks")
    chosen = [left[number * len(left) // TRIAL_WINDOWS] for number in range(TRIAL_WINDOWS)]
    windows = [w for track in dict.fromkeys(chosen) for w in islice(track.windows(cfg), chosen.count(track))]

    async def ask() -> tuple[list[Caption | BaseException], float]:
        with AnswerBook(out / ANSWERS) as book:
            async with open_teacher(cfg, book, seed, first_budget(cfg, book.totals)) as teacher:
                asked = [caption_window(window, teacher, cfg, vocabulary) for window in windows]
                found = await asyncio.gather(*asked, return_exceptions=True)
            ids = [one.sample_id for one in found if isinstance(one, Caption)]
            return found, sum(book.latency_s(flight_of(sample_id), sample_id) for sample_id in ids)

    found, seconds = run_until_interrupted(ask())
    captions = [one for one in found if isinstance(one, Caption)]
    if not captions:
        raise TeacherError(
            "none of the trial windows got an answer", where=cfg.teacher, got=str(found[0]) if found else None
        )
    scale = num_windows / len(captions)
    usage = sum((caption.usage for caption in captions), Usage())
    prompt, completion = scale * usage.prompt_tokens, scale * usage.completion_tokens
    is_priced = cfg.budget.price_prompt or cfg.budget.price_completion
    cost = f"{cfg.budget.cost(prompt, completion):,.2f}" if is_priced else "no prices set (budget.price_prompt)"
    num_accepted = sum(caption.status == "accepted" for caption in captions)
    num_done = sum(guesses.values()) - num_windows
    return [
        ("windows", f"about {num_windows:,} left" + (f", {num_done:,} done" if num_done else "")),
        ("trial", f"{len(captions)} windows, {num_accepted} accepted; their answers are kept"),
        ("requests", f"{scale * sum(caption.attempts for caption in captions):,.0f}"),
        ("tokens in", f"{prompt:,.0f}"),
        ("tokens out", f"{completion:,.0f}"),
        ("cost", cost),
        ("time", f"{duration(scale * seconds / cfg.most_in_flight)} with {cfg.most_in_flight} requests in flight"),
    ]
