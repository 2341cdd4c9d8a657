"""Unpacking deflate streams into a place that they must fill (RFC 1951): several literals at a look, repetitions eight bytes at a time.

A stream can be given as bands: parts that begin at a byte of the source, fill a part of the place that is known, and repeat nothing
from before it. Three of them are unpacked in turns, so that one's look into its table hides the others'. A band must end where
the next one begins, in the source and in the place: then what all give is what the stream gives from its beginning on.

Everywhere below, `hold` has the next `held` bits of the source, lowest first, and `position` is the byte behind them. A
function that finds the stream broken gives a negative position, or False.
"""

from __future__ import annotations

import numpy as np

from cosfly.png.huffman import (
    BASE_LENGTH,
    BASE_WAY,
    BROKEN,
    END,
    LENGTH_ORDER,
    LOOK,
    LOOK_BITS,
    MORE_LENGTH,
    MORE_WAY,
    MOST_LITERALS,
    MOST_WAYS,
    fill,
    fill_fixed,
    find_runs,
    next_symbol,
)  # fmt: skip
from cosfly.work.compiled import int64, njit, put_word, word_at

LANES = 3  # bands that are unpacked in turns
LOOKS = 56 // LOOK_BITS  # in the bits that one fetch has at least
SPARE = 32  # bytes that looks and copies may write behind theirs; nearer to the end of a band they go byte by byte
STORED, FIXED, OWN = 0, 1, 2  # forms of a block
# What a lane has: its band, negative where none is left, and where that begins and ends in `out`; whether it is between two blocks, and whether
# the one that it reads is the stream's last. How far it is, unsigned: of a signed index numba looks whether it counts from the end.
BAND, FIRST, BEHIND, IS_BETWEEN, IS_LAST = range(5)
POSITION, HOLD, HELD, AT = range(4)
NEXT, OPEN, USED = 0, 1, 2  # in a tally: the band that is taken next, lanes that have one, where the stream ends
FAR = np.uint64(258 << 6)  # 64 times the bytes of the longest repetition
ZERO, ONE, TWO, THREE, SIX, EIGHT, SIXTEEN, THIRTY_TWO, FETCHED, FULL = (np.uint64(n) for n in (0, 1, 2, 3, 6, 8, 16, 32, 56, 63))  # fmt: skip
RUN_BITS = np.uint64(24)  # of an entry of `runs`, before its numbers
# The row of `tables` where ways begin; bytes of a row, as a power of two; what eight bytes have of an entry.
WAYS, TABLE_BITS, ENTRY = np.uint64(LANES), np.uint64(LOOK_BITS + 1), np.uint64(0xFFFF)


def inflate(packed: bytes | memoryview, starts: np.ndarray, ends: np.ndarray, bounds: np.ndarray) -> tuple[np.ndarray, int]:  # fmt: skip
    """Unpack a stream of one band or several.

    Args:
        starts, ends: (n,) int64, where each band begins and ends in `packed`; of the last, bytes behind its stream count.
        bounds: (n + 1,) int64, where each begins in what is unpacked, and the size of it all.
    Returns:
        (size,) uint8, and where the stream ends, negative if it is broken, does not fill the size or has no such bands.
    """
    source, room = np.frombuffer(packed, np.uint8), np.empty(bounds[-1], np.uint8)
    source.flags.writeable = False  # whosever bytes they are: compiled for such, once
    if len(source) < 8:
        return room, -1
    return room, int(_unpack(source, starts, ends, bounds, room))


