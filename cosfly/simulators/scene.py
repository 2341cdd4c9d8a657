"""What the cameras of a server see: a town of boxes and who moves in it, drawn by the embedded renderer.

No physics: who walks goes straight on, through everything; vehicles stand where they are put.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosfly.geometry import intrinsic_matrix, world_from_camera
from cosfly.products.boxes import BoxMap
from cosfly.products.weather import WeatherParams
from cosfly.render.contract import (
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
from cosfly.unreal.conventions import world_pose
from cosfly.work.chance import rng_for

MOST_MOVERS = 64  # people and vehicles that pictures show


@dataclass(kw_only=True)
class Mover:
    """Somebody who was spawned. pose: x, y, z, pitch, yaw, roll in Unreal's axes, m and degrees; of a person the
    middle, of a vehicle the middle of its bottom. model: the same clothes or paint for the same."""

    model: str
    is_person: bool
    half_extents_m: tuple[float, float, float]
    pose: list[float]
    direction: tuple[float, ...] = (1.0, 0.0, 0.0)
    speed_mps: float = 0.0
    walked_m: float = 0.0
    last_xy: tuple[float, ...] | None = None

    def step(self, step_s: float) -> None:
        """Walk on."""
        for axis, part in enumerate(self.direction):
            self.pose[axis] += part * self.speed_mps * step_s
        xy = tuple(self.pose[:2])
        self.walked_m += float(np.hypot(*np.subtract(xy, self.last_xy or xy)))
        self.last_xy = xy

    def body(self) -> PosedPerson | PosedCar:
        """What renderers draw."""
        place_m, rotation_deg = world_pose(self.pose)
        heading_rad = float(np.radians(rotation_deg[1]))
        if self.is_person:
            phase_rad = 2.0 * np.pi * self.walked_m / STRIDE_M
            swing = float(np.clip(self.speed_mps / SLOW_MPS, 0.0, 1.0))
            return PosedPerson(place_m, heading_rad, phase_rad, swing, clothes_of(self.model))
        middle_m = place_m + np.array([0.0, 0.0, self.half_extents_m[2]])
        return PosedCar(middle_m, heading_rad, self.half_extents_m, _rng_of(self.model).random())


class ServedScene:
    """Draws. All of it belongs to one thread."""

    def __init__(self, town: BoxMap, renderer: str = "gl") -> None:
        self.town, self._renderer = town, renderer
        self._renderers: dict[tuple[int, int], tuple[Renderer, WeatherParams | None]] = {}
        self._drawn: dict[tuple, Frame] = {}
        self._row_of_id = np.full(PERSON_ID + 1, -1)
        self._row_of_id[instance_ids(town, MOST_MOVERS)] = np.arange(len(town))

    def forget(self) -> None:
        """What was drawn is not what is now."""
        self._drawn.clear()

    def draw(
        self,
        size_px: tuple[int, int],
        fov_deg: float,
        pose: list[float],
        movers: Sequence[Mover],
        weather: WeatherParams | None = None,
    ) -> Frame:
        """Draw what a camera sees, once until `forget`; pose as a mover's. The first person in full detail."""
        key = (*size_px, fov_deg, *pose)
        if key not in self._drawn:
            renderer, drawn_weather = self._renderers.get(size_px, (None, None))
            if renderer is None:
                renderer = open_renderer(self._renderer, self.town, *size_px, num_others=MOST_MOVERS)
            if drawn_weather != weather:
                renderer.prepare(*self.town.bounds(), weather)
            self._renderers[size_px] = renderer, weather
            person, others = None, list[PosedOther]()
            for mover in movers:
                body = mover.body()
                if person is None and isinstance(body, PosedPerson):
                    person = body
                else:
                    others.append(PosedOther(other_id(len(others)), body))
            camera = world_from_camera(*world_pose(pose)), intrinsic_matrix(*size_px, fov_deg)
            self._drawn[key] = renderer.render(*camera, person, others)
        return self._drawn[key]

    def owners(self, ids: np.ndarray, movers: Sequence[Mover]) -> np.ndarray:
        """Whose each pixel is, of the ids of a frame: a row of the town, from its length on a mover, -1 nobody's."""
        table, num_others, has_person = self._row_of_id.copy(), 0, False
        for k, mover in enumerate(movers, len(self.town)):
            is_person = mover.is_person and not has_person
            table[PERSON_ID if is_person else other_id(num_others)] = k
            has_person, num_others = has_person or is_person, num_others + (not is_person)
        return table[ids]


def clothes_of(model: str) -> Clothes:
    """What a person of this model wears, always."""
    return choose_clothes(_rng_of(model))


def _rng_of(model: str) -> np.random.Generator:
    return rng_for(0, "simulators", model)
