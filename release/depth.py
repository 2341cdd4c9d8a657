"""Depth of a released row, whichever way it is coded."""

from __future__ import annotations

import cv2
import numpy as np

from cosfly.errors import InputError
from cosfly.products.frames import SKY_DEPTH_M
from cosfly.reading.arrays import parse_array, parse_picture
from release.record import DepthCoding

MM_A_METRE = 1000.0
SKY_MM = 65535  # what 16 bits have left for the sky


def depth_of(data: bytes, coded: DepthCoding, where: str) -> np.ndarray:
    """Give a depth image in metres, (h, w) float32; SKY_DEPTH_M sky, 0 invalid.

    Raises:
        InputError: it is no whole image of the coding.
    """
    if coded.coding != "millimetre_png":
        kind = np.float16 if coded.coding == "float16" else np.float32
        return parse_array(data, where, dtype=kind, ndim=2, what="depth image").astype(np.float32, copy=False)
    codes = parse_picture(data, where, flags=cv2.IMREAD_UNCHANGED)
    if codes.dtype != np.uint16 or codes.ndim != 2:
        raise InputError(
            "not a depth image", where=where, got=f"{codes.dtype} {codes.shape}", expected="16 bits, one channel"
        )
    depth_m = codes.astype(np.float32) / np.float32(MM_A_METRE)
    depth_m[codes == coded.sky] = SKY_DEPTH_M
    return depth_m
