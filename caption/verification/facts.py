"""What can be measured on an observed window: the one table from which prompts, slots and the check of values take
every fact.

Values are rounded here, once, as they are printed, so that a text and its check compare the same numbers. How a single
fact is named and looked up: references.py.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from operator import mul
from typing import Any, Literal, NamedTuple

import numpy as np

from caption.schema import ObservedFrame, ObservedWindow
from cosfly.geometry.axes import wrap_deg

VisibilityWord = Literal["visible", "partly_occluded", "illegible", "occluded", "out_of_view"]
Series = Sequence[float | None]
STANDING_MPS = 0.2  # slower than this a person stands
PARTLY_BELOW = 0.7  # rendered score under which a visible person counts as partly hidden
SMOOTHED_OVER = 2  # frames before and after one that its velocity is fitted to
SMOOTH_M, SMOOTH_DEG = 0.15, 1.0  # a track that deviates by more from a parabola is perturbed
LEAST_SEEN = 3  # frames at which the target is seen, for a velocity of it
# The facts of single frames, which `_measure_frame` returns.
BY_FRAME = (
    "altitude_m", "pitch_deg", "heading_deg", "distance_m", "slant_m", "height_over_target_m", "bearing_deg",
    "depression_deg", "box_width_px", "box_height_px", "offset_x_px", "offset_y_px", "visibility",
)  # fmt: skip


@dataclass(frozen=True)
class Facts:
    """Measured series, oldest frame first; None where a value cannot be measured.

    What is measured of the target is None at frames in which it is hidden or out of view. A velocity is the slope of
    the straight line that fits positions best, of up to five neighbouring frames. If the track jitters, only the
    current frame has one, of the whole window, so that a perturbation is not reported as motion. Axes are those of the
    drone at the current frame: forward along its heading, left, up. Angles are positive to the left.
    """

    # The drone.
    speed_mps: tuple[float | None, ...]  # in 3D
    velocity_mps: tuple[float, float, float]  # (forward, left, up), over the whole window
    mean_speed_mps: float  # length of `velocity_mps`
    altitude_m: tuple[float, ...]  # world z
    climb_mps: tuple[float | None, ...]  # slope of the altitude
    yaw_deg: tuple[float, ...]  # against the oldest frame
    yaw_rate_dps: tuple[float | None, ...]  # slope of `yaw_deg`
    heading_deg: tuple[float, ...]  # in the world, 0 along x, in (-180, 180]
    pitch_deg: tuple[float, ...]  # of the camera
    travelled_m: tuple[float, ...]  # length of the path from the oldest frame
    displacement_m: tuple[float, ...]  # straight line from the oldest frame
    step_speeds_mps: tuple[float | None, ...]  # from the frame before, in 3D, as the paper's state has them
    target_speeds_mps: tuple[float | None, ...]  # on the ground
    target_velocity_mps: tuple[float, float] | None  # (forward, left), over the whole window
    target_speed_mps: float | None  # length of `target_velocity_mps`
    target_turn_deg: float | None  # change of its heading over the window
    target_headings_deg: tuple[float | None, ...]  # in the world, 0 along x
    target_travelled_m: tuple[float | None, ...]  # straight line on the ground from the first frame that shows it
    target_step_speeds_mps: tuple[float | None, ...]  # as `step_speeds_mps`, on the ground
    # From the drone to the target.
    place_m: tuple[tuple[float, float, float] | None, ...]  # (forward, left, up)
    distance_m: tuple[float | None, ...]  # horizontal
    slant_m: tuple[float | None, ...]  # in 3D
    height_over_target_m: tuple[float | None, ...]  # of the drone over the person's hip
    bearing_deg: tuple[float | None, ...]  # of the target, against the drone's heading at the frame
    depression_deg: tuple[float | None, ...]  # of the line of sight below the horizon
    # In the picture, in its pixels: the box of the target, and how far its centre is from that of the picture.
    box_width_px: tuple[int | None, ...]
    box_height_px: tuple[int | None, ...]
    offset_x_px: tuple[int | None, ...]  # positive to the right
    offset_y_px: tuple[int | None, ...]  # positive down
    visibility: tuple[VisibilityWord, ...]
    width_px: int  # of the picture
    height_px: int
    others_in_view: tuple[int | None, ...]  # how many other people have a pixel
    other_distance_m: tuple[float | None, ...]  # from the target to the nearest of them
    alike_differences: tuple[int | None, ...]  # of figure, top, legs, hat and bag, in the person most like the target
    step_s: float  # mean time between two frames
    mission: str | None  # the kind of the order that ends the pursuit, once it is given

    def __len__(self) -> int:
        return len(self.yaw_deg)

    def place_axis_m(self, axis: int) -> Series:
        """Return one axis of `place_m`: 0 forward, 1 left, 2 up."""
        return [None if place is None else place[axis] for place in self.place_m]

    @property
    def sight_rate_dps(self) -> float:
        """How fast the line of sight to the target turns to the left, by the line that fits best; 0 if not known."""
        pairs = zip(self.yaw_deg, self.bearing_deg, strict=True)
        points = [(i, yaw + bearing) for i, (yaw, bearing) in enumerate(pairs) if bearing is not None]
        if len(points) <= 2:
            return 0.0
        middle = sum([x for x, _ in points]) / len(points)
        slope = sum([(x - middle) * y for x, y in points]) / sum([(x - middle) ** 2 for x, _ in points])
        return slope / self.step_s

    @property
    def is_visible_now(self) -> bool:
        """Return whether nothing hides the target. Labels depend on this."""
        return self.visibility[-1] in ("visible", "partly_occluded", "illegible")

    @property
    def is_legible_now(self) -> bool:
        """Return whether a person could see the target in the picture; it decides what may be said of its looks."""
        return self.visibility[-1] in ("visible", "partly_occluded")

    @cached_property
    def found(self) -> dict[Any, Any]:
        """Cache of what was computed from the facts, by key: several languages and checks need the same results."""
        return {}


def measure_facts(window: ObservedWindow, picture_px: tuple[int, int] | None = None) -> Facts:
    """Measure a window. Pixels refer to the pictures that are shown, (width, height); None: the camera's own."""
    camera_px = (window.width_px, window.height_px)
    picture_px = picture_px or camera_px
    frames = window.frames
    measured = [_measure_frame(frame, camera_px, picture_px) for frame in frames]
    by_frame: dict[str, Any] = {name: tuple([facts.get(name) for facts in measured]) for name in BY_FRAME}
    seen = tuple([distance_m is not None for distance_m in by_frame["distance_m"]])
    step_s = (frames[-1].time_s - frames[0].time_s) / (len(frames) - 1)
    return Facts(
        **by_frame, **_measure_drone(frames, step_s), **_measure_target(frames, seen, step_s), width_px=picture_px[0],
        height_px=picture_px[1], step_s=round(step_s, 3), mission=window.mission,
        others_in_view=_rounded([frame.others_in_view for frame in frames], None),
        other_distance_m=_rounded([frame.other_distance_m for frame in frames], 1),
        alike_differences=_rounded([frame.alike_differences for frame in frames], None),
    )  # fmt: skip


