"""An UnrealCV server: text commands and their answers at one port, one client at a time."""

import io
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.simulators.conventions import CM_PER_M, FAR_UNITS, unreal_pose
from simulators.scene import Mover, Server, listen, send

MAGIC = 0x9E2B83C1  # before each message, with its length
VERSION = "1.1.0"
GROUND = "Landscape_0"  # the plane under everything


class UnrealCvServer(Server):
    """A level behind a port."""

    def __init__(self, town: BoxMap, port: int, faults: Sequence[str]) -> None:
        super().__init__(town, faults)
        self._objects = objects = _objects_of(town)
        self._colors = colors = {name: tuple(k.to_bytes(3)) for k, name in enumerate(objects, 1)}
        self._camera = camera = {"pose": _text([0.0] * 6), "fov": _text([90.0]), "size": "640 480"}
        self._since_s, self._paused, self._one = time.monotonic(), False, threading.Lock()
        self._commands: dict[str, Callable[..., str | bytes | None]] = {
            "vget /unrealcv/version": lambda: VERSION,
            "vget /level/name": lambda: self.town.name,
            r"vset /action/game/(\w+)": lambda word: setattr(self, "_paused", word == "pause"),
            "vget /objects": lambda: " ".join([*objects, *self.movers]),
            r"vset /objects/spawn_bp_asset (\S+) (\S+)": self._spawn,
            r"vget /object/(\S+)/color": lambda name: "(R={},G={},B={},A=255)".format(*colors[name]),
            r"vget /object/(\S+)/(\w+)": lambda name, what: objects[name][what],
            r"vset /object/(\S+)/color (\d+) (\d+) (\d+)": lambda name, *color: colors.update({name: color}),
            r"vset /object/(\S+)/(\w+) (\S+) (\S+) (\S+)": self._move,
            r"vset /object/(\S+)/destroy": lambda name: self.movers.__delitem__(name),
            r"vbp (\S+) (\w+) ?(\S*)": self._lead,
            "vget /camera/0/location": lambda: " ".join(camera["pose"].split()[:3]),
            r"vget /camera/0/(\w+)": lambda what: camera[what],
            r"vset /camera/0/(\w+) (.+)": lambda what, text: camera.update({what: text}),
            r"vget /camera/0/(\w+) \w+": self._picture,
        }
        listen(port, self._talk)

    def _talk(self, connection: socket.socket) -> None:
        with self._one, connection.makefile("rb") as stream:  # the next client is greeted when this one is gone
            send(connection, _framed(f"connected to {self.town.name}".encode()))
            while len(head := stream.read(8)) == 8:
                number, _, command = stream.read(struct.unpack("<II", head)[1]).decode().partition(":")
                self.calls.put((connection, number, command))

    def answer(self, connection: socket.socket, number: str, command: str) -> None:
        (sensor,) = re.findall(r"^vget /camera/0/(\w+) \w+$", command) or [""]
        if sensor == "lit":
            self.count()
        body = self._done(command)
        time.sleep(self.due("delay", sensor))
        for message in self.faulty(number.encode() + b":" + body, sensor) if not self.due("hang") else ():
            send(connection, _framed(message))

    def _done(self, command: str) -> bytes:
        now_s = time.monotonic()
        for mover in self.movers.values() if not self._paused else ():
            mover.step(now_s - self._since_s)
        self._since_s = now_s
        for pattern, do in self._commands.items():
            if found := re.fullmatch(pattern, command):
                answer = do(*found.groups())
                return answer if isinstance(answer, bytes) else (answer or "ok").encode()
        return b"error Can not find a handler for URI"

    def _spawn(self, path: str, name: str) -> None:
        self.movers[name] = Mover(True, path.rpartition(".")[2], [0.0] * 6)

    def _move(self, name: str, what: str, *numbers: str) -> None:
        first, scale = (0, CM_PER_M) if what == "location" else (3, 1.0)
        self.movers[name].pose[first : first + 3] = [float(part) / scale for part in numbers]

    def _lead(self, name: str, word: str, speed_cm_s: str) -> None:
        mover = self.movers[name]
        yaw_rad = np.radians(mover.pose[4])
        mover.direction = float(np.cos(yaw_rad)), float(np.sin(yaw_rad)), 0.0
        if word != "MoveForward":  # SetMaxSpeed, StopAgent
            mover.speed_mps = float(speed_cm_s or 0.0) / CM_PER_M

    def _picture(self, what: str) -> bytes:
        width, height = map(int, self._camera["size"].split())
        x, y, z, *turn = map(float, self._camera["pose"].split())
        pose = [x / CM_PER_M, y / CM_PER_M, z / CM_PER_M, *turn]
        frame, owners = self.draw((width, height), float(self._camera["fov"]), pose)
        if what == "depth":  # z-depth in centimetres, rounded to half precision
            buffer, depth_cm = io.BytesIO(), np.minimum(frame.depth * CM_PER_M, FAR_UNITS)
            np.save(buffer, depth_cm.astype(np.float16).astype(np.float32), allow_pickle=False)
            return buffer.getvalue()
        picture = frame.rgb
        if what == "object_mask":  # every object in its colour, the sky in none
            names = [*list(self._objects)[:-1], *self.movers, GROUND]
            picture = np.array([self._colors[name] for name in names], dtype=np.uint8)[owners]
            picture[frame.kinds == KINDS["Sky"]] = 0
        return cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGRA))[1].tobytes()


def _objects_of(town: BoxMap) -> dict[str, dict[str, str]]:
    """Return the answers about each object: of a box KIND_ID, of class KIND_C, at its bottom; the ground is last."""
    names = [f"{KIND_NAMES[kind]}_{number}" for kind, number in zip(town.kinds.tolist(), town.ids, strict=True)]
    lows = [*town.mins, town.bounds()[0] - [5e3, 5e3, 10.0]]
    highs = [*town.maxs, town.bounds()[0] + [5e3, 5e3, 0.0]]
    poses = [*map(unreal_pose, town.centers, town.rotations_deg), [0.0] * 6]
    objects = {}
    for name, (x0, y0, z0), (x1, y1, z1), (x, y, _, *turn) in zip([*names, GROUND], lows, highs, poses, strict=True):
        objects[name] = {
            "uclass_name": f"{name.split('_')[0]}_C", "bounds": _text(np.array([x0, -y1, z0, x1, -y0, z1]) * CM_PER_M),
            "location": _text(np.array([x, y, z0]) * CM_PER_M), "rotation": _text(turn), "scale": _text([1.0] * 3),
        }  # fmt: skip
    return objects


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.6f}" for number in numbers)


def _framed(payload: bytes) -> bytes:
    return struct.pack("<II", MAGIC, len(payload)) + payload
