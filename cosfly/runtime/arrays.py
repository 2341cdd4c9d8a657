"""NumPy arrays (`.npy`). The header is checked before memory is allocated for the sizes in it."""

import io
import math
import threading
from pathlib import Path
from tokenize import TokenError
from typing import NamedTuple

import numpy as np
from numpy.lib import format as npy

from cosfly.runtime.errors import InputError
from cosfly.runtime.png import check_pixels

MOST_HEADER_BYTES = 10_000  # NumPy's own limit
PREFIX_BYTES = 12  # magic string, version and length of the header
# NumPy evaluates a header as a Python literal, which fails in two threads at once before Python 3.11.8 (issue 106905).
_ONE_HEADER = threading.Lock()


class ArrayHeader(NamedTuple):
    """The header of a `.npy` file; the data begin at byte `offset`."""

    dtype: np.dtype
    shape: tuple[int, ...]
    is_fortran: bool
    offset: int

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"


def parse_array(
    data: bytes | memoryview, where: str | Path, *, dtype: type, ndim: int, what: str = "array", copy: bool = True
) -> np.ndarray:
    """Return the array in the bytes of a `.npy` file; dtype and ndim are the expected ones.

    copy: False returns a read-only view of the bytes.
    """
    header = _header(bytes(data[: MOST_HEADER_BYTES + PREFIX_BYTES]), len(data), where, what)
    if header.dtype != dtype or len(header.shape) != ndim:
        expected = f"{np.dtype(dtype)} with {ndim} dimensions"
        got = f"{header.dtype} of shape {header.shape}"
        raise InputError(f"the {what} has the wrong type or shape", where=where, got=got, expected=expected)
    check_pixels(math.prod(header.shape), where, f"shape {header.shape}")
    values: np.ndarray = np.ndarray(header.shape, dtype, data, header.offset, order="F" if header.is_fortran else "C")
    return values.copy("K") if copy else values


def _header(start: bytes, size: int, where: str | Path, what: str) -> ArrayHeader:
    """Return the header of a `.npy` file of `size` bytes from its first bytes."""
    file = io.BytesIO(start)
    header = None
    got = f"{size} bytes that are not a complete NumPy array"
    try:
        is_first_version = npy.read_magic(file) == (1, 0)
        read = npy.read_array_header_1_0 if is_first_version else npy.read_array_header_2_0
        with _ONE_HEADER:
            shape, is_fortran, dtype = read(file, max_header_size=MOST_HEADER_BYTES)
        header = ArrayHeader(dtype, shape, is_fortran, file.tell())
        got += f", {header}"
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError, TokenError) as error:
        got += f": {' '.join(str(error).split())[:80]}"
    # If one length is 0, the product does not bound the others, which may exceed the memory of any machine.
    if (
        header is None
        or header.dtype.kind not in "biuf"
        or math.prod(header.shape) * header.dtype.itemsize != size - header.offset
        or not all(0 <= length <= size for length in header.shape)
    ):
        expected = "a complete .npy file of numbers"
        raise InputError(f"the {what} cannot be read", where=where, got=got, expected=expected)
    return header
