"""PNG without a library, as fast as data sets of a hundred thousand pictures need it: whole pictures, or the few rows that are looked at.

The chunks' checksums, the stream's own and the number of bytes are always compared, so a picture that passes is whole. Filters
are undone when rows are wanted; where no row leans on another (filters none and sub), in those rows alone. Only what data sets hold: 8 bits, grey to RGBA, not interlaced.
Formats: RFC 1950, 1951, 2083.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from cosfly.compiled import njit
from cosfly.errors import InputError
from cosfly.reading.arrays import PNG_SIGNATURE, check_pixels

CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # by colour type; palettes are no pictures of a data set
CHUNK, NUMBER = struct.Struct(">I4s"), struct.Struct(">I")
_BASE_LENGTH = np.array([3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258], np.int64)  # fmt: skip
_MORE_LENGTH = np.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0], np.int64)  # fmt: skip
_BASE_WAY = np.array([1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129, 193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577], np.int64)  # fmt: skip
_MORE_WAY = np.array([0, 0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13, 13], np.int64)  # fmt: skip
_ORDER = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15], np.int64)


@dataclass
class Png:
    """An unpacked PNG: `lines` (h, 1 + w * channels) uint8, of each row its filter and its bytes as the filter left them."""

    width_px: int
    height_px: int
    channels: int
    lines: np.ndarray
    _is_undone: bool = False

    def rows(self, wanted: np.ndarray) -> np.ndarray:
        """Give some rows, (k, w, channels) uint8."""
        if not self._is_undone and (self.lines[:, 0] <= 1).all():
            lines = self.lines[wanted]
            _undo(lines, self.channels)
        else:
            lines = self._undone()[wanted]
        return lines[:, 1:].reshape(len(wanted), self.width_px, self.channels)

    def pixels(self) -> np.ndarray:
        """Give the picture, (h, w, channels) uint8."""
        return self._undone()[:, 1:].reshape(self.height_px, self.width_px, self.channels)

    def _undone(self) -> np.ndarray:
        if not self._is_undone:
            _undo(self.lines, self.channels)
            self._is_undone = True
        return self.lines


def parse_png(data: bytes | memoryview, where: object) -> Png:
    """Unpack a PNG, and see that every checksum holds.

    Raises:
        InputError: it is none, damaged, of another kind, or larger than pictures may be.
    """
    width, height, kind, packed = _chunks(data, where)
    channels = CHANNELS[kind]
    check_pixels(width * height, str(where), f"{width} x {height} px")
    out = np.empty(height * (1 + width * channels), np.uint8)
    source = np.frombuffer(packed, np.uint8)
    if len(source) < 8 or (source[0] & 15) != 8 or (int(source[0]) * 256 + int(source[1])) % 31 or source[1] & 32:
        raise _broken(where, "a stream that is none of zlib's")
    # Eight bytes from each place on: most bits are fetched so many at once.
    words = np.ndarray(len(source) - 7, "<u8", packed, strides=(1,))
    used = _inflate(source, words, 2, out)
    if used < 0:
        raise _broken(where, "a compressed stream that does not unpack to the picture")
    if used + 4 > len(source) or zlib.adler32(out.data) != int.from_bytes(packed[used : used + 4], "big"):
        raise _broken(where, "pixels that do not agree with their checksum")
    lines = out.reshape(height, 1 + width * channels)
    if (lines[:, 0] > 4).any():
        raise _broken(where, "a row with a filter that does not exist")
    return Png(width, height, channels, lines)


def _broken(where: object, got: str) -> InputError:
    return InputError("the image does not decode", where=str(where), got=got, expected="a whole PNG")


def _chunks(data: bytes | memoryview, where: object) -> tuple[int, int, int, bytes]:
    """Walk through the chunks: width, height, colour type, the packed pixels."""
    if data[:8] != PNG_SIGNATURE or data[12:16] != b"IHDR" or len(data) < 33:
        raise InputError("not an image", where=str(where), got=f"{len(data)} bytes", expected="a PNG")
    width, height, depth, kind, packing, filters, interlace = struct.unpack_from(">IIBBBBB", data, 16)
    check_pixels(width * height, str(where), f"{width} x {height} px")
    if depth != 8 or kind not in CHANNELS or packing or filters or interlace or not width or not height:
        raise _broken(where, f"{depth} bits, colour type {kind}, interlace {interlace}, {width} x {height} px")
    position, parts, view = len(PNG_SIGNATURE), list[memoryview](), memoryview(data)
    while position + 12 <= len(data):
        length, name = CHUNK.unpack_from(data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(view[position + 4 : end]) != NUMBER.unpack_from(data, end)[0]:
            raise _broken(where, f"a damaged {name.decode('latin-1')} chunk at byte {position}")
        if name == b"IDAT":
            parts.append(view[position + 8 : end])
        elif name == b"IEND":
            return width, height, kind, b"".join(parts)
        position = end + 4
    raise _broken(where, f"an end at byte {len(data)}, before the image's")


# --- compiled ---------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _nearest(left, up, corner):  # type: ignore[no-untyped-def]
    """Give Paeth's guess of a byte."""
    a, b, c = abs(up - corner), abs(left - corner), abs(left + up - 2 * corner)
    return left if a <= b and a <= c else up if b <= c else corner


