"""The way to a CARLA server: its settings, a checked connection, and errors that name host, port and version."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import Field

from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, nearest

PROBE_S = 5.0  # for a server to accept a connection


class CarlaConfig(Config):
    """A CARLA server."""

    host: MayDiffer[str] = Field("127.0.0.1", min_length=1, description="where the server is")
    port: MayDiffer[int] = Field(2000, ge=1, le=65533, description="its port of calls (-carla-rpc-port)")
    town: str | None = Field(None, description="map to load, as Town10HD_Opt; null takes the one that is loaded")
    timeout_s: MayDiffer[float] = Field(60.0, gt=0, description="how long the server may take to answer, s")


@dataclass(frozen=True)
class CarlaConnection:
    """A client of one version with its server; `carla` is the package. Lives in one process, which it can crash."""

    carla: Any
    client: Any
    world: Any
    endpoint: str
    version: str
    town: str

    @contextlib.contextmanager
    def asking(self, what: str) -> Iterator[None]:
        """Make an error of ours of what the client raises: `what` could not be done."""
        with _told(what, self.endpoint, self.version):
            yield


def connect(cfg: CarlaConfig, port: int) -> CarlaConnection:
    """Connect to the server at a port and have it load the town.

    Raises:
        EnvironmentMissing: the package is not there, nobody answers, or a server of another version.
        ConfigError: it has no such town.
    """
    try:
        import carla
    except ModuleNotFoundError as error:
        fix = 'pip install "cosfly[carla]", on Linux or Windows with Python 3.11 or 3.12'
        raise EnvironmentMissing("the client of CARLA is not installed", got=str(error), fix=fix) from None
    endpoint = f"{cfg.host}:{port}"
    with _told("no CARLA server", endpoint, "unknown"):
        socket.create_connection((cfg.host, port), PROBE_S).close()
        client = carla.Client(cfg.host, port)
        client.set_timeout(cfg.timeout_s)
        version, ours = client.get_server_version(), client.get_client_version()
    if version != ours:
        fix = f"run a server of {ours}: streams of other versions crash this client"
        raise EnvironmentMissing(
            "a CARLA server of another version", where=endpoint, got=version, expected=ours, fix=fix
        )
    with _told("the world was not given", endpoint, version):
        world = client.get_world()
        loaded, towns = _short(world.get_map().name), sorted({_short(name) for name in client.get_available_maps()})
        if cfg.town is not None and cfg.town != loaded:
            if cfg.town not in towns:
                what, expected = f"the server has no such town{nearest(cfg.town, towns)}", ", ".join(towns)
                raise ConfigError(what, where=f"{endpoint} (CARLA {version})", got=cfg.town, expected=expected)
            world = client.load_world(cfg.town)
    return CarlaConnection(carla, client, world, endpoint, version, cfg.town or loaded)


def _short(name: str) -> str:
    """Return the last part of a map's path."""
    return name.rpartition("/")[2]


@contextlib.contextmanager
def _told(what: str, endpoint: str, version: str) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, OSError) as error:
        fix = "see that a server runs there (of each of --workers one, ports 10 apart), or give it time with timeout_s"
        where = f"{endpoint} (CARLA {version})"
        raise EnvironmentMissing(what, where=where, got=str(error) or type(error).__name__, fix=fix) from None
