"""`cosfly bench`: figures and picture from events that are known."""

import io

import cv2
import numpy as np
import pytest
from rich.console import Console
from toy_workers import make_counting_worker, make_worker, stage_in
from typer.testing import CliRunner

from cosfly.app.settings import RunConfig
from cosfly.bench.faults import Faults, planted
from cosfly.bench.measure import row_of, run
from cosfly.bench.picture import COLORS, draw_events, draw_scaling
from cosfly.bench.tables import Bench, markdown, stage_rows, tables
from cosfly.cli import app
from cosfly.cli.bench import _tables
from cosfly.errors import ConfigError, ResumeError
from cosfly.work.runner import Item, run_items
from cosfly.work.stage_events import Event, read_events
from cosfly.work.stage_folder import Manifest, Tally, read_manifest
from cosfly.work.worker_pool import WORDS, Watch


def event(at_s: float, kind: str, **fields) -> Event:
    return Event(at_s=at_s, event=kind, **fields)


EVENTS = [
    event(0, "began", workers=2),
    event(0, "worker_started", worker=0, pid=1),
    event(0, "worker_started", worker=1, pid=2),
    event(4, "probe", rss_mib={0: 100.0, 1: 120.0}, cores_used=1.0, disk_free_mib=1.0),
    event(10, "item_done", worker=0, item="a", status="kept", seconds=8.0, steps=40),
    event(12, "worker_died", worker=1, pid=2, item="b", seconds=9.0, steps=30),
    event(12, "retried", item="b", attempt=1),
    event(13, "restarted", worker=1, pid=3),
    event(14, "probe", rss_mib={0: 90.0}, cores_used=2.0, disk_free_mib=1.0),
    event(20, "item_done", worker=1, item="b", status="kept", seconds=5.0, steps=40),
    event(20, "item_done", worker=0, item="c", status="dropped", seconds=5.0, steps=10),
    event(20, "ended"),
]
MANIFEST = Manifest(stage="render", outputs=[], counts=Tally(input=3, kept=2, dropped={"far": 1}), seconds=20.0)


def test_figures_of_a_run():
    row = row_of(EVENTS, MANIFEST, 2, counts_frames=True)
    assert (row.attempted, row.successful, row.per_s) == (120, 80, 4.0)
    assert (row.noticed, row.restarts, row.retries, row.recovered, row.failed) == (1, 1, 1, 1, 0)
    assert (row.peak_memory_mib, row.cores_used) == (220.0, 1.5)
    items = row_of(EVENTS, MANIFEST, 2, counts_frames=False)
    assert (items.attempted, items.successful) == (4, 2)


