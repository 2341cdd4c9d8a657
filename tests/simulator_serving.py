"""A simulator's server of ours in a process of its own, and an unmodified client in another, which may crash."""

import contextlib
import random
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from cosfly.formats.boxes import BoxMap, write_boxes


def free_port() -> int:
    """A port that is free, and the next one too, of those that no system gives away by itself before it is used."""
    while True:
        port = random.SystemRandom().randrange(20_000, 32_000)
        with socket.socket() as one, socket.socket() as two, contextlib.suppress(OSError):
            one.bind(("127.0.0.1", port))
            two.bind(("127.0.0.1", port + 1))
            return port


def command(town: Path, port: int, *faults: str, protocol: str = "carla") -> list[str]:
    simulators = str(Path(__file__).with_name("simulators"))
    return [sys.executable, simulators, str(town), "--port", str(port), protocol, *faults]


@contextlib.contextmanager
def serving(box_map: BoxMap, folder: Path, *faults: str, protocol: str = "carla") -> Iterator[int]:
    folder.mkdir(parents=True, exist_ok=True)
    write_boxes(folder / "boxes_3d.json", box_map)
    port = free_port()
    with listening(command(folder / "boxes_3d.json", port, *faults, protocol=protocol)):
        yield port


@contextlib.contextmanager
def listening(words: list[str]) -> Iterator[None]:
    """Start a server, and see in the end that each of its planted faults has come true."""
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert words[words.index("--port") + 1] in process.stdout.readline()
        yield
    finally:
        process.kill()
        told, _ = process.communicate()
    assert {*words[words.index("--port") + 3 :]} <= {*told.splitlines()}


def as_client(function: Callable[..., Any], *arguments: Any) -> Any:
    """Run a function in a process of its own; BrokenProcessPool where it crashes."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result(timeout=120)


AS_FOUND = (False, 0, 5.0)


def carla_settings(port: int, awaited: tuple | None = None) -> tuple:
    """Return whether a server of ours is synchronous, how many actors it has, and its clouds.

    With `awaited` the server has a minute to come to that.
    """
    import carla

    client = carla.Client("127.0.0.1", port)
    client.set_timeout(60.0)
    world, until_s = client.get_world(), time.monotonic() + 60.0
    while True:
        actors = world.get_actors(list(range(200, 300)))
        found = world.get_settings().synchronous_mode, len(actors), world.get_weather().cloudiness
        if awaited in (None, found) or time.monotonic() > until_s:
            return found
        time.sleep(0.1)
