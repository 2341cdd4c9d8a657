"""Commands in this process, as a user types them."""

import contextlib
from collections.abc import Iterator
from typing import Any
from unittest import mock

from click.testing import Result
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.runtime import pool


def invoke(*words: object) -> Result:
    """Run a command: texts are split at blanks, the words of a list stay as they are."""
    line: list[str] = []
    for word in words:
        line += word.split() if isinstance(word, str) else map(str, word if isinstance(word, list) else [word])
    return CliRunner().invoke(app, line)


def obeyed(*words: object) -> str:
    """Run a command that has to succeed; give what it printed."""
    result = invoke(*words)
    assert result.exit_code == 0, (words, result.output, result.exception)
    return result.output


@contextlib.contextmanager
def working_here() -> Iterator[None]:
    """Work on items in this process, since each worker takes seconds to begin."""

    def work(stage: Any, items: Any, start: Any, workers: int, watch: Any, progress: Any) -> Any:
        return pool._in_this_process(items, start, progress.move)

    with mock.patch.object(pool, "_in_processes", work):
        yield
