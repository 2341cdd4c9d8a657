"""Ctrl-C while requests are in flight: the first cancels them in order, the second ends the process."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

Result = TypeVar("Result")

AT_ONCE = b"error: interrupted at once; what was answered is kept: run the same command again to continue\n"


def run_until_interrupted(main: Coroutine[Any, Any, Result]) -> Result:
    """Run a coroutine as `asyncio.run` does, but end the process at a second Ctrl-C.

    asyncio's second Ctrl-C interrupts the cancelled tasks and prints a traceback of each; journals survive an end at
    any time.

    Raises:
        KeyboardInterrupt: After the first Ctrl-C, once all tasks have ended.
    """
    if threading.current_thread() is not threading.main_thread():
        return asyncio.run(main)
    is_interrupted = False

    async def guarded() -> Result:
        task, loop = asyncio.current_task(), asyncio.get_running_loop()

        def interrupt() -> None:
            nonlocal is_interrupted
            if is_interrupted:
                os.write(2, AT_ONCE)
                os._exit(130)
            assert task is not None
            is_interrupted = task.cancel()

        loop.add_signal_handler(signal.SIGINT, interrupt)
        try:
            return await main
        finally:
            if not is_interrupted:  # otherwise it stays until the last task has ended
                loop.remove_signal_handler(signal.SIGINT)

    try:
        return asyncio.run(guarded())
    except asyncio.CancelledError:
        if is_interrupted:
            raise KeyboardInterrupt from None
        raise
