"""Parts of `release verify`: flights against each other, neighbouring pictures, and what is measured in one."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from tables import each

from cosfly.products.kinds import KINDS
from cosfly.space.reprojection import Agreement
from release.columns import POSE
from release.flight_rows import FlightRows
from release.verify import scene
from release.verify.across import COMPARED, NO_SECOND, RowFiles, Summary, check_across
from release.verify.findings import Findings
from release.verify.pictures import NUM_IDS, PERSON, SKY, ground_beside, new_kinds, rays_to_person, survey


def flight(number: int, num_rows: int, **told) -> Summary:
    values = {
        "name": f"run/Town01/trajectory_{number}/ORI", "rows_file": f"{number}.rows", "split": "train",
        "walk": str(number), "pair": None,
        "track": "clean", "town": "Town01", "is_foreign": False, "num_rows": num_rows, "first_frames": [],
        "frames_digest": "",
        "way_digest": "", "kinds": [], "grounds_m": [],
    }  # fmt: skip
    return Summary(**(values | told))


def stored(folder, flights: list[np.ndarray]) -> tuple[RowFiles, list[Summary]]:
    rows = RowFiles(folder)
    for number, own in enumerate(flights):
        (folder / f"{number}.rows").write_bytes(own.tobytes())
    return rows, [flight(number, len(own)) for number, own in enumerate(flights)]


def table(num_rows: int, rng: np.random.Generator, most: int) -> np.ndarray:
    found = np.zeros(num_rows, COMPARED)
    for name in ("sample_id", "image", "depth", "place"):
        found[name] = rng.integers(0, most, num_rows)
    found["cell"] = rng.integers(-2, 3, (num_rows, 3))
    found["cell"][rng.random(num_rows) < 0.3] = NO_SECOND
    return found


@pytest.mark.parametrize("column", ["sample_id", "image", "cell"])
def test_rows_of_one_value_are_found(tmp_path, column):
    for sizes, most in (((), 3), ((0, 0), 3), ((1,), 3), ((12, 0, 7, 30), 5), ((40, 3), 200)):
        rng = np.random.default_rng(most)
        tables = [table(size, rng, most) for size in sizes]
        wanted = defaultdict(list)
        for k, own in enumerate(tables):
            for i, value in enumerate(own[column].tolist()):
                if value not in (0, [NO_SECOND] * 3):
                    wanted[str(value)].append((k, i))
        rows, flights = stored(tmp_path, tables)
        found = [[tuple(place) for place in places.tolist()] for _, places in rows.groups(flights, column)]
        assert sorted(found) == sorted(places for places in wanted.values() if len(places) > 1)


def found_in(folder, flights: list[np.ndarray], **told) -> dict[str, int]:
    rows, summaries = stored(folder, flights)
    findings = Findings()
    check_across([Summary(**(vars(s) | told)) for s in summaries], rows, by_town=False, both=False, findings=findings)
    return {code: kind.count for (_, code), kind in findings.kinds.items()}


def test_copies_and_duplicates_are_counted(tmp_path):
    one, other = np.zeros(3, COMPARED), np.zeros(3, COMPARED)
    one["cell"] = other["cell"] = NO_SECOND
    one["sample_id"], other["sample_id"] = (1, 2, 3), (4, 5, 6)
    one["image"], other["image"] = (7, 8, 9), (10, 11, 9)
    assert found_in(tmp_path, [one, other]) == {}  # one picture from one place: a camera that stands still
    other["pose"][2] = (0.6, 0, 0, 0, 0, 0)
    assert found_in(tmp_path, [one, other]) == {"copy": 1}
    other["pose"][2] = (0, 0, 0, 0, 359, 0)
    assert found_in(tmp_path, [one, other]) == {}
    other["sample_id"] = (3, 3, 6)
    assert found_in(tmp_path, [one, other]) == {"duplicate": 1}


def test_the_same_way_in_two_splits_is_a_leak(tmp_path):
    walk = np.zeros(20, COMPARED)
    walk["cell"] = np.column_stack([np.arange(20), np.arange(20) // 2, np.zeros(20)])
    late = walk.copy()
    late["cell"][:, 0] += 40
    assert found_in(tmp_path, [walk, late]) == {}
    assert found_in(tmp_path, [walk, walk.copy()]) == {"walk": 1}
    rows, (one, other) = stored(tmp_path, [walk, walk.copy()])
    findings = Findings()
    other.split = "test"
    check_across([one, other], rows, by_town=False, both=False, findings=findings)
    assert {code for _, code in findings.kinds} == {"leak"}


@pytest.mark.parametrize(
    ("num_same", "split", "is_found"), [(20, "test", True), (20, "train", False), (13, "test", False)]
)
def test_the_same_way_at_another_time_is_a_leak_between_splits(tmp_path, num_same, split, is_found):
    walk = np.zeros(20, COMPARED)
    walk["cell"] = NO_SECOND
    walk["place"] = np.arange(1, 21)
    late = walk.copy()
    late["place"][num_same:] += 100
    rows, (one, other) = stored(tmp_path, [walk, late])
    other.split = split
    findings = Findings()
    check_across([one, other], rows, by_town=False, both=False, findings=findings)
    assert {code for _, code in findings.kinds} == ({"leak"} if is_found else set())


def test_who_stands_still_is_no_copy_of_who_stands_there_too(tmp_path):
    stands = np.zeros(40, COMPARED)
    stands["cell"], stands["place"] = NO_SECOND, np.repeat(np.arange(1, 9), 5)
    rows, (one, other) = stored(tmp_path, [stands, stands.copy()])
    other.split, findings = "test", Findings()
    check_across([one, other], rows, by_town=False, both=False, findings=findings)
    assert not findings.kinds, "eight places are too few"


def told_of(flights: list[Summary], tmp_path) -> list[str]:
    findings = Findings()
    rows = RowFiles(tmp_path)
    for one in flights:
        (tmp_path / one.rows_file).write_bytes(np.zeros(one.num_rows, COMPARED).tobytes())
    check_across(flights, rows, by_town=False, both=False, findings=findings)
    return sorted(code for _, code in findings.kinds)


def test_a_thing_is_of_one_kind_in_all_flights_of_a_runs_town(tmp_path):
    building, wall = 7 << 8 | 3, 7 << 8 | 4
    assert told_of([flight(1, 1, kinds=[building]), flight(2, 1, kinds=[building])], tmp_path) == []
    assert told_of([flight(1, 1, kinds=[building]), flight(2, 1, kinds=[wall])], tmp_path) == ["instance_kind"]
    elsewhere = flight(2, 1, kinds=[wall], town="Town02")
    assert told_of([flight(1, 1, kinds=[building]), elsewhere], tmp_path) == []


@pytest.mark.parametrize(
    ("off_m", "num_frames", "is_found"), [(0.0, 9, False), (0.01, 9, False), (-0.4, 9, True), (-0.4, 4, False)]
)
def test_twins_stand_on_one_ground(tmp_path, off_m, num_frames, is_found):
    one = flight(1, 1, pair="run/Town01/trajectory_1/aug_001", grounds_m=[(k, -0.06) for k in range(20)])
    other = flight(2, 1, name=one.pair, track="perturbed", walk="1", pair=one.name)
    other.grounds_m = [(2 * k, -0.06 + off_m) for k in range(num_frames)]
    assert told_of([one, other], tmp_path) == ["ground"] * is_found


# --- what neighbouring pictures of a flight say of each other, and what the ground beside the feet --------------------


WHOLE = Agreement(
    seen=2000, agree=2000, hidden=0, through=0, same=2000, planes=1700, shifted=0, renamed=0, error=0.0,
    error_flat=0.0, error_standing=0.0, seen_back=2000, through_back=0
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({}, None), ({"renamed": 34}, "scene_instance"), ({"same": 1800}, "scene_instance"),
        ({"shifted": 20}, "scene_depth"),
        ({"agree": 200, "hidden": 1800, "same": 200}, None), ({"through": 60}, "scene_depth"),
        ({"through_back": 60}, "scene_depth"),
        ({"error": 0.001}, "scene_depth"),
        ({"error_flat": 0.0001, "error_standing": 0.001}, None),
    ],
)  # fmt: skip
def test_neighbouring_frames_show_one_world(change, code):
    found = [WHOLE] * 20
    found[12] = replace(WHOLE, **change)
    rows = [
        {"frame_index": k, "target_mask_bbox": dict.fromkeys(("xmin_px", "ymin_px", "xmax_px", "ymax_px"), 9.0)}
        for k in range(21)
    ]
    findings = Findings()
    pairs = [(k, 1, pair) for k, pair in enumerate(found, 1)]
    scene._judge_pairs(
        FlightRows("run/Town/trajectory/ORI", rows, given_id="trajectory_ORI"), pairs, "float32", findings
    )
    assert [kind.code for kind in findings.kinds.values()] == [code] * (code is not None)


@pytest.mark.parametrize(
    ("name", "error", "is_found"),
    [("error_flat", 1e-6, False), ("error_flat", 8e-5, True), ("error_standing", 3e-5, False),
     ("error_standing", 1.8e-4, True)],
)  # fmt: skip
def test_planes_keep_their_place_through_a_flight(name, error, is_found):
    """8e-5 is of depth set off by 0.3 m, 1.8e-4 of depth scaled by 2 %."""
    findings = Findings()
    flight = FlightRows("run/Town/trajectory/ORI", [{"frame_index": 0}])
    scene._judge_scale(flight, [(0, 1, replace(WHOLE, **{name: error}))] * 9, findings)
    assert [kind.code for kind in findings.kinds.values()] == ["scene_depth"] * is_found


@pytest.mark.parametrize(("scale", "id_of_ground", "expected_m"), [(1.0, 1, 0.0), (1.02, 1, -0.4), (1.0, 0, np.nan)])
def test_ground_beside_the_feet(scale, id_of_ground, expected_m):
    """A camera 20 m above a road that looks down 45 degrees, at somebody 20 m ahead. The plane below everything, of no
    id, says nothing."""
    row = {
        "frame_index": 0, "pose": dict.fromkeys(POSE, 0.0) | {"z_m": 20.0, "pitch_deg": -45.0}, "width_px": 160,
        "height_px": 120,
        "intrinsics": {"fx": 140.0, "fy": 140.0, "cx": 80.0, "cy": 60.0},
        "target": {"x_m": 20.0, "y_m": 0.0, "z_m": 0.9},
    }  # fmt: skip
    v = (np.mgrid[:120, :160][0] + 0.5 - 60.0) / 140.0
    depth = (20.0 / (np.sin(np.pi / 4) + v * np.cos(np.pi / 4)) * scale).astype(np.float32)
    instance = np.zeros((120, 160, 3), np.uint8)
    instance[:] = (KINDS["Roads"], id_of_ground, 0)
    found = ground_beside(FlightRows("run/Town/trajectory/ORI", [row]), 0, depth, instance)
    np.testing.assert_allclose(found, expected_m, atol=1e-4)


# --- release/verify/pixels.py -----------------------------------------------------------------------------------------


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
