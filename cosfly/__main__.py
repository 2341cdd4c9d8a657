"""The command `cosfly`, also `python -m cosfly`, which handles Ctrl-C before it imports large packages."""

import os
import signal
from types import FrameType


def main() -> None:
    """Run the command. Ctrl-C while modules are imported ends the process: an exception there may go anywhere."""
    signal.signal(signal.SIGINT, _end)
    from cosfly import cli

    signal.signal(signal.SIGINT, signal.default_int_handler)
    cli.main()


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, b"error: interrupted before anything was done; run the same command again\n")
    os._exit(128 + number)


if __name__ == "__main__":
    main()
