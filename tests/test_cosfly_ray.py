"""Stages on a Ray cluster of several processes: what is made is what the local engine makes, whatever is killed."""

import logging
import os
from collections.abc import Iterator

import pytest
from toy_workers import make_talking_worker, make_worker, stage_in

from cosfly.errors import EnvironmentMissing
from cosfly.work.ray_engine import ALL_ROOM, STORE_BYTES, RayConfig
from cosfly.work.runner import Item, Watch, run_items
from cosfly.work.stage_events import LOSSES, read_events

ray = pytest.importorskip("ray")
os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}


class Nodes:
    """A cluster of processes on this machine, of a head that does no work and nodes of one CPU."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster

        logging.getLogger("ray").setLevel(logging.ERROR)
        self._cluster = Cluster(
            initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": STORE_BYTES}
        )
        self.address = self._cluster.address

    def add(self, **settings):
        return self._cluster.add_node(**{"num_cpus": 1, "object_store_memory": STORE_BYTES} | settings)

    def kill(self, node) -> None:
        """End a node at once, as a machine that loses power."""
        self._cluster.remove_node(node, allow_graceful=False)

    def end(self) -> None:
        ray.shutdown()
        self._cluster.shutdown()


@pytest.fixture
def nodes() -> Iterator[Nodes]:
    ray.shutdown()
    found = Nodes()
    yield found
    found.end()


def quick(nodes: Nodes) -> Watch:
    cluster = RayConfig(address=nodes.address)
    return Watch(cluster, item_limit_s=2.0, heartbeat_s=0.1, check_s=0.4, probe_s=0.3, failed_checks=5)


def items_of(*kinds: str) -> list[Item]:
    return [Item(f"i{k}", (kind, bytes(1_000_000))) for k, kind in enumerate(kinds)]


def test_workers_that_die_and_stall_once_cost_nothing_but_time(tmp_path, nodes, caplog):
    nodes.add(num_cpus=2)
    kinds = ["once-stop", "once-die", "once-sleep", "nothing", "nothing"]
    watch = quick(nodes)
    finished = run_items(stage_in(tmp_path), items_of(*kinds), make_worker, (tmp_path / "s",), workers=2, watch=watch)
    assert [record.id for record in finished.kept] == [f"i{k}" for k in range(len(kinds))]
    events = read_events(tmp_path / "s")
    found = {event.item: event.event for event in events if event.event in LOSSES}
    assert found == {"i0": "heartbeat_lost", "i1": "worker_died", "i2": "timed_out"}
    assert all(event.node and event.pid for event in events if event.event in {"worker_started", "restarted", *LOSSES})
    assert any(mib > 10 for event in events for mib in (event.rss_mib or {}).values())
    assert not list((tmp_path / "s").glob(".*.partial"))
    assert all((tmp_path / "s" / record.id / "frame").read_text() == record.id for record in finished.kept)
    caplog.set_level(logging.INFO)
    (tmp_path / "talk").mkdir()
    run_items(stage_in(tmp_path / "talk"), [Item("a")], make_talking_worker, workers=ALL_ROOM, watch=watch)
    assert "a speaks of 7" in caplog.text


def test_where_no_cluster_answers_one_line_says_so(tmp_path):
    ray.shutdown()
    watch = Watch(RayConfig(address="127.0.0.1:1"))
    with pytest.raises(EnvironmentMissing, match=r"127\.0\.0\.1:1: no Ray cluster answers.*ray start --head"):
        run_items(stage_in(tmp_path), items_of("nothing"), make_worker, (tmp_path / "s",), workers=1, watch=watch)
