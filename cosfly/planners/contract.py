"""What a planner is: what it gets, what it gives, and what it must keep. All settings of step 4 stand here.

A planner is one function, named in PLANNERS or, if it is a generic one, in REFERENCES, with the signature

    plan(scenario: Scenario, obstacles: BoxIndex, cfg: PlanConfig, rng: np.random.Generator) -> Plan

It gives one drone position for each target position, keeps to the shared settings (tab:drone_params), draws chance from
`rng` only, and raises NoPathError where it finds nothing. `tests/test_planners_contract.py` holds every entry of
PLANNERS to that. Compiled code is imported by the planners alone: settings are read without it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from cosfly.formats.segments import FOLLOW
from cosfly.geometry.axes import DT_S
from cosfly.geometry.trajectory_metrics import (
    ACCEL_RMS_MAX_MPS2,
    FIVE_RAY_MEAN_MIN,
    JERK_RMS_MAX_MPS3,
    RELAXED_SAFETY_M,
    SAFETY_DISTANCE_M,
)
from cosfly.planners.styles import ALTITUDE_LEAST_M, NAMES, OTHER_SIDE, ROWS, Range, Style, with_ranges
from cosfly.runtime.config import Config
from cosfly.runtime.errors import NoPathError, nearest

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex

# In the order of comparisons, which hold the first against each of the others.
PLANNERS = {
    "foresight": "cosfly.planners.foresight:plan",
    "track_astar": "cosfly.planners.track_astar:plan",
    "muco": "cosfly.planners.muco.muco:plan",
}
# Generic planners that know nothing of sight, beside which `plan benchmark` holds those above (app:three_axis_eval).
REFERENCES = {
    "rrt_star": "cosfly.planners.reference.sampling:plan_rrt_star",
    "prm": "cosfly.planners.reference.sampling:plan_prm",
    "bspline_prm": "cosfly.planners.reference.sampling:plan_bspline_prm",
    "elastic_band": "cosfly.planners.reference.elastic_band:plan",
    "minimum_jerk": "cosfly.planners.reference.minimum_jerk:plan",
    "astar": "cosfly.planners.reference.grid_search:plan_astar",
    "weighted_astar": "cosfly.planners.reference.grid_search:plan_weighted",
    "theta_star": "cosfly.planners.reference.grid_search:plan_theta",
    "visibility_astar": "cosfly.planners.reference.visibility_astar:plan",
    "potential_field": "cosfly.planners.reference.potential_field:plan",
    "chomp": "cosfly.planners.reference.chomp:plan",
    "trajopt": "cosfly.planners.reference.trajopt:plan",
}
ALL_PLANNERS = PLANNERS | REFERENCES
# In tables and pictures; others go by their names.
TITLES = {
    "track_astar": "TA* + Smooth", "muco": "MuCO", "rrt_star": "RRT*", "prm": "PRM", "bspline_prm": "B-spline PRM",
    "astar": "3D A*", "weighted_astar": "weighted A*", "theta_star": "Theta*", "visibility_astar": "visibility-A*",
    "chomp": "CHOMP-lite", "trajopt": "L-BFGS-B TrajOpt",
}  # fmt: skip


def title_of(name: str) -> str:
    """Return a planner's name for people."""
    return TITLES.get(name, name.replace("_", " "))


def known_planner(name: str) -> str:
    """Return the name back.

    Raises:
        ValueError: it is not in ALL_PLANNERS.
    """
    if name not in ALL_PLANNERS:
        raise ValueError(f"there is no such planner{nearest(name, ALL_PLANNERS)}; there are {', '.join(ALL_PLANNERS)}")
    return name


# --- settings ---------------------------------------------------------------------------------------------------------


