"""The terminal: one console that log lines and progress bars share, so that neither tears the other."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

console = Console(stderr=True)
log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 10.0  # progress as log lines where there is no terminal


class _Lines(logging.Handler):
    """Writes a record as one line, however long; in a pipe there is no width to wrap it to."""

    def emit(self, record: logging.LogRecord) -> None:
        console.print(self.format(record), soft_wrap=True, markup=False, highlight=False)


def set_up_logging(verbose: bool) -> None:
    """Send log lines to the shared console; in a pipe or a file one record is one line. Called by the command line only."""
    handler: logging.Handler
    if console.is_terminal:
        handler = RichHandler(console=console, show_path=False, show_time=False, markup=False, rich_tracebacks=False)
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = _Lines()
        handler.setFormatter(logging.Formatter("%(levelname)-8s %(message)s"))
    logging.basicConfig(handlers=[handler], force=True)
    set_levels(logging.DEBUG if verbose else logging.INFO)


def set_levels(level: int) -> None:
    """Let our own log lines of a level through; of libraries, which log how they work, warnings only."""
    logging.getLogger().setLevel(level)
    for noisy in ("httpx", "httpcore", "numba", "PIL", "asyncio", "urllib3"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


@contextlib.contextmanager
def progress_bar(label: str, total: int, done: int = 0) -> Iterator[Callable[[int], None]]:
    """Show progress: a bar on a terminal, a log line every few seconds elsewhere. Yields advance(count)."""
    if console.is_terminal:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task(label, total=total, completed=done)
            yield lambda count: progress.advance(task, count)
        return
    position, last_s = done, time.monotonic()

    def advance(count: int) -> None:
        nonlocal position, last_s
        position += count
        if time.monotonic() - last_s >= SECONDS_BETWEEN_LINES:
            last_s = time.monotonic()
            log.info("%s: %d of %d", label, position, total)

    yield advance
