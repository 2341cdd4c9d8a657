"""PNG, the only picture format of a data set: 8 bits, grey to RGBA, not interlaced (RFC 2083).

Reading refuses a large picture before it allocates memory, checks the checksums of chunks and stream and the number of
bytes, and never unpacks more than the header says.
Writing filters each kind of picture in its own way. Colours: the difference of each byte to the average of its left and
upper neighbours. Instance masks: no filter. Depth: the four channels of a pixel are the bytes of a float32, lowest
first, and each row is stored as the difference to the row above.
"""

import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from isal import isal_zlib as zlib

from cosfly.runtime.compiled import njit
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import over_limit, read_bytes

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_HEADER_BYTES = 24  # signature, length and name of the first chunk, width, height
LONGEST_SIDE_PX = 8192  # of a picture that `render` draws; pictures up to this square are read, twice an 8K picture
CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # by colour type; palettes are not supported
CHUNK = struct.Struct(">I4s")  # length and name
NUMBER = struct.Struct(">I")
RGB, RGBA = 3, 4
NONE, SUB, UP, AVERAGE, PAETH = range(5)  # filters
LEVEL = 1  # of compression, the fastest
FIRST = 16  # bytes that are packed first and flushed
UNPACK_ERROR: Any = zlib.error  # in the stub it is not a class


def check_pixels(num_pixels: float, where: str | Path, got: str) -> None:
    """Raise InputError if a picture or array has more pixels than are read."""
    if num_pixels > LONGEST_SIDE_PX**2:
        limit = f"{LONGEST_SIDE_PX} x {LONGEST_SIDE_PX} px"
        raise over_limit(where, got, limit, "scale the pictures down or crop them")


def png_size(data: bytes) -> tuple[int, int] | None:
    """Return (width, height) in px from the first bytes of a PNG; None for other bytes."""
    if len(data) < PNG_HEADER_BYTES or not data.startswith(PNG_SIGNATURE) or data[12:16] != b"IHDR":
        return None
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def read_picture(path: Path, *, tree: Path | None = None) -> np.ndarray:
    """Read a PNG file of colours, (h, w, 3) uint8 RGB, without alpha."""
    return colours_of(read_bytes(path, what="image", tree=tree), path)


class Png(NamedTuple):
    """An unpacked PNG. lines: (h, 1 + w * channels) uint8, the filter and the filtered bytes of each row."""

    lines: np.ndarray
    channels: int

    def pixels(self) -> np.ndarray:
        """Return the picture, (h, w, channels) uint8."""
        return _without_filters(self.lines, self.channels).reshape(len(self.lines), -1, self.channels)


def parse_png(data: bytes | memoryview, where: object) -> Png:
    """Unpack a PNG and check its checksums; raises InputError if it is damaged, of another kind or too large."""
    width, height, channels, packed = _chunks(data, where)
    stride = 1 + width * channels
    unpacker = zlib.decompressobj()
    try:
        raw = unpacker.decompress(packed, height * stride + 1)  # one byte more, to notice a longer stream
    except UNPACK_ERROR as error:
        raise _broken(where, f"a damaged compressed stream: {error}") from None
    if len(raw) != height * stride or not unpacker.eof:
        raise _broken(where, f"a compressed stream whose length does not match {width} x {height} px")
    lines = np.frombuffer(raw, np.uint8).reshape(height, stride)
    if (lines[:, 0] > PAETH).any():
        raise _broken(where, "a row with an unknown filter")
    return Png(lines, channels)


def colours_png(rgb: np.ndarray) -> bytes:
    """Encode a picture of colours, (h, w, 3) uint8 RGB."""
    height, width, _ = rgb.shape
    lines = np.empty((height, 1 + RGB * width), np.uint8)
    lines[:, 0] = AVERAGE
    _filter_by_average(np.ascontiguousarray(rgb).reshape(height, -1), lines)
    return _png(lines, RGB)


def areas_png(red: np.ndarray, green: np.ndarray, blue: np.ndarray) -> bytes:
    """Encode a picture with areas of one colour; each channel is (h, w) uint8."""
    height, width = red.shape
    lines = np.zeros((height, 1 + RGB * width), np.uint8)
    for k, channel in enumerate((red, green, blue)):
        lines[:, 1 + k :: RGB] = channel
    return _png(lines, RGB)


def floats_png(values: np.ndarray) -> bytes:
    """Encode (h, w) float32 without loss, the bytes of a number as the channels of a pixel."""
    height, width = values.shape
    raw = np.ascontiguousarray(values, "<f4").view(np.uint8).reshape(height, RGBA * width)
    lines = np.empty((height, 1 + RGBA * width), np.uint8)
    lines[:, 0] = UP
    lines[:1, 1:] = raw[:1]
    np.subtract(raw[1:], raw[:-1], out=lines[1:, 1:])
    return _png(lines, RGBA)


def colours_of(data: bytes | memoryview, where: object) -> np.ndarray:
    """Decode a picture of colours, (h, w, 3) uint8, without alpha."""
    png = parse_png(data, where)
    if png.channels < RGB:
        raise _broken(where, f"{png.channels} channels, not RGB or RGBA")
    return np.ascontiguousarray(png.pixels()[..., :RGB])


