"""What a frame's file must be before it is released, told from its bytes without decoding a picture."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cosfly.errors import InputError
from cosfly.products.frames import SKY_DEPTH_M, FrameFile, depth_values
from cosfly.reading.arrays import PNG_HEADER_BYTES, PNG_SIGNATURE, png_size

CHUNK_FRAME_BYTES = 12  # of a PNG's chunk: length, name, checksum
# Bits a channel; colour type, RGB or RGBA; interlacing: bytes 24, 25 and 28 of a PNG. What the readers of a release take.
KIND = struct.Struct(">BBxxB")
KINDS = ((8, 2, 0), (8, 6, 0))
CONVERT = "convert it without loss, as Pillow's Image.open(FILE).convert('RGB').save(FILE), and inspect the tree again"
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
RENDER = "render it again, or put the file back"


def check_picture(file: FrameFile, data: memoryview, size_px: tuple[int, int], where: Path, *, is_known: bool) -> None:
    """See that a file is whole and of its flight's size.

    Args:
        size_px: width, height. is_known: its digest was compared, so that a PNG's own checksums need not be.
    Raises:
        InputError: it is not.
    """
    if file == "depth":
        _check_depth(depth_values(data, where), size_px, where)
        return
    found = png_size(bytes(data[:PNG_HEADER_BYTES]))
    if found is None or data[-len(PNG_END) :] != PNG_END:
        got = f"{len(data)} bytes that do not {'begin' if found is None else 'end'} as a PNG"
        raise InputError("a picture is damaged or cut short", where=where, got=got, fix=RENDER)
    if found != size_px:
        raise InputError(
            "a picture of another size",
            where=where,
            got=f"{found[0]} x {found[1]} px",
            expected=f"{size_px[0]} x {size_px[1]} px",
            fix=RENDER,
        )
    bits, colour_type, interlace = KIND.unpack_from(data, PNG_HEADER_BYTES)
    if (bits, colour_type, interlace) not in KINDS:
        got = f"{bits} bits, colour type {colour_type}{', interlaced' if interlace else ''}"
        raise InputError("a PNG of another kind", where=where, got=got, expected="8 bits, RGB or RGBA (2 or 6), not interlaced", fix=CONVERT)  # fmt: skip
    if not is_known and (chunk := next(_broken_chunks(data), None)):
        raise InputError(
            "a picture is damaged", where=where, got=f"chunk {chunk} does not have its checksum", fix=RENDER
        )


def _check_depth(values: np.ndarray, size_px: tuple[int, int], where: Path) -> None:
    if values.shape[::-1] != size_px:
        got, expected = (f"{width} x {height} px" for width, height in (values.shape[::-1], size_px))
        raise InputError("a depth image of another size", where=where, got=got, expected=expected, fix=RENDER)
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))  # NaN if any is
    if not 0.0 <= low <= high <= SKY_DEPTH_M:
        raise InputError(
            "a depth image holds what is no depth",
            where=where,
            got=f"{low:g} to {high:g} m",
            expected=f"0 to {SKY_DEPTH_M:g} m",
            fix=RENDER,
        )


def _broken_chunks(view: memoryview) -> Iterator[str]:
    """Name the chunks of a PNG whose bytes are not those of their checksums."""
    at = len(PNG_SIGNATURE)
    while at + CHUNK_FRAME_BYTES <= len(view):
        end = at + CHUNK_FRAME_BYTES + int.from_bytes(view[at : at + 4], "big")
        name = bytes(view[at + 4 : at + 8])
        if end > len(view) or zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            yield repr(name.decode("latin-1"))
        at = end
    if at != len(view):
        yield "after the last"