@njit(cache=True, nogil=True)
def _undo(lines, channels):  # type: ignore[no-untyped-def]
    """Undo the filters of rows, in place; a row leans on the one before it. A row of zeros stands before the first."""
    height, stride = lines.shape
    nothing = np.zeros(stride, np.uint8)
    for y in range(height):
        row, above = lines[y], lines[y - 1] if y > 0 else nothing
        if row[0] == 2:
            for x in range(1, stride):
                row[x] = (row[x] + above[x]) & 255
        elif row[0] != 0 and channels == 3:
            _undo_colours(row, above)
        elif row[0] != 0:
            for first in range(1, 1 + channels):
                left, corner = np.int64(0), np.int64(0)
                for x in range(first, stride, channels):
                    up = np.int64(above[x])
                    guess = left if row[0] == 1 else (left + up) >> 1 if row[0] == 3 else _nearest(left, up, corner)
                    left, corner = (np.int64(row[x]) + guess) & 255, up
                    row[x] = left
        row[0] = 0


@njit(cache=True, nogil=True)
def _undo_colours(row, above):  # type: ignore[no-untyped-def]
    """Undo a row of three channels that leans on its left: they are computed beside each other, as each has to wait for its own left."""
    red, green, blue = np.int64(0), np.int64(0), np.int64(0)
    if row[0] == 1:
        for x in range(1, len(row), 3):
            red = (row[x] + red) & 255
            green = (row[x + 1] + green) & 255
            blue = (row[x + 2] + blue) & 255
            row[x], row[x + 1], row[x + 2] = red, green, blue
    elif row[0] == 3:
        for x in range(1, len(row), 3):
            red = (row[x] + ((red + above[x]) >> 1)) & 255
            green = (row[x + 1] + ((green + above[x + 1]) >> 1)) & 255
            blue = (row[x + 2] + ((blue + above[x + 2]) >> 1)) & 255
            row[x], row[x + 1], row[x + 2] = red, green, blue
    else:
        corners = np.int64(0), np.int64(0), np.int64(0)
        for x in range(1, len(row), 3):
            ups = np.int64(above[x]), np.int64(above[x + 1]), np.int64(above[x + 2])
            red = (row[x] + _nearest(red, ups[0], corners[0])) & 255
            green = (row[x + 1] + _nearest(green, ups[1], corners[1])) & 255
            blue = (row[x + 2] + _nearest(blue, ups[2], corners[2])) & 255
            row[x], row[x + 1], row[x + 2] = red, green, blue
            corners = ups


@njit(cache=True, nogil=True)
def _make_table(lengths, count, table, sorted_symbols, counts):  # type: ignore[no-untyped-def]
    """Fill the tables of a Huffman code; False where the lengths are none.

    table (2 ** 11,): symbol * 16 + length of codes that fit, 0 of others, which are found by sorted_symbols and counts.
    """
    counts.fill(0)
    for s in range(count):
        counts[lengths[s]] += 1
    counts[0] = 0
    left = np.int64(1)
    for bits in range(1, 16):
        left = left * 2 - counts[bits]
        if left < 0:
            return False
    starts = np.zeros(17, np.int64)
    codes = np.zeros(17, np.int64)
    code = np.int64(0)
    for bits in range(1, 16):
        starts[bits + 1] = starts[bits] + counts[bits]
        code = (code + (counts[bits - 1] if bits > 1 else 0)) << 1
        codes[bits] = code
    table.fill(0)
    for s in range(count):
        n = lengths[s]
        if n == 0:
            continue
        sorted_symbols[starts[n]] = s
        starts[n] += 1
        if n <= 11:
            turned, word = np.int64(0), codes[n]
            for _ in range(n):
                turned = (turned << 1) | (word & 1)
                word >>= 1
            for at in range(turned, 2048, 1 << n):
                table[at] = s * 16 + n
        codes[n] += 1
    return True


