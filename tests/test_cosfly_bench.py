"""`cosfly bench`: figures from events that are known."""

import pytest
from toy_workers import make_counting_worker, stage_in
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.pipeline.bench import Bench, bench_run, run, tables, watchdog_figures
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.errors import ConfigError, ResumeError
from cosfly.runtime.events import Event
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Manifest, Tally, read_manifest
from cosfly.runtime.worker import Item


def event(at_s: float, kind: str, **fields) -> Event:
    return Event(at_s=at_s, event=kind, **fields)


EVENTS = [
    event(0, "began", workers=2),
    event(0, "worker_started", worker=0, pid=1),
    event(0, "worker_started", worker=1, pid=2),
    event(
        4, "probe", rss_mib={0: 100.0, 1: 120.0}, cores_used=1.0, disk_free_mib=1.0, gpu_percent=40.0, gpu_mib=2048.0
    ),
    event(10, "item_done", worker=0, item="a", status="kept", seconds=8.0, steps=40),
    event(12, "worker_died", worker=1, pid=2, item="b", seconds=9.0, steps=30),
    event(12, "retried", item="b", attempt=1),
    event(13, "restarted", worker=1, pid=3),
    event(14, "probe", rss_mib={0: 90.0}, cores_used=2.0, disk_free_mib=1.0, gpu_percent=50.0, gpu_mib=1024.0),
    event(20, "item_done", worker=1, item="b", status="kept", seconds=5.0, steps=40),
    event(20, "item_done", worker=0, item="c", status="dropped", seconds=5.0, steps=10),
    event(20, "ended"),
]
MANIFEST = Manifest(stage="render", outputs=[], counts=Tally(input=3, kept=2, dropped={"far": 1}), seconds=20.0)


def test_figures_of_a_run():
    row = bench_run(EVENTS, MANIFEST, 2, counts_frames=True)
    assert (row.attempted, row.successful, row.per_s) == (120, 80, 4.0)
    assert (row.restarts, row.failed) == (1, 0)
    assert (row.peak_memory_mib, row.cores_used) == (220.0, 1.5)
    assert (row.gpu_percent, row.gpu_gib) == (45.0, 2.0)
    without = [one.model_copy(update={"gpu_percent": None, "gpu_mib": None}) for one in EVENTS]
    assert bench_run(without, MANIFEST, 2, counts_frames=True).gpu_percent is None
    items = bench_run(EVENTS, MANIFEST, 2, counts_frames=False)
    assert (items.attempted, items.successful) == (4, 2)


def test_tables_are_those_of_the_paper():
    about = {"cores_used": 1.5, "peak_memory_mib": 300.0, "restarts": 0, "failed": 0, "seconds": 10.0}
    counts = [{"workers": n, "attempted": 100 * n, "successful": 100 * n} for n in (1, 2)]
    bench = Bench.model_validate({"stage": "render", "cores": 2, "rows": [about | row for row in counts]})
    head, *rows = tables(bench)["render on 2 cores"]
    assert [dict(zip(head, row, strict=True))["speed-up"] for row in rows] == ["1.00x", "2.00x"]
    assert rows[1][:6] == ("2", "10.0", "200", "200", "20.00", "2.00x")
    assert "NVIDIA GPUs" not in tables(bench)
    seen = bench.rows[1].model_copy(update={"gpu_percent": 58.6, "gpu_gib": 10.6})
    bench.rows[1] = seen
    assert tables(bench)["NVIDIA GPUs"][2] == ("2", "58.6", "10.6")


def test_what_lost_workers_had_done_is_counted_and_left_out(tmp_path):
    items = [Item("a", "once-die", num_steps=3), Item("b", num_steps=3)]
    folder = stage_in(tmp_path)
    finished = run_items(folder, items, make_counting_worker, (tmp_path,), workers=1, watch=Watch(heartbeat_s=0.2))
    (tmp_path / "s/product").write_text("x")
    folder.finish([tmp_path / "s/product"], finished.tally)
    assert read_manifest(tmp_path / "s").facts["lost_steps"] == 3
    launches, restarts, _, losses = watchdog_figures(tmp_path / "s")
    assert (launches, restarts, losses) == (2, 1, {"worker_died": 1})


def test_what_cannot_be_measured(tmp_path):
    with pytest.raises(ConfigError, match=r"the benchmark cannot measure this stage.*simplify.*render"):
        run(RunConfig(), tmp_path, tmp_path / "out", "simplify", [1])
    asked = RunConfig.model_validate({"caption": {"teacher": "http://127.0.0.1:9"}})
    with pytest.raises(ConfigError, match="its speed does not depend on workers"):
        run(asked, tmp_path, tmp_path / "out", "caption", [1])
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine").touch()
    with pytest.raises(ResumeError, match="not empty"):
        run(RunConfig(), tmp_path, tmp_path / "out", "render", [1])
    (tmp_path / "run.yaml").write_text("{}")
    for counts in ("two", "0,1", ""):
        answer = CliRunner().invoke(app, ["bench", str(tmp_path), "--out", str(tmp_path / "o"), "--workers", counts])
        assert answer.exit_code == 2
