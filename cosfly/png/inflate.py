"""Unpacking deflate streams into a place that they must fill (RFC 1951): several literals at a look, repetitions eight bytes at a time.

Everywhere below, `hold` has the next `held` bits of the source, lowest first, and `position` is the byte behind them; words[k] are the
eight bytes from the k-th on. A function that finds the stream broken gives a negative place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosfly.compiled import int64, njit, words_of
from cosfly.png.huffman import BASE_LENGTH, BASE_WAY, LENGTH_ORDER, MORE_LENGTH, MORE_WAY

LOOK_BITS = 11
LOOK = np.uint64((1 << LOOK_BITS) - 1)
LOOKS = 56 // LOOK_BITS  # in the bits that one fetch has at least
MOST_AT_ONCE = 3  # literals of a look
SPARE = 32  # bytes behind what a stream fills, which looks and copies may write
STORED, FIXED, OWN = 0, 1, 2  # forms of a block
END = 256
MOST_LITERALS, MOST_WAYS = 286, 30
BROKEN = np.int64(-1)


class Code(NamedTuple):
    """A Huffman code. table (2 ** LOOK_BITS,) uint16: symbol * 16 + length by the next bits, 0 for what is longer, which is found by
    symbols, in the order of their codes, and by length: ends, the first code that is longer, from the left in 16 bits; firsts, what a
    code of that length is less than its place in symbols."""

    table: np.ndarray
    symbols: np.ndarray
    ends: np.ndarray
    firsts: np.ndarray


def inflate(packed: bytes, start: int, size: int) -> tuple[np.ndarray, int]:
    """Unpack the stream that begins at a byte.

    Returns:
        (size,) uint8, and where the stream ends, negative if it is broken or does not fill the size.
    """
    out = np.empty(size + SPARE, np.uint8)
    source, room = np.frombuffer(packed, np.uint8), out[:size]
    if len(source) < 8:
        return room, -1
    return room, int(_blocks(source, words_of(source), start, out, words_of(out)))


@njit(cache=True, nogil=True)
def _blocks(source, words, position, out, out_words):  # type: ignore[no-untyped-def]
    room, at, is_last = len(out) - SPARE, np.int64(0), False
    hold, held = np.uint64(0), np.int64(0)
    lengths = np.zeros(MOST_LITERALS + MOST_WAYS + 4, np.int64)
    literal, way = _new_code(), _new_code()
    runs = np.zeros(1 << LOOK_BITS, np.uint32)
    while not is_last:
        position, hold, held = _fetch(source, words, position, hold, held)
        is_last = hold & np.uint64(1) != 0
        form = np.int64(hold >> np.uint64(1) & np.uint64(3))
        hold, held = hold >> np.uint64(3), held - 3
        if held < 0:
            return BROKEN
        if form == STORED:
            position, at = _copy_stored(source, position - (held >> 3), out, at, room)
            hold, held = np.uint64(0), np.int64(0)
        elif form == FIXED:
            _fixed_codes(lengths, literal, way)
        elif form == OWN:
            position, hold, held = _own_codes(source, words, position, hold, held, lengths, literal, way)
        if position < 0 or form > OWN:
            return BROKEN
        if form != STORED:
            _find_runs(literal.table, runs)
            position, hold, held, at = _symbols(source, words, position, hold, held, out, out_words, at, room, literal, runs, way)  # fmt: skip
            if position < 0:
                return BROKEN
    return position - (held >> 3) if at == room and held >= 0 else BROKEN


@njit(cache=True, nogil=True, inline="always")
def _fetch(source, words, position, hold, held):  # type: ignore[no-untyped-def]
    """Fetch bits: 56 and more, or all that are left. Above `held` stand those that come next, or none: or-ing them again changes nothing."""
    if position < len(words):
        return position + (63 - held >> 3), hold | words[position] << np.uint64(held), held | 56
    while held <= 48 and position < len(source):
        hold |= np.uint64(source[position]) << np.uint64(held)
        position += 1
        held += 8
    return position, hold, held


# --- codes ------------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _new_code():  # type: ignore[no-untyped-def]
    table, symbols = np.zeros(1 << LOOK_BITS, np.uint16), np.zeros(MOST_LITERALS + MOST_WAYS, np.int64)
    return Code(table, symbols, np.zeros(16, np.int64), np.zeros(16, np.int64))


@njit(cache=True, nogil=True)
def _fill(code, lengths):  # type: ignore[no-untyped-def]
    """Fill the tables of a code of these lengths; False where they are none."""
    table, symbols, ends, firsts = code
    counts = np.zeros(16, np.int64)
    for length in lengths:
        counts[length] += length > 0
    starts, codes = np.zeros(17, np.int64), np.zeros(17, np.int64)
    left, word = np.int64(1), np.int64(0)
    for n in range(1, 16):
        left = left * 2 - counts[n]
        if left < 0:
            return False
        starts[n + 1] = starts[n] + counts[n]
        word = word + counts[n - 1] << 1
        codes[n] = word
        ends[n] = word + counts[n] << 16 - n
        firsts[n] = starts[n] - word
    table.fill(0)
    for s in range(len(lengths)):
        n = lengths[s]
        if n == 0:
            continue
        symbols[starts[n]] = s
        starts[n] += 1
        if n <= LOOK_BITS:
            turned, word = np.int64(0), codes[n]
            for _ in range(n):
                turned = turned << 1 | word & 1
                word >>= 1
            for at in range(turned, len(table), 1 << n):
                table[at] = s * 16 + n
        codes[n] += 1
    return True


@njit(cache=True, nogil=True)
def _find_runs(table, runs):  # type: ignore[no-untyped-def]
    """Of the next bits, the up to three literals that they begin with: bits, how many (16s), the bytes (256s); 0 where there is none."""
    for at in range(len(table)):
        word, used, num, rest = np.int64(0), np.int64(0), 0, np.int64(at)
        while num < MOST_AT_ONCE:
            entry = np.int64(table[rest])
            width = entry & 15
            if entry == 0 or entry >> 4 >= END or used + width > LOOK_BITS:
                break
            word |= entry >> 4 << (8 + 8 * num)
            used, num, rest = used + width, num + 1, rest >> width
        runs[at] = word | num << 4 | used


@njit(cache=True, nogil=True, inline="always")
def _next(hold, code):  # type: ignore[no-untyped-def]
    """The next symbol * 16 + its length, -1 where the bits are no code."""
    entry = np.int64(code.table[np.int64(hold & LOOK)])
    return entry if entry != 0 else _next_long(hold, code)


@njit(cache=True, nogil=True)
def _next_long(hold, code):  # type: ignore[no-untyped-def]
    """As `_next`, of codes that are longer than a look: those of each length follow each other, read from the left."""
    word = np.int64(hold & np.uint64(0xFFFF))
    word = (word & 0x5555) << 1 | word >> 1 & 0x5555
    word = (word & 0x3333) << 2 | word >> 2 & 0x3333
    word = (word & 0x0F0F) << 4 | word >> 4 & 0x0F0F
    word = (word & 0x00FF) << 8 | word >> 8
    for n in range(LOOK_BITS + 1, 16):
        if word < code.ends[n]:
            return code.symbols[code.firsts[n] + (word >> 16 - n)] * 16 + n
    return BROKEN


@njit(cache=True, nogil=True)
def _fixed_codes(lengths, literal, way):  # type: ignore[no-untyped-def]
    for s in range(288):
        lengths[s] = 8 if s < 144 else 9 if s < 256 else 7 if s < 280 else 8
    _fill(literal, lengths[:288])
    lengths.fill(5)
    _fill(way, lengths[:MOST_WAYS])


@njit(cache=True, nogil=True)
def _own_codes(source, words, position, hold, held, lengths, literal, way):  # type: ignore[no-untyped-def]
    """Read the codes of a block."""
    position, hold, held = _fetch(source, words, position, hold, held)
    num_literals = np.int64(hold & np.uint64(31)) + 257
    num_ways = np.int64(hold >> np.uint64(5) & np.uint64(31)) + 1
    num_lengths = np.int64(hold >> np.uint64(10) & np.uint64(15)) + 4
    hold, held = hold >> np.uint64(14), held - 14
    broken = BROKEN, hold, held
    if held < 0 or num_literals > MOST_LITERALS or num_ways > MOST_WAYS:
        return broken
    lengths.fill(0)
    for k in range(num_lengths):
        position, hold, held = _fetch(source, words, position, hold, held)
        lengths[LENGTH_ORDER[k]] = np.int64(hold & np.uint64(7))
        hold, held = hold >> np.uint64(3), held - 3
    if not _fill(literal, lengths[: len(LENGTH_ORDER)]):
        return broken
    at, total = np.int64(0), num_literals + num_ways
    while at < total:
        position, hold, held = _fetch(source, words, position, hold, held)
        entry = _next(hold, literal)
        if entry < 0 or (held < (entry & 15) + 7 and position < len(source)):
            return broken
        hold, held = hold >> np.uint64(entry & 15), held - (entry & 15)
        value, times, used = _repeated(entry >> 4, hold, lengths[at - 1] if at > 0 else BROKEN)
        hold, held = hold >> np.uint64(used), held - used
        if value < 0 or held < 0 or at + times > total:
            return broken
        for _ in range(times):
            lengths[at] = value
            at += 1
    if not _fill(literal, lengths[:num_literals]) or not _fill(way, lengths[num_literals:total]):
        return broken
    return position, hold, held


@njit(cache=True, nogil=True)
def _repeated(symbol, hold, before):  # type: ignore[no-untyped-def]
    """What a symbol of the table of lengths stands for: a length, how often, bits that told it."""
    if symbol < 16:
        return symbol, int64(1), int64(0)
    if symbol == 16:
        return before, 3 + np.int64(hold & np.uint64(3)), int64(2)
    if symbol == 17:
        return int64(0), 3 + np.int64(hold & np.uint64(7)), int64(3)
    return int64(0), 11 + np.int64(hold & np.uint64(127)), int64(7)


# --- bytes ------------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _copy_stored(source, position, out, at, room):  # type: ignore[no-untyped-def]
    """Copy a block that is not packed; gives where it ends in the source and in `out`."""
    if position + 4 > len(source):
        return BROKEN, at
    n = np.int64(source[position]) | np.int64(source[position + 1]) << 8
    check = np.int64(source[position + 2]) | np.int64(source[position + 3]) << 8
    position += 4
    if n != check ^ 0xFFFF or position + n > len(source) or at + n > room:
        return BROKEN, at
    for k in range(n):
        out[at + k] = source[position + k]
    return position + n, at + n


@njit(cache=True, nogil=True)
def _symbols(source, words, position, hold, held, out, out_words, at, room, literal, runs, way):  # type: ignore[no-untyped-def]
    """Unpack a block's symbols up to its end."""
    broken = BROKEN, hold, held, at
    while True:
        position, hold, held, at = _literals(words, position, hold, held, out_words, at, room, runs)
        position, hold, held = _fetch(source, words, position, hold, held)
        entry = _next(hold, literal)
        s = entry >> 4
        hold, held = hold >> np.uint64(entry & 15), held - (entry & 15)
        if entry < 0 or held < 0 or s >= MOST_LITERALS:
            return broken
        if s == END:
            return position, hold, held, at
        if s < END:
            out[at] = s
            at += 1
        else:
            n, hold, held = _more(hold, held, BASE_LENGTH[s - 257], MORE_LENGTH[s - 257])
            position, hold, held = _fetch(source, words, position, hold, held)
            entry = _next(hold, way)
            s = entry >> 4
            if entry < 0 or s >= MOST_WAYS:
                return broken
            hold, held = hold >> np.uint64(entry & 15), held - (entry & 15)
            back, hold, held = _more(hold, held, BASE_WAY[s], MORE_WAY[s])
            if held < 0 or back > at or at + n > room:
                return broken
            _repeat(out_words, at, back, n)
            at += n
        if at > room:
            return broken


