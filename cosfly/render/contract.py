"""What every renderer gives and takes: the frame, the look of the scene, the protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pydantic import Field

from cosfly.config import Config
from cosfly.render.gl.body import Body

NEAR_M, FAR_M = 0.3, 1000.0  # clip planes (sec:step5)


@dataclass(frozen=True)
class Frame:
    """One synchronous set of images, row 0 at the top, pixel (i, j) sampled at its centre (j + 0.5, i + 0.5).

    rgb (h, w, 3) uint8; depth (h, w) float32 z-depth in m, sky 1000.0, invalid 0.0; kinds (h, w) uint8 KINDS;
    ids (h, w) uint16 instance ids.
    """

    rgb: np.ndarray
    depth: np.ndarray
    kinds: np.ndarray
    ids: np.ndarray


class Look(Config):
    """Sun and air, the same for every frame of a run."""

    sun_azimuth_deg: float = Field(
        235.0, ge=0, le=360, description="direction towards the sun, counter-clockwise from east"
    )
    sun_elevation_deg: float = Field(42.0, ge=5, le=85, description="height of the sun above the horizon, degrees")
    haze_m: float = Field(520.0, gt=1, description="distance at which haze hides two thirds of what stands there, m")
    exposure: float = Field(0.82, gt=0, le=10, description="brightness of the picture, a factor; 1 is neutral")

    def sun_direction(self) -> np.ndarray:
        """Unit vector towards the sun, (3,)."""
        azimuth, elevation = np.radians([self.sun_azimuth_deg, self.sun_elevation_deg])
        return np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])


class Renderer(Protocol):
    """Draws frames of one scene. Made by `open_renderer`; used from one thread."""

    name: str

    def prepare(self, low_m: np.ndarray, high_m: np.ndarray) -> None:
        """Get ready for a flight within these corners, (3,) each: shadows and the like."""

    def render(self, camera_pose: np.ndarray, intrinsic: np.ndarray, person: Body | None) -> Frame:
        """Draw one frame from world_from_camera (4, 4) through K (3, 3)."""
        ...

    def describe(self) -> dict[str, str]:
        """Say what draws: for the manifest."""
        ...

    def close(self) -> None:
        """Give the device back."""
