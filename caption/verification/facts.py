"""What can be measured on an observed window: the series from which prompts, slots, claims and the reader of prose take
every fact.

Values are rounded here, once, as they are printed, so that text and check compare the same numbers. How a single fact
is named and
looked up: references.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import Any, Literal

from caption.schema import ObservedFrame, ObservedWindow

VisibilityWord = Literal["visible", "partly_occluded", "illegible", "occluded", "out_of_view"]
STANDING_MPS = 0.2  # slower than this a person stands
PARTLY_BELOW = 0.7  # rendered score under which a visible person counts as partly hidden


@dataclass(frozen=True)
class Facts:
    """Measured series, oldest frame first; None where a value cannot be measured, () where a series was not.

    Of the drone: speed_mps is |p_i - p_(i-1)| / dt in 3D; the oldest frame has no earlier one in the window, so its
    value is None and the prompt prints 0.0, as the paper's sample does. altitude_m: world z. yaw_deg: against the
    oldest frame; heading_deg: in the world, 0 along x, in (-180, 180]; both positive to the left. pitch_deg: of the
    camera. travelled_m, displacement_m: way and straight line from the oldest frame.
    Of the target: target_speed_mps is the mean over the window, target_speeds_mps each step's; target_turn_deg: change
    of its heading between the first and the last step, target_headings_deg each step's, positive to the left;
    target_travelled_m: its way on the ground from the oldest frame.
    Between them: distance_m is horizontal, slant_m in 3D, height_over_target_m from the person's hip; bearing_deg:
    where the person is, against the drone's heading, positive to the left; depression_deg: of the line of sight below
    the horizon.
    mission: the kind of the order that ends the pursuit, once it stands.
    Of other people: others_in_view, how many have a pixel; other_distance_m, from the target to the nearest of them;
    alike_differences, in how many things, of figure, top, legs, hat and bag, who looks most like the target differs.
    In the picture of width_px x height_px, in its pixels: the target's box and its middle's offset from the image
    centre, positive to the right and down.
    """

    speed_mps: tuple[float | None, ...]
    altitude_m: tuple[float, ...]
    yaw_deg: tuple[float, ...]
    pitch_deg: tuple[float, ...]
    distance_m: tuple[float | None, ...]
    slant_m: tuple[float | None, ...]
    target_speed_mps: float | None
    target_turn_deg: float | None
    box_width_px: tuple[int | None, ...]
    box_height_px: tuple[int | None, ...]
    offset_x_px: tuple[int | None, ...]
    offset_y_px: tuple[int | None, ...]
    visibility: tuple[VisibilityWord, ...]
    width_px: int
    height_px: int
    step_s: float = 0.5
    heading_deg: tuple[float, ...] = ()
    travelled_m: tuple[float, ...] = ()
    displacement_m: tuple[float, ...] = ()
    target_speeds_mps: tuple[float | None, ...] = ()
    target_headings_deg: tuple[float | None, ...] = ()
    target_travelled_m: tuple[float | None, ...] = ()
    height_over_target_m: tuple[float | None, ...] = ()
    bearing_deg: tuple[float | None, ...] = ()
    depression_deg: tuple[float | None, ...] = ()
    mission: str | None = None
    others_in_view: tuple[int | None, ...] = ()
    other_distance_m: tuple[float | None, ...] = ()
    alike_differences: tuple[int | None, ...] = ()

    def __len__(self) -> int:
        return len(self.yaw_deg)

    @property
    def is_visible_now(self) -> bool:
        """Return whether nothing hides the person: what labels go by, as the flight was planned."""
        return self.visibility[-1] in ("visible", "partly_occluded", "illegible")

    @property
    def is_legible_now(self) -> bool:
        """Return whether somebody could see the person in the picture: what claims of sight go by."""
        return self.visibility[-1] in ("visible", "partly_occluded")

    @cached_property
    def found(self) -> dict[Any, Any]:
        """What references.py has looked up so far; several languages and checks ask for the same facts."""
        return {}


def measure_facts(window: ObservedWindow, picture_px: tuple[int, int] | None = None) -> Facts:
    """Measure a window. Reads nothing but the window.

    Args:
        picture_px: (width, height) of the pictures that are shown, which pixels refer to; None: the camera's own.
    """
    width_px, height_px = picture_px or (window.width_px, window.height_px)
    frames = window.frames
    camera_px, picture_px = (window.width_px, window.height_px), (width_px, height_px)
    altitude, pitch, heading, distance, slant, height, bearing, depression, *seen, visibility = zip(
        *[_measure_frame(frame, camera_px, picture_px) for frame in frames], strict=True
    )
    box_width, box_height, offset_x, offset_y = seen
    steps_s, turns_deg, flown, speed, walked, walked_m, walking_mps, walking, course = zip(
        *[_measure_step(before, after) for before, after in pairwise(frames)], strict=True
    )
    start = frames[0].position_m
    return Facts(
        speed_mps=(None, *speed),
        altitude_m=altitude,
        yaw_deg=(0.0, *[round(a, 1) + 0.0 for a in accumulate(turns_deg)]),
        pitch_deg=pitch,
        distance_m=distance,
        slant_m=slant,
        target_speed_mps=_rounded([sum(walking_mps) / len(walking_mps)], 2)[0],
        target_turn_deg=_turn_deg(walked[0], walked[-1], min(walking_mps[0], walking_mps[-1])),
        box_width_px=box_width,
        box_height_px=box_height,
        offset_x_px=offset_x,
        offset_y_px=offset_y,
        visibility=visibility,
        width_px=width_px,
        height_px=height_px,
        step_s=round(sum(steps_s) / len(steps_s), 3),
        heading_deg=heading,
        travelled_m=(0.0, *[round(way, 1) for way in accumulate(flown)]),
        displacement_m=tuple([round(math.dist(start, frame.position_m), 1) for frame in frames]),
        target_speeds_mps=(None, *walking),
        target_headings_deg=(None, *course),
        target_travelled_m=(0.0, *_rounded(accumulate(walked_m), 1)),
        height_over_target_m=height,
        bearing_deg=bearing,
        depression_deg=depression,
        mission=window.mission,
        others_in_view=_whole([frame.others_in_view for frame in frames]),
        other_distance_m=_rounded([frame.other_distance_m for frame in frames], 1),
        alike_differences=_whole([frame.alike_differences for frame in frames]),
    )


@lru_cache(maxsize=64)  # five windows of a flight share a frame
def _measure_frame(frame: ObservedFrame, camera_px: tuple[int, int], picture_px: tuple[int, int]) -> tuple[Any, ...]:
    """Measure what one frame tells.

    Returns:
        altitude, pitch, heading, distance, slant, height over the target, bearing, depression, the box's width and
        height, its middle's
        offset to the right and down, the word for visibility: as the facts have them.
    """
    (x, y, z), (u, v, w), (pitch, heading, _) = frame.position_m, frame.target_m, frame.rotation_deg
    # + 0.0: no negative zero, which is equal to zero here and another direction to atan2
    away_x, away_y, away_z = u - x + 0.0, v - y + 0.0, w - z + 0.0
    distance = math.hypot(away_x, away_y)
    slant = math.sqrt(away_x * away_x + away_y * away_y + away_z * away_z)
    bearing = wrapped(math.degrees(math.atan2(away_y, away_x)) - heading)
    depression = math.degrees(math.atan2(-away_z, distance))
    own = (round(z, 1) + 0.0, round(pitch, 1) + 0.0, round(wrapped(heading), 1) + 0.0)
    return (
        *own,
        *_rounded((distance, slant, -away_z, bearing, depression), 1),
        *_measure_picture(frame, camera_px, picture_px),
        _word(frame),
    )


def _measure_picture(
    frame: ObservedFrame, camera_px: tuple[int, int], picture_px: tuple[int, int]
) -> tuple[int | None, ...]:
    """Measure the target in the picture: its box's width and height, its offset from the middle to the right and
    down."""
    (width_px, height_px), (u, v) = picture_px, frame.target_uv
    x_scale, y_scale = width_px / camera_px[0], height_px / camera_px[1]
    left, top, right, bottom = frame.target_bbox
    left, top, right, bottom = left * x_scale, top * y_scale, right * x_scale, bottom * y_scale
    # The middle of the box is where the person is seen; uv (the hip) stands in where a tree has no box.
    u, v = (u * x_scale, v * y_scale) if left != left else ((left + right) / 2.0, (top + bottom) / 2.0)
    return _whole([right - left, bottom - top, u - width_px / 2.0, v - height_px / 2.0])


@lru_cache(maxsize=64)
def _measure_step(before: ObservedFrame, after: ObservedFrame) -> tuple[Any, ...]:
    """Measure what happened between two frames.

    Returns:
        time in s, turn in degrees, way in m, speed as the facts have it; of the target: (x, y) walked, way, speed, and
        as the facts have them speed and heading.
    """
    step_s = after.time_s - before.time_s
    (x0, y0, _), (x1, y1, _) = before.target_m, after.target_m
    x, y = x1 - x0, y1 - y0
    way_m, flown_m = math.hypot(x, y), math.dist(before.position_m, after.position_m)
    walking_mps = way_m / step_s
    turn_deg = wrapped(after.rotation_deg[1] - before.rotation_deg[1])
    # NaN is not larger either
    heading_deg = round(math.degrees(math.atan2(y, x)), 1) + 0.0 if walking_mps > STANDING_MPS else None
    speed, walking = _rounded((flown_m / step_s, walking_mps), 2)
    return step_s, turn_deg, flown_m, speed, (x, y), way_m, walking_mps, walking, heading_deg


def wrapped(angle_deg: float) -> float:
    """Return an angle in [-180, 180)."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def _rounded(values: Iterable[float], digits: int) -> tuple[float | None, ...]:
    return tuple([None if v != v else round(v, digits) + 0.0 for v in values])  # NaN is not equal to itself


def _whole(values: list[float]) -> tuple[int | None, ...]:
    return tuple([None if v != v else round(v) for v in values])


def _turn_deg(first: tuple[float, float], last: tuple[float, float], slowest_mps: float) -> float | None:
    """Heading change of the target; None where it stands (a heading of no motion is noise) or is unknown."""
    (x0, y0), (x1, y1) = first, last
    if not slowest_mps > STANDING_MPS or x0 != x0 or x1 != x1:
        return None
    return round(math.degrees(math.atan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1)), 1) + 0.0


def _word(frame: ObservedFrame) -> VisibilityWord:
    if not (frame.in_view and frame.visible):
        return "occluded" if frame.in_view else "out_of_view"
    if not frame.legible:
        return "illegible"
    return "partly_occluded" if frame.visibility < PARTLY_BELOW else "visible"  # NaN: the flag alone decides
