"""The contract of planners, and all settings of step 4.

A planner is one function, named in PLANNERS or, if it is a generic one, in REFERENCES, with the signature

    plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan

It returns one drone position for each target position, keeps the shared limits (tab:drone_params), draws random numbers
from `rng` only, and raises NoPathError if it finds no trajectory. `tests/test_planners_contract.py` checks this for
every planner. Only planners import compiled code, so this module and the settings load without it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from cosfly.formats.segments import FOLLOW
from cosfly.geometry import trajectory_metrics as limits
from cosfly.geometry.axes import DT_S
from cosfly.planners.gimbal import GimbalConfig
from cosfly.planners.styles import ALTITUDE_LEAST_M, NAMES, OTHER_SIDE, ROWS, Range, Style, with_ranges
from cosfly.runtime.config import Config, IfChanged
from cosfly.runtime.errors import NoPathError, nearest

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex

# In the order of comparisons: the first planner is compared with each of the others.
PLANNERS = {
    "foresight": "cosfly.planners.foresight:plan",
    "track_astar": "cosfly.planners.track_astar:plan",
    "muco": "cosfly.planners.muco.muco:plan",
}
# Generic planners without a visibility term, for `plan compare --planner all` (app:three_axis_eval).
_REFERENCE_NAMES = (
    "rrt_star", "prm", "bspline_prm", "elastic_band", "minimum_jerk", "astar", "weighted_astar", "theta_star",
    "visibility_astar", "potential_field", "chomp", "trajopt",
)  # fmt: skip
REFERENCES = {name: f"cosfly.planners.reference_planners:plan_{name}" for name in _REFERENCE_NAMES}
ALL_PLANNERS = PLANNERS | REFERENCES
# Titles for tables and pictures; other planners are shown by their names.
TITLES = {
    "track_astar": "TA* + Smooth", "muco": "MuCO", "rrt_star": "RRT*", "prm": "PRM", "bspline_prm": "B-spline PRM",
    "astar": "3D A*", "weighted_astar": "weighted A*", "theta_star": "Theta*", "visibility_astar": "visibility-A*",
    "chomp": "CHOMP-lite", "trajopt": "L-BFGS-B TrajOpt",
}  # fmt: skip
# How planners with the names of the paper's planners differ from those.
NOTES = {
    "track_astar": "the paper's search, our least-squares smoothing instead of its shortcuts and elastic band",
    "muco": "the paper's loss, our Newton step and a repair to plan.accel_max_mps2",
}


def title_of(name: str) -> str:
    """Return a planner's title for tables and pictures."""
    return TITLES.get(name, name.replace("_", " "))


def known_planner(name: str) -> str:
    """Return the name of a planner; raise ValueError if there is no such planner."""
    if name not in ALL_PLANNERS:
        raise ValueError(
            f"there is no planner {name!r}{nearest(name, ALL_PLANNERS)}; choose one of {', '.join(ALL_PLANNERS)}"
        )
    return name


# --- settings ---------------------------------------------------------------------------------------------------------


class MucoConfig(Config):
    """Settings of MuCO (subsec:appendix_planner_muco), which minimizes the paper's loss."""

    track_distance_m: ClassVar[float] = 28.0  # preferred slant distance to the target, m
    weight_tracking: ClassVar[float] = 2.0  # weight of (distance - track_distance_m)^2
    weight_smoothness: ClassVar[float] = 4.0  # weight of the squared second difference
    weight_jerk: ClassVar[float] = 3.0  # weight of the squared third difference
    weight_safety: ClassVar[float] = 2.0  # weight of half the squared intrusion into influence_m
    weight_visibility: float = Field(2.0, ge=0, description="weight of (1 - five-ray visibility)^2")
    weight_view_angle: ClassVar[float] = 1.0  # weight of squared pitch and azimuth deviation, per rad^2
    weight_path_length: ClassVar[float] = 2.0  # weight of a tenth of the path length
    weight_below: ClassVar[float] = 50.0  # weight of squared altitude below altitude_min_m
    weight_above: ClassVar[float] = 20.0  # weight of squared altitude above altitude_preferred_m
    weight_oscillation: ClassVar[float] = 8.0  # weight of the squared change of altitude per step
    weight_bearing: ClassVar[float] = 40.0  # weight of squared azimuth deviation of styles other than follow, per rad^2
    weight_beneath: ClassVar[float] = 2.0  # weight of squared altitude below that of styles other than follow
    weight_pitch: ClassVar[float] = 20.0  # weight of squared pitch outside pitch_band_deg, per rad^2; not the paper's
    influence_m: ClassVar[float] = 8.0  # obstacles nearer than this add to the safety term, m
    pitch_deg: ClassVar[float] = 45.0  # preferred downward pitch of the camera, degrees
    pitch_band_deg: ClassVar[tuple[float, float]] = (30.0, 60.0)  # pitch outside costs extra, degrees
    low_visibility: ClassVar[float] = 0.3  # visibility below this is low
    low_visibility_frames: ClassVar[int] = 20  # in a row: visibility and view angle leave the gradient
    difference_m: ClassVar[float] = 0.5  # half width of the difference window, m
    step_cap_m: ClassVar[float] = 0.5  # longest move of a waypoint in one iteration, m
    iterations_max: ClassVar[int] = 1500  # largest number of iterations
    tolerance: ClassVar[float] = 1e-5  # converged when the relative change of the loss is less
    pushes_max: ClassVar[int] = 10  # pushes out of obstacles per waypoint and projection, at most
    start_visibility: ClassVar[float] = 0.95  # of a start behind the target; below it a start is searched for; 0: never


