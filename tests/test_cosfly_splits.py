"""cosfly/geometry/splits.py: what one walk is, and splits that share none."""

from collections import Counter
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosfly.formats.playback import read_track, write_track
from cosfly.geometry.splits import SPLITS, Course, assign_splits, walks_of
from specimens import make_flight

STEP_S = 0.5


def walk(num_points: int, *, begin: tuple[float, float] = (0.0, 0.0), heading_deg: float = 0.0):
    time_s = np.arange(num_points) * STEP_S
    way_m = 1.4 * time_s[:, None] * [np.cos(np.radians(heading_deg)), np.sin(np.radians(heading_deg))]
    return time_s, np.column_stack([way_m + begin, np.full(num_points, 0.9)])


def course(name: str, points) -> Course:
    return Course(name, "Town01", *points)


def groups(*courses: Course) -> list[set[str]]:
    found: dict[str, set[str]] = {}
    for name, walk_id in walks_of(courses).items():
        found.setdefault(walk_id, set()).add(name)
    return sorted(found.values(), key=sorted)


def test_perturbed_twins_are_one_walk_once_they_are_read_again(tmp_path):
    clean, _ = make_flight(40, seed=3)
    noisy, _ = make_flight(40, seed=3, variant="aug_001")
    offsets_m = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 3))
    perturbation = replace(noisy.perturbation, target_m=offsets_m)
    shifted = replace(noisy, targets_m=noisy.targets_m + offsets_m, perturbation=perturbation)
    for flight in (clean, shifted):
        write_track(tmp_path / "Town01" / flight.trajectory / flight.variant, flight)
    read = [read_track(tmp_path / "Town01" / clean.trajectory / variant) for variant in ("ORI", "aug_001")]
    one, other = (Course(flight.variant, flight.town, flight.time_s, flight.walked_m) for flight in read)
    assert groups(one, other) == [{"ORI", "aug_001"}]
    assert groups(one, replace(other, target_m=read[1].targets_m)) == [{"ORI"}, {"aug_001"}]  # the shift was real


def test_another_timestamp_planner_or_run_is_the_same_walk():
    points = walk(60)
    noise = np.random.default_rng(1).normal(0, 0.01, points[1].shape)
    assert groups(
        course("a/Town01/trajectory_1", points),
        course("a/Town01/trajectory_2", points),
        course("b/Town01/trajectory_1", (points[0], points[1] + noise)),
    ) == [{"a/Town01/trajectory_1", "a/Town01/trajectory_2", "b/Town01/trajectory_1"}]


def test_walks_agree_with_a_slow_plain_comparison():
    rng = np.random.default_rng(5)
    courses = [
        course(f"{i:02d}", walk(20 + i % 7, begin=tuple(rng.integers(0, 3, 2) * 0.4), heading_deg=30.0 * (i % 3)))
        for i in range(30)
    ]

    def are_near(one: Course, other: Course) -> bool:
        places = [{t: p[:2] for t, p in zip(c.time_s, c.target_m, strict=True) if t % 1 == 0} for c in (one, other)]
        shared = places[0].keys() & places[1].keys()
        near = [t for t in shared if np.linalg.norm(places[0][t] - places[1][t]) <= 0.5]
        return bool(near) and (len(near) == len(shared) or len(near) >= max(5, 0.5 * len(shared)))

    walk_id = {c.name: c.name for c in courses}
    for one in courses:
        for other in courses:
            if are_near(one, other):
                names = walk_id[one.name], walk_id[other.name]
                walk_id = {name: min(names) if of in names else of for name, of in walk_id.items()}
    assert walks_of(courses) == walk_id
    assert 1 < len(set(walk_id.values())) < 30


@given(
    num_groups=st.integers(3, 60), val=st.sampled_from([0.0, 0.01, 0.1, 0.45]),
    test=st.sampled_from([0.0, 0.01, 0.2, 0.45]), seed=st.integers(0, 5),
)  # fmt: skip
def test_splits_cover_all_and_none_is_empty(num_groups, val, test, seed):
    shares = {"val": val, "test": test}
    names = [f"walk_{i}" for i in range(num_groups)]
    split_of = assign_splits(names, shares, seed)
    assert set(split_of) == set(names)
    counts = Counter(split_of.values())
    assert set(counts) == {split for split in SPLITS if split == "train" or shares[split] > 0}
    assert abs(counts["val"] - val * num_groups) <= 1
    assert split_of == assign_splits(list(reversed(names)) * 2, shares, seed)  # order, repeats
    if num_groups > 30 and min(val, test) > 0.05:
        assert split_of != assign_splits(names, shares, seed + 1)


def test_with_few_groups_train_comes_first():
    shares = {"val": 0.1, "test": 0.1}
    assert sorted(assign_splits(["a", "b"], shares, 0).values()) == ["train", "val"]
    assert assign_splits(["a"], shares, 0) == assign_splits(["a"], {}, 0) == {"a": "train"}
    assert assign_splits([], shares, 0) == {}