class MucoConfig(Config):
    """Settings of the MuCO optimiser (subsec:appendix_planner_muco)."""

    track_distance_m: float = Field(
        28.0,
        gt=0,
        description="wanted slant distance to the target, through the air, m; of muco alone: foresight keeps "
        "plan.behind_distance_m over ground and plan.altitude_preferred_m",
    )
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
    # weight of squared altitude beneath the wished one of styles other than follow
    weight_beneath: ClassVar[float] = 2.0
    # weight of squared pitch outside pitch_band_deg, per rad^2 (the paper names none)
    weight_pitch: ClassVar[float] = 20.0
    influence_m: ClassVar[float] = 8.0  # obstacles nearer than this add to the safety term, m
    pitch_deg: float = Field(45.0, gt=0, lt=90, description="wanted downward pitch of the camera, degrees")
    pitch_band_deg: ClassVar[tuple[float, float]] = (30.0, 60.0)  # pitch outside costs extra, degrees
    low_visibility: float = Field(0.3, ge=0, le=1, description="visibility below this is low")
    # so many low frames in a row take visibility and view angle out of the gradient
    low_visibility_frames: ClassVar[int] = 20
    step: Literal["newton", "paper"] = Field(
        "newton",
        description="newton: band-matrix step, shortened until the loss falls; paper: the paper's optimizer as it is "
        "printed, plain steps along finite differences whatever the loss does",
    )
    difference_m: ClassVar[float] = 0.5  # half width of the difference window, m
    learning_rate: float = Field(0.05, gt=0, description="of the paper's step; the newton step has none")
    step_cap_m: float = Field(0.5, gt=0, description="longest move of a waypoint in one iteration, m")
    iterations_max: int = Field(1500, ge=0, description="iterations at most")
    tolerance: float = Field(
        1e-5, gt=0, description="converged when the loss changes by less: a part of it (newton), or as it is (paper)"
    )
    pushes_max: ClassVar[int] = 10  # pushes out of obstacles per waypoint and projection, at most
    start_visibility: ClassVar[float] = 0.95  # search for a better start when flying plainly behind sees less; 0: never


class TrackAStarConfig(Config):
    """Settings of TA*+Smooth (subsec:appendix_planner_tastar); what the terms are stands in track_astar.py."""

    voxel_m: float = Field(4.0, gt=0, description="voxel size in the plane, m")
    voxel_height_m: ClassVar[float] = 4.0  # voxel height, m
    corridor_m: float = Field(45.0, gt=0, description="horizontal margin of the grid round the walk, m")
    beam: int = Field(2048, ge=1, description="places kept per time layer")
    weight_tracking: ClassVar[float] = 2.0  # weight of the distance to the preferred ring, in voxels
    weight_visibility: float = Field(18.0, ge=0, description="weight of the blocked part of the five rays")
    weight_path: ClassVar[float] = 1.0  # weight of the way, in voxels
    weight_safety: ClassVar[float] = 8.0  # weight of the squared intrusion into influence_m
    weight_smoothness: ClassVar[float] = 0.15  # weight of the squared change of the move, in voxels
    influence_m: ClassVar[float] = 8.0  # obstacles nearer than this add to the safety term, m


