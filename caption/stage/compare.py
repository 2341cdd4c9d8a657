"""`compare-strategies`: the four ways of re-generation on the same conflicts.

Reads a playback tree, writes `compare_strategies.json` and, for an endpoint, its journal of answers. Nothing of it
enters a data set. The distance of a repaired text from the first answer stands for naturalness: what a model says
freely is natural, and the further a constraint moves it, the less it is.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from difflib import SequenceMatcher
from pathlib import Path
from typing import get_args

from rich.table import Table

from caption.schema import CaptionConfig, Strategy, Window
from caption.stage.asking import ANSWERS
from caption.stage.flights import allot, named_flights
from caption.stage.window_loop import Trial, try_strategy
from caption.teachers.prompt_files import vocabulary_of
from caption.teachers.teacher import Teacher, first_budget, open_teacher
from caption.verification.vocabulary import Vocabulary
from cosfly.formats.captions import Coc
from cosfly.llm.answers import AnswerBook
from cosfly.llm.contract import NoAnswer, run_until_interrupted
from cosfly.runtime.errors import ConfigError, InputError
from cosfly.runtime.io import refuse_links
from cosfly.runtime.json_io import write_json

STRATEGIES: tuple[Strategy, ...] = get_args(Strategy)
RESULT = "compare_strategies.json"


@dataclass(frozen=True)
class Comparison:
    """One strategy over all conflicts; means are over the conflicts, the distance over those repaired.

    consistent: final decision equals the label. repaired: no longer rejected.
    """

    strategy: Strategy
    num_conflicts: int
    repaired: int
    consistent: int
    text_distance: float | None
    asks_per_conflict: float
    tokens_per_conflict: float


def text_distance(one: Coc, two: Coc) -> float:
    """Return 0 for the same words in the same order, 1 where no word is shared."""
    a, b = (f"{coc.critical_components} {coc.reasoning_trace}".split() for coc in (one, two))
    return 1.0 - SequenceMatcher(None, a, b, autojunk=False).ratio()


def compare(strategy: Strategy, trials: list[Trial]) -> Comparison:
    """Sum up the trials of one strategy."""
    distances = [text_distance(trial.first, trial.last) for trial in trials if trial.last is not None]
    count = max(1, len(trials))
    return Comparison(
        strategy=strategy,
        num_conflicts=len(trials),
        repaired=len(distances),
        consistent=sum(trial.verdict == "CONSISTENT" for trial in trials if trial.last is not None),
        text_distance=round(sum(distances) / len(distances), 3) if distances else None,
        asks_per_conflict=round(sum(trial.asks for trial in trials) / count, 3),
        tokens_per_conflict=round(sum(trial.tokens for trial in trials) / count, 1),
    )


def run(cfg: CaptionConfig, data: Path, out: Path, *, seed: int = 0, conflicts: int = 50) -> list[Comparison]:
    """Find conflicts among the first answers and repair each by every strategy.

    Args:
        conflicts: stop looking after so many.
    Raises:
        ConfigError: the captions are a file's. InputError: no conflict was found. TeacherError: the endpoint cannot be
        used.
    """
    if cfg.caption_file is not None:
        raise ConfigError("captions of a file cannot be asked for again", where="--teacher", got=cfg.teacher)
    out.mkdir(parents=True, exist_ok=True)
    refuse_links(out)
    num_windows, trials = run_until_interrupted(_try_all(cfg, vocabulary_of(cfg), data, out, seed, conflicts))
    if not trials[STRATEGIES[0]]:
        raise InputError("no conflict to repair", where=data, got=f"{num_windows} windows, all without one")
    comparisons = [compare(strategy, trials[strategy]) for strategy in STRATEGIES]
    value = {
        "schema": "cosfly.compare_strategies",
        "schema_version": "1.0",
        "teacher": cfg.teacher_kind,
        "windows": num_windows,
        "strategies": [asdict(comparison) for comparison in comparisons],
    }
    write_json(out / RESULT, value)
    return comparisons


async def _try_all(
    cfg: CaptionConfig, vocabulary: Vocabulary, data: Path, out: Path, seed: int, most: int
) -> tuple[int, dict[Strategy, list[Trial]]]:
    trials: dict[Strategy, list[Trial]] = {strategy: [] for strategy in STRATEGIES}
    num_windows = 0
    with AnswerBook(out / ANSWERS) as book:  # the first answer is asked once for all strategies
        async with open_teacher(cfg, book, seed, first_budget(cfg, book.totals)) as teacher:
            windows = iter(_windows(cfg, data))
            while batch := list(itertools.islice(windows, cfg.most_in_flight)):
                num_windows += len(batch)
                for tried in await asyncio.gather(*(_try_each(window, teacher, cfg, vocabulary) for window in batch)):
                    if tried is not None and len(trials[STRATEGIES[0]]) < most:
                        for strategy in STRATEGIES:
                            trials[strategy].append(tried[strategy])
                if len(trials[STRATEGIES[0]]) >= most:
                    break
    return num_windows, trials


async def _try_each(
    window: Window, teacher: Teacher, cfg: CaptionConfig, vocabulary: Vocabulary
) -> dict[Strategy, Trial] | None:
    """Return a trial per strategy; None where the first answer is no conflict or an answer is missing."""
    found: dict[Strategy, Trial] = {}
    for strategy in STRATEGIES:
        try:
            trial = await try_strategy(window, teacher, cfg, vocabulary, strategy)
        except NoAnswer:
            return None
        if trial is None:
            return None
        found[strategy] = trial
    return found


def _windows(cfg: CaptionConfig, data: Path) -> Iterable[Window]:
    for flight in allot(named_flights(data, cfg.flights), cfg)[0]:
        yield from (window for window in flight.windows(cfg) if window.problem is None)


def comparison_table(comparisons: list[Comparison]) -> Table:
    """Return the comparison as a table for the terminal."""
    table = Table(title=f"Re-generation of the same {comparisons[0].num_conflicts} conflicts", title_justify="left")
    for column in ("strategy", "repaired", "consistent", "text distance", "asks each", "tokens each"):
        table.add_column(column, justify="left" if column == "strategy" else "right", no_wrap=column == "strategy")
    for c in comparisons:
        share = f"{100 * c.consistent / c.num_conflicts:.1f} %"
        distance = "-" if c.text_distance is None else f"{c.text_distance:.3f}"
        table.add_row(
            c.strategy, str(c.repaired), share, distance, f"{c.asks_per_conflict:.2f}", f"{c.tokens_per_conflict:.0f}"
        )
    return table
