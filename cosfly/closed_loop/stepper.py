"""The simulation of one closed-loop episode: a command moves the drone, and the renderer draws what it then sees.

The drone is a point with inertia: velocity, yaw and camera pitch reach the commanded values within its limits.
That is a stabilised multicopter as its autopilot presents it, without wind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosfly.closed_loop.settings import Drone
from cosfly.formats.boxes import BoxMap
from cosfly.formats.bystanders import Bystander
from cosfly.formats.episodes import Ended
from cosfly.formats.frames import TargetMeta
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.formats.places import town_folder
from cosfly.formats.traces import DroneTrace
from cosfly.formats.weather import WeatherParams
from cosfly.geometry.axes import step_s, wrap_deg
from cosfly.geometry.kernels import swept_distances
from cosfly.geometry.trajectory_metrics import CLEARANCE_CAP_M
from cosfly.render.contract import Frame
from cosfly.render.perturbation import PerturbedTrack, Poses, Surroundings
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import make_track_script, renderer_of
from cosfly.render.track import draw_frame, written_target
from cosfly.render.weather import read_pools, weather_of

RATE_HZ = 20.0  # of the autopilot
LEAVES_M = 100.0  # beyond the map's bounds the drone has left
AREA_M, AREA_STEP_M = 420.0, 200.0  # size and spacing of the areas that are lit at once


def as_drawn(cfg: RenderConfig, seed: int) -> RenderConfig:
    """Return the render settings of an episode and its tree: the clean track, with the seed's weather."""
    weather_seed = cfg.weather_seed if cfg.weather_seed >= 0 else seed
    return cfg.model_copy(update={"tracks": ("clean",), "weather_seed": weather_seed})


class Airspace:
    """A map with its renderer and obstacles. One per process, used from one thread."""

    def __init__(
        self, cfg: RenderConfig, boxes: BoxMap, simplified: BoxMap, *, seed: int = 0, num_others: int = 0
    ) -> None:
        """
        Args:
            boxes: are drawn. simplified: are obstacles. num_others: bystanders, as the renderer counts them.
        """
        self.cfg, self.seed = as_drawn(cfg, seed).model_copy(update={"first_timestamp": cfg.first_timestamp or 0}), seed
        self.renderer, self.pools = renderer_of(cfg, boxes, seed, num_others), read_pools(cfg)
        self.surroundings, self.ground = Surroundings(simplified), simplified.ground
        self.town, self.bounds_m = town_folder(cfg.town or boxes.name), boxes.bounds()
        self._lit: object = None

    @staticmethod
    def area_of(targets_m: np.ndarray) -> tuple[float, float]:
        """Return the grid centre of the area that is lit for a trajectory: neighbours share it."""
        x, y = np.round(targets_m.mean(axis=0)[:2] / AREA_STEP_M) * AREA_STEP_M + 0.0
        return float(x), float(y)

    def light(self, targets_m: np.ndarray, weather: WeatherParams | None) -> None:
        """Prepare the renderer for a pedestrian trajectory."""
        middle = np.array(self.area_of(targets_m))
        wanted = (*middle, None if weather is None else weather.model_dump_json())
        if wanted != self._lit:
            (low, high), half = self.bounds_m, AREA_M / 2.0
            self.renderer.prepare(np.append(middle - half, low[2]), np.append(middle + half, high[2]), weather)
            self._lit = wanted


@dataclass(frozen=True)
class Moment:
    """One frame of an episode. position_m, rotation_deg (pitch, yaw, roll), velocity_mps: (3,) world. target: as in
    `meta.json`; target_m: its hip, (3,). clearance_m: the least since the previous frame."""

    index: int
    time_s: float
    position_m: np.ndarray
    rotation_deg: np.ndarray
    velocity_mps: np.ndarray
    target_m: np.ndarray
    target: TargetMeta
    bystanders: dict[str, float | None]  # as `BystandersMeta.people_of`; empty without bystanders
    frame: Frame
    clearance_m: float
    height_m: float  # over the ground under the target

    @property
    def distance_m(self) -> float:
        """Distance from drone to target, over ground."""
        return float(np.hypot(*(self.position_m - self.target_m)[:2]))


