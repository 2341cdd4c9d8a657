"""release/verify/pixels.py: what is measured in pictures, beside slow and obvious versions of the same."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from release_tampering import png

from cosfly.products.frames import grid_rows
from cosfly.products.png import parse_png
from release.verify.findings import Findings
from release.verify.person import check_shown, outline_step
from release.verify.pixels import (
    NUM_IDS,
    PERSON,
    SKY,
    bend_of,
    depths_of_person,
    edges_of,
    look_of,
    new_kinds,
    rays_to_person,
    survey,
)
from release.verify.rows import FlightRows

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
@pytest.mark.parametrize("seed", range(5))
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


@pytest.mark.parametrize(
    ("odd", "limits"),
    [
        (np.nan, (np.nan, np.nan)), (-np.nan, (np.nan, np.nan)), (np.inf, (np.nan, np.nan)), (-np.inf, (np.nan, np.nan)),
        (-3.5, (-3.5, 7.0)), (0.0, (0.0, 7.0)), (-0.0, (0.0, 7.0)), (1e-42, (np.float32(1e-42), 7.0)), (2000.0, (5.0, 2000.0)),
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


def _obvious_look(colours):
    few = colours[::3, :, :3].astype(float)
    grey = few.mean(axis=2)
    hue = np.abs(few[:, ::3] - grey[:, ::3, None]).mean()
    steps = np.abs(np.diff(grey, axis=1)).mean(axis=0)
    is_edge = np.arange(len(steps)) % 8 == 7
    red, green, blue = few.mean(axis=(0, 1))
    over = steps[is_edge].mean() if is_edge.any() else np.nan
    return [
        hue,
        steps.mean(),
        over,
        steps[~is_edge].mean(),
        red - green,
        blue - green,
        colours[..., :3].mean(),
        colours[..., :3].std(),
    ]


@pytest.mark.parametrize("shape", [(36, 77, 3), (36, 80, 4), (1, 8, 3), (2, 3, 3)])
def test_look_of_a_picture(shape):
    colours = np.random.default_rng(3).integers(0, 256, shape).astype(np.uint8)
    assert_allclose(look_of(colours), _obvious_look(colours), rtol=1e-12, atol=1e-12)


def test_a_thing_is_of_one_kind():
    mask = np.zeros((72, 128, 3), np.uint8)
    mask[:36], mask[36:] = (3, 7, 1), (4, 9, 0)
    mask[:, :10], mask[:, 10:20] = (5, 0, 0), (5, 254, 255)  # ids of nothing and of many things
    known = np.full(NUM_IDS, -1, np.int16)
    assert new_kinds(mask, known) == [9 << 8 | 4, 263 << 8 | 3]
    known[9], known[263] = 4, 5
    assert new_kinds(mask, known) == [263 << 8 | 3]


@pytest.mark.parametrize("is_ours", [True, False])
def test_depths_of_the_person(is_ours):
    depth, mask = _frame(1)
    mask[20:30, 20:30] = (PERSON, 1, 0)  # somebody else
    x0, y0, x1, y1 = box = np.array([5, 3, 60, 40])
    wanted = mask[y0:y1, x0:x1, 0] == PERSON
    if is_ours:
        wanted &= (mask[y0:y1, x0:x1, 1:] == 255).all(axis=2)
    assert_array_equal(depths_of_person(depth, mask, box, is_ours), depth[y0:y1, x0:x1][wanted])


def test_rays_that_meet_the_person():
    """A box of 2 x 2 m, 10 m before a camera of 100 px, half of it behind something and half of what is left beyond the picture."""
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


def _obvious_edges(colours, mask, rows):
    """Mean steps of colours by (down, right) from edges of the mask."""
    steps = np.minimum(np.abs(np.diff(colours[..., :3].astype(float), axis=1)).sum(axis=2), 120.0)
    found = {}
    for down in (-2, 0, 2):
        for right in range(-4, 5):
            values = [
                steps[j, x + right]
                for j, row in enumerate(rows)
                if 0 <= row - down < len(mask)
                for x in range(4, mask.shape[1] - 5)
                if (mask[row - down, x] != mask[row - down, x + 1]).any()
            ]
            found[down, right] = np.mean(values) if len(values) >= 30 else 0.0
    return found


@pytest.mark.parametrize("shift", [(0, 0), (0, 2), (2, 0), (-2, -3)])
def test_edges_of_colours_and_mask(shift):
    rng = np.random.default_rng(5)
    upright = _frame(4, (72, 128))[1]
    # Aslant, as upright edges do not tell of up and down.
    mask = np.stack([np.roll(row, y, axis=0) for y, row in enumerate(upright)])
    whole = np.roll((mask.astype(int) * 37 % 251 + rng.integers(0, 3, mask.shape)).astype(np.uint8), shift, axis=(0, 1))
    rows = grid_rows(72)
    found, wanted = edges_of(whole[rows], mask), _obvious_edges(whole[rows], mask, rows)
    rivals = {place: mean for place, mean in wanted.items() if place[0] or abs(place[1]) > 1}
    best = max(rivals, key=rivals.get)
    assert_allclose(found.rival, rivals[best] / wanted[0, 0], rtol=1e-12)
    assert found.shift_px == best[::-1]
    if shift == (0, 0):
        assert found.rival < 1.0
    else:
        assert best == shift
        assert found.rival > 1.15
        assert found.deviations > 4.0


def test_edges_that_are_few_say_nothing():
    assert edges_of(np.zeros((36, 128, 3), np.uint8), np.zeros((72, 128, 3), np.uint8)) is None


@pytest.mark.parametrize(
    ("worst", "usual", "num_frames", "is_found"),
    [(50.0, 60.0, 20, False), (10.0, 60.0, 20, True), (2.0, 7.0, 20, False), (10.0, 60.0, 4, False), (np.nan, 60.0, 20, False)],
)  # fmt: skip
def test_the_person_shows_as_clearly_as_in_the_frames_beside(worst, usual, num_frames, is_found):
    steps = np.full(num_frames, usual)
    steps[2] = worst
    findings = Findings()
    rows = [{"frame_index": k} for k in range(num_frames)]
    check_shown(FlightRows("run/Town/trajectory/ORI", rows), steps, findings)
    assert [code for _, code in findings.kinds] == ["person"] * is_found


def test_frames_far_apart_say_nothing_of_the_person():
    findings = Findings()
    rows = [{"frame_index": 10 * k} for k in range(20)]
    check_shown(FlightRows("run/Town/trajectory/ORI", rows), np.array([60.0] * 19 + [3.0]), findings)
    assert not findings.kinds


def test_steps_at_the_outline():
    """A person of 10 x 6 px, 90 grey levels brighter than the street."""
    colours, mask = np.full((72, 128, 3), 60, np.uint8), np.zeros((72, 128, 3), np.uint8)
    colours[30:40, 50:56], mask[30:40, 50:56] = 90, (PERSON, 255, 255)
    box = np.array([50.0, 30.0, 56.0, 40.0])
    assert outline_step(parse_png(png(colours), "x"), mask, box) == 90.0
    assert outline_step(parse_png(png(np.full_like(colours, 60)), "x"), mask, box) == 0.0
    assert np.isnan(outline_step(parse_png(png(colours), "x"), mask, np.full(4, np.nan)))
    assert np.isnan(outline_step(parse_png(png(colours), "x"), np.zeros_like(mask), box))


@pytest.mark.parametrize(
    ("noise", "coding", "is_bent"),
    [(0.0, "<f4", False), (0.0, "<f2", False), (0.0, "mm", False), (0.003, "<f4", True), (0.003, "<f2", True), (0.01, "mm", True)],
)  # fmt: skip
def test_noise_bends_planes(noise, coding, is_bent):
    """A street that is looked at aslant, 8 to 40 m away, in each coding of depth."""
    v, u = np.mgrid[:72, :128]
    depth = 1.0 / (1.0 / 40.0 + v * 0.0012 + u * 0.0001) * np.random.default_rng(1).normal(1.0, noise, v.shape)
    depth = np.round(depth, 3) if coding == "mm" else depth.astype(coding)
    mask = np.zeros((72, 128, 3), np.uint8)
    assert (bend_of(depth.astype(np.float32), mask) > 0.002) == is_bent
    mask[..., 1] = np.arange(128) // 2  # nothing is three pixels wide
    assert np.isnan(bend_of(depth.astype(np.float32), mask))
