"""PNG pictures and NumPy arrays: the header is checked before anything is allocated for what it claims.

PNG is the only picture format of a data set, so no other decoder is given a file. NumPy's own reader evaluates headers
as Python literals, which a crafted one makes slow and two threads at once make fail (Python before 3.11.8, its issue
106905); the three fields are found by their patterns here. Format: numpy.lib.format, versions 1 to 3.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cosfly.runtime.errors import InputError
from cosfly.runtime.io import disk_errors, open_file, over_limit, read_bytes

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_HEADER_BYTES = 24  # signature, length and name of the first chunk, width, height
NPY_MAGIC = b"\x93NUMPY"
MOST_HEADER_BYTES = 10_000  # NumPy's own limit
LONGEST_SIDE_PX = 8192  # of a picture that `render` draws; a square of it is the largest that is read, 8K has half
_DESCR = re.compile(rb"'descr' *: *'([<>|=][a-z][0-9]{1,2})'")
_ORDER = re.compile(rb"'fortran_order' *: *(True|False)")
_SHAPE = re.compile(rb"'shape' *: *\(([0-9, ]{0,200})\)")


# --- NumPy arrays -----------------------------------------------------------------------------------------------------


class ArrayHeader(NamedTuple):
    """The header of a `.npy` file; the numbers begin at byte `offset`."""

    dtype: np.dtype
    shape: tuple[int, ...]
    is_fortran: bool
    offset: int

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"


def array_header(path: Path, *, tree: Path | None = None) -> ArrayHeader:
    """Read the header of a `.npy` file, and check that the numbers are all there."""
    with open_file(path, what="array", tree=tree) as file, disk_errors(path, "array"):
        return _header(file.read(MOST_HEADER_BYTES + 12), os.fstat(file.fileno()).st_size, path, "array")


def parse_array_header(data: memoryview, where: str | Path, *, what: str = "array") -> ArrayHeader:
    """Return the header of the bytes of a `.npy` file, which are not copied."""
    return _header(bytes(data[: MOST_HEADER_BYTES + 12]), len(data), where, what)


def parse_array(
    data: bytes | memoryview, where: str | Path, *, dtype: type, ndim: int, what: str = "array", copy: bool = True
) -> np.ndarray:
    """Return the array of the bytes of a `.npy` file of a known type and number of dimensions.

    copy: False returns a view of the bytes, which cannot be written to.
    """
    header = parse_array_header(memoryview(data), where, what=what)
    if header.dtype != dtype or len(header.shape) != ndim:
        expected = f"{np.dtype(dtype)} of {ndim} dimensions"
        raise InputError(f"not a {what}", where=where, got=str(header), expected=expected)
    check_pixels(math.prod(header.shape), where, str(header.shape))
    values: np.ndarray = np.ndarray(header.shape, dtype, data, header.offset, order="F" if header.is_fortran else "C")
    return values.copy("K") if copy else values


def _header(start: bytes, size: int, where: str | Path, what: str) -> ArrayHeader:
    """Return the header of a file of `size` bytes from its first ones."""
    got, first = f"{size} bytes that do not begin as a NumPy array", 10 if start[6:7] == b"\1" else 12
    if len(start) >= 12 and start.startswith(NPY_MAGIC) and 1 <= start[6] <= 3:
        length = int.from_bytes(start[8:first], "little")
        text = start[first : first + length] if length <= MOST_HEADER_BYTES else b""
        found = [match.group(1).decode() for p in (_DESCR, _ORDER, _SHAPE) if (match := p.search(text))]
        got = f"a header of {length} bytes, {text[:80].decode('latin-1')!r}"
        if len(found) == 3:
            descr, order, shape = found
            got = f"{size} bytes that are not a complete NumPy array, {descr} ({shape})"
            with contextlib.suppress(TypeError, ValueError):
                lengths = tuple(int(part) for part in shape.split(",") if part.strip())
                header = ArrayHeader(np.dtype(descr), lengths, order == "True", first + length)
                is_whole = math.prod(lengths) * header.dtype.itemsize == size - header.offset
                # With a length of 0 the product says nothing about the others, which may be beyond every machine.
                if is_whole and max(lengths, default=0) <= size:
                    return header
    raise InputError(f"not a {what}", where=where, got=got, expected="a complete .npy file of numbers")


# --- pictures ---------------------------------------------------------------------------------------------------------


def check_pixels(num_pixels: float, where: str | Path, got: str) -> None:
    """Refuse more pixels than a picture may have."""
    if num_pixels > LONGEST_SIDE_PX**2:
        fix = "scale the pictures down, or cut them"
        raise over_limit(where, got, f"{LONGEST_SIDE_PX} x {LONGEST_SIDE_PX} px", fix)


def png_size(data: bytes) -> tuple[int, int] | None:
    """Return (width, height) px of a PNG from its first bytes, None if it is none."""
    if len(data) < PNG_HEADER_BYTES or not data.startswith(PNG_SIGNATURE) or data[12:16] != b"IHDR":
        return None
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def picture_size(path: Path, *, tree: Path | None = None) -> tuple[int, int] | None:
    """Return (width, height) px of a PNG file from its header, None if it is none."""
    with open_file(path, what="image", tree=tree) as file, disk_errors(path, "image"):
        return png_size(file.read(PNG_HEADER_BYTES))


def read_picture(path: Path, *, tree: Path | None = None) -> np.ndarray:
    """Read a PNG file, (h, w, 3) uint8 in OpenCV's order of colours."""
    return parse_picture(read_bytes(path, what="image", tree=tree), path)


def parse_picture(data: bytes, where: str | Path, *, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    """Return the pixels of a PNG; InputError where it is none, damaged, or larger than pictures may be."""
    size, image, got = png_size(data), None, f"{len(data)} bytes"
    if size is not None and _holds_its_chunks(data):
        check_pixels(size[0] * size[1], where, "{} x {} px".format(*size))
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            got = str(error)
    if image is None:
        raise InputError("not an image", where=where, got=got, expected="a PNG")
    return image


def _holds_its_chunks(data: bytes) -> bool:
    """Return whether no chunk claims to end beyond the file: OpenCV allocates what a chunk claims, up to gigabytes."""
    place = len(PNG_SIGNATURE)
    while place + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        place += length + 12
        if kind == b"IEND":
            break
    return place <= len(data)
