"""The world of the server: a town of boxes, actors that are spawned, moved and destroyed, and what cameras send."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import KINDS
from cosfly.products.others import BUILDS
from cosfly.products.walks import PERSON_HALF_EXTENTS_M
from cosfly.products.weather import WeatherParams
from cosfly.simulators.scene import MOST_MOVERS, Mover, ServedScene
from cosfly.unreal.conventions import ACTOR_BITS, depth_picture, tags_picture, unreal_pose

BOOL, INT, FLOAT, STRING = 1, 2, 3, 4  # types of attributes
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


@dataclass(kw_only=True)
class Actor(Mover):
    """Something that was spawned, cameras too."""

    number: int
    description: list

    @property
    def attributes(self) -> dict[str, str]:
        return {name: text for name, _, text in self.description[2]}

    @property
    def semantic_tag(self) -> int:
        return KINDS["Pedestrians" if self.is_person else "Car"]

    def box(self) -> list:
        """CARLA's bounding box: middle from the actor's location, half extents, rotation, and whose it is."""
        lift_m = 0.0 if self.is_person else self.half_extents_m[2]
        return [[0.0, 0.0, lift_m], list(self.half_extents_m), [0.0, 0.0, 0.0], self.number]


class World:
    """Town, actors and weather. All of it belongs to one thread, which draws."""

    def __init__(self, town: BoxMap) -> None:
        self.town, self._scene = town, ServedScene(town)
        self.actors: dict[int, Actor] = {}
        self.weather = list(FAIR_WEATHER)
        self._numbers = itertools.count(201)
        self._poses = [unreal_pose(c, r) for c, r in zip(town.centers, np.asarray(town.rotations_deg), strict=True)]

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
        actor = self.actors[number] = Actor(
            model=name,
            is_person=is_walker,
            half_extents_m=half_m,
            pose=[*transform[0], *transform[1]],
            number=number,
            description=description,
        )
        return actor

    def movers(self) -> list[Actor]:
        return [actor for actor in self.actors.values() if actor.model not in CAMERAS]

    def step(self, step_s: float) -> None:
        """Let time go on."""
        self._scene.forget()
        for actor in self.movers():
            actor.step(step_s)

    # --- what is seen -------------------------------------------------------------------------------------------------

    def picture(self, camera: Actor) -> tuple[int, int, float, bytes]:
        """Width, height, field of view in degrees, and BGRA of what a camera sees now."""
        width, height = (int(camera.attributes[f"image_size_{axis}"]) for axis in "xy")
        fov_deg = float(camera.attributes["fov"])
        knobs = {name: float(self.weather[place]) for name, place in KNOBS.items()}
        weather = None if np.allclose(self.weather, FAIR_WEATHER) else WeatherParams(**knobs)  # single precision
        frame = self._scene.draw((width, height), fov_deg, camera.pose, self.movers(), weather)
        match CAMERAS[camera.model]:
            case 1:
                picture = depth_picture(frame.depth)
            case 13:
                picture = np.dstack([frame.rgb[..., ::-1], np.full(frame.kinds.shape, 255, np.uint8)])
            case 14:
                picture = tags_picture(frame.kinds, np.zeros(frame.ids.shape, dtype=np.int64))
            case _:
                picture = tags_picture(frame.kinds, self._numbered(frame.ids))
        return width, height, fov_deg, picture.tobytes()

    def _numbered(self, ids: np.ndarray) -> np.ndarray:
        """Give the actors' numbers, as far as pictures hold them, in the place of the renderer's ids."""
        movers = self.movers()
        numbers = np.array([*range(FIRST_BOX, FIRST_BOX + len(self.town)), *(one.number for one in movers), 0])
        return numbers[self._scene.owners(ids, movers)] & ACTOR_BITS
