"""The PNG reader and writer against libraries', on pictures of every filter, packing and number of channels; and what damage does."""

from __future__ import annotations

import io
import itertools
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from cosfly.errors import InputError
from cosfly.png.checksum import adler32
from cosfly.png.deflate import band_rows, deflate
from cosfly.png.huffman import code_lengths
from cosfly.png.inflate import inflate
from cosfly.png.read import parse_png
from cosfly.png.write import areas_png, colours_png

KIND_OF = {1: 0, 2: 4, 3: 2, 4: 6}


def chunk(name: bytes, data: bytes | memoryview) -> bytes:
    body = name + bytes(data)
    return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))


def png_of(lines: np.ndarray, channels: int, level: int, strategy: int, piece: int) -> bytes:
    """A PNG of filtered rows, (h, 1 + w * channels)."""
    packer = zlib.compressobj(level, strategy=strategy)
    packed = packer.compress(lines.tobytes()) + packer.flush()
    return png_in_parts(lines, channels, [packed[k : k + piece] for k in range(0, len(packed), piece)])


def png_in_parts(lines: np.ndarray, channels: int, parts: list) -> bytes:
    """A PNG of filtered rows, whose stream stands in these parts."""
    height, width = lines.shape[0], (lines.shape[1] - 1) // channels
    head = struct.pack(">IIBBBBB", width, height, 8, KIND_OF[channels], 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + b"".join(chunk(b"IDAT", p) for p in parts) + chunk(b"IEND", b"")
    )


def content(rng: np.random.Generator, height: int, stride: int) -> np.ndarray:
    """Rows of noise, of few values and of runs, with filters as they come."""
    lines = rng.integers(0, int(rng.choice([2, 6, 40, 256])), (height, stride), dtype=np.uint8)
    if rng.random() < 0.5:
        lines = np.repeat(lines, 7, axis=1)[:, :stride]
    lines[:, 0] = rng.integers(0, 5, height)
    return lines


@settings(max_examples=150, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 90), st.sampled_from([1, 3, 4]), st.integers(0, 9),
    st.sampled_from([zlib.Z_DEFAULT_STRATEGY, zlib.Z_FILTERED, zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE, zlib.Z_FIXED]),
)  # fmt: skip
def test_pixels_are_a_librarys(seed, height, width, channels, level, strategy):
    rng = np.random.default_rng(seed)
    data = png_of(content(rng, height, 1 + width * channels), channels, level, strategy, int(rng.integers(40, 9000)))
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED).reshape(height, width, channels)
    if channels > 1:
        expected[..., :3] = expected[..., 2::-1].copy()
    np.testing.assert_array_equal(parse_png(data, "x").pixels(), expected)
    wanted = np.unique(rng.integers(0, height, 5))
    np.testing.assert_array_equal(parse_png(memoryview(data), "x").rows(wanted), expected[wanted])


def test_a_picture_of_grey_and_opacity_is_read():
    lines = np.array([[1, 10, 20, 1, 2], [2, 1, 1, 1, 1]], np.uint8)
    pixels = parse_png(png_of(lines, 2, 6, zlib.Z_DEFAULT_STRATEGY, 100), "x").pixels()
    assert pixels.tolist() == [[[10, 20], [11, 22]], [[11, 21], [12, 23]]]


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_changed_byte_is_found_or_changes_nothing(seed, is_mended):
    """Also where the chunk's checksum is made right again."""
    rng = np.random.default_rng(seed)
    lines = content(rng, 30, 1 + 40 * 3)
    data = bytearray(png_of(lines, 3, 6, zlib.Z_RLE, 1 << 20))
    expected = parse_png(bytes(data), "x").pixels()
    (length,) = struct.unpack_from(">I", data, 33)
    data[41 + int(rng.integers(0, length))] ^= int(rng.integers(1, 256))
    if is_mended:
        struct.pack_into(">I", data, 41 + length, zlib.crc32(data[37 : 41 + length]))
    try:
        found = parse_png(bytes(data), "x").pixels()
    except InputError:
        return
    assert is_mended
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("size", [0, 1, 4095, 4096, 4097, 3 * 4096, 300_001])
@pytest.mark.parametrize("value", [0, 1, 255, None])
def test_the_checksum_is_zlibs(size, value):
    """Bytes of 255 come nearest to what 32 bits hold."""
    data = (
        np.random.default_rng(size).integers(0, 256, size, dtype=np.uint8)
        if value is None
        else np.full(size, value, np.uint8)
    )
    assert adler32(data) == zlib.adler32(data.data)


