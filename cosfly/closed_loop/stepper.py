"""The simulation of one closed-loop episode: a command moves the drone, and the renderer draws its new view.

The drone is a point with inertia: its velocity, yaw rate and camera pitch approach the commanded values within its
limits. This models a multicopter with an autopilot, without wind.
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
from cosfly.render.contract import Frame, Renderer
from cosfly.render.perturbation import PerturbedTrack, Poses, Surroundings
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import make_track_script, renderer_of
from cosfly.render.track import draw_frame, written_target
from cosfly.render.weather import read_pools, weather_of

RATE_HZ = 20.0  # of the autopilot
LEAVES_M = 100.0  # farther outside the map's bounds the drone has left the map
AREA_M = 420.0  # side of the area that is lit at once; a smaller map is lit once
AREA_STEP_M = 200.0  # spacing of such areas


def as_drawn(cfg: RenderConfig, seed: int) -> RenderConfig:
    """Return the render settings of an episode and its tree: the clean track, with the seed's weather."""
    weather_seed = cfg.weather_seed if cfg.weather_seed >= 0 else seed
    return cfg.model_copy(update={"tracks": ("clean",), "weather_seed": weather_seed})


class Airspace:
    """A map with its renderer and obstacles. One per process, used from one thread."""

    def __init__(
        self, cfg: RenderConfig, boxes: BoxMap, simplified: BoxMap, *, map_sha256: str = "", seed: int = 0,
        num_others: int = 0, like: Airspace | None = None,
    ) -> None:  # fmt: skip
        """
        Args:
            boxes: The map that is drawn.
            simplified: The map whose boxes are obstacles.
            map_sha256: Digest of the map in records.
            num_others: Number of ids that the bystanders of an episode need at most.
            like: One of another map with the same settings, whose renderer's device is shared.
        """
        self.cfg = as_drawn(cfg, seed).model_copy(update={"first_timestamp": cfg.first_timestamp or 0})
        self.map_sha256 = map_sha256
        self.seed = seed
        self.renderer: Renderer = renderer_of(cfg, boxes, num_others, None if like is None else like.renderer)
        self.pools = read_pools(cfg)
        self.surroundings = Surroundings(simplified)
        self.ground_z_m = simplified.ground_z_m
        self.town = town_folder(cfg.town or boxes.name)
        self.bounds_m = boxes.bounds()
        self._lit: object = None  # area and weather that the renderer is prepared for

    @staticmethod
    def area_of(targets_m: np.ndarray) -> tuple[float, float]:
        """Return the centre (x, y) of the area that is lit for a trajectory; trajectories near each other share it."""
        x, y = np.round(targets_m.mean(axis=0)[:2] / AREA_STEP_M) * AREA_STEP_M + 0.0
        return float(x), float(y)

    def light(self, targets_m: np.ndarray, weather: WeatherParams | None) -> None:
        """Prepare the renderer for a pedestrian trajectory."""
        low, high = self.bounds_m
        is_small = (high - low)[:2].max() <= AREA_M
        middle = (low + high)[:2] / 2.0 if is_small else np.array(self.area_of(targets_m))
        key = (*middle, None if weather is None else weather.model_dump_json())
        if key != self._lit:
            half = AREA_M / 2.0
            self.renderer.prepare(np.append(middle - half, low[2]), np.append(middle + half, high[2]), weather)
            self._lit = key


@dataclass(frozen=True)
class Moment:
    """One frame of an episode."""

    index: int
    time_s: float
    position_m: np.ndarray  # (3,) world
    rotation_deg: np.ndarray  # (3,) pitch, yaw, roll
    velocity_mps: np.ndarray  # (3,) world
    target_m: np.ndarray  # (3,) hip of the target, world
    target: TargetMeta  # as in `meta.json`
    bystanders: dict[str, float | None]  # as `BystandersMeta.people_of`; empty without bystanders
    frame: Frame
    clearance_m: float  # the least since the previous frame
    height_m: float  # over the ground under the target

    @property
    def distance_m(self) -> float:
        """Distance from drone to target, over ground."""
        return float(np.hypot(*(self.position_m - self.target_m)[:2]))


