"""PNG, the only picture format of a data set: 8 bits, grey to RGBA, not interlaced (RFC 2083).

Pillow reads, after the size in the header is checked. Writing filters each kind of picture in its own way. Colours: the
difference of each byte to the average of its left and upper neighbours. Instance masks: no filter. Depth: the four
channels of a pixel are the bytes of a float32, lowest first, and each row is stored as the difference to the row above.
"""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from isal import isal_zlib
from PIL import Image

from cosfly.runtime.compiled import njit
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import over_limit, read_bytes

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
HEADER = struct.Struct(">IIBBBBB")  # width, height, bits, colour type, packing, filters, interlace
HEADER_AT, HEADER_END = 16, 29  # bytes of a file
LONGEST_SIDE_PX = 8192  # of a picture that `render` draws; pictures up to this square are read, twice an 8K picture
CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # by colour type; palettes are not supported
CHUNK = struct.Struct(">I4s")  # length and name
NUMBER = struct.Struct(">I")
RGB, RGBA = 3, 4
UP, AVERAGE = 2, 3  # filters
LEVEL = 1  # of compression, the fastest
FIRST = 16  # bytes that are packed first and flushed


def check_pixels(num_pixels: float, where: str | Path, got: str) -> None:
    """Raise InputError if a picture or array has more pixels than are read."""
    if num_pixels > LONGEST_SIDE_PX**2:
        limit = f"{LONGEST_SIDE_PX} x {LONGEST_SIDE_PX} px"
        raise over_limit(where, got, limit, "scale the pictures down or crop them")


def png_size(data: bytes | memoryview) -> tuple[int, int] | None:
    """Return (width, height) in px from the first bytes of a PNG; None for other bytes."""
    if len(data) < HEADER_END or data[:8] != PNG_SIGNATURE or data[12:16] != b"IHDR":
        return None
    width, height, *_ = HEADER.unpack_from(data, HEADER_AT)
    return width, height


def read_picture(path: Path, *, tree: Path | None = None) -> np.ndarray:
    """Read a PNG file of colours, (h, w, 3) uint8 RGB, without alpha."""
    return colours_of(read_bytes(path, what="image", tree=tree), path)


def pixels_of(data: bytes | memoryview, where: object) -> np.ndarray:
    """Decode a PNG, (h, w, channels) uint8; raises InputError if it is damaged, of another kind or too large."""
    if png_size(data) is None:
        raise _broken(where, f"{len(data)} bytes that are not a PNG")
    width, height, bits, kind, _, _, interlace = HEADER.unpack_from(data, HEADER_AT)
    check_pixels(width * height, str(where), f"{width} x {height} px")
    if bits != 8 or kind not in CHANNELS or interlace:
        raise _broken(where, f"{bits} bits, colour type {kind}, interlace {interlace}, {width} x {height} px")
    try:
        Image.open(io.BytesIO(data), formats=["PNG"]).verify()  # the checksums of all chunks, which loading skips
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            return np.array(image).reshape(height, width, CHANNELS[kind])
    except (OSError, SyntaxError, ValueError, IndexError, struct.error, zlib.error) as error:  # IndexError: no pixels
        raise _broken(where, " ".join(str(error).split())) from None


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
    pixels = pixels_of(data, where)
    if pixels.shape[2] < RGB:
        raise _broken(where, f"{pixels.shape[2]} channels, not RGB or RGBA")
    return np.ascontiguousarray(pixels[..., :RGB])


def floats_of(data: bytes | memoryview, where: object) -> np.ndarray:
    """Decode what `floats_png` wrote, (h, w) float32."""
    pixels = pixels_of(data, where)
    if pixels.shape[2] != RGBA:
        raise _broken(where, f"{pixels.shape[2]} channels, not the 4 bytes of a float32")
    return pixels.view("<f4")[..., 0]


def _png(lines: np.ndarray, channels: int) -> bytes:
    height, stride = lines.shape
    colour_type = next(kind for kind, count in CHANNELS.items() if count == channels)
    head = HEADER.pack(stride // channels, height, 8, colour_type, 0, 0, 0)
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
    packer = isal_zlib.compressobj(LEVEL)
    start = packer.compress(data[:FIRST]) + packer.flush(isal_zlib.Z_SYNC_FLUSH)
    return start + packer.compress(data[FIRST:]) + packer.flush()


def _broken(where: object, got: str) -> InputError:
    return InputError(
        "the image cannot be decoded", where=str(where), got=got, expected="a complete PNG file with 8 bits per channel"
    )


# --- compiled ---------------------------------------------------------------------------------------------------------


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
