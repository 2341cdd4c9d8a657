"""Rendering by a running CARLA server: it draws its own town, people and air, and this module decodes (sec:step5).

Each frame is one synchronous tick of three cameras in one place. Boxes that CARLA does not have get no id.
"""

import logging
import multiprocessing
import os
import queue
import threading
import time
from dataclasses import asdict
from typing import Any

import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import INVALID_DEPTH_M, SKY_DEPTH_M
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.formats.weather import WeatherParams
from cosfly.render.contract import NEAR_M, NO_INSTANCE, Frame, PosedPeople, PosedPerson, far_as_sky, instance_ids
from cosfly.render.simulator import NoPictureError, ServerCommand, SimulatorRenderer, placement_of
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.simulators import conventions
from cosfly.simulators.carla_client import CarlaConfig, CarlaConnection, connect, read_attributes, set_attributes
from cosfly.simulators.conventions import ACTOR_BITS, SIMULATED_STEP_S, unreal_pose

log = logging.getLogger(__name__)

HEALTH_CHECK_S = 5.0  # between health checks, and for each
HEALTH_CHECKS = 3  # in a row that fail: the worker ends
PICTURE_SHARE = 1 / 3  # of timeout_s, in which a picture must come after its tick
SENSORS = {"rgb": "rgb", "depth": "depth", "tags": "instance_segmentation"}
SAME_BOX_M = 0.05
PERSON_KEY = KINDS["Pedestrians"] << 16  # in the table of ids, plus the 16 bits of a picture
# Fixed exposure and no motion blur.
RGB_ATTRIBUTES = {"exposure_mode": "manual", "motion_blur_intensity": "0.0", "motion_blur_max_distortion": "0.0"}
SPAWN_M = 300.0  # over the map, where the air is free


class CarlaRenderConfig(CarlaConfig, ServerCommand):
    """CARLA as a renderer; worker i asks the server at port + 10 i."""


