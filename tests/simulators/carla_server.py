"""A CARLA 0.9.16 server, as LibCarla speaks: msgpack-RPC at a port, streams of sensors at the next."""

import itertools
import socket
import struct
import threading
from collections.abc import Callable, Sequence
from typing import Any

import msgpack
import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.formats.weather import WeatherParams
from cosfly.simulators.conventions import DEPTH_RANGE_M, DEPTH_STEPS, SIMULATED_STEP_S, unreal_pose
from simulators.scene import Mover, Server, listen, send

CARLA_VERSION = "0.9.16"
DEPTH_STEP_M = DEPTH_RANGE_M / DEPTH_STEPS
EPISODE_STREAM, EPISODE_OBSERVER = 1, 17  # the stream of the world's state, and its number as a sensor
FIRST_ACTOR = 201  # an actor's number is that of its stream too
BYTES_AFTER_POSE = 90  # of an actor's state: its motion, and what depends on its kind
FIRST_BOX = 100_000  # number of the first box as an actor; pictures hold its low 16 bits
ANY_LABEL = 255
KNOBS = dict(zip(WeatherParams.model_fields, (0, 1, 6, 7, 5, 4), strict=True))  # their places among the parameters
FAIR_WEATHER = [5.0, 0.0, 0.0, 10.0, -1.0, 45.0, 2.0, 0.75, 0.1, 0.0, 1.0, 0.03, 0.0331, 0.0]  # ClearNoon
SPECTATOR = 100  # number of this actor, which a client can move
LEAST_FOG_M = 0.01  # of the embedded renderer; CARLA's own default is 0
SENSORS = {"depth": 1, "rgb": 13, "semantic_segmentation": 14, "instance_segmentation": 15}  # their numbers in streams
CAMERAS = {f"sensor.camera.{name}": number for name, number in SENSORS.items()}
ATTRIBUTES = [  # name, type (2 int, 3 float, 4 str), value
    ("image_size_x", 2, "800"), ("image_size_y", 2, "600"), ("fov", 3, "90.0"), ("exposure_mode", 4, "histogram"),
    ("motion_blur_intensity", 3, "0.45"), ("motion_blur_max_distortion", 3, "0.35"),
]  # fmt: skip
MODELS = [*CAMERAS, *(f"walker.pedestrian.{k:04d}" for k in range(1, 17))]
ROADS = "<OpenDRIVE><header><geoReference>+proj=tmerc +lat_0=0 +lon_0=0</geoReference></header></OpenDRIVE>"