@pytest.mark.parametrize("back", [1, 2, 3, 5, 7, 8, 9, 31, 32, 33, 300])
def test_repetitions_of_every_distance_are_undone(back):
    period = np.random.default_rng(back).integers(0, 256, back, dtype=np.uint8)
    lines = np.resize(period, (40, 1 + 3 * 101))
    lines[:, 0] = 0
    data = png_of(lines, 3, 9, zlib.Z_DEFAULT_STRATEGY, 1 << 20)
    np.testing.assert_array_equal(parse_png(data, "x").pixels().reshape(40, -1), lines[:, 1:])


@pytest.mark.parametrize("cut", [0, 7, 20, 33, 60, -1, -12, -20])
def test_a_cut_picture_is_refused(cut):
    data = png_of(content(np.random.default_rng(0), 20, 61), 3, 6, zlib.Z_RLE, 500)
    with pytest.raises(InputError):
        parse_png(data[:cut], "x")


# --- writing ----------------------------------------------------------------------------------------------------------


def drawn(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Areas of one colour, some with texture, some of one row repeated."""
    picture = np.repeat(rng.integers(0, 256, (height, 1 + width // 9, 3), dtype=np.uint8), 9, axis=1)[:, :width]
    if rng.random() < 0.7:
        picture[height // 3 :] = picture[height // 3]
    if rng.random() < 0.7:
        noise = rng.normal(0.0, float(rng.choice([0.5, 3.0, 60.0])), (height - height // 2, width, 3))
        picture[height // 2 :] = np.clip(picture[height // 2 :] + noise, 0, 255).astype(np.uint8)
    return picture


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 50), st.integers(1, 300))
def test_what_is_written_is_read_by_libraries(seed, height, width):
    rng = np.random.default_rng(seed)
    picture = drawn(rng, height, width)
    alone = np.unique(rng.integers(0, height, 4))
    for data in (colours_png(picture, alone), areas_png(*np.moveaxis(picture, 2, 0))):
        np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], picture)
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), picture)
        np.testing.assert_array_equal(parse_png(data, "x").pixels(), picture)
        np.testing.assert_array_equal(parse_png(data, "x").rows(alone), picture[alone])


def test_rows_that_stand_alone_lean_on_no_other():
    alone = np.array([3, 11])
    filters = parse_png(colours_png(drawn(np.random.default_rng(1), 20, 30), alone), "x").lines[:, 0]
    assert filters[alone].tolist() == [1, 1]
    assert (np.delete(filters, alone) == 3).all()


@pytest.mark.parametrize("stride", [7, 32767, 32768, 40000])
def test_a_row_above_beyond_the_window_is_not_looked_for(stride):
    row = np.random.default_rng(stride).integers(0, 256, stride, dtype=np.uint8)
    lines = np.ascontiguousarray(np.broadcast_to(row, (4, stride)))
    packed = b"".join(deflate(lines, 3, stride))
    assert zlib.decompress(packed) == lines.tobytes()
    assert (len(packed) < 2 * stride) == (7 < stride < 32768)


def test_codes_that_would_be_too_long_are_shortened():
    """Bytes as frequent as Fibonacci's numbers have codes one bit longer each."""
    counts = [1, 1]
    while len(counts) < 24:
        counts.append(counts[-1] + counts[-2])
    values = np.repeat(np.arange(24, dtype=np.uint8) * 7, counts)
    lines = np.random.default_rng(2).permutation(values)[None]
    assert zlib.decompress(b"".join(deflate(lines, 3, 0))) == lines.tobytes()


@pytest.mark.parametrize("most", [7, 11, 15])
def test_codes_are_as_short_as_they_can_be(most):
    """Of all ways to give six symbols lengths of at most `most`, as many as fill the room."""
    rng = np.random.default_rng(most)
    for _ in range(20):
        counts = np.sort(rng.integers(1, 1 << int(rng.integers(1, 12)), 6))[::-1]
        best = min(
            int((np.array(lengths) * counts).sum())
            for lengths in itertools.combinations_with_replacement(range(1, min(most, 5) + 1), 6)
            if sum(2.0**-n for n in lengths) == 1.0
        )
        assert int((code_lengths(counts, np.int64(most)) * counts).sum()) == best


def test_a_code_that_may_not_be_long_is_whole():
    counts = np.round(60_000 * np.exp(-np.abs(np.arange(286) - 128) / 9)).astype(np.int64) + 1
    lengths = code_lengths(counts, np.int64(11))
    assert lengths.max() == 11
    assert (2.0**-lengths).sum() == 1.0


def test_noise_that_cannot_be_packed_fits():
    lines = np.random.default_rng(3).integers(0, 256, (50, 4001), dtype=np.uint8)
    packed = b"".join(deflate(lines, 3, 4001))
    assert zlib.decompress(packed) == lines.tobytes()
    assert len(packed) < 1.01 * lines.size


# --- bands ------------------------------------------------------------------------------------------------------------


def by_bands(parts: list, height: int, stride: int) -> np.ndarray | None:
    """What a stream unpacks to, read by its parts as bands; None where they are none."""
    ends = np.cumsum([len(part) for part in parts])
    starts = np.concatenate([[2], ends[:-1]])
    out, used = inflate(b"".join(parts), starts, ends, band_rows(height, len(parts)) * stride)
    return out if used >= 0 else None


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 60), st.integers(1, 12))
def test_bands_are_one_stream_to_everybody(seed, height, width, num_bands):
    lines = content(np.random.default_rng(seed), height, 1 + 3 * width)
    parts = deflate(lines, 3, lines.shape[1] * (seed % 2), min(num_bands, height))
    assert zlib.decompress(b"".join(parts)) == lines.tobytes()
    assert by_bands(parts, *lines.shape).tobytes() == lines.tobytes()
    np.testing.assert_array_equal(parse_png(png_in_parts(lines, 3, parts), "x").lines, lines)


