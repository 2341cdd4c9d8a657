"""What an endpoint run shows while it works: windows by outcome, tokens, cost, rate, time left; and a closing table.

On a terminal a live panel on the shared console, elsewhere a log line every few seconds.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable

from rich.console import RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from cosfly.chat.budget import Budget
from cosfly.console import SECONDS_BETWEEN_LINES, console
from cosfly.products.captions import Caption

log = logging.getLogger(__name__)

REFRESHES_PER_S = 4


class Display:
    """Counts outcomes and shows them. Use as a context manager."""

    def __init__(
        self,
        total: int,
        budget: Budget,
        clock: Callable[[], float] = time.monotonic,
        *,
        of_judge: Counter[str] | None = None,
    ) -> None:
        """
        Args:
            total: windows of the run, as far as known; `correct_total` mends it.
            of_judge: the judge's share of `budget.totals`.
        """
        self.total, self.budget = total, budget
        self._of_judge = Counter() if of_judge is None else of_judge
        self._of_judge_before = Counter(self._of_judge)
        self.num_before = 0  # windows of flights that were finished earlier
        self.num_accepted = self.num_repaired = self.num_unanswered = 0
        self.dropped: Counter[str] = Counter()
        self._clock = clock
        self._start_s = self._line_s = clock()
        self._answers_before = Counter(budget.totals)
        self._spent_before = budget.spent
        self._live: Live | None = None

    @property
    def num_now(self) -> int:
        """Windows that this run finished, with or without success."""
        return self.num_accepted + sum(self.dropped.values()) + self.num_unanswered

    @property
    def num_done(self) -> int:
        return self.num_before + self.num_now

    def skip(self, num_windows: int) -> None:
        """Note a flight that was finished before."""
        self.num_before += num_windows
        self._update()

    def correct_total(self, guessed: int, found: int) -> None:
        self.total += found - guessed

    def finish(self, caption: Caption) -> None:
        if caption.status == "accepted":
            self.num_accepted += 1
            self.num_repaired += caption.repair is not None
        else:
            self.dropped[str(caption.drop_reason)] += 1
        self._update()

    def miss(self) -> None:
        """Note a window without an answer."""
        self.num_unanswered += 1
        self._update()

    # --- figures ---

    @property
    def rate_per_s(self) -> float:
        return self.num_now / max(self._clock() - self._start_s, 1e-9)

    @property
    def left_s(self) -> float | None:
        """Seconds to go at the rate so far; None before the first window."""
        return (self.total - self.num_done) / self.rate_per_s if self.num_now else None

    def tokens(self) -> tuple[int, int]:
        """Give the prompt and answer tokens of this run."""
        return self._of_this_run(self.budget.totals, self._answers_before)

    @staticmethod
    def _of_this_run(now: Counter[str], before: Counter[str]) -> tuple[int, int]:
        return now["prompt_tokens"] - before["prompt_tokens"], now["completion_tokens"] - before["completion_tokens"]

    def line(self) -> str:
        prompt, completion = self.tokens()
        left = "?" if self.left_s is None else duration(self.left_s)
        cost = f", cost {self.budget.spent - self._spent_before:.2f}" if self._is_priced else ""
        return (
            f"caption: {self.num_done:,} of {self.total:,} windows; accepted {self.num_accepted:,} "
            f"(repaired {self.num_repaired:,}), dropped {_counts(self.dropped)}, no answer {self.num_unanswered:,}; "
            f"tokens {prompt:,} in {completion:,} out{cost}; {self.rate_per_s:.2f} windows/s, {left} left"
        )

    @property
    def _is_priced(self) -> bool:
        return self.budget.cfg.price_prompt > 0 or self.budget.cfg.price_completion > 0

    # --- showing ---

    def _update(self) -> None:
        if self._live is None and self._clock() - self._line_s >= SECONDS_BETWEEN_LINES:
            self._line_s = self._clock()
            log.info("%s", self.line())

    def panel(self) -> RenderableType:
        """Give what stands on a terminal: the bar, which counts windows, and the figures below it."""
        grid = Table.grid()
        grid.add_row(ProgressBar(total=max(self.total, 1), completed=self.num_done, width=48))
        for part in self.line().split("; "):
            grid.add_row(Text(part, overflow="fold"))
        return grid

    def closing_table(self) -> Table:
        """Give what this run did, for the end of it."""
        table = Table(title="What the teacher did in this run", title_justify="left", show_header=False)
        prompt, completion = self.tokens()
        table.add_row("windows", f"{self.num_now:,} now, {self.num_before:,} before, {self.total:,} in all")
        table.add_row("accepted", f"{self.num_accepted:,}, of these repaired {self.num_repaired:,}")
        for reason, count in self.dropped.most_common():
            table.add_row("dropped", f"{count:,} {reason}")
        if self.num_unanswered:
            table.add_row("no answer", f"{self.num_unanswered:,}")
        num_answers = self.budget.totals["answers"] - self._answers_before["answers"]
        table.add_row("answers", f"{num_answers:,}")
        table.add_row("tokens", f"{prompt:,} in, {completion:,} out")
        if self._of_judge["answers"]:
            prompt, completion = self._of_this_run(self._of_judge, self._of_judge_before)
            table.add_row("of these the judge's", f"{prompt:,} in, {completion:,} out")
        if self._is_priced:
            spent = self.budget.spent
            table.add_row("cost", f"{spent - self._spent_before:.4f} now, {spent:.4f} in this folder so far")
        table.add_row("time", f"{duration(self._clock() - self._start_s)}, {self.rate_per_s:.2f} windows/s")
        return table

    def __enter__(self) -> Display:
        if console.is_terminal:
            self._live = Live(
                get_renderable=self.panel, console=console, transient=True, refresh_per_second=REFRESHES_PER_S
            )
            self._live.start()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._live is not None:
            self._live.stop()
            console.print(self.closing_table())
        elif self.num_now:
            log.info("%s", self.line())


def duration(seconds: float) -> str:
    """Give a time as people say it: 42 s, 7 min, 3.4 h, 2.1 days."""
    for limit, unit_s, unit in ((90, 1, "s"), (5400, 60, "min"), (172_800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / unit_s:.0f} {unit}" if unit != "h" else f"{seconds / unit_s:.1f} h"
    return f"{seconds / 86_400:.1f} days"


def _counts(counts: Counter[str]) -> str:
    total = sum(counts.values())
    listed = ", ".join(f"{reason} {count}" for reason, count in counts.most_common(4))
    return f"{total:,}" + (f" ({listed})" if listed else "")
