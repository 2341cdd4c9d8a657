"""Flights against each other: rows of one value, splits, pairs, copies."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest

from release.verify.across import COMPARED, NO_SECOND, RowFiles, Summary, check_across
from release.verify.findings import Findings


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
