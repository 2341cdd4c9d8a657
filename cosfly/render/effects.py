"""What a real camera does to a picture after it is drawn: blur of its motion, lens, sensor, compression.

Colours change alone. Depth, ids, boxes and poses stay those of the ideal pinhole in the middle of the exposure; what
the lens bends is told by the camera's `distortion` (docs/files.md).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from pydantic import Field

from cosfly.geometry import BODY_FROM_CAMERA, rotation_matrices
from cosfly.products.frames import Camera
from cosfly.render.perturbation import Poses
from cosfly.work.chance import rng_for
from cosfly.work.config import Config

MOST_STEPS = 16  # pictures that a blur is the mean of
READ_SHARE = 0.25  # of a sensor's variance, what darkness has too
GREY, LEAST_GREY = 110.0, 12.0  # mean level that needs no gain; below, gain ends
BLUR_FAR_M = 1000.0


class EffectsConfig(Config):
    """Effects of a camera, each off at 0; labels are the same with and without."""

    tracks: tuple[Literal["clean", "perturbed"], ...] = Field(
        ("perturbed",), description="tracks whose pictures have them"
    )
    exposure_s: float = Field(
        0.0, ge=0, le=0.2, description="motion blur: how long the shutter is open while the drone flies and turns, s"
    )
    vibration_dps: float = Field(
        0.0, ge=0, le=60, description="motion blur: shaking about all three axes, roll too, standard deviation, deg/s"
    )
    noise: float = Field(
        0.0, ge=0, le=30, description="noise of a grey pixel in a well lit picture, levels of 255; dark pictures have "
        "up to three times as much, as the gain makes up for light; half of it in the dark of a picture"
    )  # fmt: skip
    vignette: float = Field(0.0, ge=0, lt=1, description="share of the light that the corners lack")
    distortion_k1: float = Field(
        0.0, ge=0, le=0.5, description="bending of the lens, OpenCV's k1: outwards, as a pinhole's picture has nothing "
        "to show beyond its border; 0.03 moves what is in the corner of 75 degrees by 8 of 640 px"
    )  # fmt: skip
    distortion_k2: float = Field(0.0, ge=0, le=0.5, description="the same of the fourth power, OpenCV's k2")
    jpeg_quality: int = Field(0, ge=0, le=100, description="loss of a video link: 1 the worst, 95 hardly any; 0: none")

    @property
    def is_on(self) -> bool:
        return bool(self.tracks) and self != EffectsConfig(tracks=self.tracks)

    @property
    def distortion(self) -> tuple[float, ...] | None:
        """k1, k2, p1, p2, k3 of OpenCV's model; None of a lens that bends nothing."""
        return (
            (self.distortion_k1, self.distortion_k2, 0.0, 0.0, 0.0)
            if self.distortion_k1 or self.distortion_k2
            else None
        )


