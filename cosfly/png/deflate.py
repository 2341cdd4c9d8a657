"""Packing the filtered rows of a picture (RFC 1950, 1951), made for what a renderer draws.

Only two places are looked at for a repetition: one pixel before, and one row above. Everything else is left to the Huffman codes,
which each block has of its own.
"""

from __future__ import annotations

import numpy as np

from cosfly.png.checksum import adler32
from cosfly.png.huffman import (
    BASE_LENGTH,
    BASE_WAY,
    END,
    LENGTH_ORDER,
    LOOK_BITS,
    MORE_LENGTH,
    MORE_WAY,
    MOST_LITERALS,
    MOST_WAYS,
    code_lengths,
    codes_of,
)
from cosfly.work.compiled import njit, put_word, word_at

BAND_BYTES = 85_000  # unpacked, at least: of a smaller band the lengths of its codes take more than a thousandth
BAND_END = b"\0\0\xff\xff"  # of a block that holds nothing and ends at a byte
BLOCK_SYMBOLS = 1 << 17
BLOCK_HEAD_BYTES = 1024  # more than the lengths of all codes of a block take
LONGEST, WINDOW = 258, 32768
SHORTEST = 4  # bytes of a repetition; of fewer the codes are shorter
IS_ABOVE, LENGTH_BITS = (
    np.int64(1 << 15),
    np.int64(511),
)  # of a repetition: whether it is of the row above, and its length
FOUR, FOURTH, FIRST_FOUR = np.uint64(4), np.uint64(0xFF000000), np.uint64(0xFFFFFFFF)  # bytes of a word
LOW_BITS = np.uint64(0x7F7F7F7F7F7F7F7F)
SYMBOL_OF_LENGTH = np.zeros(LONGEST + 1, np.int64)
for _s, _base in enumerate(BASE_LENGTH.tolist()):
    SYMBOL_OF_LENGTH[_base:] = END + 1 + _s


def band_rows(height_px: int, num_bands: int) -> np.ndarray:
    """Where bands of rows begin, and the row behind the last, (num_bands + 1,) int64."""
    return np.arange(num_bands + 1) * height_px // num_bands


def deflate(lines: np.ndarray, near: int, above: int, num_bands: int = 1) -> list[memoryview]:
    """Pack rows, (h, stride) uint8, as a zlib stream, in parts: bands of rows of which each can be unpacked without the others.

    Args:
        near, above: how many bytes back the pixel before and the one above stand; above 0: nothing repeats there.
    """
    data = np.zeros(lines.size + 8, np.uint8)
    data[:-8] = lines.reshape(-1)
    out = np.empty(
        lines.size * LOOK_BITS // 8 + BLOCK_HEAD_BYTES * (2 + num_bands + lines.size // BLOCK_SYMBOLS), np.uint8
    )
    out[:2] = 0x78, 0x01
    bounds = band_rows(len(lines), num_bands) * lines.shape[1]
    ends = _pack(data, bounds, near, above if above < WINDOW else 0, out)
    end = ends[-1] + 4
    out[end - 4 : end] = np.frombuffer(adler32(lines).to_bytes(4, "big"), np.uint8)
    ends[-1] = end
    return [out[ends[k] : ends[k + 1]].data for k in range(num_bands)]


