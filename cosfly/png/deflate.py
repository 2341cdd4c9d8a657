"""Packing the filtered rows of a picture (RFC 1950, 1951), made for what a renderer draws.

Only two places are looked at for a repetition: one pixel before, and one row above. Everything else is left to the Huffman codes,
which each block has of its own.
"""

from __future__ import annotations

import numpy as np

from cosfly.compiled import njit, words_of
from cosfly.png.checksum import adler32
from cosfly.png.huffman import BASE_LENGTH, BASE_WAY, LENGTH_ORDER, MORE_LENGTH, MORE_WAY, code_lengths, codes_of

BLOCK_TOKENS = 1 << 16
BLOCK_HEAD_BYTES = 1024  # more than the lengths of all codes of a block take
LONGEST, WINDOW = 258, 32768
SHORTEST = 4  # bytes of a repetition; of fewer the codes are shorter
END = 256  # the symbol behind a block's last
# A token is a byte, or a repetition: these marks and its length.
REPEATS, IS_ABOVE, LENGTH_BITS = np.uint32(1 << 16), np.uint32(1 << 15), np.uint32(511)
SYMBOL_OF_LENGTH = np.zeros(LONGEST + 1, np.int64)
for _s, _base in enumerate(BASE_LENGTH.tolist()):
    SYMBOL_OF_LENGTH[_base:] = END + 1 + _s


def deflate(lines: np.ndarray, near: int, above: int) -> bytes:
    """Pack rows, (h, stride) uint8, as a zlib stream.

    Args:
        near, above: how many bytes back the pixel before and the one above stand; above 0: nothing repeats there.
    """
    data = np.zeros(lines.size + 8, np.uint8)
    data[:-8] = lines.reshape(-1)
    # Codes of one optimal code take 9 bits a byte at most.
    out = np.empty(lines.size * 9 // 8 + BLOCK_HEAD_BYTES * (2 + lines.size // BLOCK_TOKENS), np.uint8)
    out[:2] = 0x78, 0x01
    end = _pack(data, words_of(data), near, above if above < WINDOW else 0, words_of(out))
    return b"".join((out[:end].data, adler32(lines).to_bytes(4, "big")))


@njit(cache=True, nogil=True)
def _pack(data, words, near, above, out):  # type: ignore[no-untyped-def]
    """Write all blocks, from the third byte of `out` on; gives where the stream ends. data: the rows and eight bytes more."""
    tokens = np.empty(BLOCK_TOKENS, np.uint32)
    counts = np.zeros(286, np.int64)
    size, at, is_last = len(data) - 8, np.int64(0), False
    place, hold, held = np.int64(2), np.uint64(0), np.int64(0)  # whole bytes in `out`, and the `held` bits behind them
    while not is_last:
        at, num_tokens = _tokenise(data, words, at, size, near, above, tokens, counts)
        is_last = at == size
        counts[END] = 1
        lengths = code_lengths(counts, np.int64(15))
        # Ways are two at most, of one bit each.
        ways = np.zeros(30, np.int64)
        near_way, above_way = _way_of(near), _way_of(above)
        ways[near_way] = ways[above_way] = 1
        place, hold, held = _put(np.int64(is_last) | 2 << 1, np.int64(3), out, place, hold, held)
        place, hold, held = _write_lengths(lengths, ways, out, place, hold, held)
        codes, is_second = codes_of(lengths), np.int64(above_way > near_way)
        near_tail = (1 - is_second) | (near - BASE_WAY[near_way]) << 1
        above_tail = is_second | (above - BASE_WAY[above_way]) << 1
        tails = (near_tail, 1 + MORE_WAY[near_way], above_tail, 1 + MORE_WAY[above_way])
        place, hold, held = _write_tokens(tokens[:num_tokens], codes, lengths, tails, out, place, hold, held)
        place, hold, held = _put(codes[END], lengths[END], out, place, hold, held)
    return place + (held + 7 >> 3)


@njit(cache=True, nogil=True)
def _way_of(back):  # type: ignore[no-untyped-def]
    """The symbol of a way back."""
    way = np.int64(0)
    while way + 1 < len(BASE_WAY) and BASE_WAY[way + 1] <= back:
        way += 1
    return way


@njit(cache=True, nogil=True)
def _tokenise(data, words, at, size, near, above, tokens, counts):  # type: ignore[no-untyped-def]
    """Fill a block with tokens and count their symbols. Gives how far it came, and how many they are."""
    counts.fill(0)
    n = np.int64(0)
    four = np.uint64(0xFFFFFFFF)
    while n < len(tokens) and at < size:
        length, marks = np.int64(0), REPEATS
        if at >= near and (words[at] ^ words[at - near]) & four == 0:
            length = _num_same(data, words, at, near, size)
        if above > 0 and at >= above and length < LONGEST and words[at] == words[at - above]:
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
    for token in tokens:
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
