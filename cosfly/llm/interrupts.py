"""Ctrl-C while many requests are in flight: once ends them in order, twice ends the process at once."""

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
    """Run a coroutine to its end, as `asyncio.run` does.

    The library's own second Ctrl-C breaks into what ends the tasks, which then speak of themselves for pages; journals
    bear an end at any moment, so ours ends the process.

    Raises:
        KeyboardInterrupt: after the first Ctrl-C, when everything is ended.
    """
    count = 0

    async def guarded() -> Result:
        task, loop = asyncio.current_task(), asyncio.get_running_loop()

        def interrupt() -> None:
            nonlocal count
            count += 1
            if count > 1:
                os.write(2, AT_ONCE)
                os._exit(130)
            assert task is not None
            task.cancel()

        loop.add_signal_handler(signal.SIGINT, interrupt)
        try:
            return await main
        finally:
            if count == 0:  # else it stays until the last task has ended
                loop.remove_signal_handler(signal.SIGINT)

    if threading.current_thread() is not threading.main_thread():
        return asyncio.run(main)  # nobody interrupts it
    try:
        return asyncio.run(guarded())
    except asyncio.CancelledError:
        if count:
            raise KeyboardInterrupt from None
        raise