@njit(cache=True, nogil=True, inline="always")
def _literals(words, position, hold, held, out_words, at, room, runs):  # type: ignore[no-untyped-def]
    """Unpack literals while their codes are short."""
    while position < len(words) and at <= room:
        hold |= words[position] << np.uint64(held)
        position += 63 - held >> 3
        held |= 56
        for _ in range(LOOKS):
            run = runs[hold & LOOK]
            if run == 0:
                return position, hold, held, at
            out_words[at] = run >> 8  # zeros behind them, where the next ones come
            at += np.int64(run >> 4 & 3)
            hold >>= np.uint64(run & 15)
            held -= np.int64(run & 15)
    return position, hold, held, at


@njit(cache=True, nogil=True, inline="always")
def _more(hold, held, base, num_bits):  # type: ignore[no-untyped-def]
    """A number and the bits that are added to it."""
    value = base + np.int64(hold & (np.uint64(1) << np.uint64(num_bits)) - np.uint64(1))
    return value, hold >> np.uint64(num_bits), held - num_bits


@njit(cache=True, nogil=True, inline="always")
def _repeat(out_words, at, back, n):  # type: ignore[no-untyped-def]
    """Write again the `n` bytes that stand so far back; some more are written behind them.

    What stands less than a word back is written from a register: reading bytes that were written just now waits until they are in the cache.
    """
    if back >= 32:
        for k in range(at, at + n, 32):
            one, two, three, four = out_words[k - back], out_words[k - back + 8], out_words[k - back + 16], out_words[k - back + 24]  # fmt: skip
            out_words[k], out_words[k + 8], out_words[k + 16], out_words[k + 24] = one, two, three, four
    elif back >= 8:
        for k in range(at, at + n, 8):
            out_words[k] = out_words[k - back]
    else:
        pattern, filled = out_words[at - back] & (np.uint64(1) << np.uint64(8 * back)) - np.uint64(1), back
        while filled < 8:
            pattern |= pattern << np.uint64(8 * filled)
            filled *= 2
        for k in range(at, at + n, back * (8 // back)):  # whole repetitions
            out_words[k] = pattern
