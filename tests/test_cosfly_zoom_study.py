"""cosfly/studies/zoom.py: the same flights at every level, and optical against digital zoom."""

import json

import numpy as np
import pytest
from test_cosfly_render import needs_gl
from test_cosfly_zoom import IN_THE_WALL
from test_renderers_contract import circling, write_inputs
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.runtime.run_dir import read_manifest
from cosfly.studies.zoom import enlarged_fov_deg, tree_of

LEVELS = [110.0, 60.0, 30.0]


def test_a_longer_lens_shows_the_middle_as_large():
    longer_deg = enlarged_fov_deg(110.0, 5.0)
    assert np.tan(np.radians(longer_deg / 2)) == pytest.approx(np.tan(np.radians(55)) / 5)


@pytest.mark.slow
@needs_gl
def test_the_target_grows_as_the_lens_does(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    boxes, simplified, traces = write_inputs(folder / "inputs", [circling(6), circling(5, "path_002"), IN_THE_WALL])
    words = f"study zoom --map {boxes} --simplified {simplified} --traces {traces} --out {folder / 'out'} --every 2"
    settings = f"max_failed=1 render.fovs_deg={LEVELS} render.width_px=640 render.height_px=360".replace(", ", ",")
    sets = [word for setting in settings.split() for word in ("--set", setting)]
    result = CliRunner().invoke(app, [*words.split(), "--workers", "0", *sets])
    assert result.exit_code == 0, result.output
    studied = folder / "out", result.output
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
    assert set(wide["by_flight"]) == {"path_000", "path_002"}
    counts = read_manifest(tree_of(out, LEVELS[0])).counts  # a bad flight is counted and stops no other
    assert (counts.input, counts.kept, dict(counts.failed)) == (3, 2, {"render": 1})
