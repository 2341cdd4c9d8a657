"""release/verify/pictures.py: what is measured in pictures, beside slow and obvious versions of the same."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from tables import each

from release.verify.pictures import NUM_IDS, PERSON, SKY, new_kinds, rays_to_person, survey

FAR_M = np.float32(1000.0)


def _frame(seed, size=(45, 77), *, sky=True):
    """A mask of blocks with some of the person and of the sky, and depth that mostly agrees with it."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, [29, 256, 256], (-(-size[0] // 5), -(-size[1] // 7), 3))
    blocks[rng.random(blocks.shape[:2]) < 0.1] = (PERSON, 255, 255)
    blocks[rng.random(blocks.shape[:2]) < 0.02] = (PERSON + 1, 255, 255)
    blocks[rng.random(blocks.shape[:2]) < 0.1] = (3, 255, 254)
    blocks[rng.random(blocks.shape[:2]) < 0.1] = (3, 254, 255)
    if not sky:
        blocks[blocks[..., 0] == SKY] = 0
    mask = np.repeat(np.repeat(blocks, 5, axis=0), 7, axis=1)[: size[0], : size[1]].astype(np.uint8)
    depth = rng.uniform(1.0, 80.0, size).astype(np.float32)
    depth[mask[..., 0] == SKY] = FAR_M
    depth[rng.random(size) < 0.003] = FAR_M if sky else 0.0
    return depth, mask


def _obvious(depth, mask):
    kinds, ids = mask[..., 0], mask[..., 1].astype(int) | mask[..., 2].astype(int) << 8
    person = ids == 65535
    rows, columns = np.nonzero(person)
    box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    odd = int(((kinds == SKY) != (depth == FAR_M)).sum())
    return [depth.min(), depth.max(), odd, person.sum(), (person & (kinds != PERSON)).sum(), kinds.max()], box


@pytest.mark.parametrize("sky", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_every_pixel_is_counted(seed, sky):
    depth, mask = _frame(seed, sky=sky)
    found, (counts, box) = survey(depth, mask), _obvious(depth, mask)
    assert list(found[:-1]) == counts
    assert found.box.tolist() == box
    assert (found.num_odd_sky > 0) == sky


@pytest.mark.parametrize("corner", [(0, 0), (0, -1), (-1, 0), (-1, -1)])
def test_pixels_at_corners_are_seen(corner):
    depth, mask = np.full((9, 13), 5.0, np.float32), np.zeros((9, 13, 3), np.uint8)
    mask[corner] = (PERSON, 255, 255)
    depth[corner] = FAR_M
    found, (counts, box) = survey(depth, mask), _obvious(depth, mask)
    assert list(found[:-1]) == counts
    assert found.box.tolist() == box
    mask[corner] = (200, 1, 0)
    assert survey(depth, mask).most_kind == 200


@each(
    ("odd", "limits"),
    [
        (np.nan, (np.nan, np.nan)), (-np.nan, (np.nan, np.nan)), (np.inf, (np.nan, np.nan)),
        (-np.inf, (np.nan, np.nan)),
        (-3.5, (-3.5, 7.0)), (0.0, (0.0, 7.0)), (-0.0, (0.0, 7.0)), (1e-42, (np.float32(1e-42), 7.0)),
        (2000.0, (5.0, 2000.0)),
    ],
)  # fmt: skip
def test_limits_of_depth(odd, limits):
    depth = np.full((9, 13), 5.0, np.float32)
    depth[2, 3], depth[8, 12] = 7.0, odd
    found = survey(depth, np.empty((0, 0, 3), np.uint8))
    assert_array_equal([found.low_m, found.high_m], limits)


def test_a_frame_may_lack_mask_or_depth():
    depth, mask = _frame(0)
    alone = survey(depth, np.empty((0, 0, 3), np.uint8))
    assert (alone.low_m, alone.high_m, alone.num_person, alone.num_odd_sky) == (depth.min(), depth.max(), 0, 0)
    alone = survey(np.empty((0, 0), np.float32), mask)
    assert (alone.low_m, alone.num_odd_sky, alone.most_kind) == (0.0, 0, mask[..., 0].max())
    assert alone.num_person == _obvious(depth, mask)[0][3]


def test_a_thing_is_of_one_kind():
    mask = np.zeros((72, 128, 3), np.uint8)
    mask[:36], mask[36:] = (3, 7, 1), (4, 9, 0)
    mask[:, :10], mask[:, 10:20] = (5, 0, 0), (5, 254, 255)  # ids of nothing and of many things
    known = np.full(NUM_IDS, -1, np.int16)
    assert new_kinds(mask, known) == [9 << 8 | 4, 263 << 8 | 3]
    known[9], known[263] = 4, 5
    assert new_kinds(mask, known) == [263 << 8 | 3]


def test_rays_that_meet_the_person():
    """A box of 2 x 2 m, 10 m before a camera of 100 px, half of it behind something and half of what is left beyond the
    picture."""
    depth, mask = np.full((40, 40), 50.0, np.float32), np.zeros((40, 40, 3), np.uint8)
    depth[20:] = 3.0
    pixels = np.arange(-10.0, 50.0)
    intrinsics, half_m = np.array([100.0, 100.0, 20.0, 20.0]), np.array([1.0, 1.0, 1e-6])
    away_m = np.array([0.0, 0.0, 10.0])
    found = rays_to_person(depth, mask, pixels, pixels, intrinsics, np.eye(3), away_m, half_m)
    assert found == (20 * 20, 20 * 10)
    mask[20:, :20] = (PERSON, 255, 255)  # the person itself hides nothing
    found = rays_to_person(depth, mask, pixels, pixels, intrinsics, np.eye(3), away_m, half_m)
    assert found == (20 * 20, 20 * 15)
    found = rays_to_person(depth, mask, pixels, pixels, intrinsics, np.eye(3), np.array([2.0, 0.0, 10.0]), half_m)
    assert found == (20 * 20, 10 * 10)
