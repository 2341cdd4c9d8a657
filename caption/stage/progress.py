"""The progress of a run that asks a model: windows by outcome, tokens, cost, rate, time left."""

from __future__ import annotations

import contextlib
import logging
import time
from collections import Counter
from collections.abc import Iterator

from cosfly.formats.captions import Caption
from cosfly.llm.answers import Budget
from cosfly.llm.contract import Troubles
from cosfly.runtime.console import Advance, progress_bar
from cosfly.runtime.escaping import for_terminal

log = logging.getLogger(__name__)


@contextlib.contextmanager
def show_progress(total: int | None, budget: Budget, troubles: Troubles) -> Iterator[RunProgress]:
    """Show the progress of a run while it works, and its last state at the end. total: Windows, if known."""
    with progress_bar("caption", total) as advance:
        progress = RunProgress(advance, total, budget, troubles)
        yield progress
    if progress.num_now or troubles.num:
        log.info("caption: %s", progress.figures())


class RunProgress:
    """Counts the outcomes of windows and moves the progress bar."""

    def __init__(self, advance: Advance, total: int | None, budget: Budget, troubles: Troubles) -> None:
        self._advance, self.total, self.budget, self.troubles = advance, total, budget, troubles
        self.num_before = self.num_accepted = self.num_repaired = self.num_unanswered = 0
        self.dropped: Counter[str] = Counter()
        self._start_s = time.monotonic()
        self._tokens_before = Counter(budget.totals)
        self._spent_before = budget.spent

    def skip(self, num_windows: int) -> None:
        """Count windows of an earlier run."""
        self.num_before += num_windows
        self.show(num_windows)

    def finish(self, caption: Caption) -> None:
        """Count a caption."""
        if caption.status == "accepted":
            self.num_accepted += 1
            self.num_repaired += caption.repair is not None
        else:
            self.dropped[str(caption.drop_reason)] += 1
        self.show(1)

    def miss(self) -> None:
        """Count a window without an answer."""
        self.num_unanswered += 1
        self.show(1)

    def show(self, num_windows: int = 0) -> None:
        """Move the progress bar by so many windows, and update its text."""
        self._advance(num_windows, self.figures())

    @property
    def num_now(self) -> int:
        """Windows that this run finished, with or without success."""
        return self.num_accepted + self.dropped.total() + self.num_unanswered

    def figures(self) -> str:
        """Return the figures of the run as a text."""
        budget, troubles = self.budget, self.troubles
        tokens = Counter(budget.totals)
        tokens.subtract(self._tokens_before)
        reasons = ", ".join(f"{reason} {count}" for reason, count in self.dropped.most_common(4))
        rate_per_s = self.num_now / max(time.monotonic() - self._start_s, 1e-9)
        figures = [
            f"accepted {self.num_accepted:,} (repaired {self.num_repaired:,})",
            f"dropped {self.dropped.total():,}" + (f" ({reasons})" if reasons else ""),
            f"no answer {self.num_unanswered:,}",
            f"tokens {tokens['prompt_tokens']:,} in {tokens['completion_tokens']:,} out",
            f"{rate_per_s:.2f} windows/s",
        ]
        if budget.cfg.price_prompt or budget.cfg.price_completion:
            figures.append(f"cost {budget.spent - self._spent_before:.2f}")
        if self.total is not None and self.num_now:
            figures.append(f"{duration((self.total - self.num_before - self.num_now) / rate_per_s)} left")
        if troubles.num:
            figures.append(f"{troubles.num:,} failed attempts")
        if troubles.last is not None:
            figures.append(f"no answer for {duration(troubles.silent_s)}, the last: {for_terminal(troubles.last)}")
        return ", ".join(figures)


def duration(seconds: float) -> str:
    """Return a time in its usual unit: 42 s, 7 min, 3.4 h, 2.1 days."""
    if seconds < 90:
        return f"{max(seconds, 0):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172_800 else f"{seconds / 86_400:.1f} days"
