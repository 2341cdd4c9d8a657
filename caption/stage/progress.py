"""What an endpoint run shows while it works: windows by outcome, tokens, cost, rate, time left.

On a terminal a live panel on the shared console, elsewhere a log line every few seconds.
"""

from __future__ import annotations

import contextlib
import logging
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator

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
MOST_DURATIONS = 256  # of the windows finished last, whose mean tells how long one takes


class Display:
    """Counts outcomes and shows them. Use as a context manager."""

    def __init__(
        self,
        total: int,
        budget: Budget,
        clock: Callable[[], float] = time.monotonic,
        *,
        troubles: Troubles | None = None,
    ) -> None:
        """
        Args:
            total: windows of the run, as far as known; `correct_total` mends it.
            troubles: what the server fails at.
        """
        self.total, self.budget, self.troubles = total, budget, troubles or Troubles()
        self.num_before = 0  # windows of flights that were finished earlier
        self.num_accepted = self.num_repaired = self.num_unanswered = 0
        self.dropped: Counter[str] = Counter()
        self.num_open = 0  # windows in work
        self._durations_s: deque[float] = deque(maxlen=MOST_DURATIONS)
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
        self.update()

    def correct_total(self, guessed: int, found: int) -> None:
        self.total += found - guessed

    @contextlib.contextmanager
    def window(self) -> Iterator[None]:
        """Hold while a window is worked on."""
        self.num_open += 1
        try:
            yield
        finally:
            self.num_open -= 1

    def finish(self, caption: Caption, duration_s: float) -> None:
        """Note a window's caption, and how long it was worked on."""
        self._durations_s.append(duration_s)
        if caption.status == "accepted":
            self.num_accepted += 1
            self.num_repaired += caption.repair is not None
        else:
            self.dropped[str(caption.drop_reason)] += 1
        self.update()

    def miss(self) -> None:
        """Note a window without an answer."""
        self.num_unanswered += 1
        self.update()

    # --- figures ---

    @property
    def rate_per_s(self) -> float:
        return self.num_now / max(self._clock() - self._start_s, 1e-9)

    @property
    def left_s(self) -> float | None:
        """Seconds to go; None before the first window is finished.

        By Little's law the rate is the number of windows in work, which are half done on average, over the time that
        one takes. The
        mean rate since the start would count the time in which none could be finished yet: it is ten times too low at
        first.
        """
        if self.num_done >= self.total:
            return 0.0
        if not self._durations_s or not self.num_open:
            return None
        num_left = max(0.0, self.total - self.num_done - self.num_open / 2.0)
        return num_left * statistics.fmean(self._durations_s) / self.num_open

    def tokens(self) -> tuple[int, int]:
        """Return the prompt and answer tokens of this run."""
        now, before = self.budget.totals, self._answers_before
        return now["prompt_tokens"] - before["prompt_tokens"], now["completion_tokens"] - before["completion_tokens"]

    def line(self) -> str:
        return "; ".join(self._parts())

    def _parts(self) -> list[str]:
        prompt, completion = self.tokens()
        left = "?" if self.left_s is None else duration(self.left_s)
        cost = f", cost {self.budget.spent - self._spent_before:.2f}" if self._is_priced else ""
        parts = [
            f"caption: {self.num_done:,} of {self.total:,} windows",
            f"accepted {self.num_accepted:,} (repaired {self.num_repaired:,}), dropped {_counts(self.dropped)}, "
            f"no answer {self.num_unanswered:,}",
            f"tokens {prompt:,} in {completion:,} out{cost}",
            f"{self.rate_per_s:.2f} windows/s, {left} left",
        ]
        return parts + ([self._trouble()] if self.troubles.num else [])

    def _trouble(self) -> str:
        """Return how many tries failed and, while no answer comes, for how long and what the server said last."""
        tries = f"{self.troubles.num:,} failed tries"
        if self.troubles.last is None:
            return tries
        return f"{tries}, no answer for {duration(self.troubles.silent_s)}, the last: {self.troubles.last}"

    @property
    def _is_priced(self) -> bool:
        return self.budget.cfg.price_prompt > 0 or self.budget.cfg.price_completion > 0

    # --- showing ---

    def update(self) -> None:
        """Show what there is, where it is time for it."""
        if self._live is None and self._clock() - self._line_s >= SECONDS_BETWEEN_LINES:
            self._line_s = self._clock()
            log.info("%s", self.line())

    def panel(self) -> RenderableType:
        """Return what stands on a terminal: the bar, which counts windows, and the figures below it."""
        grid = Table.grid()
        grid.add_column(overflow="fold")
        grid.add_row(ProgressBar(total=max(self.total, 1), completed=self.num_done, width=48))
        for part in self._parts():
            grid.add_row(part)
        return grid

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
        if self.num_now or self.troubles.num:
            log.info("%s", self.line())


def duration(seconds: float) -> str:
    """Return a time as people say it: 42 s, 7 min, 3.4 h, 2.1 days."""
    for limit, unit_s, unit in ((90, 1, "s"), (5400, 60, "min"), (172_800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / unit_s:.0f} {unit}" if unit != "h" else f"{seconds / unit_s:.1f} h"
    return f"{seconds / 86_400:.1f} days"


def _counts(counts: Counter[str]) -> str:
    total = sum(counts.values())
    listed = ", ".join(f"{reason} {count}" for reason, count in counts.most_common(4))
    return f"{total:,}" + (f" ({listed})" if listed else "")
