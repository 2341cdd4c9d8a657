"""A running CARLA server as a renderer: it draws its own town, person and air, and we decode (sec:step5).

One synchronous tick a frame, at the pose of the frame: three cameras in one place, and pictures of that very tick. Each
worker has a server of its own. What a server did not give is asked again; a health check beside that ends the worker,
which the stage replaces, and a guard leaves the server as it was found. Of a box that CARLA has not, and of what has no
box, the id is NO_INSTANCE.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import queue
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import INVALID_DEPTH_M, SKY_DEPTH_M, Look
from cosfly.formats.kinds import KIND_NAMES, KINDS
from cosfly.formats.weather import WeatherParams
from cosfly.render.contract import (
    NEAR_M,
    NO_INSTANCE,
    PERSON_ID,
    Frame,
    PosedBystander,
    PosedCar,
    PosedPerson,
    check_pose,
    far_as_sky,
    instance_ids,
)
from cosfly.render.engines import WALK_MPS, NoPictureError, fov_of, keep_asking
from cosfly.runtime.config import MayDiffer
from cosfly.runtime.errors import InputError, RenderError
from cosfly.runtime.io import sha256_bytes
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.worker import worker_place
from cosfly.simulators.carla_client import CarlaConfig, CarlaConnection, connect
from cosfly.simulators.conventions import (
    ACTOR_BITS,
    SIMULATED_STEP_S,
    camera_rotation_deg,
    depth_of,
    tags_of,
    unreal_pose,
    world_pose,
)
from cosfly.simulators.guard import EngineGuard, values_of, with_values

log = logging.getLogger(__name__)

PORT_STEP = 10  # a server takes three ports from its own on
HEALTH_CHECKS = 3  # in a row that fail: the worker ends
SENSORS = {"rgb": "rgb", "depth": "depth", "tags": "instance_segmentation"}
MOVER_KINDS = ("Pedestrians", "Rider", "Car", "Truck", "Bus", "Motorcycle", "Bicycle")
SAME_BOX_M = 0.05
SPAWN_M = 300.0  # over the map, where nothing stands in the way


class CarlaRenderConfig(CarlaConfig):
    """CARLA as a renderer; worker i asks the server at port + 10 i."""

    server_command: MayDiffer[str] = Field(
        "",
        description="starts a server, with {port} in it, as 'CarlaUE4.sh -RenderOffScreen -carla-rpc-port={port}'; it "
        "is started again when it dies; empty: servers run already",
    )
    rgb_attributes: dict[str, str] = Field(
        {"exposure_mode": "manual", "motion_blur_intensity": "0.0", "motion_blur_max_distortion": "0.0"},
        description="attributes of the RGB camera: fixed exposure, no motion blur, and what else a blueprint has",
    )
    picture_s: MayDiffer[float] = Field(20.0, gt=0, description="how long a picture may come after its tick, s")
    retries: MayDiffer[int] = Field(2, ge=0, description="how often a frame is asked again")
    health_check_s: MayDiffer[float] = Field(
        5.0, gt=0, description="seconds between health checks, and for each; three that fail end the worker"
    )


class CarlaRenderer:
    """Draws by a CARLA server whose town is the map's."""

    dresses = False  # a walker wears what its blueprint wears

    def __init__(
        self,
        box_map: BoxMap,
        width_px: int,
        height_px: int,
        look: Look,
        num_others: int = 0,
        rim: BoxMap | None = None,
        settings: CarlaRenderConfig = CarlaRenderConfig(),
    ) -> None:
        self._map, self._size_px, self._num_others, self._cfg = box_map, (width_px, height_px), num_others, settings
        self._port = settings.port + PORT_STEP * worker_place()
        self._weather: WeatherParams | None = None
        self._closed = threading.Event()
        self._open()
        if multiprocessing.parent_process() is not None:  # ending this process is the way out, so it must be a worker
            threading.Thread(target=self._watch_health, daemon=True).start()

    # --- the server ---------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        """Start the server if that is ours to do, connect, and lead its clock."""
        cfg = self._cfg
        self._guard = EngineGuard("carla", cfg.host, self._port, cfg.server_command, cfg.timeout_s)
        try:
            self._server = connect(self._cfg, self._port)
            self.device = f"CARLA {self._server.version} at {self._server.endpoint}, {self._server.town}"
            with self._server.asking("the world was not given"):
                world = self._world = self._server.world
                settings, self._found_weather = world.get_settings(), world.get_weather()
                self._guard.note({"settings": values_of(settings), "weather": values_of(self._found_weather)})
                settings.synchronous_mode, settings.fixed_delta_seconds = True, SIMULATED_STEP_S
                world.apply_settings(settings)
                self._library = world.get_blueprint_library()
                self._cameras: dict[str, tuple[Any, queue.SimpleQueue]] = {}
                self._movers: dict[int, Any] = {}
                self._fov_deg, self._sizes_m = 0.0, dict[str, np.ndarray]()
                self._ids = _ids_in_pictures(self._server, self._map, self._num_others)
        except Exception:
            self._guard.close()
            raise

    def _open_again(self) -> None:
        self._guard.close()
        self._open()
        self._set_weather()

    def _watch_health(self) -> None:
        """Ask for the version now and then; end the process where nobody answers."""
        client = self._server.carla.Client(self._cfg.host, self._port)
        client.set_timeout(self._cfg.health_check_s)
        num_failed = 0
        while num_failed < HEALTH_CHECKS:
            if self._closed.wait(self._cfg.health_check_s):
                return
            try:
                client.get_server_version()
                num_failed = 0
            except RuntimeError as error:
                num_failed += 1
                log.warning("%s: health check %d of %d failed: %s", self.device, num_failed, HEALTH_CHECKS, error)
        log.error("%s: not healthy: the worker is given up", self.device)
        os._exit(1)

    def close(self) -> None:
        """Leave the server as it was found."""
        self._closed.set()
        self._stop_cameras()
        self._guard.close()

    # --- what holds for a flight --------------------------------------------------------------------------------------

    def prepare(self, low_m: np.ndarray, high_m: np.ndarray, weather: WeatherParams | None = None) -> None:
        """Set the weather; without one, the weather is what the server was found with. Everybody is spawned anew."""
        self._weather = weather
        for number in list(self._movers):
            self._remove(number)
        self._set_weather()

    def _set_weather(self) -> None:
        """Set our six knobs; the others are zero, so that no flight inherits them."""
        weather = self._found_weather
        if self._weather is not None:
            weather = with_values(self._server.carla.WeatherParameters(), self._weather.model_dump())
        with self._server.asking("the weather was not set"):
            self._world.set_weather(weather)

    # --- one frame ----------------------------------------------------------------------------------------------------

    def render(
        self,
        camera_pose: np.ndarray,
        intrinsic: np.ndarray,
        person: PosedPerson | None,
        others: Sequence[PosedBystander] = (),
    ) -> Frame:
        """Draw one frame, as the contract says."""
        check_pose(camera_pose, intrinsic)
        fov_deg = fov_of(intrinsic, self._size_px, self.device)
        bodies = ({} if person is None else {PERSON_ID: person}) | {one.instance_id: one.body for one in others}
        return keep_asking(
            lambda: self._frame(camera_pose, fov_deg, bodies), self._mend, self._cfg.retries, self.device
        )

    def _mend(self, problem: Exception) -> None:
        if isinstance(problem, NoPictureError):
            self._stop_cameras()
        else:
            self._open_again()

    def _frame(self, camera_pose: np.ndarray, fov_deg: float, bodies: dict[int, PosedPerson | PosedCar]) -> Frame:
        pose = self._transform(camera_pose[:3, 3], camera_rotation_deg(camera_pose))
        if fov_deg != self._fov_deg or not self._cameras:
            self._make_cameras(fov_deg, pose)
        for number in self._movers.keys() - bodies.keys():
            self._remove(number)
        for number, body in bodies.items():
            self._place(number, body)
        for camera, _ in self._cameras.values():
            camera.set_transform(pose)
        pictures = self._pictures(self._world.tick(self._cfg.timeout_s))
        depth = depth_of(pictures["depth"])
        kinds, actors = tags_of(pictures["tags"])
        kinds[kinds > max(KIND_NAMES)] = KINDS["NONE"]
        depth[depth < NEAR_M] = INVALID_DEPTH_M
        depth[kinds == KINDS["Sky"]] = SKY_DEPTH_M
        ids = self._ids[kinds.astype(np.int64) << 16 | actors]
        return far_as_sky(Frame(np.ascontiguousarray(pictures["rgb"][..., 2::-1]), depth, kinds, ids))

    def _pictures(self, frame: int) -> dict[str, np.ndarray]:
        """Wait for the picture of a tick from every camera, (h, w, 4) BGRA; earlier ones, and doubles, are let go."""
        pictures, until_s = {}, time.monotonic() + self._cfg.picture_s
        for name, (_, inbox) in self._cameras.items():
            while name not in pictures:
                try:
                    number, data = inbox.get(timeout=max(0.0, until_s - time.monotonic()))
                except queue.Empty:
                    what = f"camera {name}: nothing of tick {frame} in {self._cfg.picture_s:g} s"
                    raise NoPictureError(what) from None
                if number == frame:
                    pictures[name] = np.frombuffer(data, np.uint8).reshape(*self._size_px[::-1], 4)
        return pictures

    # --- cameras ------------------------------------------------------------------------------------------------------

    def _make_cameras(self, fov_deg: float, pose: Any) -> None:
        """Spawn the three; another field of view needs others. Until all listen, ticks go by."""
        self._stop_cameras()
        for name, blueprint_name in SENSORS.items():
            blueprint = self._library.find(f"sensor.camera.{blueprint_name}")
            size = zip(("image_size_x", "image_size_y"), map(str, self._size_px), strict=True)
            attributes = {**dict(size), "fov": f"{fov_deg:g}", **(self._cfg.rgb_attributes if name == "rgb" else {})}
            for key, text in attributes.items():
                if not blueprint.has_attribute(key):
                    fix = "leave it out of render.carla.rgb_attributes"
                    raise RenderError("a camera has no such attribute", where=self.device, got=key, fix=fix)
                blueprint.set_attribute(key, text)
            inbox: queue.SimpleQueue = queue.SimpleQueue()
            camera = self._spawned(blueprint, pose)
            camera.listen(lambda image, inbox=inbox: inbox.put((image.frame, bytes(image.raw_data))))
            self._cameras[name] = camera, inbox
        carla, walkers = self._server.carla, (one for one in self._movers.values() if one.type_id.startswith("walker."))
        for walker in walkers:
            walker.apply_control(carla.WalkerControl(carla.Vector3D(1.0, 0.0, 0.0), 0.0, False))
        self._fov_deg, until_s = fov_deg, time.monotonic() + self._cfg.picture_s
        while any(inbox.empty() for _, inbox in self._cameras.values()) and time.monotonic() < until_s:
            self._world.tick(self._cfg.timeout_s)
            time.sleep(SIMULATED_STEP_S)

    def _stop_cameras(self) -> None:
        for camera, _ in self._cameras.values():
            camera.stop()
            camera.destroy()
        self._cameras.clear()

    # --- people and cars ----------------------------------------------------------------------------------------------

    def _place(self, number: int, body: PosedPerson | PosedCar) -> None:
        """Put somebody where the frame has them; a walker is put so that this tick's step leads there."""
        carla, actor = self._server.carla, self._movers.get(number) or self._add(number, body)
        turn_deg = np.array([0.0, np.degrees(body.heading_rad), 0.0])
        if isinstance(body, PosedCar):
            actor.set_transform(self._transform(body.center_m - [0.0, 0.0, body.half_extents_m[2]], turn_deg))
            return
        ahead, speed_mps = np.array([np.cos(body.heading_rad), np.sin(body.heading_rad), 0.0]), WALK_MPS * body.swing
        x, y, z = unreal_pose(ahead, turn_deg)[:3]
        actor.apply_control(carla.WalkerControl(carla.Vector3D(x, y, z), speed_mps, False))
        actor.set_transform(self._transform(body.hip_m - ahead * speed_mps * SIMULATED_STEP_S, turn_deg))

    def _add(self, number: int, body: PosedPerson | PosedCar) -> Any:
        """Spawn somebody, the same for the same clothes or paint, and note the number in pictures."""
        if isinstance(body, PosedPerson):
            names = sorted(one.id for one in self._library.filter("walker.pedestrian.*"))
            worn = dump_json(asdict(body.clothes.looks))
            name = names[int(sha256_bytes(worn.encode())[:8], 16) % len(names)]
        else:
            sizes_m = self._vehicle_sizes()
            name = min(sizes_m, key=lambda name: float(np.abs(sizes_m[name] - body.half_extents_m).sum()))
        actor = self._movers[number] = self._spawned(self._library.find(name), self._far_up())
        actor.set_collisions(False)
        actor.set_enable_gravity(False)
        if isinstance(body, PosedCar):
            actor.set_simulate_physics(False)
        self._note(actor, number)
        return actor

    def _remove(self, number: int) -> None:
        actor = self._movers.pop(number)
        self._note(actor, NO_INSTANCE)
        actor.destroy()

    def _note(self, actor: Any, number: int) -> None:
        for kind in MOVER_KINDS:
            self._ids[KINDS[kind] << 16 | actor.id & ACTOR_BITS] = number

    def _vehicle_sizes(self) -> dict[str, np.ndarray]:
        """Half extents of every car's blueprint; a server tells them of what was spawned alone."""
        if not self._sizes_m:
            for blueprint in self._library.filter("vehicle.*"):
                if (
                    blueprint.has_attribute("number_of_wheels")
                    and int(blueprint.get_attribute("number_of_wheels")) != 4
                ):
                    continue
                actor = self._spawned(blueprint, self._far_up())
                half = actor.bounding_box.extent
                self._sizes_m[blueprint.id] = np.array([half.x, half.y, half.z])
                actor.destroy()
        return self._sizes_m

    def _spawned(self, blueprint: Any, transform: Any) -> Any:
        actor = self._world.spawn_actor(blueprint, transform)
        self._guard.note(actor.id)
        return actor

    def _far_up(self) -> Any:
        """Return a place of its own over the map, so that nothing that is spawned stands in another's way."""
        x, y, z = self._map.bounds()[1]
        return self._transform(np.array([x + 10.0 * len(self._movers), y, z + SPAWN_M]), np.zeros(3))

    def _transform(self, position_m: np.ndarray, rotation_deg: np.ndarray) -> Any:
        carla, (x, y, z, pitch, yaw, roll) = self._server.carla, unreal_pose(position_m, rotation_deg)
        return carla.Transform(carla.Location(x, y, z), carla.Rotation(pitch, yaw, roll))


