"""`cosfly study muco`: what is changed, what is told of it, and the same bytes twice."""

import json

import cv2
import numpy as np
import pytest
from specimens_planning import CANYON, town_of, walk_along
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.errors import ConfigError
from cosfly.planners.contract import PlanConfig
from cosfly.products.boxes import write_boxes
from cosfly.products.walks import write_paths
from cosfly.studies import variants
from cosfly.studies.variants import AS_SET, SHOWN, Flown, VariantsConfig


def flown(value, reason=None):
    figures = None if value is None else {figure: value for figure, _, _ in SHOWN}
    return Flown(figures=figures, reason=reason, times_ms={"all": 1.0})


def test_each_weight_is_changed_alone_and_those_of_styles_with_styles():
    cfg = variants.weight_study(PlanConfig())
    plain = PlanConfig(planner="muco")
    for name in set(cfg.variants) - {AS_SET, variants.PRINTED_STEP}:
        weight, _, factor = name.partition(" x ")
        muco = plain.muco.model_copy(update={weight: float(factor) * getattr(plain.muco, weight)})
        assert cfg.of(name) == plain.model_copy(update={"muco": muco})
    assert cfg.of(AS_SET) == plain
    assert cfg.of(variants.PRINTED_STEP).muco.step == "paper"
    assert "weight_bearing x 2" not in cfg.variants
    assert "weight_bearing x 2" in variants.weight_study(PlanConfig(styles={"side": 1.0})).variants


def test_a_change_that_cannot_be_is_named():
    cfg = VariantsConfig(variants={"wrong": ("muco.weight_jerks=2",)})
    with pytest.raises(ConfigError, match=r"the variant wrong.*weight_jerk"):
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
    many = {variants.name_of("w", factor): [flown(3.0)] for factor in variants.FACTORS[1:]}
    many |= {AS_SET: [flown(1.0)], "w x 0": [flown(None, "no_path")]}
    table = variants.changes_of(variants.summarize(many, np.random.default_rng(0)), ["w"])
    assert table["length_m"] == {"w": ["-", "+2.0*", "+2.0*", "+2.0*", "+2.0*", 0]}


def test_the_command_twice_gives_the_same_bytes_and_a_picture(tmp_path):
    write_boxes(tmp_path / "map.json", town_of(*CANYON))
    walks = [walk_along("path_00000", [(0, 0), (30, 0)]), walk_along("path_00001", [(0, 0), (24, 1)])]
    write_paths(tmp_path / "path.json", walks, {})
    for out in ("one", "two"):
        words = ["study", "muco", str(tmp_path / "map.json"), str(tmp_path / "path.json"), "--out", str(tmp_path / out)]
        answer = CliRunner().invoke(app, [*words, "--workers", "1"])
        assert answer.exit_code == 0, answer.output
    for name in ("variants.json", "variants.png"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    found = json.loads((tmp_path / "one/variants.json").read_text())
    assert found["variants"][AS_SET]["kept"] == 2
    assert found["variants"]["weight_visibility x 0"]["figures"]["five_ray_mean"]["difference"] <= 0
    assert cv2.imread(str(tmp_path / "one/variants.png")).std() > 1
