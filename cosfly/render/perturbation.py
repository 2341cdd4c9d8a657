"""The perturbed track (app:dual_track): small random shifts of person and drone (position) and turns of the view
(rotation), frame by frame. What comes too near an obstacle, or loses or hides the person, falls back, and the frame's
state records why."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import Camera
from cosfly.formats.kinds import GROUND_KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M, TARGET_HEIGHT_M
from cosfly.geometry.axes import look_at, project, rotation_matrices, world_from_camera, wrap_deg
from cosfly.geometry.kernels import obstacle_index, signed_distances
from cosfly.geometry.trajectory_metrics import CLEARANCE_CAP_M, SAFETY_DISTANCE_M
from cosfly.render.contract import plane_z_m
from cosfly.render.person import NO_BYSTANDERS, DressedBystanders
from cosfly.runtime.config import Config

HEAD_OFFSET_M = np.array([0.0, 0.0, 0.6])  # from the hip point: where branches and signs may be in the way
NONE, APPLIED = "none", "applied"
OUT_OF_VIEW, HIDDEN = "fallback: target out of view", "fallback: target hidden"
PERTURBED = "aug_001"  # the variant of the perturbed track
STEP_UP_M = 0.5  # a shifted person may be this much higher or lower than before, not on a roof


class PerturbationConfig(Config):
    """Settings of the perturbed track; defaults from tab:augmentation_params."""

    position_probability: float = Field(0.6, ge=0, le=1, description="share of frames whose positions are shifted")
    rotation_probability: float = Field(0.6, ge=0, le=1, description="share of frames whose view is turned")
    pedestrian_radius_m: float = Field(2.0, ge=0, description="largest shift of the person on the ground (R_h), m")
    drone_radius_m: float = Field(3.0, ge=0, description="largest shift of the drone (R_d), m")
    view_radius_m: float = Field(2.0, ge=0, description="how far from the person the camera may look, m")
    max_view_deg: float = Field(5.0, ge=0, le=45, description="largest turn in yaw and in pitch (theta_max), degrees")
    max_roll_deg: float = Field(0.0, ge=0, le=45, description="largest roll of a turned view, degrees; the paper: none")
    sampling: Literal["cubic", "spherical"] = Field("spherical", description="offsets evenly in a cube or a ball")
    min_clearance_m: float = Field(
        SAFETY_DISTANCE_M,
        ge=0,
        description="distance that a shifted drone keeps from obstacles, m; where the plan is nearer, as far as the "
        "plan",
    )
    frame_margin: ClassVar[float] = 0.02  # share of the image at each border that the person is kept out of


@dataclass(frozen=True)
class Poses:
    """Poses of n frames: positions_m, rotations_deg (pitch, yaw, roll), targets_m (the person's hip point), (n, 3).

    clearances_m: (n,) from the drone to the nearest obstacle, CLEARANCE_CAP_M at most.
    """

    positions_m: np.ndarray
    rotations_deg: np.ndarray
    targets_m: np.ndarray
    clearances_m: np.ndarray


@dataclass(frozen=True)
class PerturbedTrack:
    """The perturbed poses and the events of each frame.

    drone_offsets_m, target_offsets_m, rotation_offsets_deg: (n, 3), zero where nothing was applied; the rotation offset
    is the turn away from the person, after the camera was aimed at it again. states: (n,) {"position", "rotation"},
    each none | applied | or the reason for the fallback. unshifted: the same frames with their rotation events only,
    which a dropped shift falls back to.
    """

    poses: Poses
    drone_offsets_m: np.ndarray
    target_offsets_m: np.ndarray
    rotation_offsets_deg: np.ndarray
    states: list[dict[str, str]]
    unshifted: PerturbedTrack | None = None

    @classmethod
    def unperturbed(cls, planned: Poses) -> PerturbedTrack:
        """Return a track of the planned poses."""
        n = len(planned.positions_m)
        states = [{"position": NONE, "rotation": NONE} for _ in range(n)]
        return cls(copy.deepcopy(planned), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3)), states)

    @property
    def is_perturbed(self) -> np.ndarray:
        return np.array([APPLIED in state.values() for state in self.states])

    def is_shifted(self, i: int) -> bool:
        return self.states[i]["position"] == APPLIED

    def drop_shift(self, i: int, position: str) -> None:
        """Undo the position event of frame i, in place; `position` is its new state."""
        assert self.unshifted is not None
        for mine, without in ((self, self.unshifted), (self.poses, self.unshifted.poses)):
            for name, values in vars(mine).items():
                if isinstance(values, np.ndarray):
                    values[i] = getattr(without, name)[i]
        self.states[i] = {**self.unshifted.states[i], "position": position}


class Surroundings:
    """Obstacles and ground heights of a map, for shifted people and drones."""

    def __init__(self, box_map: BoxMap) -> None:
        self.obstacles, self._ground = obstacle_index(box_map), box_map.ground
        slabs = box_map.select(np.isin(box_map.kinds, sorted(GROUND_KINDS)))
        self._centers, self._half = slabs.centers, slabs.half_extents
        self._turns = rotation_matrices(np.radians(slabs.rotations_deg))
        self._tops, self._bottoms = slabs.maxs[:, 2], slabs.mins[:, 2]
        self._plane_m = plane_z_m(box_map)

    def surface_z_m(self, x_m: float, y_m: float, near_z_m: float) -> float:
        """Return the height of the highest surface within STEP_UP_M of `near_z_m`, or `near_z_m` where there is
        none; on a slope, that of the ground."""
        if not self._ground.is_flat:
            return float(self._ground.height_at(np.array([[x_m, y_m]]))[0])
        over = self._slabs_at(x_m, y_m) & (np.abs(self._tops - near_z_m) <= STEP_UP_M)
        return float(self._tops[over].max()) if over.any() else near_z_m

    def below_ground_m(self, place_m: np.ndarray) -> float:
        """Return the depth of a place, (3,), in the ground: in or under its slabs, or under a slope; 0 above it."""
        x_m, y_m, z_m = place_m.tolist()
        if not self._ground.is_flat:
            return max(0.0, float(self._ground.height_at(place_m[None])[0]) - z_m)
        inside = self._slabs_at(x_m, y_m) & (self._bottoms < z_m)
        return max(0.0, self._plane_m - z_m, float(self._tops[inside].max(initial=-np.inf)) - z_m)

    def _slabs_at(self, x_m: float, y_m: float) -> np.ndarray:
        """Return which slabs of the ground are over or under a place, (n,) bool."""
        offset = np.column_stack([x_m - self._centers[:, 0], y_m - self._centers[:, 1], np.zeros(len(self._centers))])
        local = np.einsum("nji,nj->ni", self._turns, offset)
        return (np.abs(local[:, :2]) <= self._half[:, :2]).all(axis=1)


def perturb(
    planned: Poses,
    cameras: Sequence[Camera],
    surroundings: Surroundings,
    cfg: PerturbationConfig,
    rng: np.random.Generator,
    others: DressedBystanders = NO_BYSTANDERS,
) -> PerturbedTrack:
    """Perturb every frame of a trajectory; each takes the same number of random draws."""
    unshifted = PerturbedTrack.unperturbed(planned)
    result = replace(PerturbedTrack.unperturbed(planned), unshifted=unshifted)
    of_roll = rng.spawn(1)[0]  # the paper's track has none, and draws the same with and without
    for i in range(len(result.states)):
        is_shifted, is_turned = rng.random(2) < [cfg.position_probability, cfg.rotation_probability]
        person_m = _offset(rng, cfg, cfg.pedestrian_radius_m, 2)
        drone_m, view_m = _offset(rng, cfg, cfg.drone_radius_m, 3), _offset(rng, cfg, cfg.view_radius_m, 3)
        roll = of_roll.uniform(-1.0, 1.0)
        position = NONE
        if is_shifted:
            position = _shift(result, planned, i, person_m, drone_m, cameras[i], surroundings, cfg, others)
        if is_turned:
            for each in (unshifted, result):
                _turn(each, i, view_m, roll, cameras[i], cfg)
        if position != APPLIED:
            result.drop_shift(i, position)
    return result


def _offset(rng: np.random.Generator, cfg: PerturbationConfig, radius_m: float, num_axes: int) -> np.ndarray:
    """Return an offset evenly distributed in a cube or a ball, (3,); z is 0 for two axes."""
    in_cube = radius_m * rng.uniform(-1.0, 1.0, num_axes)
    direction, share = rng.normal(size=num_axes), rng.random()
    in_ball = radius_m * direction / np.linalg.norm(direction) * share ** (1.0 / num_axes)
    return np.append(in_cube if cfg.sampling == "cubic" else in_ball, np.zeros(3 - num_axes))


def _shift(
    result: PerturbedTrack, planned: Poses, i: int, person_offset: np.ndarray, drone_offset: np.ndarray, camera: Camera,
    surroundings: Surroundings, cfg: PerturbationConfig, others: DressedBystanders,
) -> str:  # fmt: skip
    """Apply one frame's position event; return its state."""
    target = planned.targets_m[i] + person_offset
    feet_z = planned.targets_m[i][2] - TARGET_HEIGHT_M
    target[2] = surroundings.surface_z_m(target[0], target[1], feet_z) + TARGET_HEIGHT_M
    drone = planned.positions_m[i] + drone_offset
    # The camera is aimed at the shifted person as it was aimed at the unshifted one.
    aimed = planned.rotations_deg[i].copy()
    aimed[:2] += _aim_deg(drone, target) - _aim_deg(planned.positions_m[i], planned.targets_m[i])
    aimed[1] = wrap_deg(aimed[1])
    ground_z = surroundings.surface_z_m(drone[0], drone[1], feet_z)
    places = np.stack([drone, target, target + HEAD_OFFSET_M])
    distances, _ = signed_distances(surroundings.obstacles, places, CLEARANCE_CAP_M)
    kept_m = min(cfg.min_clearance_m, planned.clearances_m[i])  # a plan may be nearer, at its relaxed floor
    if min(distances[0], others.distance_m(i, drone)) < kept_m or drone[2] < ground_z + cfg.min_clearance_m:
        return "fallback: drone clearance"
    if distances[1:].min() < PERSON_HALF_EXTENTS_M[0] or others.are_in_the_way(i, target):
        return "fallback: person in an obstacle"
    if not in_frame(target, drone, aimed, camera, cfg.frame_margin):
        return OUT_OF_VIEW
    poses = result.poses
    poses.positions_m[i], poses.targets_m[i], poses.rotations_deg[i] = drone, target, aimed
    poses.clearances_m[i] = distances[0]
    result.drone_offsets_m[i], result.target_offsets_m[i] = drone_offset, target - planned.targets_m[i]
    result.states[i]["position"] = APPLIED
    return APPLIED


def _turn(
    result: PerturbedTrack, i: int, view_m: np.ndarray, roll: float, camera: Camera, cfg: PerturbationConfig
) -> None:
    """Apply one frame's rotation event to the pose that the frame has, or note the reason for the fallback."""
    drone, target = result.poses.positions_m[i], result.poses.targets_m[i]
    turn = wrap_deg(_aim_deg(drone, target + view_m) - _aim_deg(drone, target))
    turn = np.array([*np.clip(turn, -cfg.max_view_deg, cfg.max_view_deg), cfg.max_roll_deg * roll])
    rotation = result.poses.rotations_deg[i] + turn
    rotation[1] = wrap_deg(rotation[1])
    if abs(rotation[0]) >= 90.0 or not in_frame(target, drone, rotation, camera, cfg.frame_margin):
        result.states[i]["rotation"] = OUT_OF_VIEW
        return
    result.states[i]["rotation"] = APPLIED
    result.poses.rotations_deg[i], result.rotation_offsets_deg[i] = rotation, turn


def _aim_deg(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return pitch and yaw from eye to target, (2,) degrees."""
    return np.degrees(np.array(look_at(eye, target)))


def in_frame(
    target_m: np.ndarray, drone_m: np.ndarray, rotation_deg: np.ndarray, camera: Camera, margin: float
) -> bool:
    """Return whether the target's hip point is inside the image by a margin (a share of width and height)."""
    uv, z = project(np.asarray(target_m)[None], world_from_camera(drone_m, rotation_deg), camera.intrinsic)
    size = np.array([camera.width_px, camera.height_px])
    return bool(z[0] > 0.3 and (uv[0] >= margin * size).all() and (uv[0] <= (1.0 - margin) * size).all())
