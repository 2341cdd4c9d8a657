"""cosfly/studies/zoom.py: the same flights at every level, and optical against digital zoom."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from test_cosfly_render import needs_gl
from test_cosfly_zoom import IN_THE_WALL
from test_renderers_contract import circling, write_inputs
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.geometry import intrinsic_matrix
from cosfly.products.frames import Camera
from cosfly.studies.zoom import compare, digital_zoom, enlarged_camera, spread, ssim, text_rows
from cosfly.work.stage_folder import read_manifest

LEVELS = [110.0, 60.0, 30.0]


# --- pictures ---------------------------------------------------------------------------------------------------------


def checks(width: int = 64, height: int = 48) -> np.ndarray:
    rows, columns = np.mgrid[0:height, 0:width]
    grey = (((rows // 8) + (columns // 8)) % 2 * 200 + 20).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def test_psnr_by_hand():
    """Every value 5 off: 10 log10(255^2 / 25) = 34.15 dB; a constant hides no edge."""
    same, found = compare(checks(), checks()), compare(checks() + 5, checks())
    assert (same.psnr_db, same.ssim, same.sharpness) == (99.0, pytest.approx(1.0), pytest.approx(1.0))
    assert (found.psnr_db, found.sharpness) == (pytest.approx(34.151, abs=1e-3), pytest.approx(1.0))


def test_ssim_of_a_constant_is_that_of_its_brightness():
    """(2 a b + C1) / (a^2 + b^2 + C1) without any structure."""
    one, two = np.full((30, 30), 100.0), np.full((30, 30), 120.0)
    c1 = (0.01 * 255) ** 2
    assert ssim(one, two) == pytest.approx((2 * 100 * 120 + c1) / (100**2 + 120**2 + c1))


def test_digital_zoom_enlarges_about_the_middle():
    """A ramp stays one, half as steep at twice the size, with its middle where it was; once as large is the picture."""
    ramp = np.repeat(np.tile(np.arange(10, 210, 4, dtype=np.uint8), (40, 1))[..., None], 3, axis=2)
    for kernel in ("bilinear", "bicubic"):
        found = digital_zoom(ramp, 2.0, kernel)[20, :, 0].astype(float)
        middle = (found[24] + found[25]) / 2
        assert middle == pytest.approx(ramp[20, 24:26, 0].astype(float).mean(), abs=1.0)
        assert np.diff(found[5:45]).mean() == pytest.approx(2.0, abs=0.1)
        np.testing.assert_array_equal(digital_zoom(checks(), 1.0, kernel), checks())


def test_a_longer_lens_shows_the_middle_as_large():
    camera = Camera(1280, 720, intrinsic_matrix(1280, 720, 110.0))
    longer = enlarged_camera(camera, 5.0)
    assert longer.focal_px == pytest.approx(5 * camera.focal_px)
    assert longer.intrinsic[:2, 2].tolist() == [640.0, 360.0]
    assert np.tan(np.radians(longer.fov_deg / 2)) == pytest.approx(np.tan(np.radians(55)) / 5)


# --- figures ----------------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=20))
def test_a_spread_lies_round_its_mean(values):
    found = spread(values, np.random.default_rng(0))
    assert found["mean"] == pytest.approx(np.mean(values), abs=1e-3)
    assert found["low"] - 1e-3 <= found["mean"] <= found["high"] + 1e-3
    assert min(values) - 1e-3 <= found["low"] <= found["high"] <= max(values) + 1e-3


def test_a_flight_that_is_never_seen_is_in_no_mean():
    assert spread([None, 4.0, None], np.random.default_rng(0))["mean"] == 4.0
    assert spread([None], np.random.default_rng(0)) == {"mean": None, "std": None, "low": None, "high": None}


# --- the study --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def studied(tmp_path_factory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("study")
    boxes, simplified, traces = write_inputs(folder / "inputs", [circling(6), circling(5, "path_002"), IN_THE_WALL])
    words = f"study zoom --map {boxes} --simplified {simplified} --traces {traces} --out {folder / 'out'} --every 2"
    settings = f"max_failed=1 render.fovs_deg={LEVELS} render.width_px=640 render.height_px=360".replace(", ", ",")
    sets = [word for setting in settings.split() for word in ("--set", setting)]
    result = CliRunner().invoke(app, [*words.split(), "--workers", "0", *sets])
    assert result.exit_code == 0, result.output
    return folder / "out", result.output


@needs_gl
def test_the_target_grows_as_the_lens_does(studied):
    """In the middle of the picture sizes go as focal lengths, and what hides the person does not change."""
    out, _ = studied
    found = json.loads((out / "zoom_study.json").read_text())
    levels = found["levels"]
    assert [level["fov_deg"] for level in levels] == LEVELS
    assert [level["frames"] for level in levels] == [6, 6, 6]
    wide, _, long = levels
    factor = long["focal_length_px"] / wide["focal_length_px"]
    for name in ("width_px", "height_px"):
        assert long[name]["mean"] / wide[name]["mean"] == pytest.approx(factor, rel=0.05)
    assert long["visibility"]["mean"] == pytest.approx(wide["visibility"]["mean"], abs=0.05)
    assert 0.2 < long["track_quality"]["mean"] < 1.0
    assert set(found["by_flight"]) == {"path_000", "path_002"}
    fidelity = found["fidelity"]  # optical zoom is sharper than digital
    assert set(fidelity) == {"2", "5"}
    for kernels in fidelity.values():
        assert all(one["sharpness"]["mean"] < 0.9 for one in kernels.values())
        assert kernels["bicubic"]["sharpness"]["mean"] > kernels["bilinear"]["sharpness"]["mean"]
    assert fidelity["5"]["bicubic"]["ssim"]["mean"] < fidelity["2"]["bicubic"]["ssim"]["mean"]
    counts = read_manifest(out).counts  # a bad flight is counted and stops no other
    assert (counts.input, counts.kept, dict(counts.failed)) == (3, 2, {"render": 1})


@needs_gl
def test_pictures_and_tables(studied):
    out, output = studied
    assert Image.open(out / "zoom_levels.png").size == (3 * 480, 2 * (270 + 36))
    assert Image.open(out / "zoom_fidelity.png").size == (2 * 960, 2 * (540 + 36))
    rows = text_rows(json.loads((out / "zoom_study.json").read_text()))
    assert [row[0] for row in rows[::2]] == ["wide-angle", "narrow", "telephoto"]
    assert rows[1][3:] == ["12 x 24", "89.2", "0.72"]
    assert "telephoto" in output