@njit(cache=True, nogil=True)
def _pack(data, bounds, near, above, out):  # type: ignore[no-untyped-def]
    """Write the blocks of all bands, from the third byte of `out` on; gives 0 and where they end. data: the rows and eight bytes more."""
    repeats, counts = np.empty((BLOCK_SYMBOLS, 2), np.int64), np.zeros(MOST_LITERALS, np.int64)
    num_bands = len(bounds) - 1
    ends = np.zeros(num_bands + 1, np.int64)
    place, hold, held = np.int64(2), np.uint64(0), np.int64(0)  # whole bytes in `out`, and the `held` bits behind them
    # Ways are two at most, of one bit each.
    ways = np.zeros(MOST_WAYS, np.int64)
    near_way, above_way = _way_of(near), _way_of(above)
    ways[near_way] = ways[above_way] = 1
    is_second = np.int64(above_way > near_way)
    near_tail = (1 - is_second) | (near - BASE_WAY[near_way]) << 1
    above_tail = is_second | (above - BASE_WAY[above_way]) << 1
    tails = (near_tail, 1 + MORE_WAY[near_way], above_tail, 1 + MORE_WAY[above_way])
    for band in range(num_bands):
        at, size = bounds[band], bounds[band + 1]
        while at < size:
            begin = at
            at, num = _find(data, begin, bounds[band], size, near, above, repeats, counts)
            counts[END] = 1
            lengths = code_lengths(counts, np.int64(LOOK_BITS))
            is_last = band == num_bands - 1 and at == size
            place, hold, held = _put(np.int64(is_last) | 2 << 1, np.int64(3), out, place, hold, held)
            place, hold, held = _write_lengths(lengths, ways, out, place, hold, held)
            codes = codes_of(lengths)
            place, hold, held = _write_symbols(data, begin, at, repeats[:num], codes, lengths, tails, out, place, hold, held)  # fmt: skip
            place, hold, held = _put(codes[END], lengths[END], out, place, hold, held)
        if band < num_bands - 1:
            place, hold, held = _put(np.int64(0), np.int64(3), out, place, hold, held)
            place, hold, held = place + (held + 7 >> 3), np.uint64(0), np.int64(0)
            put_word(out.ctypes.data + np.uint64(place), np.uint64(0xFFFF0000))
            place += len(BAND_END)
        ends[band + 1] = place
    ends[num_bands] += held + 7 >> 3
    return ends


@njit(cache=True, nogil=True)
def _way_of(back):  # type: ignore[no-untyped-def]
    """The symbol of a way back."""
    way = np.int64(0)
    while way + 1 < len(BASE_WAY) and BASE_WAY[way + 1] <= back:
        way += 1
    return way


@njit(cache=True, nogil=True)
def _find(data, at, first, size, near, above, repeats, counts):  # type: ignore[no-untyped-def]
    """Find the repetitions of a block and count its symbols: bytes that none of them holds stand for themselves. Gives how far it came, and how many they are.

    Of a repetition `repeats` gets its place and its length with its marks.
    """
    counts.fill(0)
    data_at = np.int64(data.ctypes.data)
    n, num = np.int64(0), np.int64(0)  # of symbols, and of repetitions among them
    # Four literals together, each counted in a table of its own: an addition to what was written just now waits for it.
    kinds = np.zeros((4, 256), np.uint32)
    here, back = np.uint64(at), np.uint64(near)
    byte, eight, sixteen, last = np.uint64(255), np.uint64(8), np.uint64(16), np.uint64(24)
    while n < BLOCK_SYMBOLS and at < size:
        if above == 0 and at - first >= near:
            # Where the fourth byte from here differs from its pixel before, none of these four begins a repetition, and rarely where it does not.
            here, end = np.uint64(at), np.uint64(max(min(size, at + BLOCK_SYMBOLS - n) - 4, 0))
            while here <= end:
                word = word_at(np.uint64(data_at) + here)
                differs = word ^ word_at(np.uint64(data_at) + here - back)
                if differs & FOURTH == 0:
                    # Of eight bytes each that is as before has its top bit here; four in a row make a repetition.
                    same = ~(((differs & LOW_BITS) + LOW_BITS) | differs | LOW_BITS)
                    if same & same >> eight & same >> sixteen & same >> last & FIRST_FOUR != 0:
                        break
                kinds[0, word & byte] += 1
                kinds[1, word >> eight & byte] += 1
                kinds[2, word >> sixteen & byte] += 1
                kinds[3, word >> last & byte] += 1
                here += FOUR
            n += np.int64(here) - at
            at = np.int64(here)
            if at == size or n == BLOCK_SYMBOLS:
                break
        length, marks = np.int64(0), np.int64(0)
        if at - first >= near and (word_at(data_at + at) ^ word_at(data_at + at - near)) & FIRST_FOUR == 0:
            length = _num_same(data, at, near, size)
        is_above = above > 0 and at - first >= above and length < LONGEST
        if is_above and word_at(data_at + at) == word_at(data_at + at - above):
            other = _num_same(data, at, above, size)
            if other > length + 2:  # whose way back is so much longer
                length, marks = other, IS_ABOVE
        if length >= SHORTEST:
            repeats[num, 0], repeats[num, 1] = at, marks | length
            num += 1
            counts[SYMBOL_OF_LENGTH[length]] += 1
            at += length
        else:
            counts[data[at]] += 1
            at += 1
        n += 1
    for s in range(256):
        counts[s] += np.int64(kinds[0, s]) + np.int64(kinds[1, s]) + np.int64(kinds[2, s]) + np.int64(kinds[3, s])
    return at, num


