"""Comparison and benchmark of planners: the paper's printed tables as known answers, the stages and their commands."""

import importlib.util
import json

import numpy as np
import pytest
from specimens_planning import CANYON, WORLDS, town_of, walk_along

from cosfly.formats.boxes import write_boxes
from cosfly.formats.pedestrian_paths import write_paths
from cosfly.formats.traces import read_traces
from cosfly.planners import benchmark, compare
from cosfly.planners.benchmark import CRITERIA, PAPER, BenchmarkConfig
from cosfly.planners.compare import CompareConfig, PlannedItem
from cosfly.planners.contract import ALL_PLANNERS
from cosfly.runtime.errors import EnvironmentMissing, NoPathError
from cosfly.runtime.journal import Journal
from cosfly.runtime.run_dir import read_item, result_of

FEW = ("foresight", "track_astar", "muco", "minimum_jerk", "theta_star")


# tab:appendix_h_extended_ranking: visibility, collision and clearance, each normalised.
NORMALIZED = {
    "track_astar": (1.0, 1.0, 1.0), "muco": (0.7961, 1.0, 0.5929), "prm": (0.0892, 1.0, 0.2875),
    "bspline_prm": (0.1055, 1.0, 0.2261), "visibility_astar": (0.1464, 1.0, 0.1795), "trajopt": (0.1252, 1.0, 0.1974),
    "rrt_star": (0.1264, 1.0, 0.1944), "theta_star": (0.1433, 1.0, 0.1459), "weighted_astar": (0.1324, 1.0, 0.1562),
    "astar": (0.1234, 1.0, 0.1309), "elastic_band": (0.0, 1.0, 0.0), "minimum_jerk": (0.1437, 0.6686, 0.0764),
    "chomp": (0.0856, 0.5172, 0.1135), "potential_field": (0.1702, 0.0, 0.2084),
}  # fmt: skip


def test_the_weights_are_those_of_the_papers_printed_scores():
    for name, values in NORMALIZED.items():
        assert np.dot(values, [weight for *_, weight in CRITERIA.values()]) == pytest.approx(
            PAPER[name].weighted, abs=1e-4
        )
    assert list(CRITERIA) == ["visibility", "collision", "clearance"]


