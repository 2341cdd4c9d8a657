"""The simulation of a cluster, against what can be told in closed form, and as a whole on the events of a small run."""

import sys
from pathlib import Path

import numpy as np
import pytest

from cosfly.runtime.events import EventLog

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
import simulate_cluster as simulation

ITEMS_S = np.random.default_rng(1).lognormal(0.0, 0.5, 30_000)
PLENTY = simulation.Cluster(5, 6)


def simulated(on: simulation.Cluster, **asked) -> simulation.Result:
    return simulation.simulate(ITEMS_S, on, np.random.default_rng(0), **asked)


def test_without_losses_a_stage_takes_its_work_over_its_workers():
    assert simulated(PLENTY).seconds == pytest.approx(ITEMS_S.sum() / 30, rel=0.01)
    assert simulation.simulate([3.0, 1.0, 1.0], simulation.Cluster(1, 2), np.random.default_rng(0)).seconds == 3.0


def test_what_there_is_once_bounds_a_stage():
    by_storage = simulated(simulation.Cluster(5, 6, ops_s=100.0), ops=10.0)
    assert by_storage.seconds == pytest.approx(len(ITEMS_S) * 10.0 / 100.0, rel=0.01)
    assert by_storage.busy["storage"] == pytest.approx(1.0, rel=0.01)
    by_driver = simulated(simulation.Cluster(5, 6, hand_out_s=0.1))
    assert by_driver.seconds == pytest.approx(len(ITEMS_S) * 0.1, rel=0.01)
    by_teacher = simulated(simulation.Cluster(5, 6, teachers=2), windows=simulation.WINDOWS_S)
    assert by_teacher.seconds == pytest.approx(len(ITEMS_S) / 2, rel=0.01)
    assert simulated(simulation.Cluster(5, 6, beat_s=0.5)).seconds == simulation.NEVER  # 30 workers, a beat each 2 s


def test_losses_cost_time_and_no_item():
    """A worker is lost each 1,000 s in the mean: of work half an item in the mean, less where items are short."""
    lost = simulated(simulation.Cluster(5, 6, worker_losses_h=3.6, start_s=10.0))
    assert lost.lost == pytest.approx(lost.seconds * 30 / 1000, rel=0.3)
    assert lost.given_up == 0
    assert lost.seconds == pytest.approx((ITEMS_S.sum() + lost.lost * (10.0 + ITEMS_S.mean())) / 30, rel=0.02)
    nodes = simulated(simulation.Cluster(5, 6, node_losses_h=10.0, node_down_s=100.0))
    assert nodes.lost >= 6
    assert nodes.seconds > simulated(PLENTY).seconds + nodes.lost / 30 * 90.0
    hopeless = simulation.simulate(
        [100.0] * 50, simulation.Cluster(1, 5, worker_losses_h=360.0), np.random.default_rng(0)
    )
    assert hopeless.given_up > 45


@pytest.mark.slow
def test_all_tables_of_a_small_run(tmp_path, monkeypatch, capsys):
    frames = (90, 110, 100, 120)
    for stage in simulation.STAGES:
        log = EventLog(tmp_path / "run" / stage)
        log.write("began", workers=2)
        for k, count in enumerate(frames):
            steps = {"plan": 0, "inspect": 2 * count, "caption": count - 4}.get(stage, count)
            log.write("item_done", worker=k % 2, item=f"{k}", status="kept", seconds=0.05 * count, steps=steps)
        log.write("ended")
        log.close()
    assert simulation.Profile.of(tmp_path / "run").seconds["inspect"] == pytest.approx([0.05] * 4)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["simulate_cluster.py", "run", "--flights", "2000", "--figure", "scale.png"])
    simulation.main()
    told = capsys.readouterr().out
    assert "| all | 47 | 6 | - | 2664 |" in told
    assert "2,000 flights" in told
    assert "nan" not in told
    assert (tmp_path / "scale.png").stat().st_size > 10_000
