"""The command line: one command per stage, log handlers, tables on the terminal and exit codes.

Nothing heavy is imported before a command runs, so `cosfly --help` is instant.
"""

import importlib
import logging
import os
import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from cosfly import __version__
from cosfly.cli.options import app
from cosfly.runtime.errors import CosflyError

# Exit codes of Ctrl-C, which Typer catches silently, and of SIGTERM.
ENDED = {130: "interrupted", 143: "terminated"}

log = logging.getLogger(__name__)

COMMAND_MODULES = ("run", "stages", "caption", "distill", "release")  # in the order of the help
for module_name in COMMAND_MODULES:  # importing a module adds its commands
    importlib.import_module(f"cosfly.cli.{module_name}")


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log every item.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Log warnings and errors only.")] = False,
) -> None:
    if version:
        typer.echo(f"cosfly {__version__}")
        raise typer.Exit
    from cosfly.runtime.console import set_up_logging

    set_up_logging(logging.DEBUG if verbose else logging.WARNING if quiet else logging.INFO)
    log.debug("cosfly %s, Python %s, in %s", __version__, sys.version.split()[0], Path.cwd())


def main() -> None:
    """Run the command line: a CosflyError is one line and exit 1; a bug keeps its traceback."""
    # As Ctrl-C: workers end, locks are released.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        app()
    except CosflyError as error:
        _fail(str(error), 1)
    except (SystemExit, KeyboardInterrupt) as end:
        # A KeyboardInterrupt arrives here only before Typer has started, which catches it and exits with 130.
        code = end.code if isinstance(end, SystemExit) else 130
        if code in ENDED:
            _fail(f"{ENDED[code]}; finished work is kept; run the same command again to resume", code)
        _end(code)
    except OSError as error:
        from cosfly.runtime.io import DISK_FULL

        if error.filename is not None or error.errno not in DISK_FULL:
            raise
        # An error without a file name is of the command's own output, as in `cosfly config show > FILE`.
        sys.stdout = None  # type: ignore[assignment]  # the rest of the buffer cannot be written at the end either
        _fail(f"cannot write the output; got {error.strerror}; free some space and run the same command again", 1)


def _fail(message: str, status: int) -> None:
    typer.echo(f"error: {message}", err=True)
    _end(status)


def _end(status: int | str | None) -> None:
    """End the process; at once if a launcher started several.

    Threads of libraries abort the interpreter's shutdown now and then (2 in about 200), which a launcher would take
    for a failure of the whole training.
    """
    for number in (signal.SIGINT, signal.SIGTERM):  # a second Ctrl-C during the shutdown would print a traceback
        signal.signal(number, signal.SIG_DFL)
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # a process may be started with a stream closed
            stream.flush()
    if os.environ.get("WORLD_SIZE", "1") != "1" and (status is None or isinstance(status, int)):
        logging.shutdown()
        os._exit(status or 0)
    sys.exit(status)
