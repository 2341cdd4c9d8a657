"""The sweep over the beam of TA*+Smooth: what is recorded of it, and the same bytes twice."""

import json

import numpy as np
import pytest
from specimens_planning import CANYON, town_of, walk_along

from cosfly.formats.boxes import write_boxes
from cosfly.formats.pedestrian_paths import write_paths
from cosfly.studies import beam
from cosfly.studies.beam import FIGURES, PAPER_BEAM, BeamConfig, Planned


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


def test_the_papers_beam_must_be_one_of_the_beams():
    with pytest.raises(ValueError, match="2048"):
        BeamConfig(beams=(64, 256))


@pytest.mark.slow
def test_the_study_of_beams_twice_gives_the_same_bytes(tmp_path):
    write_boxes(tmp_path / "map.json", town_of(*CANYON))
    write_paths(tmp_path / "path.json", [walk_along("path_00000", [(0, 0), (30, 0)])], {})
    cfg = BeamConfig(beams=(64, 2048))
    one, two = (
        beam.run(cfg, tmp_path / "map.json", tmp_path / "path.json", tmp_path / out, workers=1)
        for out in ("one", "two")
    )
    assert one.read_bytes() == two.read_bytes()
    assert json.loads(one.read_text())["beams"]["2048"]["kept"] == 1
