"""The sweep over the beam of TA*+Smooth: what is changed, what is recorded of it, and the same bytes twice."""

import json

import numpy as np
import pytest
from specimens_planning import CANYON, town_of, walk_along

from cosfly.errors import ConfigError
from cosfly.planners.contract import PlanConfig
from cosfly.products.boxes import write_boxes
from cosfly.products.walks import write_paths
from cosfly.studies import variants
from cosfly.studies.variants import AS_SET, SHOWN, Flown, VariantsConfig


def flown(value, reason=None):
    figures = None if value is None else {figure: value for figure, _, _ in SHOWN}
    return Flown(figures=figures, reason=reason, times_ms={"all": 1.0})


def test_a_change_that_cannot_be_is_named():
    cfg = VariantsConfig(variants={"wrong": ("track_astar.beams=2",)})
    with pytest.raises(ConfigError, match=r"the variant wrong.*beam"):
        cfg.of("wrong")


def test_differences_are_those_of_the_walks_that_both_fly():
    many = {
        AS_SET: [flown(1.0), flown(5.0), flown(None, "no_path")],
        "other": [flown(3.0), flown(None, "no_path"), flown(9.0)],
    }
    rows = variants.summarize(many, np.random.default_rng(0))
    assert rows["other"]["figures"]["length_m"] == {"mean": 3.0, "difference": 2.0, "low": 2.0, "high": 2.0}
    assert (rows["other"]["kept"], rows["other"]["reasons"]) == (2, {"no_path": 1})
    nobody = variants.summarize({AS_SET: [flown(None, "no_path")]}, np.random.default_rng(0))
    assert nobody[AS_SET] == {"walks": 1, "kept": 0, "reasons": {"no_path": 1}, "figures": {}}


def test_the_study_of_beams_twice_gives_the_same_bytes(tmp_path):
    write_boxes(tmp_path / "map.json", town_of(*CANYON))
    write_paths(tmp_path / "path.json", [walk_along("path_00000", [(0, 0), (30, 0)])], {})
    cfg = variants.beam_study(PlanConfig(), (64, 2048))
    assert set(cfg.variants) == {AS_SET, "beam 64"}
    one, two = (
        variants.run(cfg, tmp_path / "map.json", tmp_path / "path.json", tmp_path / out, workers=1)
        for out in ("one", "two")
    )
    assert one.read_bytes() == two.read_bytes()
    assert json.loads(one.read_text())["variants"][AS_SET]["kept"] == 1