@dataclass(frozen=True)
class Effects:
    """Of one flight: what it was told, the planned poses, whose motion blurs (shifts of a perturbed track are none),
    and the names that chance comes from."""

    cfg: EffectsConfig
    planned: Poses
    time_s: np.ndarray
    seed: int
    item: str

    def apply(self, rgb: np.ndarray, depth: np.ndarray, camera: Camera, i: int) -> np.ndarray:
        """Give picture i as the camera has it, (h, w, 3) uint8."""
        cfg, rng = self.cfg, rng_for(self.seed, "render", f"{self.item}/{i}/effects")
        shake_rad = np.radians(rng.normal(0.0, 1.0, 3) * cfg.vibration_dps)
        if cfg.exposure_s > 0:
            velocity, turn = (values[i] for values in self._motion)
            rgb = blurred(rgb, depth, camera.intrinsic, cfg.exposure_s * velocity, cfg.exposure_s * (turn + shake_rad))
        if cfg.distortion is not None:
            rgb = bent(rgb, camera.intrinsic, cfg.distortion)
        if cfg.vignette > 0 or cfg.noise > 0:
            light = rgb.astype(np.float32)
            light *= shaded(camera, cfg.vignette)[..., None]
            gain = np.sqrt(GREY / np.clip(light.mean(), LEAST_GREY, GREY))
            sigma = cfg.noise * gain * np.sqrt(READ_SHARE + (1.0 - READ_SHARE) * light / GREY)
            light += sigma * rng.standard_normal(light.shape, np.float32)
            rgb = np.clip(np.rint(light), 0, 255).astype(np.uint8)
        return compressed(rgb, cfg.jpeg_quality) if cfg.jpeg_quality else rgb

    @cached_property
    def _motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocity, m/s, and turn, rad/s, of the camera in its own axes (x right, y down, z forward), (n, 3) each."""
        world = rotation_matrices(np.radians(self.planned.rotations_deg)) @ BODY_FROM_CAMERA
        n, dt_s = len(self.time_s), np.gradient(self.time_s)
        before, after = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
        steps = np.einsum("nij,nik->njk", world[before], world[after])
        turns = np.array([cv2.Rodrigues(step)[0][:, 0] for step in steps]) / (after - before)[:, None] / dt_s[:, None]
        velocities = np.gradient(self.planned.positions_m, self.time_s, axis=0)
        return np.einsum("nij,ni->nj", world, velocities), turns


def blurred(
    rgb: np.ndarray, depth: np.ndarray, intrinsic: np.ndarray, shift_m: np.ndarray, turn_rad: np.ndarray
) -> np.ndarray:
    """Blur a picture along the way that its points take, by depth, while the camera moves by `shift_m` and `turn_rad`,
    (3,) in its axes, over the exposure, whose middle the picture is of. Who moves is blurred as what stands."""
    height, width = depth.shape
    fx, fy, cx, cy = intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]]
    x = ((np.arange(width) + 0.5 - cx) / fx).astype(np.float32)[None, :]
    y = ((np.arange(height) + 0.5 - cy) / fy).astype(np.float32)[:, None]
    per_m = 1.0 / np.where(depth > 0, np.minimum(depth, BLUR_FAR_M), BLUR_FAR_M)
    (tx, ty, tz), (wx, wy, wz) = shift_m, turn_rad
    # The motion field of a rigid scene, Longuet-Higgins and Prazdny 1980.
    u = fx * ((x * tz - tx) * per_m + wx * x * y - wy * (1.0 + x * x) + wz * y)
    v = fy * ((y * tz - ty) * per_m + wx * (1.0 + y * y) - wy * x * y - wz * x)
    steps = int(np.clip(np.ceil(max(np.abs(u).max(), np.abs(v).max())) + 1, 1, MOST_STEPS))
    if steps == 1:
        return rgb
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    total = np.zeros(rgb.shape, np.float32)
    for share in np.linspace(-0.5, 0.5, steps):
        at = (columns + share * u).astype(np.float32), (rows + share * v).astype(np.float32)
        total += cv2.remap(rgb, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.rint(total / steps).astype(np.uint8)


def bent(
    image: np.ndarray, intrinsic: np.ndarray, distortion: tuple[float, ...], interpolation: int = cv2.INTER_LINEAR
) -> np.ndarray:
    """Bend a pinhole's picture as a lens of OpenCV's model does; straightened by that, it is the pinhole's again."""
    fx, fy, cx, cy = intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    x, y = _straight(image.shape[1], image.shape[0], (fx, fy, cx, cy), distortion)
    return cv2.remap(image, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)


@functools.lru_cache(maxsize=4)
def _straight(
    width: int, height: int, lens: tuple[float, ...], distortion: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of a bent picture is in the pinhole's, columns and rows, (h, w) float32 each."""
    (fx, fy, cx, cy), (k1, k2, *_) = lens, distortion
    x = (np.arange(width)[None, :] + 0.5 - cx) / fx
    y = (np.arange(height)[:, None] + 0.5 - cy) / fy
    bent_to = np.hypot(x, y)
    radius = bent_to.copy()
    for _ in range(8):  # Newton; the polynomial rises everywhere
        excess = radius * (1.0 + k1 * radius**2 + k2 * radius**4) - bent_to
        radius -= excess / (1.0 + 3.0 * k1 * radius**2 + 5.0 * k2 * radius**4)
    share = radius / np.maximum(bent_to, 1e-9)
    return (x * share * fx + cx - 0.5).astype(np.float32), (y * share * fy + cy - 0.5).astype(np.float32)


def shaded(camera: Camera, lost: float) -> np.ndarray:
    """Share of the light that reaches each pixel, (h, w) float32: 1 in the middle, 1 - `lost` in the corners."""
    x = (np.arange(camera.width_px, dtype=np.float32) + 0.5) / camera.width_px * 2.0 - 1.0
    y = (np.arange(camera.height_px, dtype=np.float32) + 0.5) / camera.height_px * 2.0 - 1.0
    aspect = camera.height_px / camera.width_px
    return 1.0 - lost * (x[None, :] ** 2 + (aspect * y[:, None]) ** 2) / (1.0 + aspect**2)


def compressed(rgb: np.ndarray, quality: int) -> np.ndarray:
    """Give what is left of a picture after blocks of 8 x 8 with half the colours, as video and JPEG have them."""
    options: Any = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    ]
    _, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    found = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert found is not None
    return cv2.cvtColor(found, cv2.COLOR_BGR2RGB)
