"""What both servers share: who moves, pictures by the embedded renderer, planted faults, and listening at a port.

No physics: people walk straight on, through everything; vehicles keep their place.
"""

from __future__ import annotations

import contextlib
import re
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cosfly.geometry import intrinsic_matrix, world_from_camera
from cosfly.products.boxes import BoxMap
from cosfly.products.weather import WeatherParams
from cosfly.render.contract import (
    PERSON_ID,
    Clothes,
    Frame,
    PosedCar,
    PosedOther,
    PosedPerson,
    Renderer,
    instance_ids,
    other_id,
)
from cosfly.render.person import SLOW_MPS, STRIDE_M, choose_clothes
from cosfly.render.stage import open_renderer
from cosfly.unreal.conventions import world_pose
from cosfly.work.chance import rng_for

MOST_MOVERS = 64


@dataclass(kw_only=True)
class Mover:
    """A spawned person or vehicle. pose: x, y, z, pitch, yaw, roll in Unreal's axes, m and degrees; the middle of a
    person, the middle of the bottom of a vehicle. model: determines clothes or paint."""

    model: str
    is_person: bool
    half_extents_m: tuple[float, float, float]
    pose: list[float]
    direction: tuple[float, ...] = (1.0, 0.0, 0.0)
    speed_mps: float = 0.0
    walked_m: float = 0.0
    last_xy: tuple[float, ...] | None = None

    def step(self, step_s: float) -> None:
        for axis, part in enumerate(self.direction):
            self.pose[axis] += part * self.speed_mps * step_s
        xy = tuple(self.pose[:2])
        self.walked_m += float(np.hypot(*np.subtract(xy, self.last_xy or xy)))
        self.last_xy = xy

    def body(self) -> PosedPerson | PosedCar:
        place_m, rotation_deg = world_pose(self.pose)
        heading_rad = float(np.radians(rotation_deg[1]))
        if self.is_person:
            phase_rad = 2.0 * np.pi * self.walked_m / STRIDE_M
            swing = float(np.clip(self.speed_mps / SLOW_MPS, 0.0, 1.0))
            return PosedPerson(place_m, heading_rad, phase_rad, swing, clothes_of(self.model))
        middle_m = place_m + np.array([0.0, 0.0, self.half_extents_m[2]])
        return PosedCar(middle_m, heading_rad, self.half_extents_m, _rng_of(self.model).random())


class ServedScene:
    """Pictures of a town with movers. One thread uses it."""

    def __init__(self, town: BoxMap) -> None:
        self.town = town
        self._renderers: dict[tuple[int, int], tuple[Renderer, WeatherParams | None]] = {}
        self._drawn: dict[tuple, Frame] = {}
        self._row_of_id = np.full(PERSON_ID + 1, -1)
        self._row_of_id[instance_ids(town, MOST_MOVERS)] = np.arange(len(town))

    def forget(self) -> None:
        self._drawn.clear()

    def draw(
        self,
        size_px: tuple[int, int],
        fov_deg: float,
        pose: list[float],
        movers: Sequence[Mover],
        weather: WeatherParams | None = None,
    ) -> Frame:
        """Draw what a camera sees, once until `forget`. The first person is drawn in full detail."""
        key = (*size_px, fov_deg, *pose)
        if key not in self._drawn:
            renderer, drawn_weather = self._renderers.get(size_px, (None, None))
            if renderer is None:
                renderer = open_renderer("gl", self.town, *size_px, num_others=MOST_MOVERS)
            if drawn_weather != weather:
                renderer.prepare(*self.town.bounds(), weather)
            self._renderers[size_px] = renderer, weather
            person, others = None, list[PosedOther]()
            for mover in movers:
                body = mover.body()
                if person is None and isinstance(body, PosedPerson):
                    person = body
                else:
                    others.append(PosedOther(other_id(len(others)), body))
            camera = world_from_camera(*world_pose(pose)), intrinsic_matrix(*size_px, fov_deg)
            self._drawn[key] = renderer.render(*camera, person, others)
        return self._drawn[key]

    def owners(self, ids: np.ndarray, movers: Sequence[Mover]) -> np.ndarray:
        """Return the owner of each pixel: a row of the town, from its length on a mover, -1 for none."""
        table, num_others, has_person = self._row_of_id.copy(), 0, False
        for k, mover in enumerate(movers, len(self.town)):
            is_person = mover.is_person and not has_person
            table[PERSON_ID if is_person else other_id(num_others)] = k
            has_person, num_others = has_person or is_person, num_others + (not is_person)
        return table[ids]


def clothes_of(model: str) -> Clothes:
    return choose_clothes(_rng_of(model))


def _rng_of(model: str) -> np.random.Generator:
    return rng_for(0, "simulators", model)


@dataclass(frozen=True)
class Fault:
    """What goes wrong, at which tick, or from there on; sensor: the end of a blueprint's name, "" for all."""

    name: str
    sensor: str
    tick: int
    goes_on: bool
    seconds: float

    @classmethod
    def of(cls, text: str) -> Fault:
        """Read NAME[:SENSOR]@TICK[+][=SECONDS], as `delay:depth@3=2.5`."""
        found = re.fullmatch(r"(\w+)(?::(\w+))?@(\d+)(\+?)(?:=([\d.]+))?", text)
        assert found, text
        goes_on = bool(found[4]) or found[1] in ("unhealthy", "hang")
        return cls(found[1], found[2] or "", int(found[3]), goes_on, float(found[5] or 1.0))


def due(faults: list[Fault], name: str, tick: int, sensor: str = "") -> Fault | None:
    """Return the fault of this name that happens now."""
    for fault in faults:
        is_now = tick == fault.tick or (tick > fault.tick and fault.goes_on)
        if fault.name == name and is_now and fault.sensor in ("", sensor):
            return fault
    return None


def listen(port: int, talk: Callable[[socket.socket], None]) -> None:
    """Talk with everybody who connects, each in a thread."""
    listener = socket.create_server(("127.0.0.1", port))
    threading.Thread(target=_accept, args=(listener, talk), daemon=True).start()


def _accept(listener: socket.socket, talk: Callable[[socket.socket], None]) -> None:
    while True:
        connection, _ = listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=_talk, args=(connection, talk), daemon=True).start()


def _talk(connection: socket.socket, talk: Callable[[socket.socket], None]) -> None:
    with connection, contextlib.suppress(OSError):  # the client is gone
        talk(connection)


def send(connection: socket.socket, data: bytes) -> bool:
    """Send all of it; False where the client is gone."""
    try:
        connection.sendall(data)
    except OSError:
        return False
    return True
