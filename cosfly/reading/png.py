"""PNG without a library, as fast as data sets of a hundred thousand pictures need it: whole pictures, or the few rows that are looked at.

The chunks' checksums, the stream's own and the number of bytes are always compared, so a picture that passes is whole. A library
undoes the filter of every row; here a row is undone when it is wanted, which for rows that lean on no other (filters none and sub, as
cosfly writes them) is a hundredth of the work. Only what data sets hold: 8 bits, grey to RGBA, not interlaced.
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
TABLE_BITS = 11
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


def parse_png(data: bytes, where: object) -> Png:
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
    used = _inflate(source, 2, out)
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


def _chunks(data: bytes, where: object) -> tuple[int, int, int, bytes]:
    """Walk through the chunks: width, height, colour type, the packed pixels."""
    if not data.startswith(PNG_SIGNATURE) or data[12:16] != b"IHDR" or len(data) < 33:
        raise InputError("not an image", where=str(where), got=f"{len(data)} bytes", expected="a PNG")
    width, height, depth, kind, packing, filters, interlace = struct.unpack_from(">IIBBBBB", data, 16)
    check_pixels(width * height, str(where), f"{width} x {height} px")
    if depth != 8 or kind not in CHANNELS or packing or filters or interlace or not width or not height:
        raise _broken(where, f"{depth} bits, colour type {kind}, interlace {interlace}, {width} x {height} px")
    position, parts, view = len(PNG_SIGNATURE), list[memoryview](), memoryview(data)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        name, end = data[position + 4 : position + 8], position + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(view[position + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise _broken(where, f"a damaged {name.decode('latin-1')} chunk at byte {position}")
        if name == b"IDAT":
            parts.append(view[position + 8 : end])
        elif name == b"IEND":
            return width, height, kind, b"".join(parts)
        position = end + 4
    raise _broken(where, f"an end at byte {len(data)}, before the image's")


# --- compiled ---------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _undo(lines, channels):  # type: ignore[no-untyped-def]
    """Undo the filters of rows, in place; a row leans on the one before it."""
    height, stride = lines.shape
    for y in range(height):
        form = lines[y, 0]
        if form == 1:
            for x in range(1 + channels, stride):
                lines[y, x] = (lines[y, x] + lines[y, x - channels]) & 255
        elif form == 2 and y > 0:
            for x in range(1, stride):
                lines[y, x] = (lines[y, x] + lines[y - 1, x]) & 255
        elif form >= 3:
            for x in range(1, stride):
                left = np.int64(lines[y, x - channels]) if x > channels else np.int64(0)
                above = np.int64(lines[y - 1, x]) if y > 0 else np.int64(0)
                if form == 3:
                    lines[y, x] = (lines[y, x] + ((left + above) >> 1)) & 255
                    continue
                corner = np.int64(lines[y - 1, x - channels]) if y > 0 and x > channels else np.int64(0)
                guess = left + above - corner
                a, b, c = abs(guess - left), abs(guess - above), abs(guess - corner)
                near = left if a <= b and a <= c else above if b <= c else corner
                lines[y, x] = (lines[y, x] + near) & 255
        lines[y, 0] = 0 if form <= 4 else form


@njit(cache=True, nogil=True)
def _make_table(lengths, count, table, sorted_symbols, counts):  # type: ignore[no-untyped-def]
    """Fill the tables of a Huffman code; False where the lengths are none.

    table (2 ** TABLE_BITS,): symbol * 16 + length of codes that fit, 0 of others, which are found by sorted_symbols and counts.
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
def _inflate(source, position, out):  # type: ignore[no-untyped-def]
    """Unpack a deflate stream into `out`, which it must fill; gives where it ends in the source, -1 where it is broken."""
    size, room, at = len(source), len(out), np.int64(0)
    hold, held = np.uint64(0), np.int64(0)
    lengths = np.zeros(320, np.int64)
    literal, way = np.zeros(2048, np.int64), np.zeros(2048, np.int64)
    literal_symbols, way_symbols = np.zeros(320, np.int64), np.zeros(320, np.int64)
    literal_counts, way_counts = np.zeros(16, np.int64), np.zeros(16, np.int64)
    is_last = False
    while not is_last:
        while held <= 48 and position < size:
            hold |= np.uint64(source[position]) << np.uint64(held)
            position += 1
            held += 8
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
            while held <= 48 and position < size:
                hold |= np.uint64(source[position]) << np.uint64(held)
                position += 1
                held += 8
            num_literals = np.int64(hold & np.uint64(31)) + 257
            num_ways = np.int64((hold >> np.uint64(5)) & np.uint64(31)) + 1
            num_codes = np.int64((hold >> np.uint64(10)) & np.uint64(15)) + 4
            hold >>= np.uint64(14)
            held -= 14
            if held < 0 or num_literals > 286 or num_ways > 30:
                return np.int64(-1)
            lengths.fill(0)
            for k in range(num_codes):
                while held <= 48 and position < size:
                    hold |= np.uint64(source[position]) << np.uint64(held)
                    position += 1
                    held += 8
                lengths[_ORDER[k]] = np.int64(hold & np.uint64(7))
                hold >>= np.uint64(3)
                held -= 3
            if not _make_table(lengths, 19, literal, literal_symbols, literal_counts):
                return np.int64(-1)
            lengths.fill(0)
            at_length = np.int64(0)
            while at_length < num_literals + num_ways:
                while held <= 48 and position < size:
                    hold |= np.uint64(source[position]) << np.uint64(held)
                    position += 1
                    held += 8
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
        while True:
            while held <= 48 and position < size:
                hold |= np.uint64(source[position]) << np.uint64(held)
                position += 1
                held += 8
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
                # Another one or two literals while there are bits: refilling is what costs.
                while held >= 15:
                    entry = literal[np.int64(hold & np.uint64(2047))]
                    if entry == 0 or entry >= 4096 or at >= room:
                        break
                    hold >>= np.uint64(entry & 15)
                    held -= entry & 15
                    out[at] = entry >> 4
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
            while held <= 48 and position < size:
                hold |= np.uint64(source[position]) << np.uint64(held)
                position += 1
                held += 8
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
            for k in range(n):
                out[at + k] = out[at + k - back]
            at += n
    return position - (held >> 3) if at == room and held >= 0 else np.int64(-1)
