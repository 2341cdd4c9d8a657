"""The server: msgpack-RPC at a port, streams of sensors at the next, and faults that can be planted.

One thread does everything that the world is asked, in the order in which it comes, and ticks; others read from sockets.
The layouts are those of CARLA 0.9.16's client library (LibCarla: `rpc`, `streaming`, `sensor/s11n`).
"""

from __future__ import annotations

import logging
import os
import queue
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

from cosfly.errors import EnvironmentMissing
from cosfly.products.boxes import BoxMap
from cosfly.simulators.carla.world import CAMERAS, Actor, World
from cosfly.simulators.serving import Fault, due, listen, send
from cosfly.unreal.conventions import CARLA_VERSION, SIMULATED_STEP_S

log = logging.getLogger(__name__)

EPISODE_STREAM, EPISODE_OBSERVER = 1, 17  # the stream of the world's state, and its number as a sensor
FIRST_SENSOR_STREAM = 1000
BYTES_BY_KIND = 54  # of an actor's state
SETTINGS: list[Any] = [False, False, [False], True, 0.01, 10, 0.0, False, 3000.0, 2000.0, True]  # as a server starts
ROADS = (
    '<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4" name="" version="1.00" date="" north="0" '
    'south="0" east="0" west="0"><geoReference>+proj=tmerc +lat_0=0 +lon_0=0</geoReference></header></OpenDRIVE>'
)
FAULTS = ("drop", "delay", "duplicate", "reorder", "malformed", "late", "unhealthy", "hang", "die")  # simulators.md


