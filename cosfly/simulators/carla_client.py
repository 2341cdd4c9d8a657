"""A checked connection to a CARLA server: its settings, and errors that name host, port and version."""

import contextlib
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from pydantic import Field

from cosfly.runtime.config import Config, MayDiffer
from cosfly.runtime.errors import ConfigError, EnvironmentMissing, nearest

PROBE_S = 5.0  # time limit for a server to accept a connection


class CarlaConfig(Config):
    """A CARLA server."""

    host: MayDiffer[str] = Field("127.0.0.1", min_length=1, description="address of the server")
    port: MayDiffer[int] = Field(2000, ge=1, le=65533, description="RPC port of the server (-carla-rpc-port)")
    town: str | None = Field(None, description="map to load, such as Town10HD_Opt; null uses the loaded one")
    timeout_s: MayDiffer[float] = Field(60.0, gt=0, description="time limit for an answer, s")


@dataclass(frozen=True)
class CarlaConnection:
    """A client with its server of the same version; `carla` is the package, which can crash its process."""

    carla: Any
    client: Any
    world: Any
    endpoint: str
    version: str
    town: str

    def asking(self, what: str) -> contextlib.AbstractContextManager[None]:
        """Convert errors of the client to EnvironmentMissing; `what` describes the failure."""
        return _server_errors(what, self.endpoint, self.version)


def connect(cfg: CarlaConfig, port: int) -> CarlaConnection:
    """Connect to the server at a port, check its version, and have it load the town."""
    try:
        import carla
    except ModuleNotFoundError as error:
        fix = 'pip install -e ".[carla]", on Linux or Windows with Python 3.11 or 3.12'
        raise EnvironmentMissing("the package carla is not installed", got=str(error), fix=fix) from None
    endpoint = f"{cfg.host}:{port}"
    with _server_errors("no CARLA server answers", endpoint, "unknown"):
        socket.create_connection((cfg.host, port), PROBE_S).close()
        client = carla.Client(cfg.host, port)
        client.set_timeout(cfg.timeout_s)
        version = client.get_server_version()
        client_version = client.get_client_version()
    if version != client_version:
        raise EnvironmentMissing(
            "the CARLA server and the CARLA client have different versions",
            where=endpoint,
            got=version,
            expected=client_version,
            fix=f"run a server of version {client_version}, because other versions crash this client",
        )
    with _server_errors("CARLA did not return its world", endpoint, version):
        _check_files(client.get_required_files("", False), endpoint)
        world = client.get_world()
        loaded = _short(world.get_map().name)
        towns = sorted({_short(name) for name in client.get_available_maps()})
        if cfg.town is not None and cfg.town != loaded:
            if cfg.town not in towns:
                what = f"the server has no town of this name{nearest(cfg.town, towns)}"
                where = f"{endpoint} (CARLA {version})"
                raise ConfigError(what, where=where, got=cfg.town, expected=f"one of {', '.join(towns)}")
            world = client.load_world(cfg.town)
    return CarlaConnection(carla, client, world, endpoint, version, cfg.town or loaded)


def _check_files(names: list[str], endpoint: str) -> None:
    """Raise EnvironmentMissing if a file of the server's town would leave the folder where the client caches them."""
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts or "\0" in name:
            raise EnvironmentMissing(
                "the CARLA server names a file outside the client's cache",
                where=endpoint,
                got=name[:80],
                fix="use a server that you trust; the client would write this file",
            )


def read_attributes(parameters: Any) -> dict[str, Any]:
    """Return the plain attributes of an object of the client (numbers, flags, None), by name."""
    values = {name: getattr(parameters, name) for name in dir(parameters) if not name.startswith("_")}
    return {name: value for name, value in values.items() if isinstance(value, bool | int | float | None)}


def set_attributes(parameters: Any, values: dict[str, Any]) -> Any:
    """Set the attributes that `read_attributes` returned, and return the object."""
    for name, value in values.items():
        setattr(parameters, name, value)
    return parameters


def _short(name: str) -> str:
    """Return the last part of a map's path."""
    return name.rpartition("/")[2]


@contextlib.contextmanager
def _server_errors(what: str, endpoint: str, version: str) -> Iterator[None]:
    """Convert errors of the client to EnvironmentMissing; `what` describes the failure."""
    try:
        yield
    except (RuntimeError, OSError) as error:
        fix = "start a server there (one for each of --workers, ports 10 apart), or raise timeout_s"
        where = f"{endpoint} (CARLA {version})"
        raise EnvironmentMissing(what, where=where, got=str(error) or type(error).__name__, fix=fix) from None