class PlanConfig(Config):
    """Settings of step 4, for all planners (tab:drone_params); altitudes count from the ground under the walker."""

    planner: str = Field("foresight", description="which planner flies: foresight, muco or track_astar")
    safety_distance_m: float = Field(SAFETY_DISTANCE_M, gt=0, description="nominal distance to obstacles, m")
    relaxed_safety_m: float = Field(RELAXED_SAFETY_M, gt=0, description="distance kept where the nominal one cannot, m")
    altitude_min_m: float = Field(20.0, gt=0, description="least altitude of the style follow, m")
    altitude_preferred_m: float = Field(20.0, gt=0, description="preferred altitude of the style follow, m")
    altitude_max_m: float = Field(100.0, gt=0, description="greatest altitude, m")
    behind_distance_m: float = Field(
        20.0,
        gt=0,
        description="horizontal distance to the target of the style follow, m: for foresight all along, for others at "
        "the start",
    )
    speed_max_mps: float = Field(10.0, gt=0, description="greatest speed between two waypoints, m/s")
    accel_max_mps2: float = Field(
        5.0, gt=0, description="greatest change of speed from a step to the next, m/s^2; muco.step: paper knows none"
    )
    # standard deviation of the smoothing of the walking direction, s; 0: none
    heading_smoothing_s: ClassVar[float] = 4.0
    five_ray_mean_min: float = Field(
        FIVE_RAY_MEAN_MIN, ge=0, le=1, description="drop a flight whose mean five-ray visibility is lower; 0: never"
    )
    accel_rms_max_mps2: float = Field(
        ACCEL_RMS_MAX_MPS2, gt=0, description="drop a flight of greater RMS acceleration, m/s^2"
    )
    jerk_rms_max_mps3: float = Field(JERK_RMS_MAX_MPS3, gt=0, description="drop a flight of greater RMS jerk, m/s^3")
    styles: dict[str, float] = Field(
        {FOLLOW: 1.0},
        description="shares of the styles that flights are drawn from, by name; they need not add up to one",
        examples=[*NAMES],
    )
    style_ranges: dict[str, dict[str, Range]] = Field(
        {},
        description="style -> range -> [least, greatest]: ranges that replace those of the table of styles, for "
        "instance {side: {altitude_m: [11, 13]}}",
    )
    segment_s: float = Field(
        0.0, ge=0, description="length of the parts of a flight that draw a style each, about, s; 0: one style a flight"
    )
    styles_fallback: Literal["drop", "follow"] = Field(
        "drop", description="a style that the map cannot hold: drop the flight, or fly follow instead; counted"
    )
    muco: MucoConfig = Field(default_factory=MucoConfig, description="the MuCO optimiser")
    track_astar: TrackAStarConfig = Field(default_factory=TrackAStarConfig, description="TA*+Smooth")

    _is_known = field_validator("planner")(known_planner)

    @field_validator("styles")
    @classmethod
    def _are_shares(cls, shares: dict[str, float]) -> dict[str, float]:
        for name, share in shares.items():
            if name not in NAMES:
                raise ValueError(f"there is no style {name!r}{nearest(name, NAMES)}; there are {', '.join(NAMES)}")
            if share < 0:
                raise ValueError(f"the share of {name} must not be negative, got {share}")
        if sum(shares.values()) <= 0:
            raise ValueError("the shares of the styles must add up to more than 0")
        return shares

    @field_validator("style_ranges")
    @classmethod
    def _are_ranges(cls, ranges: dict[str, dict[str, Range]]) -> dict[str, dict[str, Range]]:
        for name, own in ranges.items():
            if name not in ROWS:
                raise ValueError(f"there is no style {name!r} with ranges{nearest(name, ROWS)}")
            with_ranges(ROWS[name], own)
        return ranges

    @model_validator(mode="after")
    def _check(self) -> PlanConfig:
        wrong = []
        if self.relaxed_safety_m > self.safety_distance_m:
            wrong.append("relaxed_safety_m may not exceed safety_distance_m")
        if not self.altitude_min_m <= self.altitude_preferred_m <= self.altitude_max_m:
            wrong.append("altitude_min_m, altitude_preferred_m and altitude_max_m must be in ascending order")
        for name, row in self._rows().items():
            highest_m = max(row.altitude_m[1], (row.altitude_end_m or row.altitude_m)[1])
            if highest_m > self.altitude_max_m:
                wrong.append(f"style_ranges.{name} goes up to {highest_m:g} m, above altitude_max_m")
            if (fastest_mps := max(map(abs, row.round_mps))) >= self.speed_max_mps:
                wrong.append(f"style_ranges.{name}.round_mps is up to {fastest_mps:g}, no less than speed_max_mps")
        if wrong:
            raise ValueError("; ".join(wrong))
        return self

    def style(self, name: str) -> Style:
        """Return a row of the table of styles with the ranges of the settings."""
        plain = name.removeprefix(OTHER_SIDE)
        row = with_ranges(ROWS[plain], self.style_ranges.get(plain, {}))
        if name.startswith(OTHER_SIDE) and row.bearing_deg is not None:
            row = replace(row, bearing_deg=(-row.bearing_deg[1], -row.bearing_deg[0]))
        return row

    def _rows(self) -> dict[str, Style]:
        return {name: self.style(name) for name, share in self.styles.items() if share > 0 and name in ROWS}

    @property
    def styles_floor_m(self) -> float:
        """Least altitude of a flight of other styles than follow."""
        lows = [min(row.altitude_m[0], (row.altitude_end_m or row.altitude_m)[0]) for row in self._rows().values()]
        return min(ALTITUDE_LEAST_M, self.altitude_min_m, *lows)

    def remarks(self) -> list[str]:
        """Return which settings of heights and distances hold for a part of the flights alone."""
        fields = ("altitude_min_m", "altitude_preferred_m", "behind_distance_m") if self._rows() else ()
        return [
            f"plan.{field} = {getattr(self, field):g} holds for the style follow alone; for others plan.style_ranges"
            for field in fields
            if getattr(self, field) != type(self).model_fields[field].default
        ]

    def recorded(self) -> dict[str, Any]:
        """Ranges of styles that nobody flies make no difference."""
        settings = super().recorded()
        ranges = {name: ends for name, ends in settings.pop("style_ranges").items() if name in self._rows()}
        return settings | ({"style_ranges": ranges} if ranges else {})