@njit(cache=True, nogil=True)
def _unpack(source, starts, ends, bounds, out):  # type: ignore[no-untyped-def]
    lanes, flow, tally = np.full((LANES, 5), -1, np.int64), np.zeros((LANES, 4), np.uint64), np.zeros(3, np.int64)
    # Codes of literals by lane, then of ways, and a row of nothing, as entries are read as words; of each lane, the up to three literals
    # that the next bits begin with.
    tables, symbols = np.zeros((2 * LANES + 1, 1 << LOOK_BITS), np.uint16), np.zeros((2 * LANES, MOST_LITERALS + MOST_WAYS), np.int64)  # fmt: skip
    limits, runs = np.zeros((2 * LANES, 2, 16), np.int64), np.zeros((LANES, 1 << LOOK_BITS), np.uint32)
    lengths = np.zeros(MOST_LITERALS + MOST_WAYS + 4, np.int64)
    for lane in range(LANES):
        _take(lanes, flow, tally, lane, starts, bounds)
    while tally[OPEN] > 0:
        one = np.int64(0)
        for lane in range(LANES):
            if lanes[lane, IS_BETWEEN] == 1 and not _next_block(source, lanes, flow, tally, lane, tables, symbols, limits, runs, lengths, starts, ends, bounds, out):  # fmt: skip
                return BROKEN
            if lanes[lane, BAND] >= 0:
                one = np.int64(lane)
        first, num = (int64(0), int64(LANES)) if tally[OPEN] == LANES else (one, int64(1))
        if tally[OPEN] > 0 and not _symbols(source, lanes, flow, first, num, tables, symbols, limits, runs, out):  # fmt: skip
            return BROKEN
    return tally[USED]


@njit(cache=True, nogil=True)
def _take(lanes, flow, tally, lane, starts, bounds):  # type: ignore[no-untyped-def]
    """Let a lane begin the next band, or close it where there is none."""
    band, had_one = tally[NEXT], lanes[lane, BAND] >= 0
    has_one = band < len(starts)
    tally[OPEN] += np.int64(has_one) - np.int64(had_one)
    lanes[lane, BAND], lanes[lane, IS_BETWEEN] = BROKEN, 0
    if has_one:
        tally[NEXT] = band + 1
        lanes[lane, BAND], lanes[lane, FIRST], lanes[lane, BEHIND] = band, bounds[band], bounds[band + 1]
        lanes[lane, IS_BETWEEN], lanes[lane, IS_LAST] = 1, 0
        flow[lane, POSITION], flow[lane, HOLD], flow[lane, HELD], flow[lane, AT] = starts[band], 0, 0, bounds[band]


@njit(cache=True, nogil=True)
def _next_block(source, lanes, flow, tally, lane, tables, symbols, limits, runs, lengths, starts, ends, bounds, out):  # type: ignore[no-untyped-def]
    """Read the head of a lane's next block, whose codes it then has; where its band is done, of the next band's first."""
    while lanes[lane, BAND] >= 0:
        position, hold, held, at = np.int64(flow[lane, POSITION]), flow[lane, HOLD], np.int64(flow[lane, HELD]), np.int64(flow[lane, AT])  # fmt: skip
        is_end, is_end_of_all = at == lanes[lane, BEHIND], lanes[lane, BAND] == len(starts) - 1
        if lanes[lane, IS_LAST] == 1:
            tally[USED] = position - (held >> 3)
            _take(lanes, flow, tally, lane, starts, bounds)
            return is_end and is_end_of_all
        if is_end and not is_end_of_all and held == 0 and position == ends[lanes[lane, BAND]]:
            _take(lanes, flow, tally, lane, starts, bounds)
            continue
        position, hold, held = _fetch(source, position, hold, held)
        lanes[lane, IS_LAST], form = np.int64(hold & ONE), np.int64(hold >> ONE & THREE)
        hold, held = hold >> THREE, held - 3
        if held < 0 or form > OWN:
            return False
        if form == STORED:
            position, at = _copy_stored(source, position - (held >> 3), out, at, lanes[lane, BEHIND])
            if position < 0:
                return False
            flow[lane, POSITION], flow[lane, HOLD], flow[lane, HELD], flow[lane, AT] = position, 0, 0, at
            continue
        if form == FIXED:
            fill_fixed(tables, symbols, limits, (lane, LANES + lane), lengths)
        else:
            position, hold, held = _own_codes(source, position, hold, held, tables, symbols, limits, (lane, LANES + lane), lengths)  # fmt: skip
        if position < 0:
            return False
        find_runs(tables[lane], runs[lane])
        flow[lane, POSITION], flow[lane, HOLD], flow[lane, HELD], lanes[lane, IS_BETWEEN] = position, hold, held, 0
        return True
    return True


