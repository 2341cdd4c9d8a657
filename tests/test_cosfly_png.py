"""The PNG reader and writer against libraries', on pictures of every filter, packing and number of channels."""

import io
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from specimens_png import png_around

from cosfly.runtime.errors import InputError
from cosfly.runtime.png import areas_png, colours_png, floats_of, floats_png, parse_png

KIND_OF = {1: 0, 2: 4, 3: 2, 4: 6}


def png_of(lines: np.ndarray, channels: int, level: int, strategy: int, piece: int) -> bytes:
    """A PNG of filtered rows, (h, 1 + w * channels)."""
    packer = zlib.compressobj(level, strategy=strategy)
    packed = packer.compress(lines.tobytes()) + packer.flush()
    width = (lines.shape[1] - 1) // channels
    return png_around(packed, width, len(lines), KIND_OF[channels], piece=piece)


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


def test_a_picture_that_is_not_what_its_header_says_is_refused():
    """Cut, too long, too short, a bomb, bytes behind the stream, and a filter that does not exist."""
    lines = content(np.random.default_rng(0), 20, 61)
    whole = png_of(lines, 3, 6, zlib.Z_RLE, 500)
    assert len(parse_png(whole, "x").lines) == 20
    wrong = lines.copy()
    wrong[3, 0] = 5
    packed = [
        zlib.compress(lines.tobytes() + b"\0"), zlib.compress(lines.tobytes()[:-1]), zlib.compress(bytes(50_000_000)),
        zlib.compress(lines.tobytes())[:-1], zlib.compress(wrong.tobytes()), b"",
    ]  # fmt: skip
    refused = [whole[:cut] for cut in (0, 7, 20, 33, 60, -1, -12, -20)] + [png_around(p, 20, 20) for p in packed]
    for data in refused:
        with pytest.raises(InputError):
            parse_png(data, "x")


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
    for data in (colours_png(picture), areas_png(*np.moveaxis(picture, 2, 0))):
        np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], picture)
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), picture)
        np.testing.assert_array_equal(parse_png(data, "x").pixels(), picture)


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (72, 128)])
def test_floats_come_back_to_the_bit_and_any_library_finds_their_bytes(shape):
    values = np.random.default_rng(0).integers(0, 2**32, shape, dtype=np.uint32).view(np.float32)
    data = floats_png(values)
    assert floats_of(data, "x").tobytes() == values.tobytes(), "also what is no number"
    with Image.open(io.BytesIO(data)) as image:
        assert np.asarray(image).view("<f4")[..., 0].tobytes() == values.tobytes()
