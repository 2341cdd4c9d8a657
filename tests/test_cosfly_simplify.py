"""Step 2: each pass against hand-made tables and properties; then the stage."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosfly.formats.boxes import BoxMap, make_box_map, read_boxes, write_boxes
from cosfly.formats.kinds import KINDS
from cosfly.simplify.passes import SimplifyConfig, crop_below_ground, merge, prune_nested, simplify
from cosfly.simplify.stage import cross_validate, run
from specimens import map_of

VEGETATION, BUILDINGS, STATIC, ROADS = (KINDS[name] for name in ("Vegetation", "Buildings", "Static", "Roads"))
PASSES = ["input", "merge", "crop_tree", "crop_below_ground", "prune_nested"]


def box_map(*rows, ids=None) -> BoxMap:
    """Rows of kind, low corner, high corner and, optionally, yaw in degrees."""
    ends = ((kind, np.array(low), np.array(high), yaw) for kind, low, high, *yaw in rows)
    return map_of(*((kind, (low + high) / 2, (high - low) / 2, *yaw) for kind, low, high, yaw in ends), ids=ids)


def only(what: str, **settings_) -> SimplifyConfig:
    """Settings with one pass switched on."""
    return SimplifyConfig(**{**dict.fromkeys(PASSES[1:], False), what: True, **settings_})


def random_map(seed: int, count: int, size_m: float = 30.0) -> BoxMap:
    rng = np.random.default_rng(seed)
    centers = rng.uniform([0, 0, -4], [size_m, size_m, 8], (count, 3))
    rotations = np.zeros((count, 3))
    rotations[:, 1] = rng.choice([0.0, 0.0, 30.0, -65.0], count)
    kinds = rng.choice([VEGETATION, BUILDINGS, STATIC, ROADS], count)
    ids = rng.choice(10 * count, count, replace=False)
    return make_box_map(centers, rng.uniform(0.2, 3.0, (count, 3)), rotations, kinds, ids)


def test_merge_follows_the_gap_rule():
    for kind, gap, count in [
        ("Vegetation", (2.0, 0, 0), 1),  # a gap equal to the threshold counts
        ("Vegetation", (2.001, 0, 0), 2),
        ("Vegetation", (0, 0, 2.5), 2),  # every axis must be near
        ("Vegetation", (-0.5, -0.5, -0.5), 1),  # overlap
        ("Buildings", (5.0, 0, 0), 1),
        ("Buildings", (5.0, 5.1, 0), 2),
        ("Static", (0.0, 0, 0), 2),  # not merged by default
        ("Buildings Vegetation", (0.0, 0, 0), 2),  # of two kinds
    ]:  # fmt: skip
        shift = np.where(np.array(gap) == 0, 0.0, 1.0 + np.array(gap))
        kinds = kind.split()
        pair = box_map((kinds[0], (0, 0, 0), (1, 1, 1)), (kinds[-1], shift, shift + 1))
        merged = simplify(pair, only("merge", min_fill=0.0, min_canopy_fill=0.0))
        assert len(merged) == count
        if count == 1:
            assert merged.ids.tolist() == [1]
            np.testing.assert_allclose(merged.mins[0], np.minimum(0, shift))
            np.testing.assert_allclose(merged.maxs[0], np.maximum(1, shift + 1))


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), min_fill=st.sampled_from([0.0, 0.5, 0.85, 1.0]))
def test_merged_boxes_enclose_their_members_and_fill_enough(seed, min_fill):
    boxes = random_map(seed, 60)
    merged = merge(boxes, {VEGETATION: (2.0, min_fill), BUILDINGS: (5.0, min_fill)})
    assert len(set(merged.ids.tolist())) == len(merged)
    assert set(merged.ids.tolist()) <= set(boxes.ids.tolist())
    for kind, low, high in zip(boxes.kinds, boxes.mins, boxes.maxs, strict=True):
        same = merged.kinds == kind
        assert ((merged.mins[same] <= low + 1e-9) & (merged.maxs[same] >= high - 1e-9)).all(axis=1).any()


def test_the_guard_keeps_a_street_between_two_askew_rows_and_the_papers_rule_does_not():
    turn = np.radians(40.0)
    rows = []
    for side in (-6.0, 6.0):
        for along in np.arange(-30, 31, 10.0):
            x, y = along * np.cos(turn) - side * np.sin(turn), along * np.sin(turn) + side * np.cos(turn)
            rows.append(("Buildings", (x - 5, y - 2.5, 0), (x + 5, y + 2.5, 8), 40.0))
    street = box_map(*rows)
    plain = simplify(street, only("merge", min_fill=0.0, min_canopy_fill=0.0))
    guarded = simplify(street, only("merge"))
    assert len(plain) == 1
    assert len(guarded) > 1
    walkable = [cross_validate(street, m)["simplified_walkable_m2"] for m in (plain, guarded)]
    assert walkable[0] == 0.0
    assert walkable[1] > 0.9 * cross_validate(street, street)["raw_walkable_m2"]


def test_stems_let_people_walk_below_trees():
    tree = box_map(("Vegetation", (0, 0, 0), (4, 6, 10)), ("Roads", (-9, -9, -1), (9, 9, 0)))
    stems = simplify(tree, only("crop_tree"))
    np.testing.assert_allclose(stems.maxs[2] - stems.mins[2], (0.5, 0.5, 2.0))
    np.testing.assert_allclose(stems.centers[2], (2, 3, 1))
    full = simplify(tree, only("crop_tree", trunk="full"))  # the paper's split
    np.testing.assert_allclose(full.mins[[0, 2]], [(0, 0, 2.5), (0, 0, 0)])
    np.testing.assert_allclose(full.maxs[[0, 2]], [(4, 6, 10.5), (4, 6, 2)])
    area = [cross_validate(tree, m)["simplified_walkable_m2"] for m in (stems, full)]
    assert area[0] > area[1] + 20.0


def test_adaptive_cropping_cuts_tall_trees_into_a_stem_and_low_pieces():
    plants = box_map(
        ("Vegetation", (0, 0, 0), (4, 6, 13)),  # stem and two pieces
        ("Vegetation", (9, 0, 0), (13, 4, 5)),  # just not too high
        ("Vegetation", (20, 0, 3), (24, 4, 9)),  # hangs: no stem
        ("Buildings", (30, 0, 0), (40, 9, 30)),
        ids=[7, 8, 9, 1],
    )
    result = simplify(plants, only("crop_tree", crop_strategy="adaptive"))
    assert result.ids.tolist() == [8, 1, 2, 7, 3, 4, 9]
    np.testing.assert_allclose(result.mins[2:], [(1.75, 2.75, 0), (0, 0, 5), (0, 0, 9), (20, 0, 3), (20, 0, 5)])
    np.testing.assert_allclose(result.maxs[2:], [(2.25, 3.25, 5), (4, 6, 9), (4, 6, 13), (24, 4, 5), (24, 4, 9)])
    again = simplify(result, only("crop_tree", crop_strategy="adaptive"))
    assert sorted(again.ids.tolist()) == sorted(result.ids.tolist())


def test_below_ground_goes_by_the_top_face_and_spares_surfaces():
    boxes = box_map(
        ("Static", (0, 0, -3), (1, 1, -0.01)),  # goes
        ("Static", (0, 0, -30), (1, 1, 0.2)),  # its middle is below, its top is not
        ("Static", (0, 0, -3), (1, 1, 0)),  # touches the ground
        ("Roads", (0, 0, -1), (9, 9, -0.06)),
        ("Water", (0, 0, -2), (9, 9, -0.5)),
    )
    assert crop_below_ground(boxes).ids.tolist() == [2, 3, 4, 5]


def test_clipping_cuts_off_what_lies_below_the_ground():
    boxes = box_map(
        ("Static", (0, 0, -3), (1, 1, 0)),  # only touches the ground: nothing of it is left
        ("Static", (0, 0, -30), (1, 1, 0.2), 30.0),
        ("Static", (0, 0, 1), (1, 1, 2)),
        ("Roads", (0, 0, -1), (9, 9, 0.5)),  # a surface stays whole
    )
    result = crop_below_ground(boxes, clip=True)
    assert result.ids.tolist() == [2, 3, 4]
    np.testing.assert_allclose(result.mins[:, 2], [0, 1, -1])
    np.testing.assert_allclose(result.maxs[:, 2], [0.2, 2, 0.5])
    leaning = replace(boxes, rotations_deg=np.full((4, 3), [20.0, 0, 0]))
    stays = crop_below_ground(leaning, clip=True)
    np.testing.assert_array_equal(stays.half_extents, leaning.select(leaning.maxs[:, 2] > 0).half_extents)


@pytest.mark.parametrize(("inner", "kind", "kept"), [
    (((1, 1, 1), (2, 2, 2)), "Buildings", [1]),
    (((1, 1, 1), (2, 2, 10.009)), "Buildings", [1]),  # within the tolerance of a centimetre
    (((1, 1, 1), (2, 2, 10.011)), "Buildings", [1, 2]),
    (((1, 1, 1), (2, 2, 2)), "Static", [1, 2]),  # another kind
    (((0, 0, 0), (10, 10, 10)), "Buildings", [1]),  # equal: the smaller id stays
])  # fmt: skip
def test_nested_boxes_of_one_kind_go(inner, kind, kept):
    boxes = box_map(("Buildings", (0, 0, 0), (10, 10, 10)), (kind, *inner))
    assert prune_nested(boxes, 0.01).ids.tolist() == kept


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), paper=st.booleans())
def test_the_whole_keeps_its_books(seed, paper):
    boxes = random_map(seed, 80)
    of_paper = SimplifyConfig(min_fill=0.0, min_canopy_fill=0.0, trunk="full")
    result = simplify(boxes, of_paper if paper else SimplifyConfig())
    ids = result.ids.tolist()
    assert len(set(ids)) == len(ids)
    assert [one.name for one in result.header.passes] == PASSES
    assert result.header.passes[0].counts == boxes.counts()
    assert result.header.passes[-1].counts == result.counts()
    after_crop, after_ground = (sum(one.counts.values()) for one in result.header.passes[2:4])
    assert sum(result.header.passes[1].counts.values()) <= len(boxes)
    assert after_ground <= after_crop


def test_stage_writes_map_report_and_picture(tmp_path: Path):
    source = tmp_path / "boxes_3d.json"
    boxes = random_map(1, 120)
    write_boxes(source, boxes)
    product = run(SimplifyConfig(), source, tmp_path / "out")
    simplified = read_boxes(product)
    assert [p.name for p in simplified.header.passes] == PASSES
    report = json.loads((tmp_path / "out/simplify_report.json").read_text())
    assert report["num_boxes"] == {"raw": 120, "simplified": len(simplified)}
    assert report["passes"][-1]["counts"] == simplified.counts()
    assert 0 < report["grid"]["iou"] <= 1
    assert (tmp_path / "out/simplify.png").read_bytes()[:4] == b"\x89PNG"