@njit(cache=True, nogil=True, inline="always")
def _fetch(source, position, hold, held):  # type: ignore[no-untyped-def]
    """Fetch bits: 56 and more, or all that are left. Above `held` stand those that come next, or none: or-ing them again changes nothing."""
    if position + 8 <= len(source):
        word = word_at(source.ctypes.data + np.uint64(position))
        return position + (63 - held >> 3), hold | word << np.uint64(held), held | 56
    while held <= 48 and position < len(source):
        hold |= np.uint64(source[position]) << np.uint64(held)
        position += 1
        held += 8
    return position, hold, held


@njit(cache=True, nogil=True)
def _own_codes(source, position, hold, held, tables, symbols, limits, rows, lengths):  # type: ignore[no-untyped-def]
    """Read the codes of a block."""
    position, hold, held = _fetch(source, position, hold, held)
    num_literals = np.int64(hold & np.uint64(31)) + 257
    num_ways = np.int64(hold >> np.uint64(5) & np.uint64(31)) + 1
    num_lengths = np.int64(hold >> np.uint64(10) & np.uint64(15)) + 4
    hold, held = hold >> np.uint64(14), held - 14
    broken = BROKEN, hold, held
    if held < 0 or num_literals > MOST_LITERALS or num_ways > MOST_WAYS:
        return broken
    lengths.fill(0)
    for k in range(num_lengths):
        position, hold, held = _fetch(source, position, hold, held)
        lengths[LENGTH_ORDER[k]] = np.int64(hold & np.uint64(7))
        hold, held = hold >> np.uint64(3), held - 3
    if not fill(tables, symbols, limits, rows[0], lengths[: len(LENGTH_ORDER)]):
        return broken
    at, total = np.int64(0), num_literals + num_ways
    while at < total:
        position, hold, held = _fetch(source, position, hold, held)
        entry = next_symbol(hold, tables, symbols, limits, rows[0])
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
    if not fill(tables, symbols, limits, rows[0], lengths[:num_literals]) or not fill(
        tables, symbols, limits, rows[1], lengths[num_literals:total]
    ):
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


# --- symbols ----------------------------------------------------------------------------------------------------------
# `_symbols` takes nearly all of the time. What is inlined into it gets addresses, no arrays: numba would count their owners at each symbol.
# A lane is a tuple there: position, hold, held, and 64 times where it is in `out`, to which looks add the bits that they use up.