@settings(max_examples=200, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.integers(2, 40), st.integers(2, 9), st.booleans(), st.booleans(), st.integers(0, 9)
)
def test_parts_that_only_look_like_bands_are_read_as_one_stream(seed, height, num_parts, is_even, is_alone, level):
    """Each ends as a band does; the rows of others are not those of bands, or they repeat what stands before them."""
    rng = np.random.default_rng(seed)
    lines, num_parts = content(rng, height, 91), min(num_parts, height)
    bounds = band_rows(height, num_parts)
    if not is_even:
        bounds[1:-1] = np.sort(rng.integers(0, height + 1, num_parts - 1))
    packer, parts = zlib.compressobj(level), []
    for first, behind in itertools.pairwise(bounds):
        part = packer.compress(lines[first:behind].tobytes())
        parts.append(part + packer.flush(zlib.Z_FULL_FLUSH if is_alone else zlib.Z_SYNC_FLUSH))
    parts[-1] += packer.flush()
    found = by_bands(parts, *lines.shape)
    assert found is None or found.tobytes() == lines.tobytes()
    if is_even and is_alone:
        assert found is not None
    np.testing.assert_array_equal(parse_png(png_in_parts(lines, 3, parts), "x").lines, lines)


def test_bands_that_repeat_rows_of_others_are_no_bands():
    lines = np.tile(np.random.default_rng(5).integers(0, 256, 91, dtype=np.uint8), (20, 1))
    packer = zlib.compressobj(6)
    parts = [packer.compress(lines[k : k + 10].tobytes()) + packer.flush(zlib.Z_SYNC_FLUSH) for k in (0, 10)]
    parts[-1] += packer.flush()
    assert by_bands(parts, 20, 91) is None
    lines[:, 0] = 0
    packer = zlib.compressobj(6)
    parts = [packer.compress(lines[k : k + 10].tobytes()) + packer.flush(zlib.Z_SYNC_FLUSH) for k in (0, 10)]
    parts[-1] += packer.flush()
    np.testing.assert_array_equal(parse_png(png_in_parts(lines, 3, parts), "x").lines, lines)


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["byte", "cut", "swapped", "moved"]))
def test_damaged_bands_are_found_or_change_nothing(seed, damage):
    """Also where the chunks' checksums are made right again."""
    rng = np.random.default_rng(seed)
    lines = content(rng, 30, 1 + 40 * 3)
    parts = [bytearray(part) for part in deflate(lines, 3, 0, int(rng.integers(2, 8)))]
    k, other = (int(n) for n in rng.choice(len(parts), 2, replace=False))
    at = int(rng.integers(0, len(parts[k])))
    if damage == "byte":
        parts[k][at] ^= int(rng.integers(1, 256))
    elif damage == "cut":
        del parts[k][at:]
    elif damage == "swapped":
        parts[k], parts[other] = parts[other], parts[k]
    else:  # the same stream, of which a part begins elsewhere
        k = min(k, len(parts) - 2)
        parts[k + 1][:0], parts[k][-1:] = parts[k][-1:], b""
    try:
        found = parse_png(png_in_parts(lines, 3, parts), "x").lines
    except InputError:
        assert damage != "moved"
        return
    np.testing.assert_array_equal(found, lines)


def test_a_whole_picture_is_written_in_bands_of_one_block():
    picture = drawn(np.random.default_rng(7), 360, 640)
    data = colours_png(picture, np.array([5]))
    assert data.count(b"IDAT") == 8
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), picture)
    np.testing.assert_array_equal(parse_png(data, "x").pixels(), picture)
