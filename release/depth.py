"""Depth of a released row: float32 as the tree has it, or coded smaller with an error that is measured on every
pixel."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from pydantic import BaseModel

from cosfly.errors import InputError, RenderError
from cosfly.products.frames import INVALID_DEPTH_M, SKY_DEPTH_M, depth_bytes, depth_values, far_clipped
from cosfly.reading.arrays import parse_array, parse_picture
from release.record import DepthCoding, DepthCodingName

MM_A_METRE = 1000.0
SKY_MM = 65535  # what 16 bits have left for the sky


def depth_of(data: bytes, coded: DepthCoding, where: str) -> np.ndarray:
    """Give a depth image in metres, (h, w) float32; SKY_DEPTH_M sky, 0 invalid."""
    if coded.coding != "millimetre_png":
        kind = np.float16 if coded.coding == "float16" else np.float32
        values = parse_array(data, where, dtype=kind, ndim=2, what="depth image")
        return far_clipped(values.astype(np.float32, copy=False))
    codes = parse_picture(data, where, flags=cv2.IMREAD_UNCHANGED)
    if codes.dtype != np.uint16 or codes.ndim != 2:
        raise InputError(
            "not a depth image", where=where, got=f"{codes.dtype} {codes.shape}", expected="16 bits, one channel"
        )
    depth_m = codes.astype(np.float32) / np.float32(MM_A_METRE)
    depth_m[codes == coded.sky] = SKY_DEPTH_M
    return depth_m


MOST_MM = 65534
MOST_PNG_M = 65.5  # beyond, 16 bits of millimetres end


class DepthErrors(BaseModel):
    """Of the pixels that are neither sky nor invalid: the least and greatest depth, m, and the greatest error of the
    coding, m."""

    min_m: float | None = None
    max_m: float | None = None
    max_error_m: float = 0.0

    def merged(self, other: DepthErrors) -> DepthErrors:
        lows = [low for low in (self.min_m, other.min_m) if low is not None]
        highs = [high for high in (self.max_m, other.max_m) if high is not None]
        return DepthErrors(
            min_m=min(lows, default=None),
            max_m=max(highs, default=None),
            max_error_m=max(self.max_error_m, other.max_error_m),
        )


def encoded(data: memoryview, coding: DepthCodingName, where: Path) -> tuple[bytes, DepthErrors]:
    """Code a depth image: the bytes of its row, and what the coding costs.

    Args:
        data: of a file of a playback tree, checked.
    Raises:
        InputError: it holds a depth that the coding has no number for.
    """
    values = depth_values(data, where)
    if coding == "float32":
        return depth_bytes(values), DepthErrors()
    is_measured = (values != SKY_DEPTH_M) & (values != INVALID_DEPTH_M)
    known = values[is_measured]
    coder = {"float16": _as_float16, "millimetre_png": _as_millimetres}[coding]
    coded, back = coder(values, is_measured, where)
    if not known.size:
        return coded, DepthErrors()
    error = np.abs(back[is_measured].astype(np.float64) - known).max()
    return coded, DepthErrors(min_m=float(known.min()), max_m=float(known.max()), max_error_m=float(error))


def _as_float16(values: np.ndarray, _: np.ndarray, __: Path) -> tuple[bytes, np.ndarray]:
    half = values.astype(np.float16)
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, half, version=(1, 0), allow_pickle=False)
    return buffer.getvalue(), half


def _as_millimetres(values: np.ndarray, is_measured: np.ndarray, where: Path) -> tuple[bytes, np.ndarray]:
    farthest = float(values[is_measured].max(initial=0.0))
    if farthest > MOST_PNG_M:
        raise InputError(
            "depth that a PNG of millimetres cannot hold", where=where, got=f"{farthest:g} m",
            expected=f"at most {MOST_PNG_M} m",
            fix="--set release.depth=float16, or float32, which is lossless",
        )  # fmt: skip
    millimetres = np.clip(np.rint(values * MM_A_METRE), 1, MOST_MM).astype(np.uint16)
    millimetres[values == SKY_DEPTH_M] = SKY_MM
    millimetres[values == INVALID_DEPTH_M] = 0
    is_done, data = cv2.imencode(".png", millimetres)
    if not is_done:
        raise RenderError("cannot encode a PNG", where=where, got=str(values.shape))
    return data.tobytes(), millimetres / MM_A_METRE


def depth_record(coding: DepthCodingName, parts: Iterable[DepthErrors]) -> DepthCoding:
    """Give what the record says of all depth images."""
    total = DepthErrors()
    for part in parts:
        total = total.merged(part)
    is_png = coding == "millimetre_png"
    return DepthCoding(
        coding=coding,
        unit="millimetre" if is_png else "metre",
        sky=float(SKY_MM if is_png else SKY_DEPTH_M),
        invalid=INVALID_DEPTH_M,
        **total.model_dump(),
    )