class ClosedLoopTrajectory:
    """One episode behind one pedestrian.

    `reset` returns the lead frames; `step` flies a command for one time step and returns the next frame.
    """

    poses: Poses  # up to `index` those of the episode, then still those of the plan
    index: int  # of the present frame
    ended: Ended | None  # None until the episode ends
    velocity_mps: np.ndarray  # (3,) world
    yaw_rate_degps: float

    def __init__(
        self, airspace: Airspace, planned: DroneTrace, *, number: int = 0, num_lead: int = 5, drone: Drone = Drone(),
        lost_s: float = 0.0, others: Sequence[Bystander] = (),
    ) -> None:  # fmt: skip
        """
        Args:
            planned: A plan. The drone starts with its first num_lead frames (2 or more); of the other frames only the
                target's positions are used.
            number: Index of the trajectory, which its weather depends on.
            lost_s: The episode ends after this time without a visible target; 0 for never.
        """
        if not 2 <= num_lead < len(planned.time_s):
            raise ValueError(f"num_lead must be from 2 to {len(planned.time_s) - 1} frames, got {num_lead}")
        self.airspace = airspace
        self.planned = planned
        self.drone = drone
        self.num_lead = num_lead
        self.lost_s = lost_s
        self.dt_s = step_s(planned.time_s)
        weather = weather_of(airspace.cfg, airspace.pools, number)
        plain = replace(planned, segments=(), mission=None)  # segments and mission describe the plan only
        self.script = make_track_script(
            plain, number, "clean", airspace.town, airspace.surroundings, airspace.cfg, airspace.seed, others, weather
        )
        self._begin()

    def _begin(self) -> None:
        planned = self.planned
        last = self.num_lead - 1
        flown = Poses(planned.positions_m, planned.rotations_deg, planned.targets_m, planned.clearances_m)
        self.script = replace(self.script, perturbed=PerturbedTrack.unperturbed(flown))  # which copies the poses
        self.poses = self.script.perturbed.poses
        self.index = last
        self._unseen_s = 0.0
        self.ended = None
        self.velocity_mps = (flown.positions_m[last] - flown.positions_m[last - 1]) / self.dt_s
        turned_deg = wrap_deg(flown.rotations_deg[last, 1] - flown.rotations_deg[last - 1, 1])
        self.yaw_rate_degps = float(turned_deg) / self.dt_s

    def reset(self, num_drawn: int | None = None) -> tuple[Moment, ...]:
        """Start from the beginning; return the last `num_drawn` lead frames (None: all) up to the present one."""
        self._begin()
        first = 0 if num_drawn is None else self.num_lead - num_drawn
        step_velocities = np.diff(self.poses.positions_m[: self.num_lead], axis=0) / self.dt_s
        velocities_mps = [step_velocities[0], *step_velocities]
        return tuple(
            self._drawn(i, velocities_mps[i], float(self.poses.clearances_m[i])) for i in range(first, self.num_lead)
        )

    def step(self, command: np.ndarray) -> Moment:
        """Fly a command, (5,) as ACTION in the level axes of the present frame; return the next frame."""
        if self.ended is not None:
            raise ValueError(f"the episode has already ended (reason: {self.ended}); call reset before step")
        if problem := self.drone.problem_of(command):
            raise ValueError(problem)
        path_m, yaw_deg, pitch_deg = self._path(np.asarray(command, dtype=np.float64))
        # Entry k is the clearance on the way from point k to point k + 1; the last one is that of the last point alone.
        gaps_m, _, _ = swept_distances(self.airspace.surroundings.obstacles, path_m, CLEARANCE_CAP_M)
        over_ground_m = path_m[:, 2] - self.airspace.ground_z_m
        gaps_m = np.minimum(gaps_m[:-1], np.minimum(over_ground_m[:-1], over_ground_m[1:]))  # of each part of the path
        hits = np.flatnonzero(gaps_m < self.drone.radius_m)
        end = int(hits[0]) if len(hits) else len(path_m) - 1  # the drone stops before the part that touches
        i = self.index + 1
        clearance_m = min(float(gaps_m[: end + 1].min()), self.script.bystanders.distance_m(i, path_m[end]))
        self.index = i
        self.poses.positions_m[i] = path_m[end]
        self.poses.rotations_deg[i] = [pitch_deg, yaw_deg, 0.0]
        # The clearance of a frame is that of the way to the next one, so that a next step replaces that of frame i.
        self.poses.clearances_m[i - 1 : i + 1] = clearance_m
        moment = self._drawn(i, self.velocity_mps.copy(), clearance_m)
        self._unseen_s = 0.0 if moment.target.visible else self._unseen_s + self.dt_s
        self.ended = self._end_at(path_m[-1], clearance_m)
        return moment

    def _end_at(self, position_m: np.ndarray, clearance_m: float) -> Ended | None:
        """Return why the episode ends at the present frame; None if it goes on."""
        low, high = self.airspace.bounds_m
        if clearance_m < self.drone.radius_m:
            return "crashed"
        if (np.maximum(low - position_m, position_m - high)[:2] > LEAVES_M).any():
            return "left"
        if self.index == len(self.planned.time_s) - 1:
            return "finished"
        return "lost" if self.lost_s and self._unseen_s >= self.lost_s else None

    def _path(self, command: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Return the positions within one step, (k + 1, 3), and yaw and pitch at its end, degrees."""
        drone = self.drone
        num_parts = max(1, round(self.dt_s * RATE_HZ))
        part_s = self.dt_s / num_parts
        # Largest changes within one part.
        speed_step_mps = drone.accel_max_mps2 * part_s
        yaw_rate_step_degps = drone.yaw_accel_max_degps2 * part_s
        pitch_step_deg = drone.gimbal_rate_max_degps * part_s
        pitch_deg, yaw_deg, _ = self.poses.rotations_deg[self.index]
        ahead_mps, left_mps, up_mps, commanded_yaw_rate_degps, commanded_pitch_deg = command
        cos, sin = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
        commanded_mps = np.array([ahead_mps * cos - left_mps * sin, ahead_mps * sin + left_mps * cos, up_mps])
        path_m = [self.poses.positions_m[self.index]]
        for _ in range(num_parts):
            change_mps = commanded_mps - self.velocity_mps
            size_mps = float(np.linalg.norm(change_mps))
            self.velocity_mps = self.velocity_mps + change_mps * min(1.0, speed_step_mps / max(size_mps, 1e-9))
            path_m.append(path_m[-1] + self.velocity_mps * part_s)
            change_degps = commanded_yaw_rate_degps - self.yaw_rate_degps
            self.yaw_rate_degps += float(np.clip(change_degps, -yaw_rate_step_degps, yaw_rate_step_degps))
            yaw_deg += self.yaw_rate_degps * part_s
            pitch_deg += float(np.clip(commanded_pitch_deg - pitch_deg, -pitch_step_deg, pitch_step_deg))
        return np.array(path_m), float(wrap_deg(yaw_deg)), float(pitch_deg)

    def _drawn(self, i: int, velocity_mps: np.ndarray, clearance_m: float) -> Moment:
        """Draw frame i and return it with its measures."""
        script = self.script
        poses = self.poses
        self.airspace.light(poses.targets_m, None if script.weather is None else script.weather.params)
        drawn = draw_frame(self.airspace.renderer, script, i, poses, self.airspace.cfg.visible_threshold)
        position_m = poses.positions_m[i].copy()
        target_m = poses.targets_m[i].copy()
        people = script.bystanders.people(script.clothes.looks) if self.airspace.renderer.dresses else None
        return Moment(
            index=i, time_s=float(script.trace.time_s[i]), position_m=position_m,
            rotation_deg=poses.rotations_deg[i].copy(), velocity_mps=velocity_mps, target_m=target_m,
            target=written_target(drawn.target, drawn.frame),
            bystanders={} if drawn.bystanders is None else drawn.bystanders.people_of(target_m, people),
            frame=drawn.frame, clearance_m=clearance_m, height_m=float(position_m[2] - (target_m[2] - TARGET_HEIGHT_M)),
        )  # fmt: skip
