"""Parts of `release verify`: flights against each other, neighbouring pictures, and what is measured in one."""

from dataclasses import replace

import numpy as np
import pytest
from tables import each

from cosfly.geometry.reprojection import Agreement
from release.flight_rows import FlightRows
from release.verify import scene
from release.verify.across import Summary, check_across
from release.verify.findings import Findings
from release.verify.scene import PERSON, SKY, survey


def _obvious(depth, mask):
    kinds, ids = mask[..., 0], mask[..., 1].astype(int) | mask[..., 2].astype(int) << 8
    person = ids == 65535
    rows, columns = np.nonzero(person)
    box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
    odd = int(((kinds == SKY) != (depth == FAR_M)).sum())
    return [depth.min(), depth.max(), odd, person.sum(), (person & (kinds != PERSON)).sum(), kinds.max()], box


def flight(number: int, **values) -> Summary:
    told = {
        "name": f"run/Town01/trajectory_{number}/ORI", "split": "train", "walk": str(number), "pair": None,
        "track": "clean", "town": "Town01", "num_rows": 1, "frames_digest": "",
    }  # fmt: skip
    return Summary(**(told | values))


@each(("change", "codes"), [
    ({}, []), ({"split": "test"}, []), ({"split": "test", "walk": "1"}, ["leak"]),
    ({"pair": "run/Town01/trajectory_9/ORI"}, ["pair"]), ({"pair": "run/Town01/trajectory_1/ORI"}, ["pair"]),
])  # fmt: skip
def test_flights_that_do_not_fit_each_other_are_found(change, codes):
    findings = Findings()
    check_across([flight(1), flight(2, **change)], by_town=False, both=False, findings=findings)
    assert [code for _, code in findings.kinds] == codes


WHOLE = Agreement(
    seen=2000, agree=2000, hidden=0, through=0, same=2000, planes=1700, shifted=0, renamed=0, error=0.0,
    error_flat=0.0, error_standing=0.0, seen_back=2000, through_back=0
)  # fmt: skip


@each(("change", "code"), [
    ({}, None), ({"renamed": 34}, "scene_instance"), ({"same": 1800}, "scene_instance"),
    ({"shifted": 20}, "scene_depth"),
    ({"agree": 200, "hidden": 1800, "same": 200}, None), ({"through": 60}, "scene_depth"),
    ({"through_back": 60}, "scene_depth"),
    ({"error": 0.001}, "scene_depth"),
    ({"error_flat": 0.0001, "error_standing": 0.001}, None),
])  # fmt: skip
def test_neighbouring_frames_show_one_world(change, code):
    found = [WHOLE] * 20
    found[12] = replace(WHOLE, **change)
    rows = [
        {"frame_index": k, "target_mask_bbox": dict.fromkeys(("xmin_px", "ymin_px", "xmax_px", "ymax_px"), 9.0)}
        for k in range(21)
    ]
    findings = Findings()
    pairs = [(k, 1, pair) for k, pair in enumerate(found, 1)]
    scene._judge_pairs(FlightRows("run/Town/trajectory/ORI", rows, given_id="trajectory_ORI"), pairs, findings)
    assert [kind.code for kind in findings.kinds.values()] == [code] * (code is not None)


@each(
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


@pytest.mark.parametrize("sky", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_every_pixel_is_counted(seed, sky):
    depth, mask = _frame(seed, sky=sky)
    found, (counts, box) = survey(depth, mask), _obvious(depth, mask)
    assert (list(found[:-1]), found.box.tolist(), found.num_odd_sky > 0) == (counts, box, sky)
