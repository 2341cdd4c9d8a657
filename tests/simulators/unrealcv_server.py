"""An UnrealCV server: text commands and their answers at one port, one client at a time. One thread answers.

A box is an object KIND_ID of class KIND_C. Depth is z-depth in centimetres, rounded to half precision.
"""

from __future__ import annotations

import io
import os
import queue
import re
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import KIND_NAMES, KINDS
from cosfly.products.others import BUILDS
from cosfly.products.walks import PERSON_HALF_EXTENTS_M
from cosfly.render.contract import Frame
from cosfly.unreal.assets import is_person
from cosfly.unreal.conventions import CM_PER_M, FAR_CM, unreal_pose
from simulators.scene import Fault, Mover, ServedScene, due, listen, send

MAGIC = 0x9E2B83C1  # before each message, with its length
VERSION = "1.1.0"
GROUND = "Landscape_0"  # the plane under everything
WALK_CM_S = 140.0  # default speed of a person


class UnrealCvServer:
    """A level behind a port."""

    def __init__(self, town: BoxMap, port: int, faults: list[Fault]) -> None:
        self.town, self.faults, self.num_lit = town.name, faults, 0
        self._scene, self._map = ServedScene(town), town
        names = [f"{KIND_NAMES[int(kind)]}_{number}" for kind, number in zip(town.kinds, town.ids, strict=True)]
        self._rows = {name: row for row, name in enumerate(names)}
        self._movers: dict[str, Mover] = {}
        self._colors = {name: _color(k) for k, name in enumerate([*names, GROUND], 1)}
        self._camera: dict[str, Any] = {"pose": [0.0] * 6, "fov": 90.0, "size": (640, 480)}
        self._since_s, self._paused = time.monotonic(), False
        self._commands = self._make_commands()
        self._one, self._asked = threading.Lock(), queue.SimpleQueue[tuple[socket.socket, str, str]]()
        listen(port, self._talk)

    def serve(self) -> None:
        while True:
            self._answer(*self._asked.get())

    def _talk(self, connection: socket.socket) -> None:
        with self._one, connection.makefile("rb") as stream:  # the next client is greeted when this one is gone
            send(connection, _framed(f"connected to {self.town}".encode()))
            while len(head := stream.read(8)) == 8:
                number, _, command = (
                    stream.read(struct.unpack("<II", head)[1]).decode("utf-8", "replace").partition(":")
                )
                self._asked.put((connection, number, command))

    def _answer(self, connection: socket.socket, number: str, command: str) -> None:
        picture = re.fullmatch(r"vget /camera/0/(\w+) \w+", command)
        sensor = picture[1] if picture else ""
        self.num_lit += sensor == "lit"
        body = self._done(command)
        if self._due("die"):
            os._exit(1)
        if self._due("hang") or (picture and self._due("drop", sensor)):
            return
        if picture and self._due("malformed", sensor):
            body = body[: len(body) // 2]
        if picture and (fault := self._due("delay", sensor)):
            time.sleep(fault.seconds)
        for _ in range(2 if picture and self._due("duplicate", sensor) else 1):
            send(connection, _framed(number.encode() + b":" + body))

    def _due(self, name: str, sensor: str = "") -> Fault | None:
        return due(self.faults, name, self.num_lit, sensor)

    def _done(self, command: str) -> bytes:
        """Do one command and return its text, or the bytes of a picture."""
        if not (self._paused and command.startswith("vget")):
            self._scene.forget()
        for pattern, do in self._commands:
            if found := pattern.fullmatch(" ".join(command.split())):
                try:
                    answer = do(*found.groups())
                except (KeyError, ValueError) as error:
                    answer = f"error {error}"
                return answer if isinstance(answer, bytes) else str("ok" if answer is None else answer).encode()
        return b"error Can not find a handler for URI"

    def _make_commands(self) -> list[tuple[re.Pattern, Callable[..., Any]]]:
        camera = self._camera
        table: dict[str, Callable[..., Any]] = {
            "vget /unrealcv/version": lambda: VERSION,
            "vget /level/name": lambda: self.town,
            "vset /action/game/level [str]": self._open,
            "vset /action/game/(pause|resume)": self._pause,
            "vget /objects": lambda: " ".join([*self._rows, GROUND, *self._movers]),
            "vget /object/[str]/uclass_name": self._class,
            "vget /object/[str]/bounds": lambda name: _text(*(CM_PER_M * part for part in self._bounds(name))),
            "vget /object/[str]/location": lambda name: _text(*(CM_PER_M * part for part in self._pose(name)[:3])),
            "vget /object/[str]/rotation": lambda name: _text(*self._pose(name)[3:]),
            "vget /object/[str]/scale": lambda name: _text(1.0, 1.0, 1.0),
            "vget /object/[str]/color": lambda name: "(R={},G={},B={},A=255)".format(*self._colors[name]),
            "vset /object/[str]/color [uint] [uint] [uint]": self._paint,
            "vset /object/[str]/location [float] [float] [float]": lambda name, *to: self._move(name, 0, to),
            "vset /object/[str]/rotation [float] [float] [float]": lambda name, *to: self._move(name, 3, to),
            "vset /object/[str]/destroy": self._destroy,
            "vset /objects/spawn_bp_asset [str] [str]": self._spawn,
            "vbp [str] MoveForward": lambda name: self._lead(name, None),
            "vbp [str] StopAgent": lambda name: self._lead(name, 0.0),
            "vbp [str] SetMaxSpeed [float]": lambda name, speed: self._lead(name, float(speed)),
            "vget /cameras": lambda: "Camera_0",
            "vget /camera/0/pose": lambda: _text(*camera["pose"]),
            "vget /camera/0/location": lambda: _text(*camera["pose"][:3]),
            "vget /camera/0/rotation": lambda: _text(*camera["pose"][3:]),
            "vget /camera/0/fov": lambda: _text(camera["fov"]),
            "vget /camera/0/size": lambda: "{} {}".format(*camera["size"]),
            f"vset /camera/0/pose{' [float]' * 6}": lambda *to: camera.update(pose=[float(text) for text in to]),
            "vset /camera/0/fov [float]": lambda fov: camera.update(fov=float(fov)),
            "vset /camera/0/size [uint] [uint]": lambda *size: camera.update(size=tuple(map(int, size))),
            "vget /camera/0/lit png": lambda: _png(self._frame().rgb[..., ::-1]),
            "vget /camera/0/object_mask png": lambda: _png(self._mask()),
            "vget /camera/0/depth npy": lambda: _npy(np.minimum(self._frame().depth * CM_PER_M, FAR_CM)),
        }
        words = {"[str]": r"(\S+)", "[float]": r"(-?[\d.]+(?:e[+-]?\d+)?)", "[uint]": r"(\d+)"}
        return [(re.compile(re.sub(r"\[\w+\]", lambda w: words[w[0]], text)), do) for text, do in table.items()]

    def _open(self, name: str) -> None:
        if name != self.town:
            raise ValueError(f"no level {name}; there is {self.town}")
        self._movers.clear()

    def _class(self, name: str) -> str:
        if name in self._movers:
            return self._movers[name].model
        return "Terrain_C" if name == GROUND else f"{KIND_NAMES[int(self._map.kinds[self._rows[name]])]}_C"

    def _bounds(self, name: str) -> list[float]:
        """Return the lowest and the highest corner in Unreal's axes, m."""
        if name == GROUND:
            (x, y, z), half = self._map.bounds()[0], 5e3
            return [x - half, -y - half, z - 10.0, x + half, -y + half, z]
        if name in self._movers:
            (x, y, z), (a, b, c) = self._movers[name].pose[:3], self._movers[name].half_extents_m
            return [x - a, y - b, z - c, x + a, y + b, z + c]
        (x0, y0, z0), (x1, y1, z1) = self._map.mins[self._rows[name]], self._map.maxs[self._rows[name]]
        return [x0, -y1, z0, x1, -y0, z1]

    def _pose(self, name: str) -> list[float]:
        """Return a pose in m; of a box the pose of its bottom."""
        if name in self._movers or name == GROUND:
            return self._movers[name].pose if name in self._movers else [0.0] * 6
        row = self._rows[name]
        pose = unreal_pose(self._map.centers[row], np.asarray(self._map.rotations_deg[row]))
        return [*pose[:2], float(self._map.mins[row, 2]), *pose[3:]]

    def _spawn(self, path: str, name: str) -> str:
        walks, model = is_person(path), path.rpartition(".")[2]
        half_m = PERSON_HALF_EXTENTS_M if walks else BUILDS["Car"].half_extents_m
        self._movers[name] = Mover(model=model, is_person=walks, half_extents_m=half_m, pose=[0.0] * 6)
        self._colors[name] = _color(len(self._colors) + 1)
        return name

    def _destroy(self, name: str) -> None:
        del self._movers[name], self._colors[name]

    def _paint(self, name: str, *color: str) -> None:
        self._colors[name] = tuple(int(part) & 0xFF for part in color)

    def _move(self, name: str, first: int, to: tuple[str, ...]) -> None:
        self._pass_time()
        scale = 1.0 if first else CM_PER_M
        self._movers[name].pose[first : first + 3] = [float(part) / scale for part in to]

    def _lead(self, name: str, speed_cm_s: float | None) -> None:
        """Let a person walk in its direction; None: at its speed."""
        self._pass_time()
        mover = self._movers[name]
        if speed_cm_s is None:
            yaw_rad = np.radians(mover.pose[4])
            mover.direction = (float(np.cos(yaw_rad)), float(np.sin(yaw_rad)), 0.0)
            speed_cm_s = mover.speed_mps * CM_PER_M or WALK_CM_S
        mover.speed_mps = speed_cm_s / CM_PER_M

    def _pause(self, word: str) -> None:
        self._pass_time()
        self._paused = word == "pause"

    def _pass_time(self) -> None:
        now_s = time.monotonic()
        for mover in self._movers.values() if not self._paused else ():
            mover.step(now_s - self._since_s)
        self._since_s = now_s

    def _frame(self) -> Frame:
        self._pass_time()
        pose = [part / scale for part, scale in zip(self._camera["pose"], [CM_PER_M] * 3 + [1.0] * 3, strict=True)]
        return self._scene.draw(self._camera["size"], self._camera["fov"], pose, list(self._movers.values()))

    def _mask(self) -> np.ndarray:
        """Return every object in its colour, BGR; the sky in none."""
        frame, movers = self._frame(), list(self._movers.values())
        colors = np.array([self._colors[name] for name in (*self._rows, *self._movers, GROUND)], dtype=np.uint8)
        mask = colors[self._scene.owners(frame.ids, movers)]
        mask[frame.kinds == KINDS["Sky"]] = 0
        return mask[..., ::-1]


def _color(number: int) -> tuple[int, ...]:
    """Return a distinct colour for each number up to 2 ** 24, the low ones far apart."""
    number = number * 0x9E3779B1 & 0xFFFFFF  # odd: a permutation
    return number >> 16, number >> 8 & 0xFF, number & 0xFF


def _text(*numbers: float) -> str:
    return " ".join(f"{number:.6f}" for number in numbers)


def _png(bgr: np.ndarray) -> bytes:
    alpha = np.full((*bgr.shape[:2], 1), 255, dtype=np.uint8)
    return cv2.imencode(".png", np.concatenate([bgr, alpha], axis=-1))[1].tobytes()


def _npy(depth_cm: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, depth_cm.astype(np.float16).astype(np.float32), allow_pickle=False)
    return buffer.getvalue()


def _framed(payload: bytes) -> bytes:
    return struct.pack("<II", MAGIC, len(payload)) + payload