def _ids_in_pictures(server: CarlaConnection, box_map: BoxMap, num_others: int) -> np.ndarray:
    """From kind x 65536 + the 16 bits of pictures to our ids, (n,) uint16.

    The link is the box: `get_level_bbs` gives boxes with the number of their actor. An actor of several boxes, as a
    building, has the id of the first of them on the map.
    """
    from scipy.spatial import cKDTree

    ids, table = instance_ids(box_map, num_others), np.full(len(KINDS) << 16, NO_INSTANCE, dtype=np.uint16)
    num_found, num_doubtful = 0, 0
    for kind in np.unique(box_map.kinds).tolist():
        rows = np.flatnonzero(box_map.kinds == kind)
        boxes = server.world.get_level_bbs(server.carla.CityObjectLabel.values[kind])
        if not boxes:
            continue
        places = [world_pose((b.location.x, b.location.y, b.location.z, 0.0, 0.0, 0.0))[0] for b in boxes]
        gaps_m, nearest = cKDTree(np.array(places)).query(box_map.centers[rows])
        actor_of_key: dict[int, int] = {}
        for row, gap_m, place in zip(rows.tolist(), gaps_m.tolist(), nearest.tolist(), strict=True):
            actor = boxes[place].actor_id
            if gap_m > SAME_BOX_M:
                continue
            key, num_found = kind << 16 | actor & ACTOR_BITS, num_found + 1
            if key not in actor_of_key:
                actor_of_key[key], table[key] = actor, ids[row]
            num_doubtful += actor_of_key[key] != actor
    where = f"{server.endpoint} (CARLA {server.version}), {server.town}"
    if not num_found:
        fix = "export the map from this town (cosfly maps --source carla), or name its town in render.carla.town"
        raise InputError("no box of the map is in the server's town", where=where, got=box_map.name, fix=fix)
    if num_found < len(box_map) or num_doubtful:
        what = "%s: %d of %d boxes have an id in pictures; %d of those share 16 bits with another"
        log.warning(what, where, num_found, len(box_map), num_doubtful)
    return table
