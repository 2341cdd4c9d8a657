"""Packing the filtered rows of a picture (RFC 1950, 1951), made for what a renderer draws.

Only two places are looked at for a repetition: one pixel before, and one row above. Everything else is left to the Huffman codes,
which each block has of its own.
"""

from __future__ import annotations

import numpy as np

from cosfly.compiled import njit, words_of
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

BAND_BYTES = 85_000  # unpacked, at least: of a smaller band the lengths of its codes take more than a thousandth
BAND_END = b"\0\0\xff\xff"  # of a block that holds nothing and ends at a byte
BLOCK_TOKENS = 1 << 17
BLOCK_HEAD_BYTES = 1024  # more than the lengths of all codes of a block take
LONGEST, WINDOW = 258, 32768
SHORTEST = 4  # bytes of a repetition; of fewer the codes are shorter
# A token is a byte, or a repetition: these marks and its length.
REPEATS, IS_ABOVE, LENGTH_BITS = np.uint32(1 << 16), np.uint32(1 << 15), np.uint32(511)
FOUR, FOURTH, FIRST_FOUR = np.uint64(4), np.uint64(0xFF000000), np.uint64(0xFFFFFFFF)  # bytes of a word
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
        lines.size * LOOK_BITS // 8 + BLOCK_HEAD_BYTES * (2 + num_bands + lines.size // BLOCK_TOKENS), np.uint8
    )
    out[:2] = 0x78, 0x01
    bounds = band_rows(len(lines), num_bands) * lines.shape[1]
    ends = _pack(data, words_of(data), bounds, near, above if above < WINDOW else 0, words_of(out))
    end = ends[-1] + 4
    out[end - 4 : end] = np.frombuffer(adler32(lines).to_bytes(4, "big"), np.uint8)
    ends[-1] = end
    return [out[ends[k] : ends[k + 1]].data for k in range(num_bands)]


@njit(cache=True, nogil=True)
def _pack(data, words, bounds, near, above, out):  # type: ignore[no-untyped-def]
    """Write the blocks of all bands, from the third byte of `out` on; gives 0 and where they end. data: the rows and eight bytes more."""
    tokens, counts = np.empty(BLOCK_TOKENS, np.uint32), np.zeros(MOST_LITERALS, np.int64)
    num = len(bounds) - 1
    ends = np.zeros(num + 1, np.int64)
    place, hold, held = np.int64(2), np.uint64(0), np.int64(0)  # whole bytes in `out`, and the `held` bits behind them
    # Ways are two at most, of one bit each.
    ways = np.zeros(MOST_WAYS, np.int64)
    near_way, above_way = _way_of(near), _way_of(above)
    ways[near_way] = ways[above_way] = 1
    is_second = np.int64(above_way > near_way)
    near_tail = (1 - is_second) | (near - BASE_WAY[near_way]) << 1
    above_tail = is_second | (above - BASE_WAY[above_way]) << 1
    tails = (near_tail, 1 + MORE_WAY[near_way], above_tail, 1 + MORE_WAY[above_way])
    for band in range(num):
        at, size = bounds[band], bounds[band + 1]
        while at < size:
            at, num_tokens = _tokenise(data, words, at, bounds[band], size, near, above, tokens, counts)
            counts[END] = 1
            lengths = code_lengths(counts, np.int64(LOOK_BITS))
            is_last = band == num - 1 and at == size
            place, hold, held = _put(np.int64(is_last) | 2 << 1, np.int64(3), out, place, hold, held)
            place, hold, held = _write_lengths(lengths, ways, out, place, hold, held)
            codes = codes_of(lengths)
            place, hold, held = _write_tokens(tokens[:num_tokens], codes, lengths, tails, out, place, hold, held)
            place, hold, held = _put(codes[END], lengths[END], out, place, hold, held)
        if band < num - 1:
            place, hold, held = _put(np.int64(0), np.int64(3), out, place, hold, held)
            place, hold, held = place + (held + 7 >> 3), np.uint64(0), np.int64(0)
            out[place] = np.uint64(0xFFFF0000)
            place += len(BAND_END)
        ends[band + 1] = place
    ends[num] += held + 7 >> 3
    return ends


@njit(cache=True, nogil=True)
def _way_of(back):  # type: ignore[no-untyped-def]
    """The symbol of a way back."""
    way = np.int64(0)
    while way + 1 < len(BASE_WAY) and BASE_WAY[way + 1] <= back:
        way += 1
    return way


