"""Huffman codes of deflate (RFC 1951): the numbers of its tables, codes for writing, tables for reading."""

from __future__ import annotations

import numpy as np

from cosfly.work.compiled import njit

END = 256  # the symbol behind a block's last
MOST_LITERALS, MOST_WAYS = 286, 30
LOOK_BITS = 11
LOOK = np.uint64((1 << LOOK_BITS) - 1)
MOST_AT_ONCE = 3  # literals of a look
BROKEN = np.int64(-1)

BASE_LENGTH = np.array([3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258], np.int64)  # fmt: skip
MORE_LENGTH = np.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0], np.int64)  # fmt: skip
BASE_WAY = np.array([1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129, 193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577], np.int64)  # fmt: skip
MORE_WAY = np.array([0, 0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13, 13], np.int64)  # fmt: skip
LENGTH_ORDER = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15], np.int64)


# --- for writing ------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def code_lengths(counts, most):  # type: ignore[no-untyped-def]
    """Lengths of the best code for symbols of these counts, none above `most` bits; 0 for what does not occur, 1 bit where it is alone.

    Source: packages of symbols, Larmore and Hirschberg 1990. A list has all symbols and the pairs of the list before, by weight; a
    symbol's length is how often it stands in the first 2 k - 2 of the last list, alone or within pairs.
    """
    order, k = _ordered(counts)
    lengths = np.zeros(len(counts), np.int64)
    if k <= 1:
        lengths[order[0]] = k
        return lengths
    weights, pairs, num_pairs = np.empty(2 * k, np.int64), np.empty(k, np.int64), np.int64(0)
    is_symbol = np.zeros((most, 2 * k), np.bool_)
    for level in range(most):
        leaf, pair = np.int64(0), np.int64(0)
        for at in range(k + num_pairs):
            if pair == num_pairs or (leaf < k and counts[order[leaf]] <= pairs[pair]):
                weights[at], is_symbol[level, at] = counts[order[leaf]], True
                leaf += 1
            else:
                weights[at] = pairs[pair]
                pair += 1
        num_pairs = k + num_pairs >> 1
        for at in range(num_pairs):
            pairs[at] = weights[2 * at] + weights[2 * at + 1]
    num = 2 * k - 2
    for level in range(most - 1, -1, -1):
        num_symbols = np.int64(0)
        for at in range(num):
            num_symbols += is_symbol[level, at]
        for at in range(num_symbols):
            lengths[order[at]] += 1
        num = 2 * (num - num_symbols)
    return lengths


@njit(cache=True, nogil=True)
def _ordered(weights):  # type: ignore[no-untyped-def]
    """Symbols that occur, from the rarest on, of equal ones the first before; and how many they are."""
    order, num = np.zeros(len(weights), np.int64), 0
    for s in range(len(weights)):
        if weights[s] > 0:
            at, num = num, num + 1
            while at > 0 and weights[order[at - 1]] > weights[s]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = s
    return order, num


@njit(cache=True, nogil=True)
def codes_of(lengths):  # type: ignore[no-untyped-def]
    """The codes of these lengths, first bit lowest, as they are written."""
    counts, codes = np.zeros(17, np.int64), np.zeros(len(lengths), np.int64)
    for length in lengths:
        counts[length + 1] += length > 0
    next_code = np.zeros(17, np.int64)
    for bits in range(2, 17):
        next_code[bits] = (next_code[bits - 1] + counts[bits]) << 1
    for s in range(len(lengths)):
        n = lengths[s]
        if n > 0:
            word, turned = next_code[n], np.int64(0)
            next_code[n] += 1
            for _ in range(n):
                turned = turned << 1 | word & 1
                word >>= 1
            codes[s] = turned
    return codes


# --- for reading ------------------------------------------------------------------------------------------------------