class CarlaServer(Server):
    """A town behind two ports."""

    def __init__(self, town: BoxMap, port: int, faults: Sequence[str]) -> None:
        super().__init__(town, faults)
        self.port, self.frame = port, 0
        self.settings: list[Any] = [False, False, [False], True, 0.01, 10, 0.0, False, 3000.0, 2000.0, True]
        self.told_weather, self._numbers, self._objects = FAIR_WEATHER, itertools.count(FIRST_ACTOR), _objects_of(town)
        self._subscribers = set[tuple[int, socket.socket]]()  # with the number of the stream
        self._held: dict[int, list[bytes]] = {}  # messages that are sent after the next one
        name, actors, detailed = f"Carla/Maps/{town.name}", self.movers, [[*row, [], True, False] for row in ATTRIBUTES]
        self._answers: dict[str, Callable[..., Any]] = {
            "version": lambda: CARLA_VERSION, "get_available_maps": lambda: [f"/Game/{name}"],
            "load_new_episode": self._load, "get_episode_info": lambda: [1, [self._token(EPISODE_STREAM)]],
            "get_sensor_token": lambda stream: [self._token(stream)], "get_episode_settings": lambda: self.settings,
            "set_episode_settings": lambda settings: setattr(self, "settings", settings) or self.frame,
            "get_map_info": lambda: [name, []], "get_map_data": lambda: ROADS,
            "get_weather_parameters": lambda: self.told_weather, "set_weather_parameters": self._set_weather,
            "get_environment_objects": lambda label: [one for one in self._objects if label in (one[-1], ANY_LABEL)],
            "get_all_level_BBs": lambda label: [one[1] for one in self._objects if label in (one[-1], ANY_LABEL)],
            "get_actor_definitions": lambda: [
                [k, name, name.replace(".", ","), detailed] for k, name in enumerate(MODELS)
            ],
            "get_actors_by_id": lambda numbers: [self._actor(n) for n in numbers if n in actors],
            "get_spectator": lambda: self._actor(SPECTATOR),
            "spawn_actor": self._spawn, "destroy_actor": lambda number: actors.pop(number, None) is not None,
            "set_actor_transform": lambda number, to: actors[number].pose.__setitem__(slice(6), [*to[0], *to[1]]),
            "get_actor_bounding_box": lambda number: self._actor(number)[3],
            "apply_control_to_walker": lambda number, to: vars(actors[number]).update(direction=to[0], speed_mps=to[1]),
            "get_required_files": lambda *_: ["../../escaped.bin"] if self.due("escape") else [],
            "query_lights_state": lambda *_: [],
            **{f"set_actor_{name}": lambda *_: None for name in ("collisions", "enable_gravity", "simulate_physics")},
            "tick_cue": lambda: self.count() or self._tick(),
        }  # fmt: skip
        actors[SPECTATOR] = Mover("Camera", "spectator", [0.0] * 6, [0, "spectator", []])
        listen(port, self._read_calls)
        listen(port + 1, self._read_subscription)

    def idle(self) -> None:
        if not self.settings[0]:  # no client leads the clock
            self._tick()

    def _read_calls(self, connection: socket.socket) -> None:
        unpacker = msgpack.Unpacker(raw=False, strict_map_key=False)
        while data := connection.recv(65536):
            unpacker.feed(data)
            for _, number, method, arguments in unpacker:
                self.calls.put((connection, number, method, arguments))

    def answer(self, connection: socket.socket, number: int, method: str, arguments: list) -> None:
        try:
            value = self._answers[method](*arguments[1:])
            result = [[False]] if value is None else [[1, value]]
        except (ValueError, KeyError) as error:
            result = [[0, [f"{method}: {error}"]]]
        if not self.due("hang"):
            send(connection, msgpack.packb([1, number, None, result]))

    def _load(self, town: str, *_: Any) -> None:
        raise ValueError(f"no map {town}; there is {self.town.name}")

    def _set_weather(self, told: list[float]) -> None:
        is_fair, self.told_weather = np.allclose(told, FAIR_WEATHER), told  # single precision
        knobs = {name: told[k] for name, k in KNOBS.items()}
        knobs["fog_distance"] = max(knobs["fog_distance"], LEAST_FOG_M)
        knobs["sun_azimuth_angle"] %= 360.0
        self.weather = None if is_fair else WeatherParams(**knobs)

    def _actor(self, number: int) -> list:
        actor = self.movers[number]
        box = [[0.0] * 3, PERSON_HALF_EXTENTS_M, [0.0] * 3, number]
        return [number, 0, actor.description, box, b"", self._token(number) if actor.model in CAMERAS else b""]

    def _spawn(self, description: list, transform: list, *_: Any) -> list:
        number, pose = next(self._numbers), [*transform[0], *transform[1]]
        self.movers[number] = Mover(description[1].startswith("walker."), description[1], pose, description)
        return self._actor(number)

    def _tick(self) -> int:
        self.frame += 1
        for actor in self.movers.values():
            actor.step(SIMULATED_STEP_S)
        self._send_stream(EPISODE_STREAM, self._state())
        for number in {stream for stream, _ in list(self._subscribers)} & self.movers.keys():
            self._send_sensor(number, self.movers[number])
        return self.frame

    def _head(self, sensor: int, pose: list[float]) -> bytes:
        return struct.pack("<QQd6f", sensor, self.frame, self.frame * SIMULATED_STEP_S, *pose)

    def _state(self) -> bytes:
        """Return the world's state: episode, times, map origin, and the pose of every actor."""
        body = struct.pack("<Qdf3ii", 1, self.frame * SIMULATED_STEP_S, SIMULATED_STEP_S, 0, 0, 0, 0)
        for number, actor in list(self.movers.items()):
            body += struct.pack("<IB6f", number, 1, *actor.pose) + bytes(BYTES_AFTER_POSE)
        return self._head(EPISODE_OBSERVER, [0.0] * 6) + body

    def _send_sensor(self, number: int, camera: Mover) -> None:
        sensor = camera.model.split("_")[0].rpartition(".")[2]
        messages = self.faulty(self._head(CAMERAS[camera.model], camera.pose) + self._seen(camera), sensor)
        if self.due("reorder", sensor):
            self._held[number] = messages
        elif seconds := self.due("delay", sensor):
            threading.Timer(seconds, self._send_stream, (number, *messages)).start()
        else:
            self._send_stream(number, *messages, *self._held.pop(number, []))

    def _send_stream(self, stream: int, *messages: bytes) -> None:
        for subscribed, connection in list(self._subscribers):
            for message in messages if subscribed == stream else ():
                send(connection, struct.pack("<I", len(message)) + message)

    def _read_subscription(self, connection: socket.socket) -> None:
        subscriber = struct.unpack("<I", connection.recv(4))[0], connection
        self._subscribers.add(subscriber)
        self._send_stream(EPISODE_STREAM, self._state())  # a client waits for its first
        connection.recv(1)  # nothing comes until the client is gone
        self._subscribers.discard(subscriber)

    def _token(self, stream: int) -> bytes:
        """Return number, port, TCP, and an address of version 4 that the client fills in with its host."""
        return struct.pack("<IHBB", stream, self.port + 1, 1, 1) + bytes([127, 0, 0, 1]) + bytes(12)

    def _seen(self, camera: Mover) -> bytes:
        """Return width, height, field of view and BGRA of what a camera sees now."""
        given = {name: text for name, _, text in camera.description[2]}
        size, fov_deg = (int(given["image_size_x"]), int(given["image_size_y"])), float(given["fov"])
        frame, owners = self.draw(size, fov_deg, camera.pose)
        match CAMERAS[camera.model]:
            case 1:
                picture = depth_picture(frame.depth)
            case 13:
                picture = _bgra(*np.moveaxis(frame.rgb, -1, 0))
            case number:
                numbers = np.array([*(box[3] for _, box, *_ in self._objects), *self.bodies(), 0])[owners]
                picture = _bgra(frame.kinds, numbers * (number == 15), numbers * (number == 15) >> 8)
        return struct.pack("<IIf", *size, fov_deg) + picture.tobytes()


def depth_picture(depth_m: np.ndarray) -> np.ndarray:
    """Encode z-depth, (h, w) m, as BGRA, (h, w, 4) uint8; to the nearest DEPTH_STEP_M, what is farther as 1000 m."""
    steps = np.round(np.clip(depth_m.astype(np.float64) / DEPTH_RANGE_M, 0.0, 1.0) * DEPTH_STEPS).astype(np.uint32)
    return _bgra(steps, steps >> 8, steps >> 16)


def _bgra(red: np.ndarray, green: np.ndarray, blue: np.ndarray) -> np.ndarray:
    return np.stack([blue, green, red, np.full_like(red, 255)], axis=-1).astype(np.uint8)


def _objects_of(town: BoxMap) -> list:
    found, halves, ids, kinds = [], town.half_extents.tolist(), town.ids.tolist(), town.kinds.tolist()
    for row in range(len(town)):
        pose = unreal_pose(town.centers[row], town.rotations_deg[row])
        box = [pose[:3], halves[row], pose[3:], FIRST_BOX + row]
        found.append([[pose[:3], pose[3:]], box, ids[row], f"Box_{ids[row]}", kinds[row]])
    return found