def floats_of(data: bytes | memoryview, where: object) -> np.ndarray:
    """Decode what `floats_png` wrote, (h, w) float32."""
    png = parse_png(data, where)
    if png.channels != RGBA:
        raise _broken(where, f"{png.channels} channels, not the 4 bytes of a float32")
    return png.pixels().view("<f4")[..., 0]


def _png(lines: np.ndarray, channels: int) -> bytes:
    height, stride = lines.shape
    colour_type = next(kind for kind, count in CHANNELS.items() if count == channels)
    head = struct.pack(">IIBBBBB", stride // channels, height, 8, colour_type, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", _packed(lines.reshape(-1).data)), (b"IEND", b""))
    return PNG_SIGNATURE + b"".join(
        CHUNK.pack(len(data), name) + data + NUMBER.pack(zlib.crc32(data, zlib.crc32(name))) for name, data in chunks
    )


def _packed(data: memoryview) -> bytes:
    """Pack bytes reproducibly.

    ISA-L's loop for long inputs hashes an address in place of the third byte (`igzip_icf_body_h1_gr_bt.asm`,
    `.write_first_byte`), so that results differ between threads; its loop for the last 16 bytes before a flush does
    not. Flushing after FIRST bytes costs about 2 bytes a picture.
    """
    packer = zlib.compressobj(LEVEL)
    start = packer.compress(data[:FIRST]) + packer.flush(zlib.Z_SYNC_FLUSH)
    return start + packer.compress(data[FIRST:]) + packer.flush()


def _broken(where: object, got: str) -> InputError:
    return InputError(
        "the image cannot be decoded", where=str(where), got=got, expected="a complete PNG file with 8 bits per channel"
    )


def _chunks(data: bytes | memoryview, where: object) -> tuple[int, int, int, bytes]:
    """Return width, height, channels and the packed pixels of the chunks."""
    if data[:8] != PNG_SIGNATURE or data[12:16] != b"IHDR" or len(data) < 33:
        raise _broken(where, f"{len(data)} bytes that are not a PNG")
    width, height, depth, kind, packing, filters, interlace = struct.unpack_from(">IIBBBBB", data, 16)
    check_pixels(width * height, str(where), f"{width} x {height} px")
    if depth != 8 or kind not in CHANNELS or packing or filters or interlace or not width or not height:
        raise _broken(where, f"{depth} bits, colour type {kind}, interlace {interlace}, {width} x {height} px")
    position = len(PNG_SIGNATURE)
    parts: list[memoryview] = []
    view = memoryview(data)
    while position + 12 <= len(data):
        length, name = CHUNK.unpack_from(data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(view[position + 4 : end]) != NUMBER.unpack_from(data, end)[0]:
            raise _broken(where, f"a damaged {name.decode('latin-1')} chunk at byte {position}")
        if name == b"IDAT":
            parts.append(view[position + 8 : end])
        elif name == b"IEND":
            return width, height, CHANNELS[kind], b"".join(parts)
        position = end + 4
    raise _broken(where, f"a file that ends at byte {len(data)}, before the end of the image")


# --- compiled ---------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _paeth(left, up, corner):  # type: ignore[no-untyped-def]
    """Return the neighbour that is nearest to left + up - corner, Paeth's prediction."""
    left_distance = abs(up - corner)
    up_distance = abs(left - corner)
    corner_distance = abs(left + up - 2 * corner)
    if left_distance <= up_distance and left_distance <= corner_distance:
        return left
    return up if up_distance <= corner_distance else corner


@njit(cache=True, nogil=True)
def _without_filters(lines, channels):  # type: ignore[no-untyped-def]
    """Return the pixels, (h, w * channels); a row depends on the row above, the first row on zeros."""
    height = lines.shape[0]
    size = lines.shape[1] - 1
    pixels = np.empty((height, size), np.uint8)
    zeros = np.zeros(size, np.uint8)
    for y in range(height):
        kind = lines[y, 0]
        row = lines[y, 1:]
        target = pixels[y]
        above = pixels[y - 1] if y > 0 else zeros
        if kind == NONE:
            for x in range(size):
                target[x] = row[x]
        elif kind == UP:
            for x in range(size):
                target[x] = (row[x] + above[x]) & 255
        else:
            # A channel depends on its own left value only: the channels side by side take a third of the time.
            for x in range(min(channels, size)):
                up = np.int64(above[x])
                target[x] = row[x] + (0 if kind == SUB else up >> 1 if kind == AVERAGE else up)
            for x in range(channels, size):
                left, up = np.int64(target[x - channels]), np.int64(above[x])
                if kind == SUB:
                    target[x] = row[x] + left
                elif kind == AVERAGE:
                    target[x] = row[x] + ((left + up) >> 1)
                else:
                    target[x] = row[x] + _paeth(left, up, np.int64(above[x - channels]))
    return pixels


@njit(cache=True, nogil=True)
def _filter_by_average(pixels, lines):  # type: ignore[no-untyped-def]
    """Fill lines (h, 1 + 3 w) with the differences of pixels (h, 3 w) to the average of left and upper neighbour."""
    height, size = pixels.shape
    zeros = np.zeros(size, np.uint8)
    for y in range(height):
        row = pixels[y]
        line = lines[y]
        above = pixels[y - 1] if y > 0 else zeros
        for x in range(RGB):
            line[1 + x] = row[x] - (above[x] >> 1)
        for x in range(RGB, size):
            line[1 + x] = row[x] - ((np.uint16(row[x - RGB]) + np.uint16(above[x])) >> 1)