def _forward_left(x: float, y: float, current: ObservedFrame) -> tuple[float, float]:
    """Return a horizontal vector of the world in the axes of the drone at the current frame."""
    yaw_rad = math.radians(current.rotation_deg[1])
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return x * cos + y * sin, y * cos - x * sin


def _measure_drone(frames: Sequence[ObservedFrame], step_s: float) -> dict[str, Any]:
    """Measure how the drone moves and turns."""
    axes = list(zip(*[frame.position_m for frame in frames], strict=True))
    turns_deg = [wrap_deg(after.rotation_deg[1] - before.rotation_deg[1]) for before, after in pairwise(frames)]
    yaw_deg = [0.0, *accumulate(turns_deg)]
    steps_m = [math.dist(before.position_m, after.position_m) for before, after in pairwise(frames)]
    is_known = (True,) * len(frames)
    (v_x, v_y, v_z), by_frame = _velocities(axes, is_known, step_s, SMOOTH_M)
    _, [yaw_rates_dps] = _velocities((yaw_deg,), is_known, step_s, SMOOTH_DEG)
    forward, left = _forward_left(v_x, v_y, frames[-1])
    return {
        "speed_mps": _rounded([math.hypot(*velocity) for velocity in zip(*by_frame, strict=True)], 2),
        "velocity_mps": _rounded((forward, left, v_z), 2),
        "mean_speed_mps": _round(math.hypot(v_x, v_y, v_z), 2),
        "climb_mps": _rounded(by_frame[2], 2),
        "yaw_deg": _rounded(yaw_deg, 1),
        "yaw_rate_dps": _rounded(yaw_rates_dps, 1),
        "travelled_m": (0.0, *_rounded(accumulate(steps_m), 1)),
        "displacement_m": _rounded([math.dist(frames[0].position_m, frame.position_m) for frame in frames], 1),
        "step_speeds_mps": (None, *_rounded([step_m / step_s for step_m in steps_m], 2)),
    }


