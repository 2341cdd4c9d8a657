"""Which field of view each frame of a flight has: one level, or levels that change smoothly between its parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from cosfly.formats.frames import Camera
from cosfly.formats.segments import Segment
from cosfly.geometry.axes import focal_px, intrinsic_matrix
from cosfly.runtime.config import Config


class ZoomConfig(Config):
    """Whether the field of view changes within a flight."""

    mode: Literal["fixed", "dynamic"] = Field(
        "fixed",
        description="fixed: a flight keeps the level that it drew; dynamic: each of its parts draws one, and each "
        "frame's own "
        "intrinsics stand in its meta.json and its point of trajectory.json",
    )
    part_s: float = Field(
        20.0, ge=1, description="dynamic: length of the parts of a flight that has no segments of its own, s"
    )
    ramp_s: float = Field(4.0, ge=0, description="dynamic: how long a change of level takes, s; 0: from one frame on")


def cameras_of(
    size_px: tuple[int, int],
    first_deg: float,
    fovs_deg: Sequence[float],
    zoom: ZoomConfig,
    time_s: np.ndarray,
    segments: Sequence[Segment],
    rng: np.random.Generator,
) -> tuple[Camera, ...]:
    """Return the camera of each frame of a flight.

    Args:
        size_px: (width, height). first_deg: the level that the flight drew. fovs_deg: all levels. time_s: (n,). rng:
            draws those of the parts after the first.
    """
    if zoom.mode == "fixed":
        return (Camera(*size_px, intrinsic_matrix(*size_px, first_deg)),) * len(time_s)
    fovs = zoomed_deg(first_deg, fovs_deg, zoom, time_s, segments, rng)
    return tuple(Camera(*size_px, intrinsic_matrix(*size_px, fov)) for fov in fovs.tolist())


def zoomed_deg(
    first_deg: float,
    fovs_deg: Sequence[float],
    zoom: ZoomConfig,
    time_s: np.ndarray,
    segments: Sequence[Segment],
    rng: np.random.Generator,
) -> np.ndarray:
    """Return fields of view, (n,) degrees, that go from part to part to another level, if there is one.

    Equal times of a change make the picture grow by equal factors, but for a gentle begin and end.
    """
    begins_s = _begins_s(zoom, time_s, segments)
    focal = np.full(len(time_s), np.log(focal_px(1, first_deg)))
    level = first_deg
    for begin_s, end_s in zip(begins_s, [*begins_s, float(time_s[-1])][1:], strict=True):
        choices = [fov for fov in dict.fromkeys(fovs_deg) if fov != level] or [level]
        following = choices[int(rng.integers(len(choices)))]
        duration_s = min(zoom.ramp_s, end_s - begin_s)
        share = np.clip(time_s - begin_s, 0.0, duration_s) / duration_s if duration_s > 0 else time_s >= begin_s
        focal += np.log(focal_px(1, following) / focal_px(1, level)) * share**2 * (3.0 - 2.0 * share)
        level = following
    return np.degrees(2.0 * np.arctan(0.5 / np.exp(focal)))


def _begins_s(zoom: ZoomConfig, time_s: np.ndarray, segments: Sequence[Segment]) -> list[float]:
    """Return the times at which parts begin, the first part's left out."""
    if segments:
        return [float(time_s[segment.begin]) for segment in segments if segment.begin > 0]
    return np.arange(time_s[0] + zoom.part_s, time_s[-1], zoom.part_s).tolist()
