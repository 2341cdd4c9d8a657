"""Depth in 16-bit PNG, for loaders that read nothing else. The default of every export is float32 as it was released.

Both codings keep 0 (invalid) and sky apart from measured depth; what they lose is measured on every pixel that goes through them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cosfly.errors import InputError, RenderError
from cosfly.products.frames import INVALID_DEPTH_M, SKY_DEPTH_M
from cosfly.reading.arrays import parse_array
from release.export.contract import DepthCoding

INVALID, SKY = 0, 65535  # the two codes that are no distance
LAST = SKY - 1
MM_FARTHEST_M = LAST / 1000.0  # 65.534 m
# The logarithmic coding: code 1 is the nearest, code LAST the farthest depth; one step is a factor of 1.000141.
LOG_NEAREST_M, LOG_FARTHEST_M = 0.1, 1000.0
_STEP = np.log(LOG_FARTHEST_M / LOG_NEAREST_M) / (LAST - 1)


@dataclass
class Loss:
    """What a coding cost, over all pixels with a distance: greatest error in m and as a share of the depth, least and greatest depth."""

    error_m: float = 0.0
    error_share: float = 0.0
    nearest_m: float = float("inf")
    farthest_m: float = 0.0

    def add(self, depth: np.ndarray, decoded: np.ndarray) -> None:
        errors = np.abs(depth.astype(np.float64) - decoded)
        self.error_m = max(self.error_m, float(errors.max()))
        self.error_share = max(self.error_share, float((errors / depth).max()))
        self.nearest_m, self.farthest_m = (
            min(self.nearest_m, float(depth.min())),
            max(self.farthest_m, float(depth.max())),
        )

    def merge(self, other: Loss) -> None:
        self.error_m, self.error_share = max(self.error_m, other.error_m), max(self.error_share, other.error_share)
        self.nearest_m, self.farthest_m = min(self.nearest_m, other.nearest_m), max(self.farthest_m, other.farthest_m)


def encode(data: bytes, where: str, coding: DepthCoding, loss: Loss) -> bytes:
    """Code the bytes of a `depth.npy` as PNG of 16 bits; adds to `loss` what that costs.

    Raises:
        InputError: it is no depth image, or holds what the coding cannot: millimetres end at 65.534 m.
    """
    depth = parse_array(data, where, dtype=np.float32, ndim=2)
    is_sky, is_invalid = depth == SKY_DEPTH_M, depth == INVALID_DEPTH_M
    is_distance = ~is_sky & ~is_invalid
    distances = depth[is_distance]
    codes = np.where(is_sky, SKY, INVALID).astype(np.uint16)
    if len(distances):
        low, high = (0.0005, MM_FARTHEST_M) if coding == "millimetre" else (LOG_NEAREST_M, LOG_FARTHEST_M)
        nearest_m, farthest_m = float(distances.min()), float(distances.max())
        if not (low <= nearest_m and farthest_m <= high):
            raise InputError(
                f"depth beyond what the {coding} coding holds", where=where, got=f"{nearest_m:.3f} to {farthest_m:.3f} m",
                expected=f"{low:g} to {high:g} m, sky apart", fix="leave --depth out: float32 loses nothing",
            )  # fmt: skip
        codes[is_distance] = _codes(distances, coding)
        loss.add(distances, decode(codes[is_distance], coding))
    ok, png = cv2.imencode(".png", codes, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not ok:
        raise RenderError("cannot encode a PNG", got=str(codes.shape))
    return png.tobytes()


def _codes(distances: np.ndarray, coding: DepthCoding) -> np.ndarray:
    exact = distances.astype(np.float64)
    scaled = exact * 1000.0 if coding == "millimetre" else np.log(exact / LOG_NEAREST_M) / _STEP + 1
    return np.rint(scaled).clip(1, LAST).astype(np.uint16)


def decode(codes: np.ndarray, coding: DepthCoding) -> np.ndarray:
    """Give depth in m, float64, of codes that are a distance."""
    exact = codes.astype(np.float64)
    return exact / 1000.0 if coding == "millimetre" else LOG_NEAREST_M * np.exp((exact - 1) * _STEP)


def in_words(coding: DepthCoding, loss: Loss) -> str:
    """Say how depth is stored, with unit, range and what was measured."""
    if coding == "millimetre":
        rule = f"PNG of 16 bits, millimetres, 0.001 to {MM_FARTHEST_M} m"
    else:
        rule = (
            f"PNG of 16 bits, logarithmic: depth in m = {LOG_NEAREST_M} * ({LOG_FARTHEST_M:g} / {LOG_NEAREST_M}) ** ((code - 1) / {LAST - 1}), "
            f"{LOG_NEAREST_M} to {LOG_FARTHEST_M:g} m"
        )
    if loss.farthest_m == 0.0:
        return f"{rule}; code 0 invalid, {SKY} sky; no pixel had a distance"
    return (
        f"{rule}; code 0 invalid, {SKY} sky. Measured over all pixels ({loss.nearest_m:.3f} to {loss.farthest_m:.3f} m): "
        f"error at most {loss.error_m:.6f} m, {loss.error_share:.6%} of the depth"
    )
