"""A CARLA 0.9.16 server: msgpack-RPC at a port, streams of sensors at the next. One thread answers and ticks.

The layouts are those of CARLA's client library (LibCarla: `rpc`, `streaming`, `sensor/s11n`).
"""

from __future__ import annotations

import itertools
import os
import queue
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import KINDS
from cosfly.products.others import BUILDS
from cosfly.products.walks import PERSON_HALF_EXTENTS_M
from cosfly.products.weather import WeatherParams
from cosfly.unreal.conventions import (
    ACTOR_BITS,
    CARLA_VERSION,
    DEPTH_RANGE_M,
    DEPTH_STEPS,
    SIMULATED_STEP_S,
    unreal_pose,
)
from simulators.scene import Fault, Mover, ServedScene, due, listen, send

EPISODE_STREAM, EPISODE_OBSERVER = 1, 17  # the stream of the world's state, and its number as a sensor
FIRST_SENSOR_STREAM = 1000
BYTES_BY_KIND = 54  # of an actor's state
FIRST_BOX = 100_000  # number of the first box as an actor; pictures hold its low 16 bits
ANY_LABEL = 255
KNOBS = {  # the parameters of the weather that change pictures
    "cloudiness": 0, "precipitation": 1, "sun_azimuth_angle": 4, "sun_altitude_angle": 5, "fog_density": 6,
    "fog_distance": 7,
}  # fmt: skip
FAIR_WEATHER = [5.0, 0.0, 0.0, 10.0, 215.0, 42.0, 0.0, 60.0, 0.0, 0.0, 1.0, 0.03, 0.0331, 0.0]
VEHICLES = {  # half extents, m
    "vehicle.cosfly.car": BUILDS["Car"].half_extents_m, "vehicle.tesla.model3": (2.4, 1.08, 0.74),
}  # fmt: skip
CAMERAS = {  # number of the sensor in streams
    "sensor.camera.depth": 1, "sensor.camera.rgb": 13, "sensor.camera.semantic_segmentation": 14,
    "sensor.camera.instance_segmentation": 15,
}  # fmt: skip
BOOL, INT, FLOAT, STRING = 1, 2, 3, 4  # types of attributes
CAMERA_ATTRIBUTES = [("image_size_x", INT, "800"), ("image_size_y", INT, "600"), ("fov", FLOAT, "90.0")]
FILM_ATTRIBUTES = [
    ("exposure_mode", STRING, "histogram"), ("exposure_compensation", FLOAT, "0.0"), ("shutter_speed", FLOAT, "200.0"),
    ("iso", FLOAT, "100.0"), ("fstop", FLOAT, "1.4"), ("motion_blur_intensity", FLOAT, "0.45"),
    ("motion_blur_max_distortion", FLOAT, "0.35"),
]  # fmt: skip
ROADS = (
    '<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4" name="" version="1.00" date="" north="0" '
    'south="0" east="0" west="0"><geoReference>+proj=tmerc +lat_0=0 +lon_0=0</geoReference></header></OpenDRIVE>'
)


@dataclass(kw_only=True)
class Actor(Mover):
    """A walker, a vehicle or a camera."""

    number: int
    description: list

    def told(self, token: bytes) -> list:
        tag = bytes([KINDS["Pedestrians" if self.is_person else "Car"]])
        return [self.number, 0, self.description, self.box(), tag, token if self.model in CAMERAS else b""]

    def box(self) -> list:
        lift_m = 0.0 if self.is_person else self.half_extents_m[2]
        return [[0.0, 0.0, lift_m], list(self.half_extents_m), [0.0, 0.0, 0.0], self.number]