@njit(cache=True, nogil=True)
def _make_pairs(table, pairs):  # type: ignore[no-untyped-def]
    """Of the next bits, the one or two literals that they begin with: bits, how many (256s), first, second byte; 0 where there is none."""
    for at in range(2048):
        first = table[at]
        pairs[at] = 0
        if first == 0 or first >= 4096:
            continue
        used = first & 15
        second = table[at >> used]
        if second != 0 and second < 4096 and used + (second & 15) <= 11:
            pairs[at] = (second >> 4) << 24 | (first >> 4) << 16 | 512 | (used + (second & 15))
        else:
            pairs[at] = (first >> 4) << 16 | 256 | used


@njit(cache=True, nogil=True)
def _slow_symbol(hold, sorted_symbols, counts):  # type: ignore[no-untyped-def]
    """Find a symbol bit by bit: symbol * 16 + length, -1 where the bits are no code."""
    code, first, index = np.int64(0), np.int64(0), np.int64(0)
    for bits in range(1, 16):
        code |= np.int64(hold & np.uint64(1))
        hold >>= np.uint64(1)
        n = counts[bits]
        if code - n < first:
            return sorted_symbols[index + code - first] * 16 + bits
        index += n
        first = (first + n) << 1
        code <<= 1
    return np.int64(-1)


@njit(cache=True, nogil=True)
def _refill(source, words, position, hold, held):  # type: ignore[no-untyped-def]
    """Fetch bits: 56 and more, or all that are left. Above `held` stand those that come next, or none: or-ing them again changes nothing."""
    if position < len(words):
        return hold | words[position] << np.uint64(held), held | 56, position + ((63 - held) >> 3)
    while held <= 48 and position < len(source):
        hold |= np.uint64(source[position]) << np.uint64(held)
        position += 1
        held += 8
    return hold, held, position


