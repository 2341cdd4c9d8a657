"""What can be measured on an observed window: the numbers of the prompt, of the rule teacher and of the evidence check.

Values are rounded here, once, as they are printed, so that text and check compare the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from caption.schema import ObservedWindow

VisibilityWord = Literal["visible", "partly_occluded", "occluded", "out_of_view"]
PARTLY_BELOW = 0.7  # rendered score under which a visible person counts as partly hidden


@dataclass(frozen=True)
class Facts:
    """Measured series, oldest frame first; None where a value cannot be measured.

    speed_mps: |p_i - p_(i-1)| / dt in 3D; the oldest frame has no earlier one in the window, so its value is None and the
    prompt prints 0.0, as the paper's sample does. altitude_m: world z. yaw_deg: against the oldest frame, positive to the
    left. pitch_deg: of the camera. distance_m: horizontal, drone to target; slant_m: in 3D. offset_px: target from the image centre, positive to the right and down.
    target_turn_deg: change of the target's heading between the first and the last step, positive to the left.
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

    @property
    def is_visible_now(self) -> bool:
        return self.visibility[-1] in ("visible", "partly_occluded")


def measure_facts(window: ObservedWindow) -> Facts:
    """Measure a window. Reads nothing but the window."""
    positions, targets = window.positions_m, window.targets_m
    steps_s = np.diff(window.time_s)
    steps = np.diff(positions, axis=0)
    speeds = np.sqrt((steps * steps).sum(axis=1)) / steps_s
    yaw = window.rotations_deg[:, 1]
    turned = (np.diff(yaw) + 180.0) % 360.0 - 180.0
    away = targets - positions
    walked = np.diff(targets[:, :2], axis=0)
    walking_mps = np.sqrt((walked * walked).sum(axis=1)) / steps_s
    box = window.target_bbox
    center = np.array([window.width_px, window.height_px]) / 2.0
    # The middle of the box is where the person is seen; uv (the hip) stands in where a tree has no box.
    seen = np.where(np.isnan(box[:, :1]), window.target_uv, (box[:, :2] + box[:, 2:]) / 2.0) - center
    return Facts(
        speed_mps=(None, *_rounded(speeds, 2)),
        altitude_m=tuple(round(float(z), 1) + 0.0 for z in positions[:, 2]),
        yaw_deg=tuple(round(float(a), 1) + 0.0 for a in np.concatenate([[0.0], np.cumsum(turned)])),
        pitch_deg=tuple(round(float(a), 1) + 0.0 for a in window.rotations_deg[:, 0]),
        distance_m=_rounded(np.hypot(away[:, 0], away[:, 1]), 1),
        slant_m=_rounded(np.sqrt((away * away).sum(axis=1)), 1),
        target_speed_mps=_rounded([walking_mps.mean()], 2)[0],
        target_turn_deg=_turn_deg(walked, walking_mps),
        box_width_px=_pixels(box[:, 2] - box[:, 0]),
        box_height_px=_pixels(box[:, 3] - box[:, 1]),
        offset_x_px=_pixels(seen[:, 0]),
        offset_y_px=_pixels(seen[:, 1]),
        visibility=tuple(
            _word(bool(i), bool(v), float(s))
            for i, v, s in zip(window.in_view, window.visible, window.visibility, strict=True)
        ),
        width_px=window.width_px,
        height_px=window.height_px,
    )


def _rounded(values, digits: int) -> tuple[float | None, ...]:
    return tuple(None if v != v else round(float(v), digits) + 0.0 for v in values)


def _pixels(values: np.ndarray) -> tuple[int | None, ...]:
    return tuple(None if v != v else round(float(v)) for v in values)


def _turn_deg(walked: np.ndarray, walking_mps: np.ndarray) -> float | None:
    """Heading change of the target; None where it stands (a heading of no motion is noise) or is unknown."""
    if not (walking_mps[[0, -1]] > 0.2).all():
        return None
    (x0, y0), (x1, y1) = walked[0], walked[-1]
    return round(float(np.degrees(np.arctan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1))), 1) + 0.0


def _word(in_view: bool, visible: bool, score: float) -> VisibilityWord:
    if not in_view:
        return "out_of_view"
    if not visible:
        return "occluded"
    return "partly_occluded" if score < PARTLY_BELOW else "visible"  # NaN: the flag alone decides