class CarlaServer:
    """A world behind two ports. `serve` works until the process ends."""

    def __init__(self, town: BoxMap, host: str, port: int, faults: list[Fault]) -> None:
        try:
            import msgpack
        except ModuleNotFoundError as error:
            fix = 'pip install "cosfly[carla]"'
            raise EnvironmentMissing("a package of the simulators is not installed", got=str(error), fix=fix) from None
        self._msgpack, self.town, self.world, self.faults = msgpack, town.name, World(town), faults
        self.port, self.frame, self.num_ticks, self.episode = port, 0, 0, 1
        self.settings = list(SETTINGS)
        self._calls: queue.SimpleQueue[tuple[socket.socket, list]] = queue.SimpleQueue()
        self._streams: dict[int, list[socket.socket]] = {}
        self._held: dict[int, bytes] = {}  # messages that are sent after the next one
        listen(host, port, self._read_calls, "; it takes that port and the next")
        listen(host, port + 1, self._read_subscription)
        self._answers = self._make_answers()

    def serve(self) -> None:
        """Answer calls; while no client leads the clock, tick at the pace of the settings."""
        while True:
            step_s = self._step_s()
            try:
                connection, (_, call_id, method, arguments) = self._calls.get(timeout=step_s)
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

    # --- calls --------------------------------------------------------------------------------------------------------

    def _read_calls(self, connection: socket.socket) -> None:
        unpacker = self._msgpack.Unpacker(raw=False, strict_map_key=False)
        while data := connection.recv(65536):
            unpacker.feed(data)
            for message in unpacker:
                self._calls.put((connection, message))

    def _answer(self, connection: socket.socket, call_id: int, method: str, arguments: list) -> None:
        """Answer one call; the first argument is the client's metadata."""
        result: list[list]
        try:
            value = self._answers[method](*arguments[1:])  # KeyError: this server does not know it
            result = [[False]] if value is None else [[1, value]]  # nothing is told as: no error
        except (ValueError, KeyError, IndexError, TypeError) as error:
            result = [[0, [f"{method}: {error}"]]]
            log.info("%s: %r", method, error)
        if method == "tick_cue" and (fault := self._due("late")):
            time.sleep(fault.seconds)
        if self._due("hang") or (method == "version" and self._due("unhealthy")):
            return
        send(connection, self._msgpack.packb([1, call_id, None, result]))

    def _make_answers(self) -> dict[str, Callable[..., Any]]:
        world = self.world
        name = f"Carla/Maps/{self.town}"
        return {
            "version": lambda: CARLA_VERSION,
            "get_available_maps": lambda: [f"/Game/{name}"],
            "load_new_episode": self._load,
            "get_episode_info": lambda: [self.episode, [self._token(EPISODE_STREAM)]],
            "get_sensor_token": lambda stream: [self._token(stream)],
            "get_episode_settings": lambda: self.settings,
            "set_episode_settings": self._set_settings,
            "get_map_info": lambda: [name, []],
            "get_map_data": lambda: ROADS,
            "get_required_files": lambda *_: [],
            "query_lights_state": lambda *_: [],
            "get_weather_parameters": lambda: world.weather,
            "set_weather_parameters": lambda told: world.weather.__setitem__(slice(None), told),
            "get_environment_objects": world.environment_objects,
            "get_all_level_BBs": lambda label: [box for _, box in world.boxes(label)],
            "get_actor_definitions": world.definitions,
            "get_actors_by_id": lambda numbers: [self._told(world.actors[n]) for n in numbers if n in world.actors],
            "get_actor_bounding_box": lambda number: world.actors[number].box(),
            "spawn_actor": lambda description, transform, *_: self._told(world.spawn(description, transform)),
            "destroy_actor": lambda number: world.actors.pop(number, None) is not None,
            "set_actor_transform": self._move,
            "set_actor_location": lambda number, place: world.actors[number].pose.__setitem__(slice(3), place),
            "apply_control_to_walker": self._control,
            **{f"set_actor_{name}": lambda *_: None for name in ("collisions", "enable_gravity", "simulate_physics")},
            "tick_cue": self._led_tick,
        }

    def _load(self, town: str, *_: Any) -> None:
        if town.rpartition("/")[2] != self.town:
            raise ValueError(f"no map {town}; there is {self.town}")
        self.episode += 1
        self.world.actors.clear()

    def _set_settings(self, settings: list) -> int:
        self.settings = settings
        return self.frame

    def _told(self, actor: Actor) -> list:
        """An actor as clients are told of it; with a token it is a sensor."""
        is_sensor = actor.model in CAMERAS
        token = self._token(FIRST_SENSOR_STREAM + actor.number) if is_sensor else b""
        return [actor.number, 0, actor.description, actor.box(), bytes([actor.semantic_tag]), token]

    def _move(self, number: int, transform: list) -> None:
        self.world.actors[number].pose[:] = [*transform[0], *transform[1]]

    def _control(self, number: int, control: list) -> None:
        self.world.actors[number].direction, self.world.actors[number].speed_mps = tuple(control[0]), control[1]

    # --- time and streams ---------------------------------------------------------------------------------------------

    def _led_tick(self) -> int:
        self.num_ticks += 1
        if self._due("die"):
            os._exit(1)
        self._tick()
        return self.frame

    def _tick(self) -> None:
        """Go one step on and send what everybody who listens is to see of it."""
        self.frame += 1
        self.world.step(self._step_s())
        self._send_state(self._streams.get(EPISODE_STREAM, []))
        for actor in list(self.world.actors.values()):
            connections = self._streams.get(FIRST_SENSOR_STREAM + actor.number)
            if connections and actor.model in CAMERAS:
                width, height, fov_deg, picture = self.world.picture(actor)
                message = self._head(CAMERAS[actor.model], actor.pose) + struct.pack("<IIf", width, height, fov_deg)
                self._send_sensor(actor, connections, message + picture)

    def _head(self, sensor: int, pose: list[float]) -> bytes:
        return struct.pack("<QQd6f", sensor, self.frame, self.frame * self._step_s(), *pose)

    def _send_state(self, connections: list[socket.socket]) -> None:
        """Send the world's state: episode, times, map origin, and of every actor where it is."""
        time_s = self.frame * self._step_s()
        body = struct.pack("<Qdf3ii", self.episode, time_s, self._step_s(), 0, 0, 0, 0)
        for number, actor in self.world.actors.items():
            motion = [part * actor.speed_mps for part in actor.direction] + [0.0] * 6
            body += struct.pack("<IB15f", number, 1, *actor.pose, *motion) + bytes(BYTES_BY_KIND)
        self._send_stream(EPISODE_STREAM, connections, self._head(EPISODE_OBSERVER, [0.0] * 6) + body)

    def _send_sensor(self, actor: Actor, connections: list[socket.socket], message: bytes) -> None:
        """Send a picture, with what is planted for it."""
        sensor, stream = actor.model.split(".")[2].split("_")[0], FIRST_SENSOR_STREAM + actor.number
        if self._due("drop", sensor):
            return
        if self._due("malformed", sensor):
            message = message[:40]
        if self._due("reorder", sensor):
            self._held[stream] = message
            return
        if fault := self._due("delay", sensor):
            threading.Timer(fault.seconds, self._send_stream, (stream, connections, message)).start()
            return
        for one in [message] * (2 if self._due("duplicate", sensor) else 1) + [self._held.pop(stream, b"")]:
            if one:
                self._send_stream(stream, connections, one)

    def _send_stream(self, stream: int, connections: list[socket.socket], message: bytes) -> None:
        for connection in list(connections):
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
        """Where a stream is: its number, port, TCP, an address of version 4 that the client fills in with its host."""
        return struct.pack("<IHBB", stream, self.port + 1, 1, 1) + bytes([127, 0, 0, 1]) + bytes(12)
