"""What can be measured on an observed window: the one table from which prompts, slots and the check of values take
every fact.

Values are rounded here, once, as they are printed, so that a text and its check compare the same numbers. How a single
fact is named and looked up: references.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from operator import mul
from typing import Any, Literal

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
# What each frame tells by itself.
BY_FRAME = (
    "altitude_m", "pitch_deg", "heading_deg", "distance_m", "slant_m", "height_over_target_m", "bearing_deg",
    "depression_deg", "box_width_px", "box_height_px", "offset_x_px", "offset_y_px", "visibility",
)  # fmt: skip


@dataclass(frozen=True)
class Facts:
    """Measured series, oldest frame first; None where a value cannot be measured.

    What is measured of the target is None at frames in which it is hidden or out of view. A velocity is the slope of
    the straight line that fits positions best: of up to five neighbouring frames, or of the whole window where the
    track jitters, so that a perturbation is not told as motion. The axes of the drone are those of the current frame:
    forward along its heading, left, up.

    Of the drone: speed_mps, 3D; velocity_mps (forward, left, up) over the whole window; mean_speed_mps its length;
    altitude_m: world z; yaw_deg: against the oldest frame; yaw_rate_dps, climb_mps: slopes; heading_deg: in the world,
    0 along x, in (-180, 180]; both positive to the left; pitch_deg: of the camera; travelled_m, displacement_m: path
    length and straight line from the oldest frame.
    Of the target: target_speeds_mps, on the ground; target_velocity_mps (forward, left) over the whole window;
    target_speed_mps its length; target_turn_deg: change of its heading over the window; target_headings_deg: positive
    to the left; target_travelled_m: straight line on the ground from the oldest frame.
    Between them: place_m (forward, left, up): from the drone to the target; distance_m is horizontal, slant_m in 3D,
    height_over_target_m from the person's hip; bearing_deg: of the target, against the drone's heading, positive to the
    left; depression_deg: of the line of sight below the horizon.
    mission: the kind of the order that ends the pursuit, once it is given.
    Of other people: others_in_view, how many have a pixel; other_distance_m, from the target to the nearest of them;
    alike_differences, in how many things, of figure, top, legs, hat and bag, the most similar person differs.
    In the picture of width_px x height_px, in its pixels: the target's box and the offset of its centre from the image
    centre, positive to the right and down.
    step_speeds_mps, target_step_speeds_mps: from each frame to the next, as the paper's state has them.
    """

    speed_mps: tuple[float | None, ...]
    velocity_mps: tuple[float, float, float]
    mean_speed_mps: float
    altitude_m: tuple[float, ...]
    climb_mps: tuple[float | None, ...]
    yaw_deg: tuple[float, ...]
    yaw_rate_dps: tuple[float | None, ...]
    heading_deg: tuple[float, ...]
    pitch_deg: tuple[float, ...]
    travelled_m: tuple[float, ...]
    displacement_m: tuple[float, ...]
    target_speeds_mps: tuple[float | None, ...]
    target_velocity_mps: tuple[float, float] | None
    target_speed_mps: float | None
    target_turn_deg: float | None
    target_headings_deg: tuple[float | None, ...]
    target_travelled_m: tuple[float | None, ...]
    place_m: tuple[tuple[float, float, float] | None, ...]
    distance_m: tuple[float | None, ...]
    slant_m: tuple[float | None, ...]
    height_over_target_m: tuple[float | None, ...]
    bearing_deg: tuple[float | None, ...]
    depression_deg: tuple[float | None, ...]
    box_width_px: tuple[int | None, ...]
    box_height_px: tuple[int | None, ...]
    offset_x_px: tuple[int | None, ...]
    offset_y_px: tuple[int | None, ...]
    visibility: tuple[VisibilityWord, ...]
    width_px: int
    height_px: int
    step_s: float
    mission: str | None
    others_in_view: tuple[int | None, ...]
    other_distance_m: tuple[float | None, ...]
    alike_differences: tuple[int | None, ...]
    step_speeds_mps: tuple[float | None, ...] = ()
    target_step_speeds_mps: tuple[float | None, ...] = ()

    def __len__(self) -> int:
        return len(self.yaw_deg)

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
        """The facts that were looked up (references.py): several languages and checks ask for the same ones."""
        return {}


def measure_facts(window: ObservedWindow, picture_px: tuple[int, int] | None = None) -> Facts:
    """Measure a window. Reads nothing but the window.

    Args:
        picture_px: (width, height) of the pictures that are shown, to which pixels refer; None: the camera's own.
    """
    camera_px = (window.width_px, window.height_px)
    picture_px = picture_px or camera_px
    frames = window.frames
    count = len(frames)
    measured = zip(*[_measure_frame(frame, camera_px, picture_px) for frame in frames], strict=True)
    by_frame: dict[str, Any] = dict(zip(BY_FRAME, measured, strict=True))
    xs, ys, zs = zip(*[frame.position_m for frame in frames], strict=True)
    seen = tuple([distance_m is not None for distance_m in by_frame["distance_m"]])
    step_s = (frames[-1].time_s - frames[0].time_s) / (count - 1)
    turns_deg = [wrap_deg(after.rotation_deg[1] - before.rotation_deg[1]) for before, after in pairwise(frames)]
    yaw_deg = [0.0, *accumulate(turns_deg)]
    is_known = (True,) * count
    (v_x, v_y, v_z), local = _velocities((xs, ys, zs), is_known, step_s, SMOOTH_M)
    velocities = list(zip(*local, strict=True))
    yaw_rad = math.radians(frames[-1].rotation_deg[1])
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    steps_m = [math.dist(before.position_m, after.position_m) for before, after in pairwise(frames)]
    return Facts(
        speed_mps=_rounded([math.hypot(*velocity) for velocity in velocities], 2),
        velocity_mps=(_round(v_x * cos + v_y * sin, 2), _round(v_y * cos - v_x * sin, 2), _round(v_z, 2)),
        mean_speed_mps=_round(math.hypot(v_x, v_y, v_z), 2),
        climb_mps=_rounded([velocity[2] for velocity in velocities], 2),
        yaw_deg=tuple([_round(angle, 1) for angle in yaw_deg]),
        yaw_rate_dps=_rounded(_velocities((yaw_deg,), is_known, step_s, SMOOTH_DEG)[1][0], 1),
        travelled_m=(0.0, *[_round(way, 1) for way in accumulate(steps_m)]),
        displacement_m=tuple([_round(math.dist(frames[0].position_m, frame.position_m), 1) for frame in frames]),
        **by_frame,
        **_measure_target(frames, seen, step_s, cos, sin),
        width_px=picture_px[0],
        height_px=picture_px[1],
        step_s=round(step_s, 3),
        mission=window.mission,
        others_in_view=_rounded([frame.others_in_view for frame in frames], None),
        other_distance_m=_rounded([frame.other_distance_m for frame in frames], 1),
        alike_differences=_rounded([frame.alike_differences for frame in frames], None),
        step_speeds_mps=(None, *_rounded([step_m / step_s for step_m in steps_m], 2)),
    )


def _measure_target(
    frames: Sequence[ObservedFrame], seen: tuple[bool, ...], step_s: float, cos: float, sin: float
) -> dict[str, Any]:
    """Measure where the target is and how it moves, at the frames at which it is seen.

    Args:
        cos, sin: of the drone's heading at the current frame.
    """
    xs, ys, _ = zip(*[frame.target_m for frame in frames], strict=True)
    places = []
    for frame, is_seen in zip(frames, seen, strict=True):
        away_x, away_y, away_z = (b - a for a, b in zip(frame.position_m, frame.target_m, strict=True))
        place = (away_x * cos + away_y * sin, away_y * cos - away_x * sin, away_z)
        places.append((_round(place[0], 1), _round(place[1], 1), _round(place[2], 1)) if is_seen else None)
    # The paper's state has the speed from frame to frame.
    steps_mps = [
        math.hypot(xs[i] - xs[i - 1], ys[i] - ys[i - 1]) / step_s if seen[i] and seen[i - 1] else math.nan
        for i in range(1, len(frames))
    ]
    first = seen.index(True) if any(seen) else 0
    travelled = [
        math.hypot(x - xs[first], y - ys[first]) if is_seen else math.nan
        for x, y, is_seen in zip(xs, ys, seen, strict=True)
    ]
    (v_x, v_y), local = (math.nan, math.nan), [[math.nan] * len(frames)] * 2
    if sum(seen) >= LEAST_SEEN:
        (v_x, v_y), local = _velocities((xs, ys), seen, step_s, SMOOTH_M)
    velocities = list(zip(*local, strict=True))
    speeds = [math.hypot(*velocity) for velocity in velocities]
    headings = [
        math.degrees(math.atan2(y, x)) if speed > STANDING_MPS else math.nan  # NaN is not larger either
        for (x, y), speed in zip(velocities, speeds, strict=True)
    ]
    known = [heading for heading in headings if heading == heading]
    velocity = (_round(v_x * cos + v_y * sin, 2), _round(v_y * cos - v_x * sin, 2))
    [speed] = _rounded([math.hypot(v_x, v_y)], 2)
    return {
        "place_m": tuple(places),
        "target_step_speeds_mps": (None, *_rounded(steps_mps, 2)),
        "target_travelled_m": _rounded(travelled, 1),
        "target_speeds_mps": _rounded(speeds, 2),
        "target_headings_deg": _rounded(headings, 1),
        "target_velocity_mps": None if speed is None else velocity,
        "target_speed_mps": speed,
        # The heading of someone who stands is noise.
        "target_turn_deg": _round(wrap_deg(known[-1] - known[0]), 1) if known and len(known) == sum(seen) else None,
    }


Weights = tuple[float, ...]  # of the values of a series; rows of frames that are not known are NaN or skipped


@lru_cache(maxsize=256)
def _fit_of(known: tuple[bool, ...]) -> tuple[Weights, tuple[Weights, ...], tuple[Weights, ...]]:
    """Return weights for the frames at which a series is known.

    They turn it into the slope per step of the straight line through all of them, into that of the line through the
    neighbours of each frame, and into the deviations from the parabola that fits best.
    """
    frames = [i for i, is_known in enumerate(known) if is_known]
    basis = np.vander(np.array(frames) - np.mean(frames), 3)
    residuals = np.zeros((len(frames), len(known)))
    residuals[:, frames] = np.eye(len(frames)) - basis @ np.linalg.pinv(basis)
    near = [[i for i in frames if abs(i - at) <= SMOOTHED_OVER] if known[at] else [] for at in range(len(known))]
    local = tuple(_line_weights(neighbours, len(known)) for neighbours in near)
    return _line_weights(frames, len(known)), local, tuple(map(tuple, residuals.tolist()))


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
    """Return the slope of each axis over the whole window, and at each frame, NaN where the frame is not known.

    Args:
        smooth: the largest root mean square deviation from a parabola, in units of the axes, at which neighbouring
            frames tell the velocity; beyond it every frame has that of the whole window.
    """
    line, lines, residuals = _fit_of(known)
    if not all(known):  # a weight of 0 does not hide NaN
        axes = [[value if is_known else 0.0 for value, is_known in zip(axis, known, strict=True)] for axis in axes]
    whole = [_weighted(line, axis) / step_s for axis in axes]
    squares = sum([_weighted(row, axis) ** 2 for axis in axes for row in residuals])
    if squares > smooth * smooth * len(residuals):
        return whole, [[slope if is_known else math.nan for is_known in known] for slope in whole]
    return whole, [[_weighted(row, axis) / step_s for row in lines] for axis in axes]


@lru_cache(maxsize=64)  # five windows of a track share a frame
def _measure_frame(frame: ObservedFrame, camera_px: tuple[int, int], picture_px: tuple[int, int]) -> tuple[Any, ...]:
    """Measure one frame; return BY_FRAME."""
    (x, y, z), (u, v, w), (pitch, heading, _) = frame.position_m, frame.target_m, frame.rotation_deg
    drone = (_round(z, 1), _round(pitch, 1), _round(wrap_deg(heading), 1))
    word = _word(frame)
    if u != u or word in ("occluded", "out_of_view"):
        return (*drone, *(None,) * 9, word)
    # + 0.0: no negative zero, which is equal to zero here and another direction to atan2
    away_x, away_y, away_z = u - x + 0.0, v - y + 0.0, w - z + 0.0
    distance = math.hypot(away_x, away_y)
    slant = math.hypot(distance, away_z)
    bearing = wrap_deg(math.degrees(math.atan2(away_y, away_x)) - heading)
    depression = math.degrees(math.atan2(-away_z, distance))
    x_scale, y_scale = picture_px[0] / camera_px[0], picture_px[1] / camera_px[1]
    left, top, right, bottom = frame.target_bbox
    left, top, right, bottom = left * x_scale, top * y_scale, right * x_scale, bottom * y_scale
    # The centre of the box is where the person is seen; uv (the hip) replaces it where a tree has no box.
    centre_x, centre_y = (left + right) / 2.0, (top + bottom) / 2.0
    if left != left:
        centre_x, centre_y = frame.target_uv[0] * x_scale, frame.target_uv[1] * y_scale
    offsets = (centre_x - picture_px[0] / 2.0, centre_y - picture_px[1] / 2.0)
    in_space = _rounded((distance, slant, -away_z, bearing, depression), 1)
    return (*drone, *in_space, *_rounded((right - left, bottom - top, *offsets), None), word)


def _round(value: float, digits: int) -> float:
    return round(value, digits) + 0.0  # no negative zero


def _rounded(values: Iterable[float], digits: int | None) -> tuple[Any, ...]:
    """Return values, as integers without `digits`, and None where they are NaN, which is not equal to itself."""
    return tuple([None if v != v else round(v, digits) + 0 for v in values])


def _word(frame: ObservedFrame) -> VisibilityWord:
    if not (frame.in_view and frame.visible):
        return "occluded" if frame.in_view else "out_of_view"
    if not frame.legible:
        return "illegible"
    return "partly_occluded" if frame.visibility < PARTLY_BELOW else "visible"  # NaN: the flag alone decides
