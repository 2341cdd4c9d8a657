"""A guard process that restores a simulator's server after the process that uses it (the user) has ended.

The user may end normally, be killed or crash. If a start command is given, the guard also starts the server, and kills
it instead of restoring it.

Protocol: the user writes lines of JSON to the standard input of the guard. The input ends when the user ends. The
guard restores nothing if it received no line.

    engine    first line                                          each further line
    carla     {"settings": {...}, "weather": {...}: attributes,   the id of an actor that was spawned
              "spectator": [location, rotation]}
    unrealcv  a list of commands that restore the camera          (none)
"""

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
    """The handle of a guard in the user's process.

    Args:
        engine: carla or unrealcv.
        command: Starts the server; `{port}` is replaced. An empty command leaves the start to the user.
        timeout_s: Time limit for the started server to listen. The connection that follows reports a server that does
            not listen by then.
    """

    def __init__(self, engine: str, host: str, port: int, command: str, timeout_s: float) -> None:
        server_command = command.replace("{port}", str(port))
        words = [sys.executable, "-m", "cosfly.simulators.guard", engine, host, str(port), server_command]
        # A session of its own protects the guard from Ctrl-C.
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, text=True, start_new_session=True)
        if command:
            _wait_until_listening(host, port, timeout_s)

    def note(self, message: Any) -> None:
        """Send one line of the protocol."""
        assert self._process.stdin is not None
        print(json.dumps(message), file=self._process.stdin, flush=True)

    def close(self) -> None:
        """Restore the server, and wait until that is done."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def _wait_until_listening(host: str, port: int, timeout_s: float) -> None:
    """Wait until a server listens at a port. Return without an error after `timeout_s`."""
    until_s = time.monotonic() + timeout_s
    while time.monotonic() < until_s:
        try:
            socket.create_connection((host, port), 1.0).close()
        except OSError:
            time.sleep(0.2)
        else:
            return


def _restore_carla(host: str, port: int, state: dict[str, Any], actor_ids: list[int]) -> None:
    """Destroy the spawned actors, and reset spectator, weather and world settings to the recorded state."""
    import carla

    from cosfly.simulators.carla_client import set_attributes

    client = carla.Client(host, port)
    client.set_timeout(RESTORE_S)
    world = client.get_world()
    for actor in world.get_actors(actor_ids):
        actor.destroy()
    location, rotation = state["spectator"]
    world.get_spectator().set_transform(carla.Transform(carla.Location(*location), carla.Rotation(*rotation)))
    world.set_weather(set_attributes(carla.WeatherParameters(), state["weather"]))
    world.apply_settings(set_attributes(carla.WorldSettings(), state["settings"]))


def _restore_unrealcv(host: str, port: int, commands: list[str]) -> None:
    """Resume the game, destroy the spawned objects and run the recorded commands."""
    from cosfly.simulators.unrealcv_client import UnrealCvConfig, connect, spawned_by_cosfly

    connection = connect(UnrealCvConfig(host=host, timeout_s=RESTORE_S), port)
    with connection.asking("UnrealCV did not restore its level"):
        names = spawned_by_cosfly(str(*connection.ask("vget /objects")))
        connection.ask("vset /action/game/resume", *(f"vset /object/{name}/destroy" for name in names), *commands)
    connection.close()


def _start_server(command: str) -> subprocess.Popen:
    """Start a server that is killed when this process ends, in its own session, which protects it from Ctrl-C."""
    with signals_held_back():
        return subprocess.Popen(
            shlex.split(command),
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=partial(_begin, os.getpid()),
        )


def _begin(parent_pid: int) -> None:
    """Prepare the new process before it runs the server's program."""
    end_with_parent(parent_pid)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, LEFT_TO_THE_PARENT)


def _end_server(server: subprocess.Popen) -> None:
    """Kill a server and all its descendants."""
    if sys.platform != "linux":  # other systems do not list descendants
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
    while pids := _descendants():
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        server.poll()
        time.sleep(0.02)


def _descendants() -> list[int]:
    """Return the ids of the running descendants of this process."""
    children = defaultdict[int, list[int]](list)
    for path in Path("/proc").glob("[0-9]*"):
        if (stat := process_stat(int(path.name))) and stat[0] != b"Z":
            children[int(stat[1])].append(int(path.name))
    pids = [os.getpid()]
    for pid in pids:  # the list grows while it is read
        pids += children[pid]
    return pids[1:]


def main(engine: str, host: str, port: str, command: str) -> None:
    """Read the protocol until the user ends, then kill the server that was started here, or restore the other."""
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
        except (RuntimeError, EnvironmentMissing) as error:
            # No answer usually means that the server has ended, so there is nothing to restore.
            print(f"{engine} at {host}:{port}: the level was not restored: {error}", file=sys.stderr)


if __name__ == "__main__":
    main(*sys.argv[1:])