class TrackAStarConfig(Config):
    """Settings of TA*+Smooth (subsec:appendix_planner_tastar), whose smoothing is ours; see track_astar.py."""

    voxel_m: ClassVar[float] = 4.0  # voxel size in the plane, m
    voxel_height_m: ClassVar[float] = 4.0  # voxel height, m
    corridor_m: ClassVar[float] = 45.0  # horizontal margin of the grid around the pedestrian trajectory, m
    beam: int = Field(2048, ge=1, description="states kept per time layer")
    weight_tracking: ClassVar[float] = 2.0  # weight of the distance to the preferred ring, in voxels
    weight_visibility: ClassVar[float] = 18.0  # weight of the blocked part of the five rays
    weight_path: ClassVar[float] = 1.0  # weight of the path length, in voxels
    weight_safety: ClassVar[float] = 8.0  # weight of the squared intrusion into influence_m
    weight_smoothness: ClassVar[float] = 0.15  # weight of the squared change of the move, in voxels
    influence_m: ClassVar[float] = 8.0  # obstacles nearer than this add to the safety term, m


class PlanConfig(Config):
    """Settings of step 4, for all planners (tab:drone_params); altitudes count from the ground under the target."""

    planner: str = Field(
        "foresight", description=f"foresight (ours), muco ({NOTES['muco']}) or track_astar ({NOTES['track_astar']})"
    )
    safety_distance_m: float = Field(limits.SAFETY_DISTANCE_M, gt=0, description="nominal distance to obstacles, m")
    relaxed_safety_m: float = Field(
        limits.RELAXED_SAFETY_M, gt=0, description="distance to obstacles where the nominal one is impossible, m"
    )
    altitude_min_m: float = Field(20.0, gt=0, description="least altitude of the style follow, m")
    altitude_preferred_m: float = Field(20.0, gt=0, description="preferred altitude of the style follow, m")
    altitude_max_m: float = Field(100.0, gt=0, description="greatest altitude, m")
    behind_distance_m: float = Field(
        20.0, gt=0, description="horizontal distance of the style follow, m; at the start only for muco and track_astar"
    )
    speed_max_mps: float = Field(10.0, gt=0, description="greatest speed between two waypoints, m/s")
    accel_max_mps2: float = Field(5.0, gt=0, description="greatest acceleration between steps, m/s^2")
    yaw_rate_max_degps: IfChanged[float] = Field(
        limits.YAW_RATE_MAX_DEGPS, gt=0, le=720, description="greatest yaw rate of the camera, also for inspect, deg/s"
    )
    gimbal: IfChanged[GimbalConfig] = Field(
        GimbalConfig(), description="camera that follows the target imperfectly, on both tracks"
    )
    heading_smoothing_s: ClassVar[float] = 4.0  # standard deviation of the target's heading filter, s; 0: none
    five_ray_mean_min: float = Field(
        limits.FIVE_RAY_MEAN_MIN, ge=0, le=1, description="smallest mean five-ray visibility of an accepted trajectory"
    )
    accel_rms_max_mps2: ClassVar[float] = limits.ACCEL_RMS_MAX_MPS2  # of greater RMS acceleration: dropped
    jerk_rms_max_mps3: ClassVar[float] = limits.JERK_RMS_MAX_MPS3  # of greater RMS jerk: dropped
    styles: dict[str, float] = Field(
        {FOLLOW: 1.0}, description="share of each manoeuvre style; shares need not add up to one", examples=[*NAMES]
    )
    style_ranges: dict[str, dict[str, Range]] = Field(
        {}, description="[least, greatest] values that replace those of a style, such as {side: {altitude_m: [11, 13]}}"
    )
    segment_s: float = Field(
        0.0, ge=0, description="approximate duration of a segment with one style, s; 0: one style per trajectory"
    )
    styles_fallback: Literal["drop", "follow"] = Field(
        "drop",
        description="where the map leaves no room for a style: drop the trajectory, or use follow; both are counted",
    )
    muco: MucoConfig = Field(MucoConfig(), description="the MuCO optimiser")
    track_astar: TrackAStarConfig = Field(TrackAStarConfig(), description="TA*+Smooth, with our smoothing")

    _is_known = field_validator("planner")(known_planner)

    @field_validator("styles")
    @classmethod
    def _are_shares(cls, shares: dict[str, float]) -> dict[str, float]:
        for name, share in shares.items():
            if name not in NAMES:
                raise ValueError(f"there is no style {name!r}{nearest(name, NAMES)}; choose from {', '.join(NAMES)}")
            if share < 0:
                raise ValueError(f"the share of the style {name} must not be negative, got {share}")
        if sum(shares.values()) <= 0:
            raise ValueError("the shares of the styles must add up to more than 0")
        return shares

    @field_validator("style_ranges")
    @classmethod
    def _are_ranges(cls, ranges: dict[str, dict[str, Range]]) -> dict[str, dict[str, Range]]:
        for name, style_ranges in ranges.items():
            if name not in ROWS:
                choices = ", ".join(ROWS)
                raise ValueError(
                    f"there is no style {name!r} with adjustable ranges{nearest(name, ROWS)}; choose from {choices}"
                )
            with_ranges(ROWS[name], style_ranges)
        return ranges

    @model_validator(mode="after")
    def _check(self) -> PlanConfig:
        problems = []
        if self.relaxed_safety_m > self.safety_distance_m:
            problems.append("relaxed_safety_m must be at most safety_distance_m")
        if not self.altitude_min_m <= self.altitude_preferred_m <= self.altitude_max_m:
            problems.append("altitude_min_m, altitude_preferred_m and altitude_max_m must be in ascending order")
        for name, row in self._rows().items():
            if (highest_m := row.altitude_range_m[1]) > self.altitude_max_m:
                problems.append(f"style_ranges.{name} must not go above altitude_max_m, got {highest_m:g} m")
            if (fastest_mps := max(map(abs, row.round_mps))) >= self.speed_max_mps:
                problems.append(f"style_ranges.{name}.round_mps must stay below speed_max_mps, got {fastest_mps:g} m/s")
        if problems:
            raise ValueError("; ".join(problems))
        return self

    def style(self, name: str) -> Style:
        """Return a row of the table of styles with the ranges of the settings, mirrored if the name asks for it."""
        style_name = name.removeprefix(OTHER_SIDE)
        row = with_ranges(ROWS[style_name], self.style_ranges.get(style_name, {}))
        if name.startswith(OTHER_SIDE) and row.bearing_deg is not None:
            low_deg, high_deg = row.bearing_deg
            row = replace(row, bearing_deg=(-high_deg, -low_deg))
        return row

    def _rows(self) -> dict[str, Style]:
        return {name: self.style(name) for name, share in self.styles.items() if share > 0 and name in ROWS}

    @property
    def styles_floor_m(self) -> float:
        """Return the least altitude of styles other than follow."""
        return min(ALTITUDE_LEAST_M, self.altitude_min_m, *(row.altitude_range_m[0] for row in self._rows().values()))

    def remarks(self) -> list[str]:
        """Return remarks on settings of altitude and distance that apply to some of the trajectories only."""
        fields = ("altitude_min_m", "altitude_preferred_m", "behind_distance_m") if self._rows() else ()
        return [
            f"plan.{field} = {getattr(self, field):g} applies to the style follow only, not to plan.style_ranges"
            for field in fields
            if getattr(self, field) != type(self).model_fields[field].default
        ]

    def recorded(self) -> dict[str, Any]:
        """Return the settings without the ranges of styles that have no share."""
        settings = super().recorded()
        ranges = {name: ends for name, ends in settings.pop("style_ranges").items() if name in self._rows()}
        return settings | ({"style_ranges": ranges} if ranges else {})