class CarlaRenderer(SimulatorRenderer):
    """A renderer that uses a CARLA server with the town of the map."""

    engine = "carla"
    port_step = 10  # a server takes three ports, from its own on
    # The following belong to one connection; Any is a type of the package carla.
    _server: CarlaConnection
    _world: Any
    _spectator: Any
    _library: Any  # of blueprints
    _cameras: dict[str, tuple[Any, queue.SimpleQueue]]  # by name in SENSORS: the sensor, and its pictures
    _walkers: dict[int, Any]  # by instance id
    _fov_deg: float  # of the cameras
    _ids: np.ndarray  # as `_ids_in_pictures` returns it, and with the walkers

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._weather: WeatherParams | None = None
        self._closed = threading.Event()
        super().__init__(*args, **kwargs)
        if multiprocessing.parent_process() is not None:  # the check ends this process, so it must be a worker
            threading.Thread(target=self._watch_health, daemon=True).start()

    # --- the server ---------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        """Start the server if a command is given, connect, and control its clock."""
        self._guard = self._start_guard()
        try:
            self._server = connect(self._cfg, self._port)
            self.device = f"CARLA {self._server.version} at {self._server.endpoint}, {self._server.town}"
            with self._server.asking("CARLA did not return its world"):
                world = self._world = self._server.world
                settings = world.get_settings()
                self._spectator = world.get_spectator()
                view = self._spectator.get_transform()
                location = [view.location.x, view.location.y, view.location.z]
                rotation = [view.rotation.pitch, view.rotation.yaw, view.rotation.roll]
                weather = read_attributes(world.get_weather())
                self._guard.note(
                    {"settings": read_attributes(settings), "weather": weather, "spectator": [location, rotation]}
                )
                settings.synchronous_mode = True
                settings.spectator_as_ego = True  # the tiles of a large map are loaded around the spectator
                settings.fixed_delta_seconds = SIMULATED_STEP_S
                world.apply_settings(settings)
                self._library = world.get_blueprint_library()
                self._cameras = {}
                self._walkers = {}
                self._fov_deg = 0.0
                self._ids = _ids_in_pictures(self._server, self._map, self._num_others)
        except Exception:
            self._guard.close()
            raise

    def _recover(self, problem: Exception) -> None:
        if isinstance(problem, NoPictureError):
            self._stop_cameras()
            return
        self._guard.close()
        self._open()
        self._set_weather()

    def _watch_health(self) -> None:
        """Ask for the version every few seconds; end the process after HEALTH_CHECKS failures in a row."""
        client = self._server.carla.Client(self._cfg.host, self._port)
        client.set_timeout(HEALTH_CHECK_S)
        num_failed = 0
        while num_failed < HEALTH_CHECKS:
            if self._closed.wait(HEALTH_CHECK_S):
                return
            try:
                client.get_server_version()
                num_failed = 0
            except RuntimeError as error:
                num_failed += 1
                log.warning("%s: health check %d of %d failed: %s", self.device, num_failed, HEALTH_CHECKS, error)
        log.error("%s: the server does not answer, so the worker ends", self.device)
        os._exit(1)

    def close(self) -> None:
        """Restore the server, and disconnect."""
        self._closed.set()
        self._stop_cameras()
        self._guard.close()

    # --- one trajectory --------------------------------------------------------------------------------------

    def prepare(self, low_m: np.ndarray, high_m: np.ndarray, weather: WeatherParams | None = None) -> None:
        """Set the weather, and remove all people."""
        self._weather = weather
        for instance_id in list(self._walkers):
            self._remove(instance_id)
        self._set_weather()

    def _set_weather(self) -> None:
        """Set the six knobs of the paper, with CARLA's others zero; without a weather, CARLA's ClearNoon.

        So no trajectory inherits what another client left.
        """
        carla = self._server.carla
        weather = carla.WeatherParameters.ClearNoon
        if self._weather is not None:
            weather = set_attributes(carla.WeatherParameters(), self._weather.model_dump())
        with self._server.asking("CARLA did not set the weather"):
            self._world.set_weather(weather)

    # --- one frame ----------------------------------------------------------------------------------------------------

    def _frame(self, camera_pose: np.ndarray, fov_deg: float, people: PosedPeople) -> Frame:
        pose = self._transform(camera_pose[:3, 3], conventions.camera_rotation_deg(camera_pose))
        if fov_deg != self._fov_deg or not self._cameras:
            self._make_cameras(fov_deg, pose)
        for instance_id in self._walkers.keys() - people.keys():
            self._remove(instance_id)
        for instance_id, person in people.items():
            self._place(instance_id, person)
        for camera, _ in self._cameras.values():
            camera.set_transform(pose)
        self._spectator.set_transform(pose)
        pictures = self._pictures(self._world.tick(self._cfg.timeout_s))
        depth = conventions.depth_of(pictures["depth"])
        kinds, actors = conventions.tags_of(pictures["tags"])
        kinds[kinds > max(KIND_NAMES)] = KINDS["NONE"]
        depth[depth < NEAR_M] = INVALID_DEPTH_M
        depth[kinds == KINDS["Sky"]] = SKY_DEPTH_M
        ids = self._ids[kinds.astype(np.int64) << 16 | actors]
        return far_as_sky(Frame(np.ascontiguousarray(pictures["rgb"][..., 2::-1]), depth, kinds, ids))

    def _pictures(self, tick: int) -> dict[str, np.ndarray]:
        """Wait for the picture of a tick from every camera, (h, w, 4) BGRA; pictures of earlier ticks are ignored."""
        limit_s = PICTURE_SHARE * self._cfg.timeout_s
        pictures = {}
        until_s = time.monotonic() + limit_s
        for name, (_, inbox) in self._cameras.items():
            while name not in pictures:
                try:
                    picture_tick, data = inbox.get(timeout=max(0.0, until_s - time.monotonic()))
                except queue.Empty:
                    raise NoPictureError(
                        f"camera {name} sent no picture of tick {tick} in {limit_s:g} s; raise render.carla.timeout_s"
                    ) from None
                if picture_tick == tick:
                    pictures[name] = np.frombuffer(data, np.uint8).reshape(*self._size_px[::-1], 4)
        return pictures

    # --- cameras ------------------------------------------------------------------------------------------------------

    def _make_cameras(self, fov_deg: float, pose: Any) -> None:
        """Spawn the three cameras for a field of view, and tick until all of them listen."""
        self._stop_cameras()
        width, height = map(str, self._size_px)
        for name, blueprint_name in SENSORS.items():
            blueprint = self._library.find(f"sensor.camera.{blueprint_name}")
            attributes = {"image_size_x": width, "image_size_y": height, "fov": f"{fov_deg:g}"}
            for key, text in (attributes | (RGB_ATTRIBUTES if name == "rgb" else {})).items():
                blueprint.set_attribute(key, text)
            inbox: queue.SimpleQueue = queue.SimpleQueue()
            camera = self._spawned(blueprint, pose)
            camera.listen(lambda image, inbox=inbox: inbox.put((image.frame, bytes(image.raw_data))))
            self._cameras[name] = camera, inbox
        carla = self._server.carla
        for walker in self._walkers.values():
            walker.apply_control(carla.WalkerControl(carla.Vector3D(1.0, 0.0, 0.0), 0.0, False))
        self._fov_deg = fov_deg
        until_s = time.monotonic() + PICTURE_SHARE * self._cfg.timeout_s
        while any(inbox.empty() for _, inbox in self._cameras.values()) and time.monotonic() < until_s:
            self._world.tick(self._cfg.timeout_s)
            time.sleep(SIMULATED_STEP_S)

    def _stop_cameras(self) -> None:
        for camera, _ in self._cameras.values():
            camera.stop()
            camera.destroy()
        self._cameras.clear()

    # --- people -------------------------------------------------------------------------------------------------------

    def _place(self, instance_id: int, person: PosedPerson) -> None:
        """Put a person one step before the place, because the tick moves walkers there."""
        carla = self._server.carla
        walker = self._walkers.get(instance_id) or self._add(instance_id, person)
        placement = placement_of(person, SIMULATED_STEP_S)
        x, y, z = unreal_pose(placement.ahead, placement.rotation_deg)[:3]
        walker.apply_control(carla.WalkerControl(carla.Vector3D(x, y, z), placement.speed_mps, False))
        walker.set_transform(self._transform(placement.hip_m, placement.rotation_deg))

    def _add(self, instance_id: int, person: PosedPerson) -> Any:
        """Spawn a walker by a person's clothes, and note the number of the actor in pictures."""
        names = sorted(blueprint.id for blueprint in self._library.filter("walker.pedestrian.*"))
        worn = dump_json(asdict(person.clothes.looks))
        name = names[int(sha256_bytes(worn.encode())[:8], 16) % len(names)]
        walker = self._spawned(self._library.find(name), self._far_up())
        self._walkers[instance_id] = walker
        walker.set_collisions(False)
        walker.set_enable_gravity(False)
        self._ids[PERSON_KEY | walker.id & ACTOR_BITS] = instance_id
        return walker

    def _remove(self, instance_id: int) -> None:
        walker = self._walkers.pop(instance_id)
        self._ids[PERSON_KEY | walker.id & ACTOR_BITS] = NO_INSTANCE
        walker.destroy()

    def _spawned(self, blueprint: Any, transform: Any) -> Any:
        """Spawn an actor that the guard destroys if this process ends early."""
        actor = self._world.spawn_actor(blueprint, transform)
        self._guard.note(actor.id)
        return actor

    def _far_up(self) -> Any:
        """Return a free place over the map, so that no two spawned actors touch."""
        x, y, z = self._map.bounds()[1]
        return self._transform(np.array([x + 10.0 * len(self._walkers), y, z + SPAWN_M]), np.zeros(3))

    def _transform(self, position_m: np.ndarray, rotation_deg: np.ndarray) -> Any:
        carla = self._server.carla
        x, y, z, pitch, yaw, roll = unreal_pose(position_m, rotation_deg)
        return carla.Transform(carla.Location(x, y, z), carla.Rotation(pitch, yaw, roll))