def _measure_target(frames: Sequence[ObservedFrame], seen: tuple[bool, ...], step_s: float) -> dict[str, Any]:
    """Measure where the target is and how it moves, at the frames at which it is seen."""
    places_m, positions = [], []  # positions: (x, y) in the world; NaN where the target is not seen
    for frame, is_seen in zip(frames, seen, strict=True):
        away_x, away_y, away_z = (b - a for a, b in zip(frame.position_m, frame.target_m, strict=True))
        places_m.append(_rounded((*_forward_left(away_x, away_y, frames[-1]), away_z), 1) if is_seen else None)
        positions.append(frame.target_m[:2] if is_seen else (math.nan, math.nan))
    first = positions[seen.index(True) if any(seen) else 0]
    v_x, v_y = math.nan, math.nan
    by_frame = [[math.nan] * len(frames)] * 2
    if sum(seen) >= LEAST_SEEN:
        (v_x, v_y), by_frame = _velocities(list(zip(*positions, strict=True)), seen, step_s, SMOOTH_M)
    velocities = list(zip(*by_frame, strict=True))
    speeds = [math.hypot(*velocity) for velocity in velocities]
    headings = [
        math.degrees(math.atan2(y, x)) if speed > STANDING_MPS else math.nan  # also if the speed is NaN
        for (x, y), speed in zip(velocities, speeds, strict=True)
    ]
    known_headings = [heading for heading in headings if not math.isnan(heading)]
    turn_deg = None  # the heading of someone who stands is noise
    if known_headings and len(known_headings) == sum(seen):
        turn_deg = _round(wrap_deg(known_headings[-1] - known_headings[0]), 1)
    mean_speed = _round(math.hypot(v_x, v_y), 2)
    return {
        "place_m": tuple(places_m),
        "target_step_speeds_mps": (None, *_rounded([math.dist(a, b) / step_s for a, b in pairwise(positions)], 2)),
        "target_travelled_m": _rounded([math.dist(first, position) for position in positions], 1),
        "target_speeds_mps": _rounded(speeds, 2),
        "target_headings_deg": _rounded(headings, 1),
        "target_velocity_mps": None if mean_speed is None else _rounded(_forward_left(v_x, v_y, frames[-1]), 2),
        "target_speed_mps": mean_speed,
        "target_turn_deg": turn_deg,
    }


Weights = tuple[float, ...]  # one for each value of a series; the result is the sum of their products


class Fit(NamedTuple):
    """Weights for the frames at which a series is known."""

    line: Weights  # for the slope per step of the straight line through all known frames
    lines: tuple[Weights, ...]  # for each frame, of the line through its neighbours; NaN where it is not known
    residuals: tuple[Weights, ...]  # for each known frame, of its deviation from the parabola that fits best


@lru_cache(maxsize=256)
def _fit_of(known: tuple[bool, ...]) -> Fit:
    """Return the weights for a series that is known at some of its frames."""
    count = len(known)
    frames = [i for i, is_known in enumerate(known) if is_known]
    lines = []
    for k, is_known in enumerate(known):
        neighbours = [i for i in frames if abs(i - k) <= SMOOTHED_OVER] if is_known else []
        lines.append(_line_weights(neighbours, count))
    parabola = np.vander(np.array(frames) - np.mean(frames), 3)
    residuals = np.zeros((len(frames), count))
    residuals[:, frames] = np.eye(len(frames)) - parabola @ np.linalg.pinv(parabola)
    return Fit(_line_weights(frames, count), tuple(lines), tuple(map(tuple, residuals.tolist())))


def _line_weights(frames: Sequence[int], count: int) -> Weights:
    """Return the weights whose sum with a series is the slope, per step, of the line through some of its frames."""
    if len(frames) < 2:
        return (math.nan,) * count
    middle = sum(frames) / len(frames)
    norm = sum((i - middle) ** 2 for i in frames)
    return tuple((i - middle) / norm if i in frames else 0.0 for i in range(count))