# --- a planner --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrackingReference:
    """The trajectory that a planner tracks as closely as boxes, speed and visibility allow; arrays are (n,).

    The paper's three values of pitch and distances do not agree, so none of them follows from the others.
    """

    heading_rad: np.ndarray  # smoothed direction of the target, continuous
    bearing_rad: np.ndarray  # from the target to the drone, counter-clockwise from the heading: 0 in front, pi behind
    distance_m: np.ndarray  # slant distance to the hip point
    ground_distance_m: np.ndarray  # distance in the plane
    pitch_rad: np.ndarray  # downward pitch of the view
    altitude_m: np.ndarray  # above the ground under the target
    altitude_min_m: np.ndarray  # hard bound
    altitude_max_m: np.ndarray  # hard bound
    keeps_sight: np.ndarray  # bool: whether the target must be visible; elsewhere a planner ignores visibility
    any_bearing: bool = False  # the paper's reference: bearing is a weak preference; else bearing and altitude count

    @property
    def view_rad(self) -> np.ndarray:
        """Return the azimuth from the drone to the target, (n,)."""
        return self.heading_rad + (self.bearing_rad - np.pi)

    def places_m(self, targets_m: np.ndarray, ground_m: np.ndarray) -> np.ndarray:
        """Return the reference positions, (n, 3), for hip points (n, 3) and the ground below them (n,)."""
        back = -self.ground_distance_m[:, None] * np.stack([np.cos(self.view_rad), np.sin(self.view_rad)], axis=1)
        return np.column_stack([targets_m[:, :2] + back, ground_m + self.altitude_m])