def _ids_in_pictures(server: CarlaConnection, box_map: BoxMap, num_others: int) -> np.ndarray:
    """Return the table from kind x 65536 + the 16 bits of pictures to instance ids, (n,) uint16.

    `get_level_bbs` returns boxes with the number of their actor. An actor of several boxes, as a building, gets the id
    of the first of them on the map.
    """
    from scipy.spatial import cKDTree

    ids = instance_ids(box_map, num_others)
    table = np.full(len(KINDS) << 16, NO_INSTANCE, dtype=np.uint16)
    num_found, num_doubtful = 0, 0
    for kind in np.unique(box_map.kinds).tolist():
        rows = np.flatnonzero(box_map.kinds == kind)
        boxes = server.world.get_level_bbs(server.carla.CityObjectLabel.values[kind])
        if not boxes:
            continue
        places = (box.location for box in boxes)
        centers = [conventions.world_pose((place.x, place.y, place.z, 0.0, 0.0, 0.0))[0] for place in places]
        gaps_m, nearest = cKDTree(np.array(centers)).query(box_map.centers[rows])
        actor_of_key: dict[int, int] = {}
        is_same = gaps_m <= SAME_BOX_M
        for row, k in zip(rows[is_same].tolist(), nearest[is_same].tolist(), strict=True):
            num_found += 1
            actor = boxes[k].actor_id
            key = kind << 16 | actor & ACTOR_BITS
            if key not in actor_of_key:
                actor_of_key[key] = actor
                table[key] = ids[row]
            num_doubtful += actor_of_key[key] != actor
    where = f"{server.endpoint} (CARLA {server.version}), {server.town}"
    if not num_found:
        what = "none of the boxes of the map is in the town that the server has loaded"
        fix = "export the map from this town (cosfly maps --source carla), or name its town in render.carla.town"
        raise InputError(what, where=where, got=f"the map {box_map.name}", fix=fix)
    if num_found < len(box_map) or num_doubtful:
        note = "%s: %d of %d boxes have an id in the pictures; %d of these share their 16-bit id with another box"
        log.warning(note, where, num_found, len(box_map), num_doubtful)
    return table
