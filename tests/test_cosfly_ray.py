"""Stages on a Ray cluster of several processes: what is made is what the local engine makes, whatever is killed."""

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from crashes import contents, differences
from processes import QUICK, wait_until
from teacher_server import TeacherServer
from toy_workers import items_of, make_faulty, make_talking_worker, stage_in

from cosfly.pipeline import run as pipeline
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load
from cosfly.runtime.errors import EnvironmentMissing
from cosfly.runtime.events import LOSSES, read_events
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.ray_engine import ALL_ROOM, ENVIRONMENT, STORE_BYTES, RayConfig
from cosfly.runtime.worker import Item

ray = pytest.importorskip("ray")
os.environ |= ENVIRONMENT


ROOM = {"object_store_memory": STORE_BYTES}


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A cluster of processes on this machine, so far of a head that does no work."""
    from ray.cluster_utils import Cluster

    ray.shutdown()
    logging.getLogger("ray").setLevel(logging.ERROR)
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False, **ROOM})
    yield made
    ray.shutdown()
    made.shutdown()


@pytest.mark.slow
def test_workers_that_die_and_stall_once_cost_nothing_but_time(tmp_path, cluster, caplog):
    cluster.add_node(num_cpus=2, **ROOM)
    kinds = ["once-stop", "once-die", "once-sleep", "nothing", "nothing"]
    watch = replace(QUICK, ray=RayConfig(address=cluster.address))
    finished = run_items(stage_in(tmp_path), items_of(*kinds), make_faulty, (tmp_path / "s",), workers=2, watch=watch)
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


SETTINGS = (
    "pedestrians.num_paths=4", "pedestrians.min_distance_m=15", "pedestrians.max_distance_m=25", "workers=2",
    "render.width_px=160", "render.height_px=90", "render.fovs_deg=[60]", "inspect.legible_min=0", "release.licence=cc-by-4.0",
)  # fmt: skip


def make(names: str, *settings: str) -> None:
    for stage in pipeline.stages(load(RunConfig, None, [*SETTINGS, *settings]), Path("run")):
        if stage.name in names.split():
            stage.work()


@contextlib.contextmanager
def meanwhile(folder: Path, num_done: int, do: Callable[[], object]) -> Iterator[None]:
    def wait() -> None:
        wait_until(lambda: sum(event.event == "item_done" for event in read_events(folder)) >= num_done, 300.0)
        do()

    with ThreadPoolExecutor(1) as aside:
        doing = aside.submit(wait)
        yield
    doing.result()


def kill_worker(folder: Path) -> None:
    os.kill([event.pid for event in read_events(folder) if event.event in ("worker_started", "restarted")][-1], 9)


@pytest.mark.slow
def test_a_run_has_the_bytes_of_the_local_engine_though_workers_and_nodes_are_lost(tmp_path, cluster, monkeypatch):
    on = ("engine=ray", f"ray.address={cluster.address}")
    for place in ("local", "cluster"):
        (tmp_path / place).mkdir()
        monkeypatch.chdir(tmp_path / place)
        make("maps simplify" if place == "cluster" else "maps simplify pedestrians plan render inspect caption")
    first, second = (cluster.add_node(num_cpus=1, **ROOM) for _ in range(2))
    rendered = Path("run/render")
    make("pedestrians plan", *on)
    worker_lost = meanwhile(rendered, 1, lambda: kill_worker(rendered))
    with worker_lost, meanwhile(rendered, 3, lambda: cluster.remove_node(first, allow_graceful=False)):
        make("render", *on)
    cluster.add_node(num_cpus=1, **ROOM)
    make("inspect", *on)
    with meanwhile(Path("run/caption"), 1, lambda: cluster.remove_node(second, allow_graceful=False)):
        make("caption", *on)
    for name, least in (("render", 1), ("caption", 0)):
        events = read_events(Path("run") / name)
        assert sum(event.event in LOSSES for event in events) >= least
        assert all(event.attempt == 1 for event in events if event.event == "retried")
    assert differences(contents(tmp_path / "cluster"), contents(tmp_path / "local")) == []


def refused(tmp_path: Path, words: str, **cluster: str) -> None:
    watch = Watch(RayConfig(**cluster))
    with pytest.raises(EnvironmentMissing, match=words):
        run_items(stage_in(tmp_path), items_of("nothing"), make_faulty, (tmp_path / "s",), workers=1, watch=watch)
    assert not (tmp_path / "s/manifest.json").exists()


@pytest.mark.slow
def test_where_no_cluster_answers_one_line_says_so(tmp_path, monkeypatch):
    ray.shutdown()
    refused(tmp_path, r"127\.0\.0\.1:1: no Ray cluster answers.*ray start --head", address="127.0.0.1:1")
    with TeacherServer() as server:
        address = server.url.removeprefix("http://").partition("/")[0]
        refused(tmp_path, "no Ray cluster answers at this address; got no answer of a gRPC server", address=address)
        monkeypatch.setenv("RAY_ADDRESS", address)
        refused(tmp_path, f"{address}: no Ray cluster answers")
    monkeypatch.setitem(sys.modules, "ray", None)
    refused(tmp_path, r"the package ray is not installed; pip install -e '\.\[ray\]', on every node")
