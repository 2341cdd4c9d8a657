"""PNG without a library, as fast as data sets of a hundred thousand pictures need it: whole pictures, or the few rows that are looked at.

The chunks' checksums, the stream's own and the number of bytes are always compared, so a picture that passes is whole. Filters
are undone when rows are wanted; where no row leans on another (filters none and sub), in those rows alone. Only what data sets hold: 8 bits, grey to RGBA, not interlaced.
Formats: RFC 1950, 1951, 2083.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from cosfly.errors import InputError
from cosfly.png.checksum import adler32
from cosfly.png.deflate import BAND_END, band_rows
from cosfly.png.inflate import inflate
from cosfly.reading.arrays import PNG_SIGNATURE, check_pixels
from cosfly.work.compiled import njit

CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # by colour type; palettes are no pictures of a data set
MOST_NAMED = 8  # chunks
ZLIB_HEAD_BYTES = 2
CHUNK, NUMBER = struct.Struct(">I4s"), struct.Struct(">I")


@dataclass
class Png:
    """An unpacked PNG: `lines` (h, 1 + w * channels) uint8, of each row its filter and its bytes as the filter left them. others: names of
    the chunks that are no pixels (colours meant, words); num_behind: bytes behind its end."""

    width_px: int
    height_px: int
    channels: int
    lines: np.ndarray
    others: tuple[str, ...] = ()
    num_behind: int = 0
    _pixels: np.ndarray | None = None

    def rows(self, wanted: np.ndarray) -> np.ndarray:
        """Give some rows, (k, w, channels) uint8; of the others those are undone that these lean on."""
        if self._pixels is None:
            stand_alone = self.lines[:, 0] <= 1
            first = np.maximum.accumulate(np.where(stand_alone, np.arange(self.height_px), 0))[wanted]
            if (wanted - first + 1).sum() < self.height_px // 2:
                found = _undone_alone(self.lines, first, wanted, self.channels)
                return found.reshape(len(wanted), self.width_px, self.channels)
        return self.pixels()[wanted]

    def pixels(self) -> np.ndarray:
        """Give the picture, (h, w, channels) uint8."""
        if self._pixels is None:
            self._pixels = _undone(self.lines, self.channels).reshape(self.height_px, self.width_px, self.channels)
        return self._pixels


def parse_png(data: bytes | memoryview, where: object) -> Png:
    """Unpack a PNG, and see that every checksum holds.

    Raises:
        InputError: it is none, damaged, of another kind, or larger than pictures may be.
    """
    width, height, kind, spans, others, num_behind = _chunks(data, where)
    channels = CHANNELS[kind]
    check_pixels(width * height, str(where), f"{width} x {height} px")
    out = _unpacked(data, spans, height, 1 + width * channels, where)
    lines = out.reshape(height, 1 + width * channels)
    if (lines[:, 0] > 4).any():
        raise _broken(where, "a row with a filter that does not exist")
    return Png(width, height, channels, lines, others, num_behind)


def _broken(where: object, got: str) -> InputError:
    return InputError("the image does not decode", where=str(where), got=got, expected="a whole PNG")


def _unpacked(
    data: bytes | memoryview, spans: list[tuple[int, int]], height: int, stride: int, where: object
) -> np.ndarray:
    """Unpack the stream whose parts stand in these places of the file: by bands where they are such, else from its beginning on."""
    packed, out, used = data, np.empty(0, np.uint8), -1
    # What ends a band stands at the end of nobody else's parts but by chance.
    if 1 < len(spans) <= height and all(data[end - len(BAND_END) : end] == BAND_END for _, end in spans[:-1]):
        out, used = _inflated(data, spans, band_rows(height, len(spans)) * stride, where)
    if used < 0:
        if len(spans) != 1:
            packed = b"".join(memoryview(data)[start:end] for start, end in spans)
            spans = [(0, len(packed))]
        out, used = _inflated(packed, spans, np.array([0, height * stride]), where)
    if used < 0:
        raise _broken(where, "a compressed stream that does not unpack to the picture")
    if used + 4 > spans[-1][1] or adler32(out) != int.from_bytes(packed[used : used + 4], "big"):
        raise _broken(where, "pixels that do not agree with their checksum")
    return out


def _inflated(packed: bytes | memoryview, spans: list[tuple[int, int]], bounds: np.ndarray, where: object) -> tuple[np.ndarray, int]:  # fmt: skip
    """Unpack zlib's stream in these places of the bytes by `inflate`, to these places."""
    start, end = spans[0]
    head = packed[start : min(start + ZLIB_HEAD_BYTES, end)]
    if len(head) < ZLIB_HEAD_BYTES or (head[0] & 15) != 8 or (head[0] * 256 + head[1]) % 31 or head[1] & 32:
        raise _broken(where, "a stream that is none of zlib's")
    starts, ends = (np.array(places, np.int64) for places in zip(*spans, strict=True))
    starts[0] += ZLIB_HEAD_BYTES
    return inflate(packed, starts, ends, bounds)