@njit(cache=True, nogil=True)
def _symbols(source, lanes, flow, first, num, tables, symbols, limits, runs, out):  # type: ignore[no-untyped-def]
    """Unpack symbols of one lane, or of all three in turns, until a block ends; False where there are none."""
    last, own = np.uint64(len(source) - 7), np.uint64(first)
    source_at, out_at, tables_at = source.ctypes.data, out.ctypes.data, tables.ctypes.data
    room_a, room_b, room_c = _room(lanes[first, BEHIND]), _room(lanes[1, BEHIND]), _room(lanes[2, BEHIND])
    first_a, first_b, first_c = lanes[first, FIRST], lanes[1, FIRST], lanes[2, FIRST]
    while True:
        a, run_a = (flow[first, POSITION], flow[first, HOLD], flow[first, HELD], flow[first, AT] << SIX), ONE
        if num == 1:
            while run_a != ZERO and a[0] < last and a[3] < room_a:
                a = _filled(a, source_at)
                for _ in range(LOOKS):
                    run_a = np.uint64(runs[own, a[1] & LOOK])
                    put_word(out_at + (a[3] >> SIX), run_a)
                    a = _moved(a, run_a)
                a, is_copied = _settled(a), ONE
                while run_a == ZERO and is_copied == ONE and a[0] < last and a[3] + FAR < room_a:
                    a, is_copied = _copied(a, own, first_a, source_at, out_at, tables_at)
                    run_a = np.uint64(runs[own, a[1] & LOOK])
        else:
            b, run_b = (flow[1, POSITION], flow[1, HOLD], flow[1, HELD], flow[1, AT] << SIX), ONE
            c, run_c = (flow[2, POSITION], flow[2, HOLD], flow[2, HELD], flow[2, AT] << SIX), ONE
            while (run_a != ZERO and run_b != ZERO and run_c != ZERO and a[0] < last and b[0] < last and c[0] < last
                    and a[3] < room_a and b[3] < room_b and c[3] < room_c):  # fmt: skip
                a, b, c = _filled(a, source_at), _filled(b, source_at), _filled(c, source_at)
                for _ in range(LOOKS):
                    run_a, run_b, run_c = np.uint64(runs[0, a[1] & LOOK]), np.uint64(runs[1, b[1] & LOOK]), np.uint64(runs[2, c[1] & LOOK])  # fmt: skip
                    put_word(out_at + (a[3] >> SIX), run_a)
                    put_word(out_at + (b[3] >> SIX), run_b)
                    put_word(out_at + (c[3] >> SIX), run_c)
                    a, b, c = _moved(a, run_a), _moved(b, run_b), _moved(c, run_c)
                a, b, c = _settled(a), _settled(b), _settled(c)
                if run_a == ZERO and a[0] < last and a[3] + FAR < room_a:
                    a, run_a = _copied(a, ZERO, first_a, source_at, out_at, tables_at)
                if run_b == ZERO and b[0] < last and b[3] + FAR < room_b:
                    b, run_b = _copied(b, ONE, first_b, source_at, out_at, tables_at)
                if run_c == ZERO and c[0] < last and c[3] + FAR < room_c:
                    c, run_c = _copied(c, TWO, first_c, source_at, out_at, tables_at)
            flow[1, POSITION], flow[1, HOLD], flow[1, HELD], flow[1, AT] = b[0], b[1], b[2], b[3] >> SIX
            flow[2, POSITION], flow[2, HOLD], flow[2, HELD], flow[2, AT] = c[0], c[1], c[2], c[3] >> SIX
        flow[first, POSITION], flow[first, HOLD], flow[first, HELD], flow[first, AT] = a[0], a[1], a[2], a[3] >> SIX
        for lane in range(first, first + num):
            hold, at = flow[lane, HOLD], flow[lane, AT] << SIX
            if flow[lane, POSITION] < last and at < _room(lanes[lane, BEHIND]) and runs[lane, hold & LOOK] != 0:
                continue  # another lane ended the turn
            if not _symbol(source, lanes, flow, lane, tables, symbols, limits, out):
                return False
            if lanes[lane, IS_BETWEEN] == 1:
                return True


@njit(cache=True, nogil=True, inline="always")
def _filled(a, source_at):  # type: ignore[no-untyped-def]
    position, hold, held, flown = a
    return position + (FULL - held >> THREE), hold | word_at(source_at + position) << held, held | FETCHED, flown


@njit(cache=True, nogil=True, inline="always")
def _moved(a, run):  # type: ignore[no-untyped-def]
    """Behind a run; one of 0 leaves a lane where it is, and so do all that follow."""
    position, hold, held, flown = a
    return position, hold >> (run >> RUN_BITS & FULL), held, flown + (run >> RUN_BITS)


@njit(cache=True, nogil=True, inline="always")
def _settled(a):  # type: ignore[no-untyped-def]
    """After looks: the bits that they used up are no longer held."""
    position, hold, held, flown = a
    return position, hold, held - (flown & FULL), flown & ~FULL


@njit(cache=True, nogil=True, inline="always")
def _copied(a, lane, first, source_at, out_at, tables_at):  # type: ignore[no-untyped-def]
    """Undo a repetition; 0 where the next bits begin with none whose codes are no longer than a look."""
    a = position, hold, held, flown = _filled(a, source_at)
    entry = _entry(tables_at, lane, hold)
    s, length = entry >> 4, np.uint64(entry & 15)
    if s <= END or s >= MOST_LITERALS:
        return a, ZERO
    n, hold, more = _more(hold >> length, BASE_LENGTH[s - 257], MORE_LENGTH[s - 257])
    held -= length + more
    entry = _entry(tables_at, lane + WAYS, hold)
    s, length = entry >> 4, np.uint64(entry & 15)
    if entry == 0 or s >= MOST_WAYS:
        return a, ZERO
    back, hold, more = _more(hold >> length, BASE_WAY[s], MORE_WAY[s])
    held -= length + more
    if back > np.int64(flown >> SIX) - first:
        return a, ZERO
    _repeat(out_at + (flown >> SIX), np.uint64(back), np.uint64(n))
    return (position, hold, held, flown + (np.uint64(n) << SIX)), ONE


