"""A process that restores a simulator's server when its user ends: normally, killed, or by a crash. It starts and ends
the server itself if a command is given. Its input is lines of JSON, up to the end of the process that writes it: for
CARLA the state of the world, then the numbers of spawned actors; for UnrealCV the commands that restore the camera."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.events import process_stat
from cosfly.runtime.worker import LEFT_TO_THE_PARENT, adopt_orphans, end_with_parent, signals_held_back

RESTORE_S = 20.0  # time limit of a server while it is restored


class EngineGuard:
    """The handle of a guard in the process that it watches; engine: carla or unrealcv."""

    def __init__(self, engine: str, host: str, port: int, command: str, timeout_s: float) -> None:
        filled = command.replace("{port}", str(port))
        words = [sys.executable, "-m", "cosfly.simulators.guard", engine, host, str(port), filled]
        # In a session of its own, so that Ctrl-C does not end it.
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, text=True, start_new_session=True)
        if command:
            _wait_for(host, port, timeout_s)

    def note(self, what: Any) -> None:
        """Send the state of the world, or the number of an actor."""
        assert self._process.stdin is not None
        print(json.dumps(what), file=self._process.stdin, flush=True)

    def close(self) -> None:
        """Restore the server, and wait until that is done."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def values_of(thing: Any) -> dict[str, Any]:
    """Return the plain attributes of an object of the client, by name."""
    names = [name for name in dir(thing) if not name.startswith("_")]
    return {name: getattr(thing, name) for name in names if isinstance(getattr(thing, name), bool | int | float | None)}


def with_values(thing: Any, values: dict[str, Any]) -> Any:
    """Set attributes that `values_of` returned."""
    for name, value in values.items():
        setattr(thing, name, value)
    return thing


def _wait_for(host: str, port: int, timeout_s: float) -> None:
    """Wait until a server listens at a port, or the time is over."""
    until_s = time.monotonic() + timeout_s
    while time.monotonic() < until_s:
        try:
            socket.create_connection((host, port), 1.0).close()
        except OSError:
            time.sleep(0.2)
        else:
            return


def _restore_carla(host: str, port: int, found: dict[str, Any], actors: list[int]) -> None:
    import carla

    client = carla.Client(host, port)
    client.set_timeout(RESTORE_S)
    world = client.get_world()
    for actor in world.get_actors(actors):
        actor.destroy()
    world.set_weather(with_values(carla.WeatherParameters(), found["weather"]))
    world.apply_settings(with_values(carla.WorldSettings(), found["settings"]))


def _restore_unrealcv(host: str, port: int, commands: list[str]) -> None:
    from cosfly.simulators.unrealcv_client import UnrealCvConfig, connect, spawned_by_cosfly

    connection = connect(UnrealCvConfig(host=host, timeout_s=RESTORE_S), port)
    with connection.asking("UnrealCV did not restore its level"):
        names = spawned_by_cosfly(str(*connection.ask("vget /objects")))
        connection.ask("vset /action/game/resume", *(f"vset /object/{name}/destroy" for name in names), *commands)
    connection.close()


def _start_server(command: str) -> subprocess.Popen:
    """Start a process that is killed with this one, in a session of its own, so that Ctrl-C does not end it."""
    with signals_held_back():
        return subprocess.Popen(
            shlex.split(command),
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=partial(_begin, os.getpid()),
        )


def _begin(parent_pid: int) -> None:
    end_with_parent(parent_pid)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, LEFT_TO_THE_PARENT)


def _end_server(server: subprocess.Popen) -> None:
    """Kill a server and all its descendants."""
    if sys.platform != "linux":  # other systems do not list descendants
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
    while left := _descendants():
        for pid in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        server.poll()
        time.sleep(0.02)


def _descendants() -> list[int]:
    """Return the running descendants of this process."""
    children = defaultdict[int, list[int]](list)
    for path in Path("/proc").glob("[0-9]*"):
        if (stat := process_stat(int(path.name))) and stat[0] != b"Z":
            children[int(stat[1])].append(int(path.name))
    found = [os.getpid()]
    for pid in found:
        found += children[pid]
    return found[1:]


def main(engine: str, host: str, port: str, command: str) -> None:
    adopt_orphans()
    server = _start_server(command) if command else None
    lines = [json.loads(line) for line in sys.stdin]
    if server is not None:
        _end_server(server)
    elif lines:
        try:
            if engine == "carla":
                _restore_carla(host, int(port), lines[0], lines[1:])
            else:
                _restore_unrealcv(host, int(port), lines[0])
        except (RuntimeError, EnvironmentMissing) as error:  # the server has ended, with all that was to be restored
            print(f"{engine} at {host}:{port} was not restored: {error}", file=sys.stderr)


if __name__ == "__main__":
    main(*sys.argv[1:])