class ClosedLoopTrajectory:
    """One episode behind one pedestrian. `reset` returns the lead frames, `step` flies a command for one time step and
    returns the next frame; `ended`: how the episode ended, None before. `script`: what is drawn."""

    def __init__(
        self, airspace: Airspace, planned: DroneTrace, *, number: int = 0, num_lead: int = 5, drone: Drone = Drone(),
        lost_s: float = 0.0, others: Sequence[Bystander] = (),
    ) -> None:  # fmt: skip
        """
        Args:
            planned: a plan; its first num_lead frames (2 or more) are flown, the others give the target's positions.
            number: of the trajectory, for its weather.
            lost_s: the episode ends after so long without a visible target; 0: never.
        """
        if not 2 <= num_lead < len(planned.time_s):
            raise ValueError(f"num_lead must be 2 to {len(planned.time_s) - 1}, not {num_lead}")
        self.airspace, self.planned, self.drone = airspace, planned, drone
        self.num_lead, self.lost_s, self.dt_s = num_lead, lost_s, step_s(planned.time_s)
        weather = weather_of(airspace.cfg, airspace.pools, number)
        plain = replace(planned, segments=(), mission=None)  # segments and mission describe the plan only
        self.script = make_track_script(
            plain, number, "clean", airspace.town, airspace.surroundings, airspace.cfg, airspace.seed, others, weather
        )
        self._begin()

    def _begin(self) -> None:
        planned, last = self.planned, self.num_lead - 1
        flown = Poses(planned.positions_m, planned.rotations_deg, planned.targets_m, planned.clearances_m)
        self.script = replace(self.script, perturbed=PerturbedTrack.unperturbed(flown))  # which copies it
        self.poses = self.script.perturbed.poses  # written as it is flown; what lies ahead is still the plan
        self.index, self._unseen_s = last, 0.0
        self.ended: Ended | None = None
        self.velocity_mps = (flown.positions_m[last] - flown.positions_m[last - 1]) / self.dt_s
        turned_deg = wrap_deg(flown.rotations_deg[last, 1] - flown.rotations_deg[last - 1, 1])
        self.yaw_rate_degps = float(turned_deg) / self.dt_s

    def reset(self) -> tuple[Moment, ...]:
        """Start from the beginning; return the lead frames, of which the last is the present one."""
        self._begin()
        steps = np.diff(self.poses.positions_m[: self.num_lead], axis=0) / self.dt_s
        velocities = [steps[0], *steps]
        return tuple(self._drawn(i, velocities[i], float(self.poses.clearances_m[i])) for i in range(self.num_lead))

    def step(self, command: np.ndarray) -> Moment:
        """Fly a command, (5,) as ACTION in the level axes of the present frame; return the next frame."""
        if self.ended is not None or (problem := self.drone.problem_of(command)):
            raise ValueError(f"the episode has ended: {self.ended}" if self.ended else problem)
        places, yaw_deg, pitch_deg = self._path(np.asarray(command, dtype=np.float64))
        (low, high), i = self.airspace.bounds_m, self.index + 1
        gaps, _, _ = swept_distances(self.airspace.surroundings.obstacles, places, CLEARANCE_CAP_M)
        over_ground = places[:, 2] - self.airspace.ground.height_at(places)
        gaps = np.minimum(gaps[:-1], np.minimum(over_ground[:-1], over_ground[1:]))  # of each part of the path
        hits = np.flatnonzero(gaps < self.drone.radius_m)
        end = int(hits[0]) if len(hits) else len(places) - 1  # the drone stops before the part that touches
        clearance_m = min(float(gaps[: end + 1].min()), self.script.others.distance_m(i, places[end]))
        self.index = i
        self.poses.positions_m[i], self.poses.rotations_deg[i] = places[end], [pitch_deg, yaw_deg, 0.0]
        self.poses.clearances_m[i - 1 : i + 1] = clearance_m
        moment = self._drawn(i, self.velocity_mps.copy(), clearance_m)
        self._unseen_s = 0.0 if moment.target.visible else self._unseen_s + self.dt_s
        if clearance_m < self.drone.radius_m:
            self.ended = "crashed"
        elif (np.maximum(low - places[-1], places[-1] - high)[:2] > LEAVES_M).any():
            self.ended = "left"
        elif i == len(self.planned.time_s) - 1:
            self.ended = "finished"
        elif self.lost_s and self._unseen_s >= self.lost_s:
            self.ended = "lost"
        return moment

    def _path(self, command: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Return the positions within one step, (k + 1, 3), and yaw and pitch at its end, degrees."""
        place, (pitch_deg, yaw_deg, _) = self.poses.positions_m[self.index], self.poses.rotations_deg[self.index]
        num, drone = max(1, round(self.dt_s * RATE_HZ)), self.drone
        part_s, yaw_rad = self.dt_s / num, np.radians(yaw_deg)
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        wanted = np.array([command[0] * cos - command[1] * sin, command[0] * sin + command[1] * cos, command[2]])
        places = [place]
        for _ in range(num):
            change = wanted - self.velocity_mps
            size = float(np.linalg.norm(change))
            self.velocity_mps = self.velocity_mps + change * min(1.0, drone.accel_max_mps2 * part_s / max(size, 1e-9))
            places.append(places[-1] + self.velocity_mps * part_s)
            most = drone.yaw_accel_max_degps2 * part_s
            self.yaw_rate_degps += float(np.clip(command[3] - self.yaw_rate_degps, -most, most))
            yaw_deg += self.yaw_rate_degps * part_s
            tilt = drone.gimbal_rate_max_degps * part_s
            pitch_deg += float(np.clip(command[4] - pitch_deg, -tilt, tilt))
        return np.array(places), float(wrap_deg(yaw_deg)), float(pitch_deg)

    def _drawn(self, i: int, velocity_mps: np.ndarray, clearance_m: float) -> Moment:
        script, poses = self.script, self.poses
        self.airspace.light(poses.targets_m, None if script.weather is None else script.weather.params)
        frame, target, others = draw_frame(
            self.airspace.renderer, script, i, poses, self.airspace.cfg.visible_threshold
        )
        target = written_target(target, frame)
        position_m, target_m = poses.positions_m[i].copy(), poses.targets_m[i].copy()
        people = script.others.people(script.clothes.looks) if self.airspace.renderer.dresses else None
        bystanders = {} if others is None else others.people_of(target_m, people)
        height_m = float(position_m[2] - (target_m[2] - TARGET_HEIGHT_M))
        return Moment(
            i, float(script.trace.time_s[i]), position_m, poses.rotations_deg[i].copy(), velocity_mps,
            target_m, target, bystanders, frame, clearance_m, height_m,
        )  # fmt: skip