# --- a planner --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrackingReference:
    """What a flight should be at each of n waypoints, all (n,); a planner comes as near as boxes, speed and sight
    allow.

    heading_rad: the walker's smoothed direction, continuous. bearing_rad: where the drone stands as seen from the
    walker, counter-clockwise from the heading: 0 in front, pi behind. distance_m: slant distance to the hip point;
    ground_distance_m: in the plane. pitch_rad: downward pitch of the view. Two of the three would do, but the paper's
    do not agree with each other.
    altitude_m: above the ground under the walker; altitude_min_m and altitude_max_m are bounds, which a flight keeps.
    keeps_sight: bool, whether the walker is to be seen; elsewhere a planner gives up nothing for it. any_bearing: the
    paper's way, to whose planners the bearing is a beginning and a weak wish; elsewhere the bearing and the altitude
    are what the flight is for.
    """

    heading_rad: np.ndarray
    bearing_rad: np.ndarray
    distance_m: np.ndarray
    ground_distance_m: np.ndarray
    pitch_rad: np.ndarray
    altitude_m: np.ndarray
    altitude_min_m: np.ndarray
    altitude_max_m: np.ndarray
    keeps_sight: np.ndarray
    any_bearing: bool = False

    @property
    def view_rad(self) -> np.ndarray:
        """Azimuth in which the drone looks at the walker, (n,)."""
        return self.heading_rad + (self.bearing_rad - np.pi)

    def places_m(self, targets_m: np.ndarray, ground_m: np.ndarray) -> np.ndarray:
        """Return the wished places, (n, 3), for hip points (n, 3) and the ground below them (n,)."""
        back = -self.ground_distance_m[:, None] * np.stack([np.cos(self.view_rad), np.sin(self.view_rad)], axis=1)
        return np.column_stack([targets_m[:, :2] + back, ground_m + self.altitude_m])


@dataclass(frozen=True)
class Scenario:
    """What a planner gets to know; n >= 2 waypoints, dt_s apart.

    targets_m: (n, 3) hip points. ground_m: (n,) height of the ground below each. wish: what the flight should be at
    each. flown_m: (k, 3), where the drone was at the first k waypoints, of a flight that goes on from there; k is 0, or
    3 and more, and only foresight plans on. turns_round: such a drone is first to brake and turn round.
    """

    path_id: str
    targets_m: np.ndarray
    ground_m: np.ndarray
    reference: TrackingReference
    dt_s: float = DT_S
    flown_m: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    turns_round: bool = False

    @property
    def start(self) -> int:
        """The waypoint from which on is planned."""
        return max(len(self.flown_m) - 1, 0)

    def as_flown(self, points_m: np.ndarray) -> np.ndarray:
        """Return a flight, (n, 3), with what is flown already as its begin."""
        return np.vstack([self.flown_m, points_m[len(self.flown_m) :]])

    def key_frames(self, stride: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return every stride-th frame from the start on and the last, and the least, preferred and greatest z at each,
        all (m,).

        Between key frames a flight is straight while the ground may rise and fall: a key frame keeps the bounds of all
        frames around it.
        """
        from scipy.ndimage import maximum_filter1d, minimum_filter1d

        frames = np.unique(np.append(np.arange(self.start, len(self.targets_m), stride), len(self.targets_m) - 1))
        least, preferred = (
            maximum_filter1d(self.ground_m + altitudes_m, 2 * stride + 1, mode="nearest")[frames]
            for altitudes_m in (self.reference.altitude_min_m, self.reference.altitude_m)
        )
        highest_m = self.ground_m + self.reference.altitude_max_m
        return frames, least, preferred, minimum_filter1d(highest_m, 2 * stride + 1, mode="nearest")[frames]

    def between(self, frames: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return the flight that is straight between places at key frames, (m, 3): (n, 3)."""
        every = np.arange(len(self.targets_m))
        return self.as_flown(np.stack([np.interp(every, frames, places[:, axis]) for axis in range(3)], axis=1))

    def no_way(self, what: str, floor_m: float) -> NoPathError:
        """Return the error of a planner that finds nothing. floor_m: distance to boxes that it keeps at least."""
        low_m, high_m = self.reference.altitude_min_m.min(), self.reference.altitude_max_m.max()
        expected = f"places from {low_m:g} to {high_m:g} m up, {floor_m:g} m from all boxes"
        fix = "is the walk roofed over? raise plan.altitude_max_m or leave the path out"
        return NoPathError(what, where=self.path_id, expected=expected, fix=fix)


@dataclass(frozen=True)
class Plan:
    """What a planner gives. positions_m: (n, 3), one per target. solver: JSON-able facts, no times (they would differ).

    is_converged: False where an optimizer was stopped before it came to rest; the prefilter drops such a flight.
    """

    positions_m: np.ndarray
    solver: dict = field(default_factory=dict)
    is_converged: bool = True


Planner = Callable[[Scenario, "BoxIndex", PlanConfig, np.random.Generator], Plan]


def load_planner(name: str) -> Planner:
    """Import a planner of ALL_PLANNERS."""
    module, _, function = ALL_PLANNERS[name].partition(":")
    return getattr(importlib.import_module(module), function)
