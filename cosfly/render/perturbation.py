"""The perturbed track (app:dual_track): random position and rotation events, frame by frame.

A position event shifts person and drone; a rotation event turns the view. An event falls back if it brings the drone
or the person too near an obstacle, or if the person leaves the image or is hidden. The frame's state records the
reason.

In the paper every frame draws its own events and offsets. With `correlation_s` they are smooth in time, so that drone
and person move as they could: offsets grow from zero at the begin of an event and return to zero before its end, and
before and after a fallback.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field
from scipy.special import gammainc, ndtr

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import Camera
from cosfly.formats.kinds import GROUND_KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M, TARGET_HEIGHT_M
from cosfly.formats.playback import EVENTS
from cosfly.geometry.axes import DT_S, look_at, project, rotation_matrices, world_from_camera, wrap_deg
from cosfly.geometry.kernels import obstacle_index, signed_distances, visibility
from cosfly.geometry.trajectory_metrics import CLEARANCE_CAP_M, SAFETY_DISTANCE_M, YAW_RATE_MAX_DEGPS
from cosfly.render.contract import NEAR_M
from cosfly.render.person import NO_BYSTANDERS, DressedBystanders
from cosfly.runtime.config import Config, IfChanged
from cosfly.runtime.seeding import draw_smooth

HEAD_OFFSET_M = np.array([0.0, 0.0, 0.6])  # head from hip point: branches and signs may be in the way up there
PERTURBED = "aug_001"  # the variant of the perturbed track
STEP_UP_M = 0.5  # most by which a shifted person may be higher or lower than before; keeps people off roofs
SEEN_LEAST = 0.3  # five-ray visibility of a target that a smooth shift must not hide

# States of an event.
NONE = "none"
APPLIED = "applied"
DRONE_CLEARANCE = "fallback: drone clearance"
PERSON_IN_OBSTACLE = "fallback: person in an obstacle"
OUT_OF_VIEW = "fallback: target out of view"
HIDDEN = "fallback: target hidden"
TURNS_FAST = "fallback: yaw rate"  # of smooth perturbations: near a target below, a shift turns the camera round


class PerturbationConfig(Config):
    """Settings of the perturbed track; defaults from tab:augmentation_params."""

    position_probability: float = Field(0.6, ge=0, le=1, description="share of frames whose positions are shifted")
    rotation_probability: float = Field(0.6, ge=0, le=1, description="share of frames whose view is turned")
    pedestrian_radius_m: float = Field(2.0, ge=0, description="largest shift of the person on the ground (R_h), m")
    drone_radius_m: float = Field(3.0, ge=0, description="largest shift of the drone (R_d), m")
    view_radius_m: float = Field(2.0, ge=0, description="largest distance of the camera's aim from the person, m")
    max_view_deg: float = Field(5.0, ge=0, le=45, description="largest turn in yaw and in pitch (theta_max), degrees")
    max_roll_deg: float = Field(0.0, ge=0, le=45, description="largest roll of a turned view, degrees; 0 in the paper")
    correlation_s: IfChanged[float] = Field(
        0.0, ge=0, le=60, description="correlation time of the offsets, s; 0: each frame draws its own, as in the paper"
    )
    sampling: Literal["cubic", "spherical"] = Field(
        "spherical", description="offsets are uniform in a cube or in a ball"
    )
    min_clearance_m: float = Field(
        SAFETY_DISTANCE_M,
        ge=0,
        description="distance that a shifted drone keeps from obstacles, m; where the plan is nearer, that of the plan",
    )
    frame_margin: ClassVar[float] = 0.02  # share of the image at each border that the person is kept out of


@dataclass(frozen=True)
class Poses:
    """Poses of n frames."""

    positions_m: np.ndarray  # (n, 3), the drone
    rotations_deg: np.ndarray  # (n, 3), pitch, yaw, roll
    targets_m: np.ndarray  # (n, 3), hip of the target
    clearances_m: np.ndarray  # (n,), from the drone to the nearest obstacle, CLEARANCE_CAP_M at most

    def copy_frame(self, i: int, source: Poses) -> None:
        """Copy frame i from other poses, in place."""
        self.positions_m[i] = source.positions_m[i]
        self.rotations_deg[i] = source.rotations_deg[i]
        self.targets_m[i] = source.targets_m[i]
        self.clearances_m[i] = source.clearances_m[i]


@dataclass(frozen=True)
class PerturbedTrack:
    """The perturbed poses and the events of n frames."""

    poses: Poses
    drone_offsets_m: np.ndarray  # (n, 3), zero without an applied position event
    target_offsets_m: np.ndarray  # (n, 3), zero without an applied position event
    rotation_offsets_deg: np.ndarray  # (n, 3), turn away from the shifted target; zero without a rotation event
    states: list[dict[str, str]]  # n of {"position", "rotation"}: NONE, APPLIED or the reason for the fallback
    unshifted: PerturbedTrack | None = None  # only the rotation events, for frames whose shift is dropped

    @classmethod
    def unperturbed(cls, planned: Poses) -> PerturbedTrack:
        """Return a track without events."""
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
        self.poses.copy_frame(i, self.unshifted.poses)
        self.drone_offsets_m[i] = 0.0
        self.target_offsets_m[i] = 0.0
        self.rotation_offsets_deg[i] = self.unshifted.rotation_offsets_deg[i]
        self.states[i] = {**self.unshifted.states[i], "position": position}


class Surroundings:
    """Obstacles and ground heights of a map, for shifted people and drones."""

    def __init__(self, box_map: BoxMap) -> None:
        self.obstacles = obstacle_index(box_map)
        slabs = box_map.select(np.isin(box_map.kinds, sorted(GROUND_KINDS)))
        self._centers = slabs.centers
        self._half = slabs.half_extents
        self._turns = rotation_matrices(np.radians(slabs.rotations_deg))
        self._tops = slabs.maxs[:, 2]

    def surface_z_m(self, x_m: float, y_m: float, near_z_m: float) -> float:
        """Return the height of the surface at a place, m.

        It is that of the highest slab within STEP_UP_M of `near_z_m`, or `near_z_m` itself if there is none.
        """
        offset = np.column_stack([x_m - self._centers[:, 0], y_m - self._centers[:, 1], np.zeros(len(self._centers))])
        local = np.einsum("nji,nj->ni", self._turns, offset)
        is_inside = (np.abs(local[:, :2]) <= self._half[:, :2]).all(axis=1)  # in the top view
        over = is_inside & (np.abs(self._tops - near_z_m) <= STEP_UP_M)
        return float(self._tops[over].max()) if over.any() else near_z_m


@dataclass(frozen=True)
class _Scene:
    """The inputs of a perturbation that no event changes."""

    planned: Poses
    cameras: Sequence[Camera]  # one per frame
    surroundings: Surroundings
    cfg: PerturbationConfig
    bystanders: DressedBystanders

    def shows(self, i: int, target_m: np.ndarray, drone_m: np.ndarray, rotation_deg: np.ndarray) -> bool:
        """Return whether the target is inside the image of frame i by the margin."""
        return in_frame(target_m, drone_m, rotation_deg, self.cameras[i], self.cfg.frame_margin)


def perturb(
    planned: Poses, cameras: Sequence[Camera], surroundings: Surroundings, cfg: PerturbationConfig,
    rng: np.random.Generator, bystanders: DressedBystanders = NO_BYSTANDERS, dt_s: float = DT_S,
) -> PerturbedTrack:  # fmt: skip
    """Perturb every frame of a trajectory. dt_s: between frames. The random draws do not depend on the map."""
    scene = _Scene(planned, cameras, surroundings, cfg, bystanders)
    if cfg.correlation_s == 0:
        return _apply(_draw_each_frame(len(cameras), cfg, rng), scene)
    return _apply_smoothly(_draw_smoothly(len(cameras), dt_s, cfg, rng), scene, dt_s)


class _Draws(NamedTuple):
    """The events and offsets of n frames."""

    is_drawn: dict[str, np.ndarray]  # event -> (n,) bool
    person_m: np.ndarray  # (n, 3)
    drone_m: np.ndarray  # (n, 3)
    view_m: np.ndarray  # (n, 3), from the person to the point to look at
    roll: np.ndarray  # (n,), from -1 to 1, the share of max_roll_deg


def _draw_each_frame(num: int, cfg: PerturbationConfig, rng: np.random.Generator) -> _Draws:
    """Draw the events and offsets of each frame alone, as in the paper."""
    roll_rng = rng.spawn(1)[0]  # its own generator: the other draws are those of the paper's track, which has no roll
    is_drawn = {event: np.zeros(num, dtype=bool) for event in EVENTS}
    person_m, drone_m, view_m = np.empty((3, num, 3))
    for i in range(num):
        events = rng.random(2) < [cfg.position_probability, cfg.rotation_probability]
        is_drawn["position"][i], is_drawn["rotation"][i] = events
        person_m[i] = _offset(rng, cfg, cfg.pedestrian_radius_m, 2)
        drone_m[i] = _offset(rng, cfg, cfg.drone_radius_m, 3)
        view_m[i] = _offset(rng, cfg, cfg.view_radius_m, 3)
    return _Draws(is_drawn, person_m, drone_m, view_m, roll_rng.uniform(-1.0, 1.0, num))


def _offset(rng: np.random.Generator, cfg: PerturbationConfig, radius_m: float, num_axes: int) -> np.ndarray:
    """Return an offset evenly distributed in a cube or a ball, (3,); z is 0 for two axes."""
    in_cube = radius_m * rng.uniform(-1.0, 1.0, num_axes)
    direction = rng.normal(size=num_axes)
    share = rng.random()
    in_ball = radius_m * direction / np.linalg.norm(direction) * share ** (1.0 / num_axes)
    return np.append(in_cube if cfg.sampling == "cubic" else in_ball, np.zeros(3 - num_axes))


def _draw_smoothly(num: int, dt_s: float, cfg: PerturbationConfig, rng: np.random.Generator) -> _Draws:
    """Draw events and offsets that are smooth in time, with the distribution of `_draw_each_frame` in each frame."""
    # Standard normal columns: 2 events, 2 axes of the person's offset, 3 of the drone's, 3 of the view's, 1 roll.
    normals = draw_smooth(num, 11, dt_s, cfg.correlation_s, rng)
    events, person, drone, view, roll = np.split(normals, np.cumsum([2, 2, 3, 3]), axis=1)

    def offsets(normal: np.ndarray, radius_m: float) -> np.ndarray:
        num_axes = normal.shape[1]
        in_unit = 2.0 * ndtr(normal) - 1.0
        if cfg.sampling == "spherical":
            # A squared length has a chi-square distribution; gammainc, its CDF, makes the volume within it uniform.
            squares = (normal**2).sum(axis=1, keepdims=True)
            in_unit = normal / np.sqrt(squares) * gammainc(num_axes / 2.0, squares / 2.0) ** (1.0 / num_axes)
        return np.hstack([radius_m * in_unit, np.zeros((num, 3 - num_axes))])

    is_drawn = ndtr(events) < [cfg.position_probability, cfg.rotation_probability]
    return _Draws(
        dict(zip(EVENTS, is_drawn.T, strict=True)), offsets(person, cfg.pedestrian_radius_m),
        offsets(drone, cfg.drone_radius_m), offsets(view, cfg.view_radius_m), 2.0 * ndtr(roll[:, 0]) - 1.0,
    )  # fmt: skip


def _apply(drawn: _Draws, scene: _Scene) -> PerturbedTrack:
    """Apply the events of all frames that pass the checks."""
    unshifted = PerturbedTrack.unperturbed(scene.planned)
    track = replace(PerturbedTrack.unperturbed(scene.planned), unshifted=unshifted)
    for i in range(len(track.states)):
        position = NONE
        if drawn.is_drawn["position"][i]:
            position = _shift(track, i, drawn.person_m[i], drawn.drone_m[i], scene)
        if drawn.is_drawn["rotation"][i]:
            _turn(unshifted, i, drawn.view_m[i], drawn.roll[i], scene)
            _turn(track, i, drawn.view_m[i], drawn.roll[i], scene)
        if position != APPLIED:  # also without an event: then the frame is that of the unshifted track
            track.drop_shift(i, position)
    return track


def _apply_smoothly(drawn: _Draws, scene: _Scene, dt_s: float) -> PerturbedTrack:
    """Apply smooth events; around frames without an event and around fallbacks the offsets fade to zero.

    A smaller offset may fall back too, so rounds with ever fewer events are repeated until all events pass the checks.
    """
    obstacles = scene.surroundings.obstacles
    planned_degps = _yaw_rates_degps(scene.planned, dt_s)
    is_seen = visibility(obstacles, scene.planned.positions_m, scene.planned.targets_m) >= SEEN_LEAST
    fallbacks: dict[str, dict[int, str]] = {event: {} for event in EVENTS}  # event -> frame -> reason
    while True:
        active = {event: is_drawn.copy() for event, is_drawn in drawn.is_drawn.items()}
        for event, reasons in fallbacks.items():
            active[event][list(reasons)] = False
        track = _apply(_faded(drawn, active, scene.cfg.correlation_s / dt_s), scene)
        hides = is_seen & (visibility(obstacles, track.poses.positions_m, track.poses.targets_m) < SEEN_LEAST)
        is_fast = _yaw_rates_degps(track.poses, dt_s) > np.maximum(planned_degps, YAW_RATE_MAX_DEGPS)
        is_settled = True
        for event, reasons in fallbacks.items():
            for i in np.flatnonzero(active[event]).tolist():
                state = track.states[i][event]
                if state == APPLIED and is_fast[i]:
                    state = TURNS_FAST
                elif state == APPLIED and event == "position" and hides[i]:
                    state = HIDDEN
                if state != APPLIED:
                    reasons[i] = state
                    is_settled = False
        if is_settled:
            break
    assert track.unshifted is not None
    for event, reasons in fallbacks.items():
        for i, reason in reasons.items():
            track.states[i][event] = track.unshifted.states[i][event] = reason
    return track


def _yaw_rates_degps(poses: Poses, dt_s: float) -> np.ndarray:
    """Return the greater yaw rate of the steps to and from each frame, (n,)."""
    rates = np.abs(wrap_deg(np.diff(poses.rotations_deg[:, 1]))) / dt_s
    return np.maximum(np.append(rates, 0.0), np.insert(rates, 0, 0.0))


def _faded(drawn: _Draws, active: dict[str, np.ndarray], fade_frames: float) -> _Draws:
    """Return only the active events, with offsets that fade to zero towards frames without them."""
    shift_fade, turn_fade = (_fade(active[event], fade_frames) for event in EVENTS)
    person_m, drone_m = drawn.person_m * shift_fade, drawn.drone_m * shift_fade
    return _Draws(active, person_m, drone_m, drawn.view_m * turn_fade, drawn.roll * turn_fade[:, 0])


def _fade(is_active: np.ndarray, fade_frames: float) -> np.ndarray:
    """Return factors from 0 to 1, (n, 1), that rise from 0 at frames that are not active."""
    frames = np.arange(len(is_active), dtype=np.float64)
    share = np.minimum(np.abs(frames[:, None] - frames[~is_active]).min(axis=1, initial=np.inf) / fade_frames, 1.0)
    return (share**2 * (3.0 - 2.0 * share))[:, None]


def _shift(track: PerturbedTrack, i: int, person_offset: np.ndarray, drone_offset: np.ndarray, scene: _Scene) -> str:
    """Apply the position event of frame i, in place, if all checks pass; return its state. Offsets: (3,) m."""
    planned = scene.planned
    feet_z = planned.targets_m[i][2] - TARGET_HEIGHT_M
    target = planned.targets_m[i] + person_offset
    target[2] = scene.surroundings.surface_z_m(target[0], target[1], feet_z) + TARGET_HEIGHT_M
    drone = planned.positions_m[i] + drone_offset
    # Keep the angle between the camera's axis and the direction to the person.
    rotation = planned.rotations_deg[i].copy()
    rotation[:2] += _aim_deg(drone, target) - _aim_deg(planned.positions_m[i], planned.targets_m[i])
    rotation[1] = wrap_deg(rotation[1])
    points = np.stack([drone, target, target + HEAD_OFFSET_M])
    (drone_distance, *person_distances), _ = signed_distances(scene.surroundings.obstacles, points, CLEARANCE_CAP_M)
    min_clearance_m = scene.cfg.min_clearance_m
    ground_z = scene.surroundings.surface_z_m(drone[0], drone[1], feet_z)
    # Where the planner relaxed its safety distance, the plan itself may be nearer than min_clearance_m.
    required_m = min(min_clearance_m, planned.clearances_m[i])
    is_near = min(drone_distance, scene.bystanders.distance_m(i, drone)) < required_m
    if is_near or drone[2] < ground_z + min_clearance_m:
        return DRONE_CLEARANCE
    if min(person_distances) < PERSON_HALF_EXTENTS_M[0] or scene.bystanders.are_in_the_way(i, target):
        return PERSON_IN_OBSTACLE
    if not scene.shows(i, target, drone, rotation):
        return OUT_OF_VIEW
    track.poses.positions_m[i] = drone
    track.poses.targets_m[i] = target
    track.poses.rotations_deg[i] = rotation
    track.poses.clearances_m[i] = drone_distance
    track.drone_offsets_m[i] = drone_offset
    track.target_offsets_m[i] = target - planned.targets_m[i]
    track.states[i]["position"] = APPLIED
    return APPLIED


def _turn(track: PerturbedTrack, i: int, view_offset: np.ndarray, roll: float, scene: _Scene) -> None:
    """Turn the view of frame i from its present pose, or record the fallback, in place.

    Args:
        view_offset: (3,) m, from the person to the point to look at.
        roll: From -1 to 1, the share of max_roll_deg.
    """
    cfg = scene.cfg
    drone = track.poses.positions_m[i]
    target = track.poses.targets_m[i]
    pitch_yaw = wrap_deg(_aim_deg(drone, target + view_offset) - _aim_deg(drone, target))
    turn = np.array([*np.clip(pitch_yaw, -cfg.max_view_deg, cfg.max_view_deg), cfg.max_roll_deg * roll])
    rotation = track.poses.rotations_deg[i] + turn
    rotation[1] = wrap_deg(rotation[1])
    if abs(rotation[0]) >= 90.0 or not scene.shows(i, target, drone, rotation):
        track.states[i]["rotation"] = OUT_OF_VIEW
        return
    track.states[i]["rotation"] = APPLIED
    track.poses.rotations_deg[i] = rotation
    track.rotation_offsets_deg[i] = turn


def _aim_deg(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return pitch and yaw from eye to target, (2,) degrees."""
    return np.degrees(np.array(look_at(eye, target)))


def in_frame(
    target_m: np.ndarray, drone_m: np.ndarray, rotation_deg: np.ndarray, camera: Camera, margin: float
) -> bool:
    """Return whether the target's hip point is inside the image by a margin (a share of width and height).

    A point nearer than NEAR_M is not drawn.
    """
    uv, z = project(np.asarray(target_m)[None], world_from_camera(drone_m, rotation_deg), camera.intrinsic)
    size = np.array([camera.width_px, camera.height_px])
    return bool(z[0] > NEAR_M and (uv[0] >= margin * size).all() and (uv[0] <= (1.0 - margin) * size).all())