@njit(cache=True, nogil=True, inline="always")
def _entry(tables_at, row, hold):  # type: ignore[no-untyped-def]
    """The next symbol * 16 + its length, 0 where that is longer than a look."""
    return np.int64(word_at(tables_at + (row << TABLE_BITS) + ((hold & LOOK) << ONE)) & ENTRY)


@njit(cache=True, nogil=True, inline="always")
def _room(behind):  # type: ignore[no-untyped-def]
    """64 times where a lane may no longer be written by words."""
    return np.uint64(max(behind - SPARE + 1, 0) << 6)


@njit(cache=True, nogil=True)
def _symbol(source, lanes, flow, lane, tables, symbols, limits, out):  # type: ignore[no-untyped-def]
    """Unpack any symbol of a lane, byte by byte, near an end of the source or of its band as well; False where there is none."""
    at, behind = np.int64(flow[lane, AT]), lanes[lane, BEHIND]
    position, hold, held = _fetch(source, np.int64(flow[lane, POSITION]), flow[lane, HOLD], np.int64(flow[lane, HELD]))
    entry = next_symbol(hold, tables, symbols, limits, lane)
    s = entry >> 4
    hold, held = hold >> np.uint64(entry & 15), held - (entry & 15)
    if entry < 0 or held < 0 or s >= MOST_LITERALS or (s < END and at >= behind):
        return False
    if s < END:
        out[at] = s
        at += 1
    elif s == END:
        lanes[lane, IS_BETWEEN] = 1
    else:
        n, hold, more = _more(hold, BASE_LENGTH[s - 257], MORE_LENGTH[s - 257])
        held -= np.int64(more)
        position, hold, held = _fetch(source, position, hold, held)
        entry = next_symbol(hold, tables, symbols, limits, LANES + lane)
        s = entry >> 4
        if entry < 0 or s >= MOST_WAYS:
            return False
        hold, held = hold >> np.uint64(entry & 15), held - (entry & 15)
        back, hold, more = _more(hold, BASE_WAY[s], MORE_WAY[s])
        held -= np.int64(more)
        if held < 0 or back > at - lanes[lane, FIRST] or at + n > behind:
            return False
        for k in range(at, at + n):
            out[k] = out[k - back]
        at += n
    flow[lane, POSITION], flow[lane, HOLD], flow[lane, HELD], flow[lane, AT] = position, hold, held, at
    return True


@njit(cache=True, nogil=True, inline="always")
def _more(hold, base, num_bits):  # type: ignore[no-untyped-def]
    """A number and the bits that are added to it; what is held behind them, and how many they are."""
    bits = np.uint64(num_bits)
    return base + np.int64(hold & (ONE << bits) - ONE), hold >> bits, bits


@njit(cache=True, nogil=True, inline="always")
def _repeat(place, back, n):  # type: ignore[no-untyped-def]
    """Write again, at an address, the `n` bytes that stand so far before it; some more are written behind them.

    What stands less than a word back is written from a register: reading bytes that were written just now waits until they are in the cache.
    """
    end = place + n
    if back >= THIRTY_TWO:
        while place < end:
            one, two = word_at(place - back), word_at(place - back + EIGHT)
            three, four = word_at(place - back + SIXTEEN), word_at(place - back + SIXTEEN + EIGHT)
            put_word(place, one)
            put_word(place + EIGHT, two)
            put_word(place + SIXTEEN, three)
            put_word(place + SIXTEEN + EIGHT, four)
            place += THIRTY_TWO
    elif back >= EIGHT:
        while place < end:
            put_word(place, word_at(place - back))
            place += EIGHT
    else:
        pattern, filled = word_at(place - back) & (ONE << (back << THREE)) - ONE, back
        while filled < EIGHT:
            pattern |= pattern << (filled << THREE)
            filled += filled
        step = back * (EIGHT // back)  # whole repetitions
        while place < end:
            put_word(place, pattern)
            place += step
