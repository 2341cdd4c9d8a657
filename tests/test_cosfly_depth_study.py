"""`cosfly study depth`."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosfly.studies.depth import BITS, quantised, run

NEAR_M, FAR_M = 15.36, 38.32  # tab:depth_format_comparison


def ramp(dtype: type, shape: tuple[int, int] = (72, 128)) -> np.ndarray:
    """Depths spread evenly over the paper's range, in an order that no row tells."""
    values = np.linspace(NEAR_M, FAR_M, shape[0] * shape[1])
    return np.random.default_rng(0).permutation(values).reshape(shape).astype(dtype)


def test_depths_spread_evenly_give_the_papers_errors(tmp_path):
    """Its scene is nearly so: half a step at most, a quarter of one on average; its print is within 3 % of that."""
    np.save(tmp_path / "depth.npy", ramp(np.float64, (360, 640)))
    rows = {row["coding"]: row for row in run(tmp_path / "depth.npy", tmp_path / "out")["rows"]}
    for coding, *errors_cm, psnr_db in (
        ("8-bit", 4.5019, 2.2494, 2.5979, 58.9),
        ("10-bit", 1.1222, 0.5543, 0.6418, 71.1),
        ("12-bit", 0.2803, 0.1436, 0.1646, 82.9),
        ("16-bit", 0.0175, 0.0088, 0.0101, 107.1),
    ):
        row = rows[coding]
        assert [row["max_cm"], row["mean_cm"], row["rmse_cm"]] == pytest.approx(errors_cm, rel=0.03)
        assert row["psnr_db"] == pytest.approx(psnr_db, abs=0.3)
        kib = 360 * 640 * int(coding.removesuffix("-bit")) / 8 / 1024
        assert row["kilobytes"] == pytest.approx(kib), "as the paper's column counts them"


@given(st.sampled_from(BITS), st.integers(0, 2**31))
def test_codes_are_within_half_a_step(bits, seed):
    truth = np.random.default_rng(seed).uniform(1, 90, (5, 7)).astype(np.float32)
    measured = np.ones_like(truth, dtype=bool)
    codes, values = quantised(truth, measured, bits)
    step = (float(truth.max()) - float(truth.min())) / (2**bits - 1)
    assert np.abs(values - truth).max() <= step / 2 * 1.0001 + 1e-6
    assert (codes.min(), codes.max()) == (0, 2**bits - 1)