def _weighted(weights: Weights, values: Sequence[float]) -> float:
    return sum(map(mul, weights, values))


def _velocities(
    axes: Sequence[Sequence[float]], known: tuple[bool, ...], step_s: float, smooth: float
) -> tuple[list[float], list[list[float]]]:
    """Return the slope per second of each axis over the whole window, and at each frame, NaN if that is not known. A
    track jitters if it deviates from a parabola by more than `smooth`, as a root mean square in units of the axes; then
    the current frame alone has a velocity, that of the whole window."""
    fit = _fit_of(known)
    if not all(known):  # a weight of 0 does not hide NaN
        axes = [[value if is_known else 0.0 for value, is_known in zip(axis, known, strict=True)] for axis in axes]
    whole = [_weighted(fit.line, axis) / step_s for axis in axes]
    squares = sum([_weighted(weights, axis) ** 2 for axis in axes for weights in fit.residuals])
    if squares > smooth * smooth * len(fit.residuals):
        return whole, [[*[math.nan] * (len(known) - 1), slope if known[-1] else math.nan] for slope in whole]
    return whole, [[_weighted(weights, axis) / step_s for weights in fit.lines] for axis in axes]


@lru_cache(maxsize=64)  # five windows of a track share a frame
def _measure_frame(frame: ObservedFrame, camera_px: tuple[int, int], picture_px: tuple[int, int]) -> dict[str, Any]:
    """Measure one frame; return the facts BY_FRAME, without those of a target that is not seen."""
    x, y, z = frame.position_m
    target_x, target_y, target_z = frame.target_m
    pitch, heading, _ = frame.rotation_deg
    visibility = _visibility_word(frame)
    facts: dict[str, Any] = {
        "altitude_m": _round(z, 1), "pitch_deg": _round(pitch, 1), "heading_deg": _round(wrap_deg(heading), 1),
        "visibility": visibility,
    }  # fmt: skip
    if math.isnan(target_x) or visibility in ("occluded", "out_of_view"):
        return facts
    # + 0.0: no negative zero, which is equal to zero here and another direction to atan2
    away_x, away_y, away_z = target_x - x + 0.0, target_y - y + 0.0, target_z - z + 0.0
    distance = math.hypot(away_x, away_y)
    x_scale, y_scale = picture_px[0] / camera_px[0], picture_px[1] / camera_px[1]
    left, top, right, bottom = frame.target_bbox
    left, right = left * x_scale, right * x_scale
    top, bottom = top * y_scale, bottom * y_scale
    # The centre of the box is where the person is seen; uv (the hip) replaces it where a tree has no box.
    centre_x, centre_y = (left + right) / 2.0, (top + bottom) / 2.0
    if math.isnan(left):
        centre_x, centre_y = frame.target_uv[0] * x_scale, frame.target_uv[1] * y_scale
    return facts | {
        "distance_m": _round(distance, 1), "slant_m": _round(math.hypot(distance, away_z), 1),
        "height_over_target_m": _round(-away_z, 1),
        "bearing_deg": _round(wrap_deg(math.degrees(math.atan2(away_y, away_x)) - heading), 1),
        "depression_deg": _round(math.degrees(math.atan2(-away_z, distance)), 1), "box_width_px": _round(right - left),
        "box_height_px": _round(bottom - top), "offset_x_px": _round(centre_x - picture_px[0] / 2.0),
        "offset_y_px": _round(centre_y - picture_px[1] / 2.0),
    }  # fmt: skip


def _round(value: float, digits: int | None = None) -> Any:
    """Return a value, as an integer without `digits`; None for NaN."""
    return None if math.isnan(value) else round(value, digits) + 0  # + 0: no negative zero


def _rounded(values: Iterable[float], digits: int | None) -> tuple[Any, ...]:
    return tuple([_round(value, digits) for value in values])


def _visibility_word(frame: ObservedFrame) -> VisibilityWord:
    if not (frame.in_view and frame.visible):
        return "occluded" if frame.in_view else "out_of_view"
    if not frame.legible:
        return "illegible"
    return "partly_occluded" if frame.visibility < PARTLY_BELOW else "visible"  # NaN: the flag alone decides
