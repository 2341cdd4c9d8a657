"""Pictures of a renderer as PNG: the same bytes with every version of every library, in a third of the time of zlib's fastest.

Two kinds, by what is in them. Colours have texture: each row is told by the average of its left and upper neighbours, but rows that
somebody reads alone by the left one. Instance masks have areas: their bytes stay as they are, and the packing finds the row above.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from cosfly.png.deflate import BAND_BYTES, deflate
from cosfly.reading.arrays import PNG_SIGNATURE
from cosfly.work.compiled import njit

CHANNELS, COLOUR_TYPE = 3, 2
NONE, SUB, AVERAGE = 0, 1, 3  # filters


def colours_png(rgb: np.ndarray, rows_alone: np.ndarray) -> bytes:
    """Encode a picture with texture, (h, w, 3) uint8 RGB. rows_alone: rows that can be read without any other."""
    height, width, _ = rgb.shape
    lines = np.empty((height, 1 + CHANNELS * width), np.uint8)
    lines[:, 0] = AVERAGE
    lines[rows_alone, 0] = SUB
    _filter(np.ascontiguousarray(rgb).reshape(height, -1), lines)
    return _png(lines, deflate(lines, CHANNELS, 0, min(max(lines.size // BAND_BYTES, 1), height)))


def areas_png(red: np.ndarray, green: np.ndarray, blue: np.ndarray) -> bytes:
    """Encode a picture of areas, its three channels, (h, w) uint8 each."""
    height, width = red.shape
    lines = np.empty((height, 1 + CHANNELS * width), np.uint8)
    lines[:, 0] = NONE
    _interleave(*(np.ascontiguousarray(channel) for channel in (red, green, blue)), lines)
    return _png(lines, deflate(lines, CHANNELS, lines.shape[1]))


def _png(lines: np.ndarray, parts: list[memoryview]) -> bytes:
    height, stride = lines.shape
    head = struct.pack(">IIBBBBB", stride // CHANNELS, height, 8, COLOUR_TYPE, 0, 0, 0)
    return (
        PNG_SIGNATURE
        + _chunk(b"IHDR", head)
        + b"".join([*(_chunk(b"IDAT", part) for part in parts), _chunk(b"IEND", b"")])
    )


def _chunk(name: bytes, data: bytes | memoryview) -> bytes:
    checksum = zlib.crc32(data, zlib.crc32(name))
    return b"".join((struct.pack(">I", len(data)), name, data, struct.pack(">I", checksum)))


@njit(cache=True, nogil=True)
def _interleave(red, green, blue, lines):  # type: ignore[no-untyped-def]
    """Fill rows with three channels, (h, w) each, behind the filter of each row."""
    height, width = red.shape
    for y in range(height):
        r, g, b, line = red[y], green[y], blue[y], lines[y, 1:]
        for x in range(width):
            line[CHANNELS * x], line[CHANNELS * x + 1], line[CHANNELS * x + 2] = r[x], g[x], b[x]


@njit(cache=True, nogil=True)
def _filter(pixels, lines):  # type: ignore[no-untyped-def]
    """Fill rows by the filter that stands before each: pixels (h, 3 w), lines (h, 1 + 3 w). Above the first row and left of it stands 0."""
    height, size = pixels.shape
    nothing = np.zeros(size, np.uint8)
    for y in range(height):
        row, line, above = pixels[y], lines[y], pixels[y - 1] if y > 0 else nothing
        if line[0] == SUB:
            line[1 : 1 + CHANNELS] = row[:CHANNELS]
            for x in range(CHANNELS, size):
                line[1 + x] = row[x] - row[x - CHANNELS]
        else:
            for x in range(CHANNELS):
                line[1 + x] = row[x] - (above[x] >> 1)
            for x in range(CHANNELS, size):
                line[1 + x] = row[x] - ((np.uint16(row[x - CHANNELS]) + np.uint16(above[x])) >> 1)
