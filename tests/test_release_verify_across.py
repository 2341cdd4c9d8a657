"""Parts of `release verify`: flights against each other, and what is measured in a picture."""

import numpy as np
import pytest
from tables import each

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
