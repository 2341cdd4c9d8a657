"""PNG pictures and NumPy arrays. The header is checked before memory is allocated for the sizes in it.

PNG is the only picture format of a data set, so no other decoder reads a file. NumPy's own reader evaluates headers as
Python literals: a crafted header makes that slow, and it fails in two threads at once (Python before 3.11.8, its issue
106905). This reader finds the three fields by regular expressions. Format: numpy.lib.format, versions 1 to 3.
"""

from __future__ import annotations

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
CHUNK_HEADER_BYTES, CHECKSUM_BYTES = 8, 4  # length and name before the data of a chunk, checksum after it
NPY_MAGIC = b"\x93NUMPY"
VERSION_BYTE, LENGTH_BYTE = 6, 8  # the places of the major version and of the header's length in a `.npy` file
PREFIX_BYTES, LONG_PREFIX_BYTES = 10, 12  # before the header: version 1 stores its length in 2 bytes, later ones in 4
MOST_HEADER_BYTES = 10_000  # NumPy's own limit
LONGEST_SIDE_PX = 8192  # of a picture that `render` draws; pictures up to this square are read, twice an 8K picture
_DESCR = re.compile(rb"'descr' *: *'([<>|=][a-z][0-9]{1,2})'")
_ORDER = re.compile(rb"'fortran_order' *: *(True|False)")
_SHAPE = re.compile(rb"'shape' *: *\(([0-9, ]{0,200})\)")


# --- NumPy arrays -----------------------------------------------------------------------------------------------------


class ArrayHeader(NamedTuple):
    """The header of a `.npy` file; the data begin at byte `offset`."""

    dtype: np.dtype
    shape: tuple[int, ...]
    is_fortran: bool
    offset: int

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"


def array_header(path: Path, *, tree: Path | None = None) -> ArrayHeader:
    """Read the header of a `.npy` file, and check that the file is complete."""
    with open_file(path, what="array", tree=tree) as file, disk_errors(path, "array"):
        return _header(file.read(MOST_HEADER_BYTES + LONG_PREFIX_BYTES), os.fstat(file.fileno()).st_size, path, "array")


def parse_array_header(data: memoryview, where: str | Path, *, what: str = "array") -> ArrayHeader:
    """Return the header of a `.npy` file from its bytes, without copying them."""
    return _header(bytes(data[: MOST_HEADER_BYTES + LONG_PREFIX_BYTES]), len(data), where, what)


def parse_array(
    data: bytes | memoryview, where: str | Path, *, dtype: type, ndim: int, what: str = "array", copy: bool = True
) -> np.ndarray:
    """Return the array in the bytes of a `.npy` file; dtype and ndim are the expected ones.

    copy: False returns a read-only view of the bytes.
    """
    header = parse_array_header(memoryview(data), where, what=what)
    if header.dtype != dtype or len(header.shape) != ndim:
        expected = f"{np.dtype(dtype)} with {ndim} dimensions"
        got = f"{header.dtype} of shape {header.shape}"
        raise InputError(f"the {what} has the wrong type or shape", where=where, got=got, expected=expected)
    check_pixels(math.prod(header.shape), where, f"shape {header.shape}")
    values: np.ndarray = np.ndarray(header.shape, dtype, data, header.offset, order="F" if header.is_fortran else "C")
    return values.copy("K") if copy else values


def _header(start: bytes, size: int, where: str | Path, what: str) -> ArrayHeader:
    """Return the header of a `.npy` file of `size` bytes from its first bytes."""

    def not_an_array(got: str) -> InputError:
        return InputError(
            f"the {what} cannot be read", where=where, got=got, expected="a complete .npy file of numbers"
        )

    if len(start) < LONG_PREFIX_BYTES or not start.startswith(NPY_MAGIC) or start[VERSION_BYTE] not in (1, 2, 3):
        raise not_an_array(f"{size} bytes that do not begin as a NumPy array")
    text_start = PREFIX_BYTES if start[VERSION_BYTE] == 1 else LONG_PREFIX_BYTES
    length = int.from_bytes(start[LENGTH_BYTE:text_start], "little")
    text = start[text_start : text_start + length] if length <= MOST_HEADER_BYTES else b""
    matches = [pattern.search(text) for pattern in (_DESCR, _ORDER, _SHAPE)]
    fields = [match.group(1).decode() for match in matches if match]
    if len(fields) < len(matches):
        raise not_an_array(f"a header of {length} bytes that begins with {text[:80].decode('latin-1')!r}")
    descr, order, shape = fields
    incomplete = not_an_array(f"{size} bytes, which are not a whole array of type {descr} and shape ({shape})")
    try:
        lengths = tuple(int(part) for part in shape.split(",") if part.strip())
        header = ArrayHeader(np.dtype(descr), lengths, order == "True", text_start + length)
    except (TypeError, ValueError):
        raise incomplete from None
    # If one length is 0, the product does not bound the others, which may exceed the memory of any machine.
    has_all_bytes = math.prod(lengths) * header.dtype.itemsize == size - header.offset
    if not has_all_bytes or max(lengths, default=0) > size:
        raise incomplete
    return header


# --- pictures ---------------------------------------------------------------------------------------------------------


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


def picture_size(path: Path, *, tree: Path | None = None) -> tuple[int, int] | None:
    """Return (width, height) in px from the header of a PNG file; None for another file."""
    with open_file(path, what="image", tree=tree) as file, disk_errors(path, "image"):
        return png_size(file.read(PNG_HEADER_BYTES))


def read_picture(path: Path, *, tree: Path | None = None) -> np.ndarray:
    """Read a PNG file, (h, w, 3) uint8 in OpenCV's channel order (B, G, R)."""
    return parse_picture(read_bytes(path, what="image", tree=tree), path)


def parse_picture(data: bytes, where: str | Path, *, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    """Return the pixels of a PNG; raises InputError if it is not a PNG, damaged or too large."""
    size = png_size(data)
    image = None
    got = f"{len(data)} bytes"
    if size is not None and _holds_its_chunks(data):
        width, height = size
        check_pixels(width * height, where, f"{width} x {height} px")
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            got = str(error)
    if image is None:
        raise InputError("the image cannot be decoded", where=where, got=got, expected="a complete PNG file")
    return image


def _holds_its_chunks(data: bytes) -> bool:
    """Return whether all chunks end within the file: OpenCV allocates the length in a chunk, up to gigabytes."""
    chunk_start = len(PNG_SIGNATURE)
    while chunk_start + CHUNK_HEADER_BYTES <= len(data):
        length, kind = struct.unpack_from(">I4s", data, chunk_start)
        chunk_start += CHUNK_HEADER_BYTES + length + CHECKSUM_BYTES
        if kind == b"IEND":
            break
    return chunk_start <= len(data)