class CarlaServer:
    """A town behind two ports."""

    def __init__(self, box_map: BoxMap, port: int, faults: list[Fault]) -> None:
        self.town, self._map, self._scene, self.faults = box_map.name, box_map, ServedScene(box_map), faults
        self.port, self.frame, self.num_ticks = port, 0, 0
        self.settings: list[Any] = [False, False, [False], True, 0.01, 10, 0.0, False, 3000.0, 2000.0, True]
        self.weather, self.actors, self._numbers = list(FAIR_WEATHER), dict[int, Actor](), itertools.count(201)
        self._poses = [unreal_pose(c, np.asarray(r)) for c, r in zip(box_map.centers, box_map.rotations_deg)]  # noqa: B905
        self._calls: queue.SimpleQueue[tuple[socket.socket, list]] = queue.SimpleQueue()
        self._streams: dict[int, list[socket.socket]] = {}
        self._held: dict[int, bytes] = {}  # messages that are sent after the next one
        self._answers = self._make_answers()
        listen(port, self._read_calls)
        listen(port + 1, self._read_subscription)

    def serve(self) -> None:
        """Answer calls; while no client leads the clock, tick at the pace of the settings."""
        while True:
            try:
                connection, (_, call_id, method, arguments) = self._calls.get(timeout=self._step_s())
            except queue.Empty:
                if not self.settings[0]:
                    self._tick()
                continue
            self._answer(connection, call_id, method, arguments)

    def _step_s(self) -> float:
        is_fixed, *step_s = self.settings[2]
        return float(step_s[0]) if is_fixed and step_s[0] > 0 else SIMULATED_STEP_S

    def _due(self, name: str, sensor: str = "") -> Fault | None:
        return due(self.faults, name, self.num_ticks, sensor)

    def _read_calls(self, connection: socket.socket) -> None:
        unpacker = msgpack.Unpacker(raw=False, strict_map_key=False)
        while data := connection.recv(65536):
            unpacker.feed(data)
            for message in unpacker:
                self._calls.put((connection, message))

    def _answer(self, connection: socket.socket, call_id: int, method: str, arguments: list) -> None:
        """Answer one call; the first argument is the client's metadata."""
        result: list[list]
        try:
            value = self._answers[method](*arguments[1:])
            result = [[False]] if value is None else [[1, value]]
        except (ValueError, KeyError, IndexError, TypeError) as error:
            result = [[0, [f"{method}: {error}"]]]
        if method == "tick_cue" and (fault := self._due("late")):
            time.sleep(fault.seconds)
        if not self._due("hang") and not (method == "version" and self._due("unhealthy")):
            send(connection, msgpack.packb([1, call_id, None, result]))

    def _make_answers(self) -> dict[str, Callable[..., Any]]:
        name, actors = f"Carla/Maps/{self.town}", self.actors
        ignored = ("set_actor_collisions", "set_actor_enable_gravity", "set_actor_simulate_physics")
        return {
            "version": lambda: CARLA_VERSION,
            "get_available_maps": lambda: [f"/Game/{name}"],
            "load_new_episode": self._load,
            "get_episode_info": lambda: [1, [self._token(EPISODE_STREAM)]],
            "get_sensor_token": lambda stream: [self._token(stream)],
            "get_episode_settings": lambda: self.settings,
            "set_episode_settings": self._set_settings,
            "get_map_info": lambda: [name, []],
            "get_map_data": lambda: ROADS,
            "get_required_files": lambda *_: [],
            "query_lights_state": lambda *_: [],
            "get_weather_parameters": lambda: self.weather,
            "set_weather_parameters": lambda told: self.weather.__setitem__(slice(None), told),
            "get_environment_objects": lambda label: [self._object(row) for row in self._rows(label)],
            "get_all_level_BBs": lambda label: [self._box(row) for row in self._rows(label)],
            "get_actor_definitions": _definitions,
            "get_actors_by_id": lambda numbers: [self._told(actors[n]) for n in numbers if n in actors],
            "get_actor_bounding_box": lambda number: actors[number].box(),
            "spawn_actor": lambda description, transform, *_: self._told(self._spawn(description, transform)),
            "destroy_actor": lambda number: actors.pop(number, None) is not None,
            "set_actor_transform": lambda number, to: actors[number].pose.__setitem__(slice(6), [*to[0], *to[1]]),
            "set_actor_location": lambda number, place: actors[number].pose.__setitem__(slice(3), place),
            "apply_control_to_walker": self._control,
            **dict.fromkeys(ignored, lambda *_: None),
            "tick_cue": self._led_tick,
        }

    def _load(self, town: str, *_: Any) -> None:
        if town.rpartition("/")[2] != self.town:
            raise ValueError(f"no map {town}; there is {self.town}")
        self.actors.clear()

    def _set_settings(self, settings: list) -> int:
        self.settings = settings
        return self.frame

    def _rows(self, label: int) -> list[int]:
        return np.flatnonzero((self._map.kinds == label) | (label == ANY_LABEL)).tolist()

    def _box(self, row: int) -> list:
        pose = self._poses[row]
        return [pose[:3], self._map.half_extents[row].tolist(), pose[3:], FIRST_BOX + row]

    def _object(self, row: int) -> list:
        number, pose = int(self._map.ids[row]), self._poses[row]
        return [[pose[:3], pose[3:]], self._box(row), number, f"Box_{number}", int(self._map.kinds[row])]

    def _told(self, actor: Actor) -> list:
        return actor.told(self._token(FIRST_SENSOR_STREAM + actor.number))

    def _spawn(self, description: list, transform: list) -> Actor:
        name, number = description[1], next(self._numbers)
        is_walker = name.startswith("walker.pedestrian.")
        half_m = PERSON_HALF_EXTENTS_M if is_walker else VEHICLES.get(name, (0.1, 0.1, 0.1))
        pose, own = [*transform[0], *transform[1]], {"number": number, "description": description}
        self.actors[number] = Actor(model=name, is_person=is_walker, half_extents_m=half_m, pose=pose, **own)
        return self.actors[number]

    def _control(self, number: int, control: list) -> None:
        self.actors[number].direction, self.actors[number].speed_mps = tuple(control[0]), control[1]

    # --- time and streams ---------------------------------------------------------------------------------------------

    def _led_tick(self) -> int:
        self.num_ticks += 1
        if self._due("die"):
            os._exit(1)
        self._tick()
        return self.frame

    def _tick(self) -> None:
        self.frame += 1
        self._scene.forget()
        for actor in self._movers():
            actor.step(self._step_s())
        self._send_state(self._streams.get(EPISODE_STREAM, []))
        for actor in list(self.actors.values()):
            connections = self._streams.get(FIRST_SENSOR_STREAM + actor.number)
            if connections and actor.model in CAMERAS:
                self._send_sensor(actor, connections, self._head(CAMERAS[actor.model], actor.pose) + self._seen(actor))

    def _movers(self) -> list[Actor]:
        return [actor for actor in self.actors.values() if actor.model not in CAMERAS]

    def _head(self, sensor: int, pose: list[float]) -> bytes:
        return struct.pack("<QQd6f", sensor, self.frame, self.frame * self._step_s(), *pose)

    def _send_state(self, connections: list[socket.socket]) -> None:
        """Send the world's state: episode, times, map origin, and the pose and motion of every actor."""
        body = struct.pack("<Qdf3ii", 1, self.frame * self._step_s(), self._step_s(), 0, 0, 0, 0)
        for number, actor in self.actors.items():
            motion = [part * actor.speed_mps for part in actor.direction] + [0.0] * 6
            body += struct.pack("<IB15f", number, 1, *actor.pose, *motion) + bytes(BYTES_BY_KIND)
        self._send_stream(connections, self._head(EPISODE_OBSERVER, [0.0] * 6) + body)

    def _send_sensor(self, actor: Actor, connections: list[socket.socket], message: bytes) -> None:
        sensor, stream = actor.model.split(".")[2].split("_")[0], FIRST_SENSOR_STREAM + actor.number
        if self._due("drop", sensor):
            return
        if self._due("malformed", sensor):
            message = message[:40]
        if self._due("reorder", sensor):
            self._held[stream] = message
        elif fault := self._due("delay", sensor):
            threading.Timer(fault.seconds, self._send_stream, (connections, message)).start()
        else:
            for one in [message] * (2 if self._due("duplicate", sensor) else 1) + [self._held.pop(stream, b"")]:
                self._send_stream(connections, one)

    def _send_stream(self, connections: list[socket.socket], message: bytes) -> None:
        for connection in list(connections if message else ()):
            if not send(connection, struct.pack("<I", len(message)) + message):
                connections.remove(connection)

    def _read_subscription(self, connection: socket.socket) -> None:
        data = connection.recv(4)
        if len(data) < 4:
            return
        (stream,) = struct.unpack("<I", data)
        self._streams.setdefault(stream, []).append(connection)
        if stream == EPISODE_STREAM:
            self._send_state([connection])
        while connection.recv(4096):
            pass
        if connection in self._streams[stream]:
            self._streams[stream].remove(connection)

    def _token(self, stream: int) -> bytes:
        """Return number, port, TCP, and an address of version 4 that the client fills in with its host."""
        return struct.pack("<IHBB", stream, self.port + 1, 1, 1) + bytes([127, 0, 0, 1]) + bytes(12)

    def _seen(self, camera: Actor) -> bytes:
        """Return width, height, field of view and BGRA of what a camera sees now."""
        told = {name: text for name, _, text in camera.description[2]}
        size, fov_deg = (int(told["image_size_x"]), int(told["image_size_y"])), float(told["fov"])
        is_fair = np.allclose(self.weather, FAIR_WEATHER)  # single precision
        weather = None if is_fair else WeatherParams(**{name: float(self.weather[k]) for name, k in KNOBS.items()})
        frame = self._scene.draw(size, fov_deg, camera.pose, self._movers(), weather)
        match CAMERAS[camera.model]:
            case 1:
                picture = depth_picture(frame.depth)
            case 13:
                picture = np.dstack([frame.rgb[..., ::-1], np.full(frame.kinds.shape, 255, np.uint8)])
            case 14:
                picture = tags_picture(frame.kinds, np.zeros(frame.ids.shape, dtype=np.int64))
            case _:
                boxes = range(FIRST_BOX, FIRST_BOX + len(self._map))
                numbers = np.array([*boxes, *(one.number for one in self._movers()), 0])
                owners = numbers[self._scene.owners(frame.ids, self._movers())]
                picture = tags_picture(frame.kinds, owners & ACTOR_BITS)
        return struct.pack("<IIf", *size, fov_deg) + picture.tobytes()


