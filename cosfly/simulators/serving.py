"""What all servers share: a port that is listened at, and faults that can be planted."""

from __future__ import annotations

import logging
import re
import socket
import threading
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

from cosfly.errors import ConfigError, EnvironmentMissing

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Fault:
    """What goes wrong, at which tick, or from there on; sensor: the end of a blueprint's name, "" for all."""

    name: str
    sensor: str
    tick: int
    goes_on: bool
    seconds: float

    @classmethod
    def of(cls, text: str, names: Collection[str]) -> Fault:
        """Read NAME[:SENSOR]@TICK[+][=SECONDS], as `delay:depth@3=2.5`; names: of all faults of a server."""
        found = re.fullmatch(r"(\w+)(?::(\w+))?@(\d+)(\+?)(?:=([\d.]+))?", text)
        if found is None or found[1] not in names:
            expected = f"NAME[:SENSOR]@TICK[+][=SECONDS], NAME one of {', '.join(names)}"
            raise ConfigError("no such fault", where="--fault", got=text, expected=expected)
        return cls(found[1], found[2] or "", int(found[3]), bool(found[4]), float(found[5] or 1.0))

    def is_due(self, tick: int) -> bool:
        return tick == self.tick or (tick > self.tick and (self.goes_on or self.name in ("unhealthy", "hang")))


def due(faults: Iterable[Fault], name: str, tick: int, sensor: str = "") -> Fault | None:
    """Give the fault of this name that is to happen now."""
    return next((f for f in faults if f.name == name and f.is_due(tick) and f.sensor in ("", sensor)), None)


def listen(host: str, port: int, talk: Callable[[socket.socket], None], note: str = "") -> None:
    """Have everybody who connects talked with, each in a thread."""
    try:
        listener = socket.create_server((host, port))
    except OSError as error:
        fix = f"choose another with --port{note}"
        raise EnvironmentMissing("cannot listen", where=f"{host}:{port}", got=str(error), fix=fix) from None
    threading.Thread(target=_accept, args=(listener, talk), daemon=True).start()


def _accept(listener: socket.socket, talk: Callable[[socket.socket], None]) -> None:
    while True:
        connection, _ = listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=_talk, args=(connection, talk), daemon=True).start()


def _talk(connection: socket.socket, talk: Callable[[socket.socket], None]) -> None:
    with connection:
        try:
            talk(connection)
        except OSError as error:  # the client is gone
            log.debug("%s", error)


def send(connection: socket.socket, data: bytes) -> bool:
    """Send all of it; False: nobody is there any more."""
    try:
        connection.sendall(data)
    except OSError:
        return False
    return True
