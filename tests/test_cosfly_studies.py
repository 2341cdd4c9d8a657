"""Studies: depth, the beam of TA*+Smooth, and zoom."""

import json

import numpy as np
import pytest
from specimens_planning import CANYON, town_of, walk_along
from test_cosfly_render import needs_gl
from test_cosfly_zoom import IN_THE_WALL
from test_renderers_contract import circling, write_inputs
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.formats.boxes import write_boxes
from cosfly.formats.pedestrian_paths import write_paths
from cosfly.planners.contract import PlanConfig
from cosfly.runtime.run_dir import read_manifest
from cosfly.studies import beam
from cosfly.studies.beam import FIGURES, PAPER_BEAM, Planned
from cosfly.studies.depth import study_of
from cosfly.studies.zoom import enlarged_fov_deg, tree_of

NEAR_M, FAR_M = 15.36, 38.32  # tab:depth_format_comparison


def ramp(dtype: type, shape: tuple[int, int] = (72, 128)) -> np.ndarray:
    """Depths spread evenly over the paper's range, in an order that no row tells."""
    values = np.linspace(NEAR_M, FAR_M, shape[0] * shape[1])
    return np.random.default_rng(0).permutation(values).reshape(shape).astype(dtype)


def test_depths_spread_evenly_give_the_papers_errors():
    """Its scene is nearly so: half a step at most, a quarter of one on average; its print is within 3 % of that."""
    rows = {row["coding"]: row for row in study_of(ramp(np.float64, (360, 640)), "ramp")[0]["rows"]}
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


def planned(value, reason=None):
    return Planned(figures=None if value is None else dict.fromkeys(FIGURES, value), reason=reason)


def test_differences_are_those_of_the_walks_that_both_fly():
    many = {
        PAPER_BEAM: [planned(1.0), planned(5.0), planned(None, "no_path")],
        64: [planned(3.0), planned(None, "no_path"), planned(9.0)],
    }
    rows = beam.summarize(many, np.random.default_rng(0))
    assert rows[64]["figures"]["length_m"] == {"mean": 3.0, "difference": 2.0, "low": 2.0, "high": 2.0}
    assert rows[64]["kept"] == 2
    nobody = beam.summarize({PAPER_BEAM: [planned(None, "no_path")]}, np.random.default_rng(0))
    assert nobody[PAPER_BEAM] == {"walks": 1, "kept": 0, "figures": {}}


@pytest.mark.slow
def test_the_study_of_beams_twice_gives_the_same_bytes(tmp_path, in_this_process):
    write_boxes(tmp_path / "map.json", town_of(*CANYON))
    write_paths(tmp_path / "path.json", [walk_along("path_00000", [(0, 0), (30, 0)])], {})
    one, two = (
        beam.run(PlanConfig(), tmp_path / "map.json", tmp_path / "path.json", tmp_path / out, workers=1)
        for out in ("one", "two")
    )
    assert one.read_bytes() == two.read_bytes()
    assert json.loads(one.read_text())["beams"]["2048"]["kept"] == 1


LEVELS = [110.0, 60.0, 30.0]


def test_a_longer_lens_shows_the_middle_as_large():
    longer_deg = enlarged_fov_deg(110.0, 5.0)
    assert np.tan(np.radians(longer_deg / 2)) == pytest.approx(np.tan(np.radians(55)) / 5)


@pytest.mark.slow
@needs_gl
def test_the_target_grows_as_the_lens_does(tmp_path_factory, in_this_process):
    folder = tmp_path_factory.mktemp("study")
    boxes, simplified, traces = write_inputs(folder / "inputs", [circling(6), circling(5, "path_002"), IN_THE_WALL])
    words = f"study zoom --map {boxes} --simplified {simplified} --traces {traces} --out {folder / 'out'} --every 2"
    settings = f"max_failed=1 render.fovs_deg={LEVELS} render.width_px=640 render.height_px=360".replace(", ", ",")
    sets = [word for setting in settings.split() for word in ("--set", setting)]
    result = CliRunner().invoke(app, [*words.split(), "--workers", "0", *sets])
    assert result.exit_code == 0, result.output
    out = folder / "out"
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
    assert set(wide["by_flight"]) == {"path_000", "path_002"}
    counts = read_manifest(tree_of(out, LEVELS[0])).counts  # a bad flight is counted and stops no other
    assert (counts.input, counts.kept, dict(counts.failed)) == (3, 2, {"render": 1})