@njit(cache=True, nogil=True)
def _inflate(source, words, position, out):  # type: ignore[no-untyped-def]
    """Unpack a deflate stream into `out`, which it must fill; gives where it ends in the source, -1 where it is broken.

    `hold` has the next `held` bits; words[k]: the eight bytes of the source from its k-th on.
    """
    size, room, at = len(source), len(out), np.int64(0)
    num_words = len(words)
    pairs = np.zeros(2048, np.uint32)
    hold, held = np.uint64(0), np.int64(0)
    lengths = np.zeros(320, np.int64)
    literal, way = np.zeros(2048, np.int64), np.zeros(2048, np.int64)
    literal_symbols, way_symbols = np.zeros(320, np.int64), np.zeros(320, np.int64)
    literal_counts, way_counts = np.zeros(16, np.int64), np.zeros(16, np.int64)
    is_last = False
    while not is_last:
        hold, held, position = _refill(source, words, position, hold, held)
        if held < 3:
            return np.int64(-1)
        is_last = (hold & np.uint64(1)) == np.uint64(1)
        form = np.int64((hold >> np.uint64(1)) & np.uint64(3))
        hold >>= np.uint64(3)
        held -= 3
        if form == 3:
            return np.int64(-1)
        if form == 0:
            position -= held >> 3  # whole bytes go back
            hold, held = np.uint64(0), np.int64(0)
            if position + 4 > size:
                return np.int64(-1)
            n = np.int64(source[position]) | np.int64(source[position + 1]) << 8
            other = np.int64(source[position + 2]) | np.int64(source[position + 3]) << 8
            position += 4
            if n != (other ^ 0xFFFF) or position + n > size or at + n > room:
                return np.int64(-1)
            for k in range(n):
                out[at + k] = source[position + k]
            at += n
            position += n
            continue
        if form == 1:
            for s in range(288):
                lengths[s] = 8 if s < 144 else 9 if s < 256 else 7 if s < 280 else 8
            _make_table(lengths, 288, literal, literal_symbols, literal_counts)
            for s in range(30):
                lengths[s] = 5
            _make_table(lengths, 30, way, way_symbols, way_counts)
        else:
            hold, held, position = _refill(source, words, position, hold, held)
            num_literals = np.int64(hold & np.uint64(31)) + 257
            num_ways = np.int64((hold >> np.uint64(5)) & np.uint64(31)) + 1
            num_codes = np.int64((hold >> np.uint64(10)) & np.uint64(15)) + 4
            hold >>= np.uint64(14)
            held -= 14
            if held < 0 or num_literals > 286 or num_ways > 30:
                return np.int64(-1)
            lengths.fill(0)
            for k in range(num_codes):
                hold, held, position = _refill(source, words, position, hold, held)
                lengths[_ORDER[k]] = np.int64(hold & np.uint64(7))
                hold >>= np.uint64(3)
                held -= 3
            if not _make_table(lengths, 19, literal, literal_symbols, literal_counts):
                return np.int64(-1)
            lengths.fill(0)
            at_length = np.int64(0)
            while at_length < num_literals + num_ways:
                hold, held, position = _refill(source, words, position, hold, held)
                entry = literal[np.int64(hold & np.uint64(2047))]
                if entry == 0 or held < 0:
                    return np.int64(-1)
                hold >>= np.uint64(entry & 15)
                held -= entry & 15
                s = entry >> 4
                if s < 16:
                    lengths[at_length] = s
                    at_length += 1
                    continue
                if s == 16:
                    if at_length == 0:
                        return np.int64(-1)
                    value, times = lengths[at_length - 1], 3 + np.int64(hold & np.uint64(3))
                    used = np.int64(2)
                elif s == 17:
                    value, times = np.int64(0), 3 + np.int64(hold & np.uint64(7))
                    used = np.int64(3)
                else:
                    value, times = np.int64(0), 11 + np.int64(hold & np.uint64(127))
                    used = np.int64(7)
                hold >>= np.uint64(used)
                held -= used
                if at_length + times > num_literals + num_ways:
                    return np.int64(-1)
                for _ in range(times):
                    lengths[at_length] = value
                    at_length += 1
            if not _make_table(lengths, num_literals, literal, literal_symbols, literal_counts):
                return np.int64(-1)
            if not _make_table(lengths[num_literals:], num_ways, way, way_symbols, way_counts):
                return np.int64(-1)
        _make_pairs(literal, pairs)
        while True:
            # Literals, two a look where their codes are short: five looks of at most 11 bits are what one fetch has.
            is_literal = True
            while is_literal and position < num_words and at + 16 <= room:
                hold |= words[position] << np.uint64(held)
                position += (63 - held) >> 3
                held |= 56
                for _ in range(5):
                    both = np.int64(pairs[np.int64(hold & np.uint64(2047))])
                    if both < 256:
                        is_literal = False
                        break
                    out[at] = (both >> 16) & 255
                    out[at + 1] = both >> 24
                    at += (both >> 8) & 255
                    hold >>= np.uint64(both & 255)
                    held -= both & 255
            hold, held, position = _refill(source, words, position, hold, held)
            entry = literal[np.int64(hold & np.uint64(2047))]
            if entry == 0:
                entry = _slow_symbol(hold, literal_symbols, literal_counts)
                if entry < 0:
                    return np.int64(-1)
            hold >>= np.uint64(entry & 15)
            held -= entry & 15
            s = entry >> 4
            if s < 256:
                if at >= room or held < 0:
                    return np.int64(-1)
                out[at] = s
                at += 1
                continue
            if s == 256:
                break
            s -= 257
            if s > 28 or held < 0:
                return np.int64(-1)
            more = _MORE_LENGTH[s]
            n = _BASE_LENGTH[s] + np.int64(hold & ((np.uint64(1) << np.uint64(more)) - np.uint64(1)))
            hold >>= np.uint64(more)
            held -= more
            hold, held, position = _refill(source, words, position, hold, held)
            entry = way[np.int64(hold & np.uint64(2047))]
            if entry == 0:
                entry = _slow_symbol(hold, way_symbols, way_counts)
                if entry < 0:
                    return np.int64(-1)
            hold >>= np.uint64(entry & 15)
            held -= entry & 15
            s = entry >> 4
            if s > 29:
                return np.int64(-1)
            more = _MORE_WAY[s]
            back = _BASE_WAY[s] + np.int64(hold & ((np.uint64(1) << np.uint64(more)) - np.uint64(1)))
            hold >>= np.uint64(more)
            held -= more
            if held < 0 or back > at or at + n > room:
                return np.int64(-1)
            if back == 1:  # a run, which is what most of a mask is
                value = out[at - 1]
                for k in range(n):
                    out[at + k] = value
            else:
                for k in range(n):
                    out[at + k] = out[at + k - back]
            at += n
    return position - (held >> 3) if at == room and held >= 0 else np.int64(-1)
