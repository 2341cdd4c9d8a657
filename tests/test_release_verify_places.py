"""Walks of one town against each other: what stands still in the frames of one stands there in those of the other."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_release_verify_across import flight

from cosfly.products.kinds import KINDS
from cosfly.space.reprojection import View, compare_views
from release.verify.across import RowFiles
from release.verify.findings import Findings
from release.verify.places import check_places, kept_rows, packed, thinned, unpacked

CAMERA = np.array([400.0, 400.0, 320.0, 180.0])
STEP_M = 3.0  # height and half the width of a block on the ground


def seen_from(x_m: float, block_x_m: float = 0.0, block_id: int = 7) -> View:
    """Ground and a block, 20 m below a camera that looks straight down (camera axes x right, y down, z away are the world's)."""
    v, u = np.mgrid[:360, :640]
    x, y = (u + 0.5 - CAMERA[2]) / CAMERA[0], (v + 0.5 - CAMERA[3]) / CAMERA[1]
    top_m = 20.0 - STEP_M
    is_block = (np.abs(x * top_m + x_m - block_x_m) < STEP_M) & (np.abs(y * top_m) < STEP_M)
    instance = np.zeros((360, 640, 3), np.uint8)
    instance[:] = (KINDS["Roads"], 1, 0)
    instance[is_block] = (KINDS["Buildings"], block_id, 0)
    depth = np.where(is_block, top_m, 20.0).astype(np.float32)
    return View(depth, instance, None, np.eye(3), np.array([x_m, 0.0, 0.0]))


def test_frames_that_are_kept_are_cameras_of_fewer_pixels():
    here, there = thinned(seen_from(0.0), CAMERA), thinned(seen_from(1.7), CAMERA)
    assert here[0].depth.shape == (90, 160)
    pair = compare_views(here[0], there[0], here[1], there[1])
    assert (pair.through, pair.same) == (0, pair.agree)
    assert pair.error < 1e-6  # planes, to the rounding of float32
    again = unpacked(packed([here, there]))
    assert_array_equal(again[1][0].depth, there[0].depth)
    assert_allclose(again[1][1], there[1])
    assert packed([]) == b""
    assert unpacked(b"") == []


@pytest.mark.parametrize(("num_rows", "kept"), [(1, {0}), (3, {0, 1, 2}), (101, {0, 20, 40, 60, 80, 100})])
def test_rows_that_are_kept(num_rows, kept):
    assert kept_rows(num_rows) == kept


@pytest.mark.parametrize(
    ("told", "block_x_m", "block_id", "expected"),
    [
        ({}, 0.0, 7, ""),
        ({}, 3.0, 7, "before what the other draws"),
        ({}, 0.0, 8, "of the instances"),
        ({"walk": "1"}, 3.0, 7, ""),  # the same walk: its frames are compared one after the other
        ({"town": "Town02"}, 3.0, 7, ""),
        ({"is_foreign": True}, 3.0, 7, ""),
    ],
)
def test_a_thing_stands_where_another_walk_sees_it(tmp_path, told, block_x_m, block_id, expected):
    rows, places = RowFiles(tmp_path), [[0.5 * k, 0.0] for k in range(3)]
    flights = [flight(1, 3, kept_places_m=places), flight(2, 3, kept_places_m=places, **told)]
    rows.write_kept("1.rows", [thinned(seen_from(x), CAMERA) for x, _ in places])
    rows.write_kept("2.rows", [thinned(seen_from(x + 0.7, block_x_m, block_id), CAMERA) for x, _ in places])
    findings = Findings()
    check_places(flights, rows, findings)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_town"] * bool(expected)
    assert all(expected in kind.got for kind in findings.kinds.values())