def _chunks(data: bytes | memoryview, where: object) -> tuple[int, int, int, list[tuple[int, int]], tuple[str, ...], int]:  # fmt: skip
    """Walk through the chunks: width, height, colour type, where the packed pixels are, names of other chunks, bytes behind the end."""
    if data[:8] != PNG_SIGNATURE or data[12:16] != b"IHDR" or len(data) < 33:
        raise InputError("not an image", where=str(where), got=f"{len(data)} bytes", expected="a PNG")
    width, height, depth, kind, packing, filters, interlace = struct.unpack_from(">IIBBBBB", data, 16)
    check_pixels(width * height, str(where), f"{width} x {height} px")
    if depth != 8 or kind not in CHANNELS or packing or filters or interlace or not width or not height:
        raise _broken(where, f"{depth} bits, colour type {kind}, interlace {interlace}, {width} x {height} px")
    position, spans, others, view = len(PNG_SIGNATURE), list[tuple[int, int]](), list[str](), memoryview(data)
    while position + 12 <= len(data):
        length, name = CHUNK.unpack_from(data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(view[position + 4 : end]) != NUMBER.unpack_from(data, end)[0]:
            raise _broken(where, f"a damaged {name.decode('latin-1')} chunk at byte {position}")
        if name == b"IDAT":
            spans.append((position + 8, end))
        elif name == b"IEND":
            return width, height, kind, spans, tuple(others), len(data) - end - 4
        elif name != b"IHDR" and len(others) < MOST_NAMED:
            others.append(name.decode("latin-1"))
        position = end + 4
    raise _broken(where, f"an end at byte {len(data)}, before the image's")


# --- compiled ---------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _nearest(left, up, corner):  # type: ignore[no-untyped-def]
    """Give Paeth's guess of a byte."""
    a, b, c = abs(up - corner), abs(left - corner), abs(left + up - 2 * corner)
    return left if a <= b and a <= c else up if b <= c else corner


@njit(cache=True, nogil=True)
def _undone(lines, channels):  # type: ignore[no-untyped-def]
    """Undo the filters of rows, (h, w * channels); a row leans on the one before it. A row of zeros stands before the first."""
    height, size = lines.shape[0], lines.shape[1] - 1
    found, nothing = np.empty((height, size), np.uint8), np.zeros(size, np.uint8)
    for y in range(height):
        kind, row, target, above = lines[y, 0], lines[y, 1:], found[y], found[y - 1] if y > 0 else nothing
        if kind == 0:
            for x in range(size):
                target[x] = row[x]
        elif kind == 2:
            for x in range(size):
                target[x] = (row[x] + above[x]) & 255
        elif channels == 3:
            _undo_colours(kind, row, above, target)
        else:
            for first in range(channels):
                left, corner = np.int64(0), np.int64(0)
                for x in range(first, size, channels):
                    up = np.int64(above[x])
                    guess = left if kind == 1 else (left + up) >> 1 if kind == 3 else _nearest(left, up, corner)
                    left, corner = (np.int64(row[x]) + guess) & 255, up
                    target[x] = left
    return found


@njit(cache=True, nogil=True)
def _undone_alone(lines, first, wanted, channels):  # type: ignore[no-untyped-def]
    """Undo some rows, (k, w * channels): of each those from its first on, as it leans on these, and once for all that lean on one first."""
    found, k = np.empty((len(wanted), lines.shape[1] - 1), np.uint8), 0
    while k < len(wanted):
        end = k + 1
        while end < len(wanted) and first[end] == first[k]:
            end += 1
        undone = _undone(lines[first[k] : wanted[k:end].max() + 1], channels)
        for i in range(k, end):
            found[i] = undone[wanted[i] - first[k]]
        k = end
    return found


@njit(cache=True, nogil=True)
def _undo_colours(kind, row, above, target):  # type: ignore[no-untyped-def]
    """Undo a row of three channels that leans on its left: they are computed beside each other, as each has to wait for its own left."""
    # Unsigned throughout: of a signed index numba looks whether it counts from the end, which takes as long as all the rest.
    red, green, blue, byte = np.uint32(0), np.uint32(0), np.uint32(0), np.uint32(255)
    x, one, two, three, size = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(len(row))
    if kind == 1:
        while x < size:
            red = (row[x] + red) & byte
            green = (row[x + one] + green) & byte
            blue = (row[x + two] + blue) & byte
            target[x], target[x + one], target[x + two] = red, green, blue
            x += three
    elif kind == 3:
        while x < size:
            red = (row[x] + ((red + above[x]) >> one)) & byte
            green = (row[x + one] + ((green + above[x + one]) >> one)) & byte
            blue = (row[x + two] + ((blue + above[x + two]) >> one)) & byte
            target[x], target[x + one], target[x + two] = red, green, blue
            x += three
    else:
        corners = np.int64(0), np.int64(0), np.int64(0)
        lefts = np.int64(0), np.int64(0), np.int64(0)
        for k in range(0, len(row), 3):
            ups = np.int64(above[k]), np.int64(above[k + 1]), np.int64(above[k + 2])
            lefts = (
                (row[k] + _nearest(lefts[0], ups[0], corners[0])) & 255,
                (row[k + 1] + _nearest(lefts[1], ups[1], corners[1])) & 255,
                (row[k + 2] + _nearest(lefts[2], ups[2], corners[2])) & 255,
            )
            target[k], target[k + 1], target[k + 2] = lefts
            corners = ups
