"""The terminal: one console that log lines and progress bars share, so that neither breaks the other."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from cosfly.runtime.escaping import LONGEST_LOG, for_terminal


class _Console(Console):
    """Prints plain text: no markup and no control characters, because a text may come from a server."""

    def __init__(self, *, stderr: bool) -> None:
        super().__init__(stderr=stderr, markup=False, highlight=False, emoji=False)

    def render_str(self, text: str, **kwargs: Any) -> Text:
        """Return plain text with control characters escaped; rich calls this for each `str` that it prints."""
        return super().render_str(for_terminal(text, LONGEST_LOG), **kwargs)


console = _Console(stderr=True)
answer_console = _Console(stderr=False)  # for the result of a command
log = logging.getLogger(__name__)

# Progress as log lines where there is no terminal.
SECONDS_BETWEEN_LINES = 10.0
SECONDS_OF_SILENCE = 30.0  # until a line says that nothing has changed; each next one after twice the time


class _Lines(logging.Handler):
    """Writes a record as one line of any length, because a pipe has no width."""

    def emit(self, record: logging.LogRecord) -> None:
        console.print(self.format(record), soft_wrap=True)


def set_up_logging(level: int) -> None:
    """Send log lines of a level to the shared console, with times where it is no terminal."""
    with_time = logging.Formatter("%(asctime)s %(levelname)-8s %(message)s", "%Y-%m-%dT%H:%M:%S%z")
    handler = _Lines(level)
    handler.setFormatter(logging.Formatter("%(levelname)-8s %(message)s") if console.is_terminal else with_time)
    logging.basicConfig(handlers=[handler], force=True)
    set_levels(level)


def set_levels(level: int) -> None:
    """Set the level of our own log lines; libraries log warnings only."""
    logging.getLogger().setLevel(level)
    # Some HTTP clients log whole requests, with the key in them.
    libraries = "httpx httpcore httpx2 httpcore2 huggingface_hub urllib3 numba PIL asyncio"
    for library in libraries.split():
        logging.getLogger(library).setLevel(logging.WARNING)


Advance = Callable[..., None]  # advance(count, words=""): moves a bar and sets the words next to it


@contextlib.contextmanager
def progress_bar(label: str, total: int | None, done: int = 0) -> Iterator[Advance]:
    """Yield a function that shows progress: as a bar on a terminal, else as log lines, also while nothing changes."""
    if console.is_terminal:
        name = TextColumn("{task.description}", markup=False)
        columns = (name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task(label, total=total, completed=done)

            def move(count: int, words: str = "") -> None:
                progress.update(task, advance=count, description=f"{label}  {words}" if words else None)

            yield move
        return
    state = (done, "")

    def advance(count: int, words: str = "") -> None:
        nonlocal state
        state = (state[0] + count, words)

    def write_lines() -> None:
        shown, changed_s, next_line_s = state, time.monotonic(), SECONDS_OF_SILENCE
        while not ended.wait(SECONDS_BETWEEN_LINES):
            unchanged_s = time.monotonic() - changed_s
            if state != shown:
                shown, changed_s, next_line_s = state, time.monotonic(), SECONDS_OF_SILENCE
                since = ""
            elif unchanged_s >= next_line_s:
                next_line_s *= 2
                since = f", no change for {duration(unchanged_s)}"
            else:
                continue
            position, words = shown
            of_all = "" if total is None else f" of {total}"
            log.info("%s: %d%s%s%s", label, position, of_all, f", {words}" if words else "", since)

    ended = threading.Event()
    threading.Thread(target=write_lines, daemon=True).start()
    try:
        yield advance
    finally:
        ended.set()


def duration(seconds: float) -> str:
    """Return a time in its usual unit: 42 s, 7 min, 3.4 h, 2.1 days."""
    if seconds < 120:
        return f"{max(seconds, 0):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172_800 else f"{seconds / 86_400:.1f} days"
