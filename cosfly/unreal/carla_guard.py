"""Leaves a CARLA server as it was found, however the process that used it ends: normally, killed, or by a crash.

A process of its own. It starts the server, if there is a command for that, and then ends it too. Its input is lines of
JSON: first how the world was found, then the number of each actor that is spawned. Where the input ends, so has the
process that wrote it.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
from typing import Any

PATIENCE_S = 20.0  # for a server that is to be left in order


class CarlaGuard:
    """The guard, from the side of the process that it watches."""

    def __init__(self, host: str, port: int, command: str) -> None:
        words = [sys.executable, "-m", "cosfly.unreal.carla_guard", host, str(port), command]
        # A session of its own: Ctrl-C is not for it.
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, text=True, start_new_session=True)

    def note(self, what: Any) -> None:
        """Tell it how the world was found, or of an actor."""
        assert self._process.stdin is not None
        print(json.dumps(what), file=self._process.stdin, flush=True)

    def close(self) -> None:
        """Have everything put back, and wait for that."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def values_of(thing: Any) -> dict[str, Any]:
    """Give the plain values of the client's object, as of settings, by name."""
    names = [name for name in dir(thing) if not name.startswith("_")]
    return {name: getattr(thing, name) for name in names if isinstance(getattr(thing, name), bool | int | float | None)}


def with_values(thing: Any, values: dict[str, Any]) -> Any:
    """Set what `values_of` gave."""
    for name, value in values.items():
        setattr(thing, name, value)
    return thing


def _put_back(host: str, port: int, found: dict[str, Any], actors: list[int]) -> None:
    import carla

    client = carla.Client(host, port)
    client.set_timeout(PATIENCE_S)
    world = client.get_world()
    for actor in world.get_actors(actors):
        actor.destroy()
    world.set_weather(with_values(carla.WeatherParameters(), found["weather"]))
    world.apply_settings(with_values(carla.WorldSettings(), found["settings"]))


def main(host: str, port: str, command: str) -> None:
    server = subprocess.Popen(shlex.split(command), start_new_session=True) if command else None
    lines = [json.loads(line) for line in sys.stdin]
    if server is not None:
        os.killpg(server.pid, signal.SIGKILL)
    elif lines:
        try:
            _put_back(host, int(port), lines[0], lines[1:])
        except RuntimeError as error:  # it is gone, and with it all that there was to put back
            print(f"CARLA at {host}:{port} was not left as it was found: {error}", file=sys.stderr)


if __name__ == "__main__":
    main(*sys.argv[1:])