@njit(cache=True, nogil=True)
def _tokenise(data, words, at, first, size, near, above, tokens, counts):  # type: ignore[no-untyped-def]
    """Fill a block with tokens and count their symbols. Gives how far it came, and how many they are."""
    counts.fill(0)
    n = np.int64(0)
    # Four literals together, each counted in a table of its own: an addition to what was written just now waits for it.
    kinds = np.zeros((4, 256), np.uint32)
    here, back, place = np.uint64(at), np.uint64(near), np.uint64(0)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    while n < len(tokens) and at < size:
        if above == 0 and at - first >= near:
            # Where the fourth byte from here differs from its pixel before, none of these four begins a repetition.
            here, place, end = np.uint64(at), np.uint64(n), np.uint64(max(min(size, at + len(tokens) - n) - 4, 0))
            while here <= end and (words[here] ^ words[here - back]) & FOURTH != 0:
                a, b, c, d = data[here], data[here + one], data[here + two], data[here + three]
                tokens[place], tokens[place + one], tokens[place + two], tokens[place + three] = a, b, c, d
                kinds[0, a] += 1
                kinds[1, b] += 1
                kinds[2, c] += 1
                kinds[3, d] += 1
                here, place = here + FOUR, place + FOUR
            at, n = np.int64(here), np.int64(place)
            if at == size or n == len(tokens):
                break
        length, marks = np.int64(0), REPEATS
        if at - first >= near and (words[at] ^ words[at - near]) & FIRST_FOUR == 0:
            length = _num_same(data, words, at, near, size)
        if above > 0 and at - first >= above and length < LONGEST and words[at] == words[at - above]:
            other = _num_same(data, words, at, above, size)
            if other > length + 2:  # whose way back is so much longer
                length, marks = other, REPEATS | IS_ABOVE
        if length >= SHORTEST:
            tokens[n] = marks | np.uint32(length)
            counts[SYMBOL_OF_LENGTH[length]] += 1
            at += length
        else:
            tokens[n] = data[at]
            counts[data[at]] += 1
            at += 1
        n += 1
    for s in range(256):
        counts[s] += np.int64(kinds[0, s]) + np.int64(kinds[1, s]) + np.int64(kinds[2, s]) + np.int64(kinds[3, s])
    return at, n


@njit(cache=True, nogil=True)
def _num_same(data, words, at, back, size):  # type: ignore[no-untyped-def]
    """How many bytes repeat those `back` before them."""
    most = min(np.int64(LONGEST), size - at)
    n = np.int64(0)
    while n + 8 <= most and words[at + n] == words[at + n - back]:
        n += 8
    while n < most and data[at + n] == data[at + n - back]:
        n += 1
    return n


@njit(cache=True, nogil=True)
def _put(value, num_bits, out, place, hold, held):  # type: ignore[no-untyped-def]
    """Write up to 56 bits."""
    hold |= np.uint64(value) << np.uint64(held)
    held += num_bits
    out[place] = hold
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
def _write_tokens(tokens, codes, lengths, tails, out, place, hold, held):  # type: ignore[no-untyped-def]
    """Write tokens. tails: what follows the length of a repetition of the pixel before, its bits; the same of the one above."""
    near_tail, near_bits, above_tail, above_bits = tails
    entries = np.empty(256, np.uint64)
    for s in range(256):
        entries[s] = codes[s] << 4 | lengths[s]
    at, num, four, low = np.uint64(0), np.uint64(len(tokens)), np.uint64(4), np.uint64(15)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    while at < num:
        if at + four <= num:  # four literals together
            a, b, c, d = tokens[at], tokens[at + one], tokens[at + two], tokens[at + three]
            if a | b | c | d < REPEATS:
                w, x, y, z = entries[np.uint64(a)], entries[np.uint64(b)], entries[np.uint64(c)], entries[np.uint64(d)]
                first = w >> four | x >> four << (w & low)
                second = y >> four | z >> four << (y & low)
                word, width = first | second << ((w & low) + (x & low)), (w & low) + (x & low) + (y & low) + (z & low)
                place, hold, held = _put(word, np.int64(width), out, place, hold, held)
                at += four
                continue
        token = tokens[at]
        at += one
        if token < REPEATS:
            place, hold, held = _put(codes[token], lengths[token], out, place, hold, held)
        else:
            length = np.int64(token & LENGTH_BITS)
            s = SYMBOL_OF_LENGTH[length]
            value, num_bits = (
                codes[s] | (length - BASE_LENGTH[s - 257]) << lengths[s],
                lengths[s] + MORE_LENGTH[s - 257],
            )
            is_above = token & IS_ABOVE != 0
            value |= (above_tail if is_above else near_tail) << num_bits
            num_bits += above_bits if is_above else near_bits
            place, hold, held = _put(value, num_bits, out, place, hold, held)
    return place, hold, held