def test_the_picture_shows_a_worker_that_died():
    def num_red(events: list[Event]) -> int:
        picture = cv2.imdecode(np.frombuffer(draw_events(events, "render"), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        return int((picture[80:] == COLORS["worker_died"]).all(axis=2).sum())  # below the legend

    assert num_red(EVENTS) > 5000, "nine seconds of twenty"
    assert num_red([e for e in EVENTS if e.event not in WORDS]) == 0
    assert draw_events([], "nothing").startswith(b"\x89PNG")


def bench_of(*rows) -> Bench:
    about = {"seconds": 10.0, "cores_used": 1.5, "peak_memory_mib": 300.0, "noticed": 0, "recovered": 0, "retries": 0}
    return Bench.model_validate({"stage": "render", "cores": 2, "rows": [about | row for row in rows]})


def test_tables_are_those_of_the_paper():
    """Two workers twice as fast; a run with a kill lost 30 frames and is the same in the end."""
    bench = bench_of(
        {"workers": 1, "attempted": 100, "successful": 100, "restarts": 0, "failed": 0},
        {"workers": 2, "attempted": 200, "successful": 200, "restarts": 0, "failed": 0},
        {"workers": 2, "attempted": 230, "successful": 200, "restarts": 1, "failed": 0, "fault": "kill", "planted": 1, "same_products": True},
    )  # fmt: skip
    scaling, faults, _ = tables(bench)
    assert [dict(zip(scaling.head, row, strict=True))["speed-up"] for row in scaling.rows] == ["1.00x", "2.00x"]
    last = dict(zip(faults.head, faults.rows[-1], strict=True))
    assert (last["fault"], last["lost"], last["same"], last["restarts"]) == ("kill", "30", "yes", "1")
    text = markdown(bench)
    assert "| 2 | 10.0 | 200 | 200 | 20.00 | 2.00x |" in text
    terminal = Console(width=80, file=io.StringIO())
    terminal.print(*_tables(bench))
    shown = terminal.file.getvalue()
    assert "…" not in shown, "eighty columns hold all heads"
    assert "successful frames/s speed-up" in shown
    picture = cv2.imdecode(np.frombuffer(draw_scaling(bench), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert (picture == COLORS["worker_died"]).all(axis=2).sum() > 1000, "a bar of one restart"


def test_what_lost_workers_had_done_is_counted_and_left_out(tmp_path):
    """A worker dies after its third step: the item is done again, and the steps are told in the manifest and in the table of stages."""
    items = [Item("a", "once-die", num_steps=3), Item("b", num_steps=3)]
    folder = stage_in(tmp_path)
    finished = run_items(folder, items, make_counting_worker, (tmp_path,), workers=1, watch=Watch(heartbeat_s=0.2))
    (tmp_path / "s/product").write_text("x")
    folder.finish([tmp_path / "s/product"], finished.tally)
    assert read_manifest(tmp_path / "s").facts["lost_steps"] == 3
    (row,) = stage_rows(tmp_path, ["s", "t"])
    assert (row.launches, row.restarts, row.modes) == (2, 1, {"worker_died": 1})


def test_frames_of_a_trajectory_that_fails_are_counted_and_left_out(tmp_path):
    """Its worker lives: it fails by itself after four of nine steps."""
    items = [Item("a", num_steps=9), Item("b", "fail", num_steps=4)]
    folder = stage_in(tmp_path)
    finished = run_items(folder, items, make_counting_worker, (tmp_path,), workers=1)
    (tmp_path / "s/product").write_text("x")
    folder.finish([tmp_path / "s/product"], finished.tally)
    manifest = read_manifest(tmp_path / "s")
    assert (manifest.counts.kept, manifest.counts.failed, manifest.facts["lost_steps"]) == (1, {"render": 1}, 4)
    row = row_of(read_events(tmp_path / "s"), manifest, 1, counts_frames=True)
    assert (row.attempted, row.successful, row.failed) == (13, 9, 1)


def test_what_cannot_be_measured(tmp_path):
    with pytest.raises(ConfigError, match=r"not a stage that can be measured.*simplify.*render"):
        run(RunConfig(), tmp_path, tmp_path / "out", "simplify", [1], {})
    asked = RunConfig.model_validate({"caption": {"teacher": "http://127.0.0.1:9"}})
    with pytest.raises(ConfigError, match="no work of workers"):
        run(asked, tmp_path, tmp_path / "out", "caption", [1], {})
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine").touch()
    with pytest.raises(ResumeError, match="not empty"):
        run(RunConfig(), tmp_path, tmp_path / "out", "render", [1], {})
    for counts in ("two", "0,1", ""):
        answer = CliRunner().invoke(app, ["bench", str(tmp_path), "--out", str(tmp_path / "o"), "--workers", counts])
        assert answer.exit_code == 2


def test_planted_faults_hit_workers_and_are_noticed(tmp_path):
    items = [Item(f"i{k}", ("slow", b"")) for k in range(2)]
    with planted(Faults("kill", 1, 1.0, seed=0), tmp_path / "s") as moments_s:
        finished = run_items(stage_in(tmp_path), items, make_worker, (tmp_path / "s",), workers=2)
    assert finished.tally.kept == 2
    assert len(moments_s) == 1
    assert [e.event for e in read_events(tmp_path / "s") if e.event in WORDS] == ["worker_died"]
