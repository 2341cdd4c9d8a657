"""The terminal: one console that log lines and progress bars share, so that neither tears the other."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from cosfly.runtime.errors import StorageError
from cosfly.runtime.escaping import LONGEST_LOG, for_terminal


class _Console(Console):
    """Prints what it is given: no markup, and no control character gets through, wherever a text came from."""

    def __init__(self, *, stderr: bool) -> None:
        super().__init__(stderr=stderr, markup=False, highlight=False, emoji=False)

    def render_str(self, text: str, **kwargs: Any) -> Text:
        """Make words of plain text: rich calls this for every `str` that is printed or stands in a table."""
        return super().render_str(for_terminal(text, LONGEST_LOG), **kwargs)


console = _Console(stderr=True)
answer_console = _Console(stderr=False)  # for what a command was asked to tell
log = logging.getLogger(__name__)

SECONDS_BETWEEN_LINES = 10.0  # progress as log lines where there is no terminal


class _Printable(logging.Formatter):
    """Formats a record, whose words may be a server's, as text that a terminal prints."""

    def format(self, record: logging.LogRecord) -> str:
        return for_terminal(super().format(record), LONGEST_LOG)


class _Lines(logging.Handler):
    """Writes a record as one line, however long; in a pipe there is no width to wrap it to."""

    def emit(self, record: logging.LogRecord) -> None:
        console.print(self.format(record), soft_wrap=True)


class _File(logging.FileHandler):
    """Writes records to a file. One that cannot be written any more is told once, and the command goes on without."""

    def handleError(self, record: logging.LogRecord) -> None:  # the name of the library
        logging.getLogger().removeHandler(self)
        log.warning("the log %s cannot be written any more: %s", self.baseFilename, sys.exc_info()[1])


LINE, WHEN = "%(asctime)s %(levelname)-8s %(message)s", "%Y-%m-%dT%H:%M:%S%z"


def set_up_logging(level: int, file: Path | None = None) -> None:
    """Send log lines of a level to the shared console, and all to a file. Called by the command line only.

    In a pipe or a file one record is one line and has its time.
    """
    handler: logging.Handler
    if console.is_terminal:
        handler = RichHandler(console=console, show_path=False, show_time=False, markup=False, rich_tracebacks=False)
        handler.setFormatter(_Printable("%(message)s"))
    else:
        handler = _Lines()
        handler.setFormatter(_Printable(LINE, WHEN))
    handler.setLevel(level)
    handlers: list[logging.Handler] = [handler]
    if file is not None:
        try:
            handlers.append(_File(file, encoding="utf-8"))
        except OSError as error:
            raise StorageError(
                "cannot write the log", where=file, got=error.strerror, fix="choose another --log-file"
            ) from None
        handlers[1].setFormatter(_Printable(LINE, WHEN))
    logging.basicConfig(handlers=handlers, force=True)
    set_levels(logging.DEBUG if file is not None else level)


def set_levels(level: int) -> None:
    """Let our own log lines of a level through; of libraries, which log how they work, warnings only."""
    logging.getLogger().setLevel(level)
    # Of those that speak to servers some log requests whole, with the key in them.
    noisy_ones = "httpx httpcore httpx2 httpcore2 huggingface_hub urllib3"
    for noisy in (*noisy_ones.split(), "numba", "PIL", "asyncio"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


class Advance(Protocol):
    """Tells a bar that so much more is done, and words that stand beside it until there are others."""

    def __call__(self, count: int, told: str = "") -> None: ...


@contextlib.contextmanager
def progress_bar(label: str, total: int | None, done: int = 0) -> Iterator[Advance]:
    """Show progress: a bar on a terminal, else a log line every few seconds; total None: unknown. Yields
    advance(count)."""
    if console.is_terminal:
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console, transient=True) as progress:
            task = progress.add_task(label, total=total, completed=done)

            def move(count: int, told: str = "") -> None:
                progress.update(task, advance=count, description=f"{label}  {told}" if told else None)

            yield move
        return
    position, last_s = done, time.monotonic()

    def advance(count: int, told: str = "") -> None:
        nonlocal position, last_s
        position += count
        if time.monotonic() - last_s >= SECONDS_BETWEEN_LINES:
            last_s = time.monotonic()
            of_all = "" if total is None else f" of {total}"
            log.info("%s: %d%s%s", label, position, of_all, f", {told}" if told else "")

    yield advance
