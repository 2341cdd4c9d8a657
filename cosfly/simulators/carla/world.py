"""The world of the server: a town of boxes, actors that are spawned, moved and destroyed, and what cameras see.

No physics: a walker goes where its control leads it, through everything; vehicles stand where they are put.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from cosfly.geometry import intrinsic_matrix, world_from_camera
from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import KINDS
from cosfly.products.others import BUILDS
from cosfly.products.walks import PERSON_HALF_EXTENTS_M
from cosfly.products.weather import WeatherParams
from cosfly.render.contract import (
    NO_INSTANCE,
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
from cosfly.unreal.conventions import ACTOR_BITS, depth_picture, tags_picture, unreal_pose, world_pose
from cosfly.work.chance import rng_for

BOOL, INT, FLOAT, STRING = 1, 2, 3, 4  # types of attributes
MOST_MOVERS = 64  # walkers and vehicles that pictures show
FIRST_BOX = 100_000  # number of the first box as an actor; its low 16 bits stand in pictures
ANY_LABEL = 255
# Of 14 parameters, those with knobs of ours; the others change nothing.
KNOBS = {
    "cloudiness": 0, "precipitation": 1, "sun_azimuth_angle": 4, "sun_altitude_angle": 5, "fog_density": 6,
    "fog_distance": 7,
}  # fmt: skip
FAIR_WEATHER = [5.0, 0.0, 0.0, 10.0, 215.0, 42.0, 0.0, 60.0, 0.0, 0.0, 1.0, 0.03, 0.0331, 0.0]
NUM_WALKERS = 16
VEHICLES = {  # half extents, m; the first is the car of our own flights
    "vehicle.cosfly.car": BUILDS["Car"].half_extents_m,
    "vehicle.mini.cooper_s": (1.9, 0.97, 0.74), "vehicle.tesla.model3": (2.4, 1.08, 0.74),
    "vehicle.nissan.patrol": (2.3, 0.97, 0.93), "vehicle.mercedes.sprinter": (2.96, 0.99, 1.28),
}  # fmt: skip
CAMERA_ATTRIBUTES = [("image_size_x", INT, "800"), ("image_size_y", INT, "600"), ("fov", FLOAT, "90.0")]
# What an RGB camera of CARLA has too, for clients that set it: exposure here is always fixed and nothing blurs.
FILM_ATTRIBUTES = [
    ("exposure_mode", STRING, "histogram"), ("exposure_compensation", FLOAT, "0.0"), ("shutter_speed", FLOAT, "200.0"),
    ("iso", FLOAT, "100.0"), ("fstop", FLOAT, "1.4"), ("gamma", FLOAT, "2.2"),
    ("enable_postprocess_effects", BOOL, "true"),
    ("motion_blur_intensity", FLOAT, "0.45"), ("motion_blur_max_distortion", FLOAT, "0.35"),
    ("lens_flare_intensity", FLOAT, "0.1"), ("bloom_intensity", FLOAT, "0.675"),
    ("chromatic_aberration_intensity", FLOAT, "0.0"),
]  # fmt: skip
# Blueprint -> number of the sensor in the streams of 0.9.16.
CAMERAS = {
    "sensor.camera.depth": 1, "sensor.camera.rgb": 13, "sensor.camera.semantic_segmentation": 14,
    "sensor.camera.instance_segmentation": 15,
}  # fmt: skip


@dataclass
class Actor:
    """Something that was spawned. pose: CARLA's x, y, z, pitch, yaw, roll; direction and speed: a walker's control."""

    number: int
    blueprint: str
    description: list
    half_extents_m: tuple[float, float, float]
    pose: list[float]
    direction: tuple[float, ...] = (1.0, 0.0, 0.0)
    speed_mps: float = 0.0
    walked_m: float = 0.0
    last_xy: tuple[float, ...] | None = None

    @property
    def attributes(self) -> dict[str, str]:
        return {name: text for name, _, text in self.description[2]}

    @property
    def semantic_tag(self) -> int:
        return KINDS["Pedestrians" if self.blueprint.startswith("walker.") else "Car"]

    def box(self) -> list:
        """CARLA's bounding box: middle from the actor's location, half extents, rotation, and whose it is."""
        lift_m = 0.0 if self.blueprint.startswith("walker.") else self.half_extents_m[2]
        return [[0.0, 0.0, lift_m], list(self.half_extents_m), [0.0, 0.0, 0.0], self.number]

    def step(self, step_s: float) -> None:
        """Let a walker walk."""
        for axis, part in enumerate(self.direction):
            self.pose[axis] += part * self.speed_mps * step_s
        xy = tuple(self.pose[:2])
        self.walked_m += float(np.hypot(*np.subtract(xy, self.last_xy or xy)))
        self.last_xy = xy


class World:
    """Town, actors and weather. All of it belongs to one thread, which draws."""

    def __init__(self, town: BoxMap, renderer: str = "gl") -> None:
        self.town, self._renderer = town, renderer
        self.actors: dict[int, Actor] = {}
        self.weather = list(FAIR_WEATHER)
        self._numbers = itertools.count(201)
        self._renderers: dict[tuple[int, int], tuple[Renderer, list[float]]] = {}
        self._drawn: dict[tuple, Frame] = {}
        self._poses = [unreal_pose(c, r) for c, r in zip(town.centers, np.asarray(town.rotations_deg), strict=True)]
        # From ids of the embedded renderer's pictures to actors' numbers.
        self._actor_of_id = np.zeros(PERSON_ID + 1, dtype=np.int64)
        self._actor_of_id[instance_ids(town, MOST_MOVERS)] = FIRST_BOX + np.arange(len(town))
        self._actor_of_id[NO_INSTANCE] = 0

    # --- what stands there --------------------------------------------------------------------------------------------

    def boxes(self, label: int) -> list[tuple[int, list]]:
        """Rows of the town's boxes of a label, and each as CARLA's bounding box."""
        rows = range(len(self.town)) if label == ANY_LABEL else np.flatnonzero(self.town.kinds == label).tolist()
        halves = self.town.half_extents
        return [(k, [self._poses[k][:3], halves[k].tolist(), self._poses[k][3:], FIRST_BOX + k]) for k in rows]

    def environment_objects(self, label: int) -> list:
        """Transform, box, id, name and label of each box of the town."""
        found = []
        for row, box in self.boxes(label):
            number, pose = int(self.town.ids[row]), self._poses[row]
            found.append([[pose[:3], pose[3:]], box, number, f"Box_{number}", int(self.town.kinds[row])])
        return found

    # --- what is spawned ----------------------------------------------------------------------------------------------

    def definitions(self) -> list:
        """Blueprints: uid, id, tags, attributes."""
        named = [(name, CAMERA_ATTRIBUTES + (FILM_ATTRIBUTES if name.endswith(".rgb") else [])) for name in CAMERAS]
        named += [(f"walker.pedestrian.{k:04d}", [("is_invincible", BOOL, "true")]) for k in range(1, NUM_WALKERS + 1)]
        named += [(name, []) for name in VEHICLES]
        found = []
        for uid, (name, own) in enumerate(named, 1):
            attributes = [[*row, [], True, False] for row in (*own, ("role_name", STRING, "default"))]
            found.append([uid, name, name.replace(".", ","), attributes])
        return found

    def spawn(self, description: list, transform: list) -> Actor:
        """Put an actor into the world; ValueError: there is no such blueprint, or no room."""
        name, number = description[1], next(self._numbers)
        is_walker = name.startswith("walker.pedestrian.")
        if name not in CAMERAS and name not in VEHICLES and not is_walker:
            raise ValueError(f"no blueprint {name}")
        if name not in CAMERAS and len(self.movers()) >= MOST_MOVERS:
            raise ValueError(f"no more than {MOST_MOVERS} walkers and vehicles")
        half_m = PERSON_HALF_EXTENTS_M if is_walker else VEHICLES.get(name, (0.1, 0.1, 0.1))
        actor = self.actors[number] = Actor(number, name, description, half_m, [*transform[0], *transform[1]])
        return actor

    def movers(self) -> list[Actor]:
        return [actor for actor in self.actors.values() if actor.blueprint not in CAMERAS]

    def step(self, step_s: float) -> None:
        """Let time go on."""
        self._drawn.clear()
        for actor in self.movers():
            actor.step(step_s)

    # --- what is seen -------------------------------------------------------------------------------------------------

    def picture(self, camera: Actor) -> tuple[int, int, float, bytes]:
        """Width, height, field of view in degrees, and BGRA of what a camera sees now."""
        width, height = (int(camera.attributes[f"image_size_{axis}"]) for axis in "xy")
        fov_deg = float(camera.attributes["fov"])
        key = (width, height, fov_deg, *camera.pose)
        if key not in self._drawn:
            self._drawn[key] = self._draw(width, height, fov_deg, camera.pose)
        frame = self._drawn[key]
        match CAMERAS[camera.blueprint]:
            case 1:
                picture = depth_picture(frame.depth)
            case 13:
                picture = np.dstack([frame.rgb[..., ::-1], np.full(frame.kinds.shape, 255, np.uint8)])
            case 14:
                picture = tags_picture(frame.kinds, np.zeros(frame.ids.shape, dtype=np.int64))
            case _:
                picture = tags_picture(frame.kinds, self._numbered(frame.ids))
        return width, height, fov_deg, picture.tobytes()

    def _draw(self, width: int, height: int, fov_deg: float, pose: list[float]) -> Frame:
        renderer, drawn_weather = self._renderers.get((width, height), (None, FAIR_WEATHER))
        if renderer is None:
            renderer = open_renderer(self._renderer, self.town, width, height, num_others=MOST_MOVERS)
        if drawn_weather != self.weather:
            knobs = {name: float(self.weather[place]) for name, place in KNOBS.items()}
            is_fair = self.weather == FAIR_WEATHER
            renderer.prepare(*self.town.bounds(), None if is_fair else WeatherParams(**knobs))
        self._renderers[width, height] = renderer, list(self.weather)
        person, others = self._bodies()
        camera_pose = world_from_camera(*world_pose(pose))
        return renderer.render(camera_pose, intrinsic_matrix(width, height, fov_deg), person, others)

    def _bodies(self) -> tuple[PosedPerson | None, list[PosedOther]]:
        """The walker that was spawned first as the person, everybody else as others."""
        person, others = None, list[PosedOther]()
        for actor in self.movers():
            body = self._body(actor)
            if person is None and isinstance(body, PosedPerson):
                person = body
            else:
                others.append(PosedOther(other_id(len(others)), body))
        return person, others

    def _body(self, actor: Actor) -> PosedPerson | PosedCar:
        place_m, rotation_deg = world_pose(actor.pose)
        heading_rad = float(np.radians(rotation_deg[1]))
        if actor.blueprint.startswith("walker."):
            phase_rad = 2.0 * np.pi * actor.walked_m / STRIDE_M
            swing = float(np.clip(actor.speed_mps / SLOW_MPS, 0.0, 1.0))
            return PosedPerson(place_m, heading_rad, phase_rad, swing, clothes_of(actor.blueprint))
        middle_m = place_m + np.array([0.0, 0.0, actor.half_extents_m[2]])
        return PosedCar(middle_m, heading_rad, actor.half_extents_m, _rng_of(actor.blueprint).random())

    def _numbered(self, ids: np.ndarray) -> np.ndarray:
        """Give the actors' numbers, as far as pictures hold them, in the place of the renderer's ids."""
        table, num_others = self._actor_of_id.copy(), 0
        for actor in self.movers():
            is_person = table[PERSON_ID] == 0 and actor.blueprint.startswith("walker.")
            table[PERSON_ID if is_person else other_id(num_others)] = actor.number
            num_others += not is_person
        return table[ids] & ACTOR_BITS


def clothes_of(blueprint: str) -> Clothes:
    """What a walker of this blueprint wears, always."""
    return choose_clothes(_rng_of(blueprint))


def _rng_of(blueprint: str) -> np.random.Generator:
    return rng_for(0, "simulators", blueprint)