def test_every_planner_has_its_group_and_every_one_of_the_papers_its_row():
    assert sorted(benchmark.GROUP_OF) == sorted(ALL_PLANNERS)
    assert set(ALL_PLANNERS) - set(PAPER) == {"foresight"}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A walk round a corner, through whose block minimum jerk finds no way, and one along a wall."""
    folder, (box_map, corners) = tmp_path_factory.mktemp("inputs"), WORLDS["corner"]
    write_boxes(folder / "map.json", box_map)
    walks = [
        walk_along("round", corners), walk_along("along", [(-30, 0), (0, 0)]), walk_along("more", [(0, 0), (9, 0)]),
    ]  # fmt: skip
    write_paths(folder / "path.json", walks, {"map": "hand", "seed": 0})
    return folder / "map.json", folder / "path.json"


@pytest.fixture(scope="module")
def made(inputs, tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "benchmark"
    benchmark.run(BenchmarkConfig(planners=FEW, scenarios=2), *inputs, out)
    return out


@pytest.mark.slow
def test_what_is_not_flown_is_counted_and_stays_in_every_table(made):
    found = json.loads((made / "benchmark.json").read_text())
    assert ([one["id"] for one in found["scenarios"]], list(found["infeasible"])) == (["round", "along"], ["round"])
    assert "no trajectory within the limits" in found["infeasible"]["round"]["minimum_jerk"]
    assert found["scenarios"][0]["minimum_jerk"] is None
    flown = found["scenarios"][1]["minimum_jerk"]
    means = found["means"]["minimum_jerk"]
    assert means["five_ray_mean"] == pytest.approx(flown["five_ray_mean"] / 2, abs=1e-4)
    assert means["clearance_min_m"] == pytest.approx(flown["clearance_min_m"] / 2, abs=1e-4)
    assert means["collision_fraction"] == 0.5
    assert means["length_m"] == pytest.approx(flown["length_m"], abs=1e-4)
    assert found["ranking"]["minimum_jerk"]["normalized"]["collision"] == 0.0
    for table in (found["axes"], found["ranking"], found["means"]):
        assert set(table) == set(FEW)
    page = (made / "benchmark.md").read_text()
    assert "| minimum jerk | gradient, optimization | 1 of 2 | 1 of 2 | 0.500 |" in page
    manifest = json.loads((made / "manifest.json").read_text())
    assert manifest["counts"]["kept"] == 2
    assert len([entry for entry in manifest["outputs"] if entry["path"].endswith(".png")]) == 5


def test_the_tables_are_those_of_the_flights(made):
    found, records = json.loads((made / "benchmark.json").read_text()), Journal(made / "items.jsonl").read_as(read_item)
    flown = {record.id: result_of(record, PlannedItem) for record in records}
    assert [set(one.traces) | set(one.errors) for one in flown.values()] == [set(FEW)] * 2
    traces = [one.read_traces(walk_id) for walk_id, one in flown.items()]
    for planner in ("track_astar", "muco", "theta_star"):
        seen = np.mean([flown[planner].visibility.mean() for flown in traces])
        assert found["means"][planner]["five_ray_mean"] == pytest.approx(seen, abs=1e-4)
        low, high = found["intervals"][planner]["visibility"]
        assert low <= found["axes"][planner]["visibility"] <= high
    change = found["means"]["track_astar"]["length_m"] - found["means"]["muco"]["length_m"]
    assert found["deltas"]["length_m"]["delta"] == pytest.approx(change, abs=1e-3)
    pair = found["groups"]["target-aware"]
    assert pair["num_planners"] == 2
    mean = (found["means"]["track_astar"]["five_ray_mean"] + found["means"]["muco"]["five_ray_mean"]) / 2
    assert pair["figures"]["five_ray_mean"] == pytest.approx(mean, abs=1e-4)


def test_without_ompl_a_line_names_the_extra_and_the_others_fly(inputs, tmp_path, monkeypatch, caplog):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "ompl" else find(name, *rest))
    cfg = BenchmarkConfig(planners=("prm", "theta_star", "rrt_star"), scenarios=1)
    found = json.loads((benchmark.run(cfg, *inputs, tmp_path / "out")).read_text())
    assert list(found["means"]) == ["theta_star"]
    assert (tmp_path / "out/axes_bars.png").exists()
    with pytest.raises(EnvironmentMissing, match="OMPL is not installed"):
        benchmark.run(BenchmarkConfig(planners=("prm", "rrt_star")), *inputs, tmp_path / "none")
    assert [r.message for r in caplog.records if "OMPL" in r.message] == [
        'OMPL is not installed, so these planners are skipped: prm, rrt_star; to install it: pip install -e ".[ompl]"'
    ]


CFG = CompareConfig()

# tab:appendix_h_tastar_muco_delta and tab:appendix_h_four_axis_scores of the paper.
DELTAS_OF_PAPER = {
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
    scores = compare.axis_scores({name: figures(**row) for name, row in DELTAS_OF_PAPER.items()})
    for name, expected in SCORES.items():
        assert list(scores[name].values()) == pytest.approx(expected, abs=1e-3)


def test_a_planner_that_collides_does_not_set_the_shortest_path_and_is_less_safe():
    means = {name: figures(**row) for name, row in DELTAS_OF_PAPER.items()}
    means["jerk"] = figures(five_ray_mean=0.624, length_m=84.4, jerk_rms_mps3=1.732, collision_fraction=0.002,
        clearance_min_m=1.137)  # fmt: skip
    scores = compare.axis_scores(means)
    assert scores["spline"]["path_efficiency"] == 1.0
    assert scores["jerk"]["path_efficiency"] == pytest.approx(1.016, abs=1e-3)
    assert scores["jerk"]["safety"] == pytest.approx(0.227, abs=1e-3)


def test_deltas_are_the_papers():
    table = compare.deltas(figures(**DELTAS_OF_PAPER["track_astar"]), figures(**DELTAS_OF_PAPER["muco"]))
    assert table["length_m"] == {"delta": -4.359, "relative_percent": pytest.approx(-4.005, abs=1e-3)}
    assert table["clearance_min_m"]["relative_percent"] == pytest.approx(46.283, abs=0.02)
    assert table["collision_fraction"] == {"delta": 0.0, "relative_percent": None}


@pytest.fixture(scope="module")
def canyon(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    write_boxes(folder / "map.json", town_of(*CANYON, ((60, -40, 20), (5, 5, 20))))
    walks = [
        walk_along("a", [(0, 0), (30, 0)]),
        walk_along("into_wall", [(60, -50), (60, -30)]),
        walk_along("b", [(30, 2), (60, 2)]),
    ]
    write_paths(folder / "path.json", walks, {"map": "hand", "seed": 0})
    return folder / "map.json", folder / "path.json"


def test_the_record_is_what_the_flights_are(canyon, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "compare"
    compare.run(CFG, *canyon, out)
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


def test_a_walk_that_one_planner_cannot_fly_is_counted(canyon, tmp_path, monkeypatch):
    real = compare.plan_trajectory

    def lame(walk, obstacles, cfg, *rest):
        if walk.path_id == "b" and cfg.planner == "muco":
            raise NoPathError("lame", where="b")
        return real(walk, obstacles, cfg, *rest)

    monkeypatch.setattr(compare, "plan_trajectory", lame)
    record = json.loads(compare.run(CFG, *canyon, tmp_path / "out").read_text())
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert manifest["counts"]["dropped"] == {"no_muco_trajectory": 1}
    assert {(row["id"], row["planner"]) for row in record["skipped"]} == {("into_wall", "all"), ("b", "muco")}
    _, axes, _ = compare.text_tables(tmp_path / "out/compare.json")
    assert not any("(" in row[-1] for row in axes.rows)  # one trajectory has no interval