@dataclass(frozen=True)
class Scenario:
    """The input of a planner: n >= 2 waypoints. Only foresight continues a trajectory from past positions."""

    path_id: str
    targets_m: np.ndarray  # (n, 3) hip points
    ground_m: np.ndarray  # (n,) height of the ground below each
    reference: TrackingReference
    dt_s: float = DT_S  # time between waypoints
    past_m: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))  # (k, 3) of the drone; k is 0, or at least 3
    turns_back: bool = False  # the drone of `past_m` first has to brake and turn back

    @property
    def start(self) -> int:
        """Return the first waypoint that is planned."""
        return max(len(self.past_m) - 1, 0)

    def with_past(self, points_m: np.ndarray) -> np.ndarray:
        """Return positions, (n, 3), whose first ones are replaced by the past ones."""
        return np.vstack([self.past_m, points_m[len(self.past_m) :]])

    def key_frames(self, stride: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return every stride-th frame and the last, with the least, preferred and greatest z at each, all (m,).

        A trajectory is straight between key frames and the ground is not, so a height respects the bounds of all frames
        around its key frame.
        """
        from scipy.ndimage import maximum_filter1d, minimum_filter1d

        last = len(self.targets_m) - 1
        frames = np.unique(np.append(np.arange(self.start, last + 1, stride), last))
        width = 2 * stride + 1
        least_z = maximum_filter1d(self.ground_m + self.reference.altitude_min_m, width, mode="nearest")
        preferred_z = maximum_filter1d(self.ground_m + self.reference.altitude_m, width, mode="nearest")
        greatest_z = minimum_filter1d(self.ground_m + self.reference.altitude_max_m, width, mode="nearest")
        return frames, least_z[frames], preferred_z[frames], greatest_z[frames]

    def between(self, frames: np.ndarray, positions_m: np.ndarray) -> np.ndarray:
        """Return positions, (n, 3), interpolated linearly between those at key frames, (m, 3)."""
        every = np.arange(len(self.targets_m))
        return self.with_past(np.stack([np.interp(every, frames, positions_m[:, axis]) for axis in range(3)], axis=1))

    def no_path_error(self, what: str, clearance_m: float) -> NoPathError:
        """Return the error of a planner that finds no trajectory with a clearance."""
        low_m = self.reference.altitude_min_m.min()
        high_m = self.reference.altitude_max_m.max()
        expected = f"positions {low_m:g} to {high_m:g} m above ground and {clearance_m:g} m from all boxes"
        fix = "raise plan.altitude_max_m, or remove the pedestrian trajectory if a roof covers it"
        return NoPathError(what, where=self.path_id, expected=expected, fix=fix)


@dataclass(frozen=True)
class Plan:
    """The result of a planner. The filter drops a trajectory whose optimiser did not converge."""

    positions_m: np.ndarray  # (n, 3), one per target
    solver: dict = field(default_factory=dict)  # JSON facts about the search that do not vary between runs
    is_converged: bool = True


Planner = Callable[[Scenario, "BoxIndex", PlanConfig, np.random.Generator], Plan]


def load_planner(name: str) -> Planner:
    """Import a planner of ALL_PLANNERS."""
    module, _, function = ALL_PLANNERS[name].partition(":")
    return getattr(importlib.import_module(module), function)
