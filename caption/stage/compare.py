"""`compare-strategies`: the four strategies of regeneration on the same conflicts (fig:regen_strategy).

Reads a playback tree, writes `compare_strategies.json` and, for an endpoint, its journal of answers. A data set uses
none of it.
"""

import asyncio
import contextlib
import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from difflib import SequenceMatcher
from pathlib import Path
from statistics import fmean
from typing import get_args

from caption.schema import CaptionConfig, Strategy, Window
from caption.stage.asking import ANSWERS
from caption.stage.tracks import find_inputs
from caption.stage.window_loop import WindowLoop
from caption.teachers.prompt_files import Vocabulary, vocabulary_of
from caption.teachers.teacher import Teacher, open_teacher
from cosfly.formats.captions import Coc, Verdict
from cosfly.llm.answers import AnswerBook, Budget
from cosfly.llm.contract import NoAnswer, run_until_interrupted
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.json_io import write_json

STRATEGIES: tuple[Strategy, ...] = get_args(Strategy)
RESULT = "compare_strategies.json"
COLUMNS = ("strategy", "repaired", "consistency", "naturalness", "requests each", "tokens each")


@dataclass(frozen=True)
class Trial:
    """One conflict and its regeneration by a strategy, without the mirror."""

    first: Coc
    last: Coc | None  # None if the regeneration failed
    verdict: Verdict | None  # on the last answer
    asks: int  # of the regeneration, as its tokens
    tokens: int


@dataclass(frozen=True)
class Comparison:
    """The results of one strategy on all conflicts."""

    strategy: Strategy
    num_conflicts: int
    repaired: int  # conflicts with a new answer that is not rejected
    consistency: float  # share of the conflicts whose new decision is the label
    # Mean share of words that a new text has in common with the free one, which is natural while a constraint changes
    # it; None if nothing was repaired.
    naturalness: float | None
    asks_per_conflict: float
    tokens_per_conflict: float

    @property
    def row(self) -> tuple[str, ...]:
        """The row of a table of these COLUMNS."""
        natural = "-" if self.naturalness is None else f"{100 * self.naturalness:.1f} %"
        per_conflict = (f"{self.asks_per_conflict:.2f}", f"{self.tokens_per_conflict:.0f}")
        return (self.strategy, str(self.repaired), f"{100 * self.consistency:.1f} %", natural, *per_conflict)


def words_in_common(first: Coc, second: Coc) -> float:
    """Return the share of words that two texts have in common, in order: 1 for equal texts."""

    def words(coc: Coc) -> list[str]:
        return f"{coc.critical_components} {coc.reasoning_trace}".split()

    return SequenceMatcher(None, words(first), words(second), autojunk=False).ratio()


def compare(strategy: Strategy, trials: Sequence[Trial]) -> Comparison:
    """Return the results of a strategy over at least one trial."""
    repaired = [(trial.first, trial.last) for trial in trials if trial.last is not None]
    consistent = sum(trial.last is not None and trial.verdict == "CONSISTENT" for trial in trials)
    return Comparison(
        strategy=strategy, num_conflicts=len(trials), repaired=len(repaired),
        consistency=round(consistent / len(trials), 3),
        naturalness=round(fmean(itertools.starmap(words_in_common, repaired)), 3) if repaired else None,
        asks_per_conflict=round(fmean(trial.asks for trial in trials), 3),
        tokens_per_conflict=round(fmean(trial.tokens for trial in trials), 1),
    )  # fmt: skip


def run(cfg: CaptionConfig, data: Path, out: Path, *, seed: int = 0, conflicts: int = 50) -> list[Comparison]:
    """Find so many conflicts among the free answers and regenerate each by every strategy. ConfigError: The captions
    come from a file. InputError: There is no conflict. TeacherError: The endpoint fails."""
    if cfg.caption_file is not None:
        fix = "pass --teacher rules, a URL or vllm:MODEL_DIR"
        raise ConfigError("captions of a file cannot be regenerated", where="--teacher", got=cfg.teacher, fix=fix)
    out.mkdir(parents=True, exist_ok=True)
    num_windows, trials = run_until_interrupted(_try_all(cfg, vocabulary_of(cfg), data, out, seed, conflicts))
    if not trials:
        what, fix = "the first answers have no conflict, so there is nothing to compare", "pass another --teacher"
        raise InputError(what, where=data, got=f"{num_windows} windows without conflict", fix=fix)
    comparisons = list(map(compare, STRATEGIES, zip(*trials, strict=True)))
    value = {
        "schema": "cosfly.compare_strategies", "schema_version": "2.0", "teacher": cfg.teacher_kind,
        "windows": num_windows, "strategies": [asdict(comparison) for comparison in comparisons],
    }  # fmt: skip
    write_json(out / RESULT, value)
    return comparisons


async def _try_all(
    cfg: CaptionConfig, vocabulary: Vocabulary, data: Path, out: Path, seed: int, most: int
) -> tuple[int, list[list[Trial]]]:
    """Return the number of windows asked about, and for each of at most `most` conflicts a trial of each strategy."""
    trials: list[list[Trial]] = []
    num_windows = 0
    tracks, _ = find_inputs(cfg, data)
    windows = (window for track in tracks for window in track.windows(cfg) if window.problem is None)
    with AnswerBook(out / ANSWERS) as book:  # the first answer is asked for once for all strategies
        budget = Budget(cfg.budget, cfg.most_in_flight, book.totals)
        async with open_teacher(cfg, book, seed, budget) as teacher:
            while len(trials) < most and (batch := list(itertools.islice(windows, cfg.most_in_flight))):
                num_windows += len(batch)
                tried = await asyncio.gather(*(_try_each(window, teacher, cfg, vocabulary) for window in batch))
                trials += [of_window for of_window in tried if of_window]
    return num_windows, trials[:most]


async def _try_each(window: Window, teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary) -> list[Trial]:
    """Return a trial of each strategy; none if the free answer is not in conflict or an answer is missing."""
    trials: list[Trial] = []
    with contextlib.suppress(NoAnswer):
        for strategy in STRATEGIES:
            if (trial := await try_strategy(window, teacher, cfg, vocabulary, strategy)) is None:
                break
            trials.append(trial)
    return trials if len(trials) == len(STRATEGIES) else []


async def try_strategy(
    window: Window, teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary, strategy: Strategy
) -> Trial | None:
    """Repair the first answer of a window by a strategy; None if it is not rejected. NoAnswer: There is none."""
    repair = cfg.repair.model_copy(update={"strategy": strategy})
    loop = WindowLoop(window, teacher, cfg.model_copy(update={"repair": repair}), vocabulary)
    reason = await loop.ask_freely(loop.answered)
    if reason is not None or repair.treatment_of(loop.caption.verdict) == "keep" or loop.label is None:
        return None
    caption, first = loop.caption, loop.english.coc
    asks_before, tokens_before = caption.attempts, caption.usage.total
    try:
        reason = await loop.regenerate(loop.answered)
    except NoAnswer as error:  # a teacher without a reason for the label has not repaired the conflict
        if not error.is_final:
            raise
        reason = error.cause
    last = loop.english.coc if reason is None else None
    return Trial(first, last, caption.verdict, caption.attempts - asks_before, caption.usage.total - tokens_before)
