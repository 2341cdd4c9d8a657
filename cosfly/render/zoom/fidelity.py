"""Optical against digital zoom: what a longer lens draws, and what enlarging the middle of a wide picture makes of it (fig:zoom_fidelity)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import cv2
import numpy as np

from cosfly.products.frames import Camera

KERNELS = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}
# Structural similarity of Wang, Bovik, Sheikh and Simoncelli 2004: an 11 px Gaussian window of 1.5 px, and its two constants.
WINDOW_PX, SIGMA_PX, K1, K2 = 11, 1.5, 0.01, 0.03


@dataclass(frozen=True)
class Fidelity:
    """A digital picture against the optical one of the same view. psnr_db of all three channels; ssim of brightness; sharpness: its mean
    squared gradient of brightness as a share of the optical one's, 1 where it is as sharp.
    """

    psnr_db: float
    ssim: float
    sharpness: float

    def as_json(self) -> dict[str, float]:
        return {name: round(value, 4) for name, value in asdict(self).items()}


def enlarged_camera(camera: Camera, magnification: float) -> Camera:
    """The camera whose picture shows the middle of another's so many times as large."""
    intrinsic = camera.intrinsic.copy()
    intrinsic[[0, 1], [0, 1]] *= magnification
    return replace(camera, intrinsic=intrinsic)


def digital_zoom(rgb: np.ndarray, magnification: float, kernel: str) -> np.ndarray:
    """Enlarge the middle of a picture, (h, w, 3) uint8, to all of it, as exactly as `enlarged_camera` does."""
    height, width = rgb.shape[:2]
    # Pixel (u, v) of the result samples the place that the same ray has in the wide picture; centres lie at + 0.5.
    offsets = [(side - 1) / 2.0 * (1.0 - 1.0 / magnification) for side in (width, height)]
    matrix = np.array([[1.0 / magnification, 0.0, offsets[0]], [0.0, 1.0 / magnification, offsets[1]]])
    return cv2.warpAffine(rgb, matrix, (width, height), flags=KERNELS[kernel] | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE)  # fmt: skip


def compare(digital: np.ndarray, optical: np.ndarray) -> Fidelity:
    """Measure a digital picture against an optical one, (h, w, 3) uint8 each."""
    error = float(np.mean((digital.astype(np.float64) - optical.astype(np.float64)) ** 2))
    psnr_db = float("inf") if error == 0 else 10.0 * np.log10(255.0**2 / error)
    mine, theirs = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float64) for rgb in (digital, optical))
    edges = _edges(theirs)
    return Fidelity(min(psnr_db, 99.0), ssim(mine, theirs), _edges(mine) / edges if edges else 1.0)


def ssim(one: np.ndarray, two: np.ndarray) -> float:
    """Mean structural similarity of two grey pictures, (h, w) float64 from 0 to 255; 1 for equal ones."""

    def blurred(picture: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(picture, (WINDOW_PX, WINDOW_PX), SIGMA_PX)

    mean_one, mean_two = blurred(one), blurred(two)
    var_one, var_two = blurred(one * one) - mean_one**2, blurred(two * two) - mean_two**2
    shared = blurred(one * two) - mean_one * mean_two
    c1, c2 = (K1 * 255.0) ** 2, (K2 * 255.0) ** 2
    above = (2.0 * mean_one * mean_two + c1) * (2.0 * shared + c2)
    below = (mean_one**2 + mean_two**2 + c1) * (var_one + var_two + c2)
    return float((above / below).mean())


def _edges(grey: np.ndarray) -> float:
    return float(np.mean(np.diff(grey, axis=0)[:, :-1] ** 2 + np.diff(grey, axis=1)[:-1] ** 2))
