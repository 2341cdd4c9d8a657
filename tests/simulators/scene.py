"""What both servers share: the loop that answers, who moves, pictures by the embedded renderer, and planted faults."""

import contextlib
import os
import queue
import re
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.render.contract import PERSON_ID, Frame, PosedPerson, instance_ids, other_id
from cosfly.render.person import SLOW_MPS, choose_clothes
from cosfly.render.stage import open_renderer
from cosfly.runtime.seeding import rng_for
from cosfly.simulators.conventions import SIMULATED_STEP_S, world_pose

MOST_MOVERS = 64
FAULT = re.compile(r"(\w+)(?::(\w+))?@(\d+)(\+?)(?:=([\d.]+))?")  # NAME[:SENSOR]@TICK[+][=SECONDS]


@dataclass
class Mover:
    """A person or a camera. People walk straight on."""

    is_person: bool
    model: str
    pose: list[float]  # in Unreal's axes, m and degrees; of a person's middle
    description: list = field(default_factory=list)  # of the client that spawned it
    direction: tuple[float, ...] = (1.0, 0.0, 0.0)
    speed_mps: float = 0.0

    def step(self, step_s: float) -> None:
        for axis, part in enumerate(self.direction):
            self.pose[axis] += part * self.speed_mps * step_s

    def body(self) -> PosedPerson:
        place_m, rotation_deg = world_pose(self.pose)
        heading_rad = float(np.radians(rotation_deg[1]))
        return PosedPerson(place_m, heading_rad, 0.0, min(self.speed_mps / SLOW_MPS, 1.0), clothes_of(self.model))


def clothes_of(model: str) -> Any:
    return choose_clothes(rng_for(0, "simulators", model))


class Server:
    def __init__(self, town: BoxMap, faults: Sequence[str]) -> None:
        self.town, self.num_ticks, self.calls = town, 0, queue.SimpleQueue[tuple]()
        self.movers, self.weather = dict[Any, Mover](), None
        self._faults = {text: found.groups() for text in faults if (found := FAULT.fullmatch(text))}
        self._renderer, self._size_px, self._prepared_for, self._drawn = None, None, None, ("", None)

    def serve(self) -> None:
        while True:
            try:
                call = self.calls.get(timeout=SIMULATED_STEP_S)
            except queue.Empty:
                self.idle()
            else:
                self.answer(*call)

    def idle(self) -> None:
        """Nobody asked anything for a step."""

    def count(self) -> None:
        self.num_ticks += 1
        if self.due("die"):
            os._exit(1)

    def due(self, name: str, sensor: str = "") -> float:
        for text, (planted, its_sensor, tick, plus, seconds) in self._faults.items():
            is_now = self.num_ticks == int(tick) or ((plus or name == "hang") and self.num_ticks > int(tick))
            if planted == name and is_now and its_sensor in (None, sensor):
                print(text, flush=True)
                return float(seconds or 1.0)
        return 0.0

    def faulty(self, message: bytes, sensor: str) -> list[bytes]:
        if self.due("drop", sensor):
            return []
        message = message[:40] if self.due("malformed", sensor) else message
        return [message] * (2 if self.due("duplicate", sensor) else 1)

    def bodies(self) -> dict[Any, Mover]:
        return {key: mover for key, mover in self.movers.items() if mover.is_person}

    def draw(self, size_px: tuple[int, int], fov_deg: float, pose: list[float]) -> tuple[Frame, np.ndarray]:
        """Draw what a camera sees, and the owner of each pixel: a row of the town, behind these a body, -1 for none."""
        key = repr((size_px, fov_deg, pose, self.bodies(), self.weather))
        if key == self._drawn[0]:
            return self._drawn[1]
        if self._size_px != size_px:
            self._renderer = open_renderer("gl", self.town, *size_px, num_others=MOST_MOVERS)
            self._size_px, self._prepared_for = size_px, None
        if self._prepared_for != self.weather:
            self._renderer.prepare(*self.town.bounds(), self.weather)
            self._prepared_for = self.weather
        others = {other_id(k): mover.body() for k, mover in enumerate(self.bodies().values())}
        ids = [*instance_ids(self.town, MOST_MOVERS), *others]
        owners = np.full(PERSON_ID + 1, -1)
        owners[ids] = np.arange(len(ids))
        camera = world_from_camera(*world_pose(pose)), intrinsic_matrix(*size_px, fov_deg)
        frame = self._renderer.render(*camera, others)
        self._drawn = key, (frame, owners[frame.ids])
        return self._drawn[1]


def listen(port: int, talk: Callable[[socket.socket], None]) -> None:
    listener = socket.create_server(("127.0.0.1", port))

    def accept() -> None:
        while True:
            connection, _ = listener.accept()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=until_gone, args=(connection,), daemon=True).start()

    def until_gone(connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            talk(connection)

    threading.Thread(target=accept, daemon=True).start()


def send(connection: socket.socket, data: bytes) -> None:
    with contextlib.suppress(OSError):  # the client is gone
        connection.sendall(data)