@njit(cache=True, nogil=True)
def _num_same(data, at, back, size):  # type: ignore[no-untyped-def]
    """How many bytes repeat those `back` before them."""
    most = min(np.int64(LONGEST), size - at)
    n, place = np.int64(0), np.int64(data.ctypes.data) + at
    while n + 8 <= most and word_at(place + n) == word_at(place + n - back):
        n += 8
    while n < most and data[at + n] == data[at + n - back]:
        n += 1
    return n


@njit(cache=True, nogil=True)
def _put(value, num_bits, out, place, hold, held):  # type: ignore[no-untyped-def]
    """Write up to 56 bits."""
    hold |= np.uint64(value) << np.uint64(held)
    held += num_bits
    put_word(out.ctypes.data + np.uint64(place), hold)
    return place + (held >> 3), hold >> np.uint64(held & ~7), held & 7


@njit(cache=True, nogil=True)
def _write_lengths(lengths, ways, out, place, hold, held):  # type: ignore[no-untyped-def]
    """Write the lengths of a block's codes, one by one, in a code of their own."""
    counts = np.zeros(19, np.int64)
    for own in (lengths, ways):
        for length in own:
            counts[length] += 1
    of_lengths = code_lengths(counts, np.int64(7))
    codes = codes_of(of_lengths)
    head = np.int64((len(lengths) - 257) | (len(ways) - 1) << 5 | (len(LENGTH_ORDER) - 4) << 10)
    place, hold, held = _put(head, np.int64(14), out, place, hold, held)
    for s in LENGTH_ORDER:
        place, hold, held = _put(of_lengths[s], np.int64(3), out, place, hold, held)
    for own in (lengths, ways):
        for length in own:
            place, hold, held = _put(codes[length], of_lengths[length], out, place, hold, held)
    return place, hold, held


@njit(cache=True, nogil=True)
def _write_symbols(data, at, stop, repeats, codes, lengths, tails, out, place, hold, held):  # type: ignore[no-untyped-def]
    """Write the bytes from `at` to `stop`. tails: what follows the length of a repetition of the pixel before, its bits; the same of the one above."""
    near_tail, near_bits, above_tail, above_bits = tails
    data_at, entries = np.uint64(data.ctypes.data), np.empty(256, np.uint64)
    for s in range(256):
        entries[s] = codes[s] << 4 | lengths[s]
    four, low, byte = np.uint64(4), np.uint64(15), np.uint64(255)
    eight, sixteen, last = np.uint64(8), np.uint64(16), np.uint64(24)
    for k in range(len(repeats) + 1):
        end = repeats[k, 0] if k < len(repeats) else stop
        here, fours = np.uint64(at), np.uint64(at + (end - at) // 4 * 4)
        while here < fours:  # four literals together
            word = word_at(data_at + here)
            w, x = entries[word & byte], entries[word >> eight & byte]
            y, z = entries[word >> sixteen & byte], entries[word >> last & byte]
            first = w >> four | x >> four << (w & low)
            second = y >> four | z >> four << (y & low)
            bits, width = first | second << ((w & low) + (x & low)), (w & low) + (x & low) + (y & low) + (z & low)
            place, hold, held = _put(bits, np.int64(width), out, place, hold, held)
            here += four
        for i in range(np.int64(fours), end):
            place, hold, held = _put(codes[data[i]], lengths[data[i]], out, place, hold, held)
        if k < len(repeats):
            length, is_above = repeats[k, 1] & LENGTH_BITS, repeats[k, 1] & IS_ABOVE != 0
            s = SYMBOL_OF_LENGTH[length]
            value = codes[s] | (length - BASE_LENGTH[s - 257]) << lengths[s]
            num_bits = lengths[s] + MORE_LENGTH[s - 257]
            value |= (above_tail if is_above else near_tail) << num_bits
            num_bits += above_bits if is_above else near_bits
            place, hold, held = _put(value, num_bits, out, place, hold, held)
            at = end + length
    return place, hold, held
