"""Ctrl-C while requests are in flight, sent to a real process at moments that it names itself."""

import asyncio
import signal
import subprocess
import sys

import pytest

from cosfly.llm.contract import run_until_interrupted

CHILD = """
import asyncio, sys
from cosfly.llm.contract import run_until_interrupted

async def ask():
    await asyncio.sleep(3600)

async def main():
    tasks = [asyncio.create_task(ask()) for _ in range(20)]
    print("asking", flush=True)
    try:
        await asyncio.gather(*tasks)
    finally:
        print("ending", flush=True)
        if "hang" in sys.argv:
            await asyncio.sleep(3600)

try:
    run_until_interrupted(main())
except KeyboardInterrupt:
    print("ended", flush=True)
    sys.exit(7)
"""


def interrupted(*words: str) -> tuple[int, list[str], str]:
    """Interrupt a process when it asks, and if it hangs again when it ends: its status, what it said and complained
    of."""
    with subprocess.Popen(
        [sys.executable, "-X", "dev", "-c", CHILD, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        said = []
        for line in process.stdout:
            said.append(line.strip())
            if said[-1] == "asking" or (said[-1] == "ending" and "hang" in words):
                process.send_signal(signal.SIGINT)
        _, complained = process.communicate(timeout=60)
        return process.returncode, said, complained


def test_once_ends_everything_in_order():
    assert interrupted() == (7, ["asking", "ending", "ended"], "")


def test_twice_ends_the_process_in_one_line():
    status, said, complained = interrupted("hang")
    assert (status, said) == (130, ["asking", "ending"])
    assert (
        complained == "error: interrupted at once; what was answered is kept: run the same command again to continue\n"
    )


def test_without_it_all_is_as_ever():
    async def answer() -> int:
        return 3

    async def fail() -> None:
        raise ValueError("as it is")

    async def give_up() -> None:
        raise asyncio.CancelledError

    assert run_until_interrupted(answer()) == 3
    with pytest.raises(ValueError, match="as it is"):
        run_until_interrupted(fail())
    with pytest.raises(asyncio.CancelledError):
        run_until_interrupted(give_up())
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
