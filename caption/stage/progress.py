"""What a run that asks a model shows: windows by outcome, tokens, cost, rate, time left.

On a terminal it is a live panel on the shared console, elsewhere a log line every few seconds.
"""

from __future__ import annotations

import logging
import statistics
import time
from collections import Counter, deque

from rich.console import RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from cosfly.formats.captions import Caption
from cosfly.llm.answers import Budget
from cosfly.llm.contract import Troubles
from cosfly.runtime.console import SECONDS_BETWEEN_LINES, console

log = logging.getLogger(__name__)

REFRESHES_PER_S = 4
MOST_DURATIONS = 256  # durations of the last windows, whose mean gives the time left


class Display:
    """Counts outcomes and shows them. Use as a context manager.

    The attributes `total` (windows of the run), `num_open` (windows in work) and `num_before` (windows of earlier runs)
    are set by its user.
    """

    def __init__(self, total: int, budget: Budget, troubles: Troubles) -> None:
        self.total, self.budget, self.troubles = total, budget, troubles
        self.num_open = self.num_before = 0
        self.num_accepted = self.num_repaired = self.num_unanswered = 0
        self.dropped: Counter[str] = Counter()
        self._durations_s: deque[float] = deque(maxlen=MOST_DURATIONS)
        self._start_s = self._line_s = time.monotonic()
        self._totals_before = Counter(budget.totals)
        self._spent_before = budget.spent
        self._live: Live | None = None

    def finish(self, caption: Caption, duration_s: float) -> None:
        """Count a caption. duration_s: Time of its window in work."""
        self._durations_s.append(duration_s)
        if caption.status == "accepted":
            self.num_accepted += 1
            self.num_repaired += caption.repair is not None
        else:
            self.dropped[str(caption.drop_reason)] += 1
        self.update()

    @property
    def num_now(self) -> int:
        """Windows that this run finished, with or without success."""
        return self.num_accepted + self.dropped.total() + self.num_unanswered

    @property
    def num_done(self) -> int:
        return self.num_before + self.num_now

    @property
    def left_s(self) -> float | None:
        """Seconds to go; None before the first window is finished.

        By Little's law the rate is the number of windows in work over the duration of one. The mean rate since the
        start is ten times too low at first, because no window can be finished yet. Windows in work count as half done.
        """
        if self.num_done >= self.total:
            return 0.0
        if not self._durations_s or not self.num_open:
            return None
        num_left = max(0.0, self.total - self.num_done - self.num_open / 2.0)
        return num_left * statistics.fmean(self._durations_s) / self.num_open

    def figures(self) -> list[str]:
        """Return the figures, each as a text."""
        budget, left_s = self.budget, self.left_s
        tokens = Counter(budget.totals)
        tokens.subtract(self._totals_before)
        used = f"tokens {tokens['prompt_tokens']:,} in {tokens['completion_tokens']:,} out"
        if budget.cfg.price_prompt or budget.cfg.price_completion:
            used += f", cost {budget.spent - self._spent_before:.2f}"
        reasons = ", ".join(f"{reason} {count}" for reason, count in self.dropped.most_common(4))
        dropped = f"dropped {self.dropped.total():,}" + (f" ({reasons})" if reasons else "")
        rate_per_s = self.num_now / max(time.monotonic() - self._start_s, 1e-9)
        figures = [
            f"caption: {self.num_done:,} of {self.total:,} windows",
            f"accepted {self.num_accepted:,} (repaired {self.num_repaired:,}), {dropped}, "
            f"no answer {self.num_unanswered:,}",
            used,
            f"{rate_per_s:.2f} windows/s, {'?' if left_s is None else duration(left_s)} left",
        ]
        troubles = self.troubles
        if troubles.last is not None:
            silent = f"no answer for {duration(troubles.silent_s)}, the last: {troubles.last}"
            figures.append(f"{troubles.num:,} failed tries, {silent}")
        elif troubles.num:
            figures.append(f"{troubles.num:,} failed tries")
        return figures

    def update(self) -> None:
        """Log a line if it is time for one; a live panel updates itself."""
        if self._live is None and time.monotonic() - self._line_s >= SECONDS_BETWEEN_LINES:
            self._line_s = time.monotonic()
            log.info("%s", "; ".join(self.figures()))

    def _panel(self) -> RenderableType:
        grid = Table.grid()
        grid.add_column(overflow="fold")
        grid.add_row(ProgressBar(total=max(self.total, 1), completed=self.num_done, width=48))
        for figure in self.figures():
            grid.add_row(figure)
        return grid

    def __enter__(self) -> Display:
        if console.is_terminal:
            self._live = Live(
                get_renderable=self._panel, console=console, transient=True, refresh_per_second=REFRESHES_PER_S
            )
            self._live.start()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._live is not None:
            self._live.stop()
        if self.num_now or self.troubles.num:
            log.info("%s", "; ".join(self.figures()))


def duration(seconds: float) -> str:
    """Return a time in its usual unit: 42 s, 7 min, 3.4 h, 2.1 days."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172_800 else f"{seconds / 86_400:.1f} days"