def depth_picture(depth_m: np.ndarray) -> np.ndarray:
    """Encode z-depth, (h, w) m, as BGRA, (h, w, 4) uint8; to the nearest DEPTH_STEP_M, what is farther as 1000 m."""
    steps = np.round(np.clip(depth_m.astype(np.float64) / DEPTH_RANGE_M, 0.0, 1.0) * DEPTH_STEPS).astype("<u4")
    picture = steps[..., None].view(np.uint8)[..., [2, 1, 0, 3]]
    picture[..., 3] = 255
    return picture


def tags_picture(kinds: np.ndarray, actors: np.ndarray) -> np.ndarray:
    """Encode semantic numbers and actors' numbers, (h, w) each, as BGRA; of an actor's number 16 bits are left."""
    low, high = actors & 0xFF, actors >> 8 & 0xFF
    return np.stack([high, low, kinds, np.full_like(kinds, 255)], axis=-1).astype(np.uint8)


def _definitions() -> list:
    """Return the blueprints: uid, id, tags, attributes."""
    named = [(name, CAMERA_ATTRIBUTES + (FILM_ATTRIBUTES if name.endswith(".rgb") else [])) for name in CAMERAS]
    named += [(f"walker.pedestrian.{k:04d}", [("is_invincible", BOOL, "true")]) for k in range(1, 17)]
    named += [(name, []) for name in VEHICLES]
    found = []
    for uid, (name, own) in enumerate(named, 1):
        attributes = [[*row, [], True, False] for row in (*own, ("role_name", STRING, "default"))]
        found.append([uid, name, name.replace(".", ","), attributes])
    return found
