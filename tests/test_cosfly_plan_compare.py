"""The comparison of planners: the paper's own tables as known answers, the stage, its pictures and its command."""

import json

import numpy as np
import pytest
from specimens_planning import CANYON, town_of, walk_along

from cosfly.formats.boxes import write_boxes
from cosfly.formats.pedestrian_paths import write_paths
from cosfly.formats.traces import read_traces
from cosfly.planners import compare
from cosfly.planners.compare import CompareConfig
from cosfly.runtime.errors import NoPathError

CFG = CompareConfig()

# tab:appendix_h_tastar_muco_delta and tab:appendix_h_four_axis_scores of the paper.
PAPER = {
    "track_astar": {"five_ray_mean": 0.979, "length_m": 104.479, "accel_rms_mps2": 0.673, "jerk_rms_mps3": 0.919,
        "clearance_min_m": 4.029},
    "muco": {"five_ray_mean": 0.894, "length_m": 108.838, "accel_rms_mps2": 0.738, "jerk_rms_mps3": 0.773,
        "clearance_min_m": 2.754},
    "spline": {"five_ray_mean": 0.618, "length_m": 85.73, "jerk_rms_mps3": 1.433, "clearance_min_m": 1.775},
}  # fmt: skip
SCORES = {
    "track_astar": (0.979, 0.821, 0.521, 0.806, 0.782),
    "muco": (0.894, 0.788, 0.564, 0.551, 0.699),
    "spline": (0.618, 1.000, 0.411, 0.355, 0.596),
}


def figures(**given):
    return {name: 0.0 for name, _, _ in compare.FIGURES} | given


def test_axis_scores_are_the_papers():
    scores = compare.axis_scores({name: figures(**row) for name, row in PAPER.items()})
    for name, expected in SCORES.items():
        assert list(scores[name].values()) == pytest.approx(expected, abs=1e-3)


def test_a_planner_that_collides_does_not_set_the_shortest_path_and_is_less_safe():
    means = {name: figures(**row) for name, row in PAPER.items()}
    means["jerk"] = figures(five_ray_mean=0.624, length_m=84.4, jerk_rms_mps3=1.732, collision_fraction=0.002,
        clearance_min_m=1.137)  # fmt: skip
    scores = compare.axis_scores(means)
    assert scores["spline"]["path_efficiency"] == 1.0
    assert scores["jerk"]["path_efficiency"] == pytest.approx(1.016, abs=1e-3)
    assert scores["jerk"]["safety"] == pytest.approx(0.227, abs=1e-3)


def test_deltas_are_the_papers():
    table = compare.deltas(figures(**PAPER["track_astar"]), figures(**PAPER["muco"]))
    assert table["length_m"] == {"delta": -4.359, "relative_percent": pytest.approx(-4.005, abs=1e-3)}
    assert table["clearance_min_m"]["relative_percent"] == pytest.approx(46.283, abs=0.02)
    assert table["collision_fraction"] == {"delta": 0.0, "relative_percent": None}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    write_boxes(folder / "map.json", town_of(*CANYON, ((60, -40, 20), (5, 5, 20))))
    walks = [
        walk_along("a", [(0, 0), (30, 0)]),
        walk_along("into_wall", [(60, -50), (60, -30)]),
        walk_along("b", [(30, 2), (60, 2)]),
    ]
    write_paths(folder / "path.json", walks, {"map": "hand", "seed": 0})
    return folder / "map.json", folder / "path.json"


def test_the_record_is_what_the_flights_are(inputs, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "compare"
    compare.run(CFG, *inputs, out)
    record = json.loads((out / "compare.json").read_text())
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["counts"] == {"input": 3, "kept": 2, "dropped": {}, "failed": {"no_path": 1}}
    assert record["skipped"][0]["id"] == "into_wall"
    assert [row["id"] for row in record["scenarios"]] == ["a", "b"]
    for planner in ("track_astar", "muco"):
        traces = read_traces(out / f"drone_trace_{planner}.json")
        assert {trace.planner for trace in traces} == {planner}
        seen = np.mean([trace.visibility.mean() for trace in traces])
        assert record["means"][planner]["five_ray_mean"] == pytest.approx(seen, abs=1e-4)
        assert record["means"][planner]["blocked_fraction"] == pytest.approx(1 - seen, abs=1e-3)
        assert record["means"][planner]["collision_fraction"] == 0
        assert manifest["timings"][planner]["mean_ms"] > 0
    assert record["win_rates"]["muco"]["both_collision_free"] == {"count": 2, "of": 2, "rate": 1.0}


def test_a_walk_that_one_planner_cannot_fly_is_counted(inputs, tmp_path, monkeypatch):
    real = compare.plan_trajectory

    def lame(walk, obstacles, cfg, *rest):
        if walk.path_id == "b" and cfg.planner == "muco":
            raise NoPathError("lame", where="b")
        return real(walk, obstacles, cfg, *rest)

    monkeypatch.setattr(compare, "plan_trajectory", lame)
    record = json.loads(compare.run(CFG, *inputs, tmp_path / "out").read_text())
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert manifest["counts"]["dropped"] == {"no_muco_trajectory": 1}
    assert {(row["id"], row["planner"]) for row in record["skipped"]} == {("into_wall", "all"), ("b", "muco")}