# A code for reading is a row of three arrays. tables (n, 2 ** LOOK_BITS) uint16: symbol * 16 + length by the next bits, 0 for what is longer,
# which is found by symbols (n, m), in the order of their codes, and by length: limits (n, 2, 16), the first code that is longer,
# from the left in 16 bits, and what a code of that length is less than its place in symbols.


@njit(cache=True, nogil=True)
def fill(tables, symbols, limits, row, lengths):  # type: ignore[no-untyped-def]
    """Fill a row with the code of these lengths; False where they are none."""
    table = tables[row]
    counts = np.zeros(16, np.int64)
    for length in lengths:
        counts[length] += length > 0
    starts, nexts = np.zeros(17, np.int64), np.zeros(17, np.int64)
    left, word = np.int64(1), np.int64(0)
    for n in range(1, 16):
        left = left * 2 - counts[n]
        if left < 0:
            return False
        starts[n + 1] = starts[n] + counts[n]
        word = word + counts[n - 1] << 1
        nexts[n] = word
        limits[row, 0, n] = word + counts[n] << 16 - n
        limits[row, 1, n] = starts[n] - word
    table.fill(0)
    for s in range(len(lengths)):
        n = lengths[s]
        if n == 0:
            continue
        symbols[row, starts[n]] = s
        starts[n] += 1
        if n <= LOOK_BITS:
            turned, word = np.int64(0), nexts[n]
            for _ in range(n):
                turned = turned << 1 | word & 1
                word >>= 1
            for at in range(turned, len(table), 1 << n):
                table[at] = s * 16 + n
        nexts[n] += 1
    return True


@njit(cache=True, nogil=True)
def fill_fixed(tables, symbols, limits, rows, lengths):  # type: ignore[no-untyped-def]
    """Fill two rows with the codes of literals and of ways of a block that has none of its own."""
    for s in range(288):
        lengths[s] = 8 if s < 144 else 9 if s < 256 else 7 if s < 280 else 8
    fill(tables, symbols, limits, rows[0], lengths[:288])
    lengths.fill(5)
    fill(tables, symbols, limits, rows[1], lengths[:MOST_WAYS])


@njit(cache=True, nogil=True)
def find_runs(table, runs):  # type: ignore[no-untyped-def]
    """Of the next bits, the up to three literals that they begin with: the bytes, bits (RUN_BITS), how many (64s of these); 0 where there is none."""
    for at in range(len(table)):
        word, used, num, rest = np.int64(0), np.int64(0), 0, np.int64(at)
        while num < MOST_AT_ONCE:
            entry = np.int64(table[rest])
            width = entry & 15
            if entry == 0 or entry >> 4 >= END or used + width > LOOK_BITS:
                break
            word |= entry >> 4 << 8 * num
            used, num, rest = used + width, num + 1, rest >> width
        runs[at] = word | (num << 6 | used) << 24


@njit(cache=True, nogil=True, inline="always")
def next_symbol(hold, tables, symbols, limits, row):  # type: ignore[no-untyped-def]
    """The next symbol * 16 + its length, -1 where the bits are no code."""
    entry = np.int64(tables[row, hold & LOOK])
    return entry if entry != 0 else next_long(hold, symbols, limits, row)


@njit(cache=True, nogil=True)
def next_long(hold, symbols, limits, row):  # type: ignore[no-untyped-def]
    """As `next_symbol`, of codes that are longer than a look: those of each length follow each other, read from the left."""
    word = np.int64(hold & np.uint64(0xFFFF))
    word = (word & 0x5555) << 1 | word >> 1 & 0x5555
    word = (word & 0x3333) << 2 | word >> 2 & 0x3333
    word = (word & 0x0F0F) << 4 | word >> 4 & 0x0F0F
    word = (word & 0x00FF) << 8 | word >> 8
    for n in range(LOOK_BITS + 1, 16):
        if word < limits[row, 0, n]:
            return symbols[row, limits[row, 1, n] + (word >> 16 - n)] * 16 + n
    return BROKEN
