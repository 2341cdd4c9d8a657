"""Studies of depth and zoom; `cosfly reproduce`."""

import json

import numpy as np
import pytest
from commands import obeyed
from test_renderers_contract import circling, write_inputs
from toy_workers import make_counting_worker, stage_in

from cosfly.pipeline.reproduce import FigureReader, MissingFile, rendering_figures, watchdog_figures
from cosfly.runtime.errors import InputError
from cosfly.runtime.events import Event, read_events
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import write_json
from cosfly.runtime.pool import Watch, run_items
from cosfly.runtime.run_dir import Manifest, Tally, read_manifest
from cosfly.runtime.worker import Item
from cosfly.studies.depth import study_of
from cosfly.studies.zoom import enlarged_fov_deg


def test_depths_spread_evenly_give_the_papers_errors():
    """Its scene (tab:depth_format_comparison) is nearly so: half a step at most, a quarter of one on average; its print is within 3 % of that."""
    depths_m = np.random.default_rng(0).permutation(np.linspace(15.36, 38.32, 360 * 640)).reshape(360, 640)
    rows = {row["coding"]: row for row in study_of(depths_m, "ramp")[0]["rows"]}
    for coding, *errors_cm, psnr_db in (
        ("8-bit", 4.5019, 2.2494, 2.5979, 58.9),
        ("10-bit", 1.1222, 0.5543, 0.6418, 71.1),
        ("12-bit", 0.2803, 0.1436, 0.1646, 82.9),
        ("16-bit", 0.0175, 0.0088, 0.0101, 107.1),
    ):
        row = rows[coding]
        assert [row["max_cm"], row["mean_cm"], row["rmse_cm"]] == pytest.approx(errors_cm, rel=0.03)
        assert row["psnr_db"] == pytest.approx(psnr_db, abs=0.3)
        kib = 360 * 640 * int(coding.removesuffix("-bit")) / 8 / 1024
        assert row["kilobytes"] == pytest.approx(kib), "as the paper's column counts them"


def test_a_longer_lens_shows_the_middle_as_large():
    longer_deg = enlarged_fov_deg(110.0, 5.0)
    assert np.tan(np.radians(longer_deg / 2)) == pytest.approx(np.tan(np.radians(55)) / 5)


@pytest.mark.slow
def test_the_target_grows_as_the_lens_does(tmp_path, in_this_process):
    boxes, simplified, traces = write_inputs(tmp_path / "inputs", [circling(6), circling(5, "path_002")])
    words = f"study zoom --map {boxes} --simplified {simplified} --traces {traces} --out {tmp_path / 'out'} --every 2"
    size = "--set render.width_px=640 --set render.height_px=360"
    obeyed(words, "--workers 0 --set render.fovs_deg=[110,60,30]", size)
    levels = json.loads((tmp_path / "out/zoom_study.json").read_text())["levels"]
    assert [level["fov_deg"] for level in levels] == [110.0, 60.0, 30.0]
    assert [level["frames"] for level in levels] == [6, 6, 6]
    wide, _, long = levels
    factor = long["focal_length_px"] / wide["focal_length_px"]
    for name in ("width_px", "height_px"):
        assert long[name]["mean"] / wide[name]["mean"] == pytest.approx(factor, rel=0.05)
    assert long["visibility"]["mean"] == pytest.approx(wide["visibility"]["mean"], abs=0.05)
    assert 0.2 < long["track_quality"]["mean"] < 1.0
    assert set(wide["by_flight"]) == {"path_000", "path_002"}


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


def test_figures_of_a_run():
    manifest = Manifest(stage="render", outputs=[], counts=Tally(input=3, kept=2, dropped={"far": 1}), seconds=20.0)
    assert rendering_figures(EVENTS, manifest) == {"2 workers": [20.0, 120, 80, 4.0, 1.0, 1.5, 220.0, 1, 0]}


def test_what_lost_workers_had_done_is_counted(tmp_path):
    items = [Item("a", "once-die", num_steps=3), Item("b", num_steps=3)]
    folder = stage_in(tmp_path)
    finished = run_items(folder, items, make_counting_worker, (tmp_path,), workers=1, watch=Watch(heartbeat_s=0.2))
    (tmp_path / "s/product").write_text("x")
    folder.finish([tmp_path / "s/product"], finished.tally)
    events, manifest = read_events(tmp_path / "s"), read_manifest(tmp_path / "s")
    assert sum(event.steps for event in events if event.event == "worker_died") == 3
    assert watchdog_figures(events, manifest) == [2, 1, manifest.seconds, {"worker_died": 1}]


def test_figures_are_found_by_keys_numbers_ids_and_stars(tmp_path):
    write_json(tmp_path / "a.json", {"many": [{"id": "x", "ms": 1}, {"id": "y", "ms": 3}, {"id": "z"}], "none": {}})
    with Journal(tmp_path / "items.jsonl") as journal:
        journal.append({"id": "walk", "rss_mib": {"0": 2.0, "1": 3.0}})
    reader = FigureReader([tmp_path / "absent", tmp_path], {"counts": {"a": 1, "b": 3}})
    for place, expected in {
        "a.json:many.0.ms": [1], "a.json:many.-1.id": ["z"], "a.json:many.y.ms": [3], "a.json:many.9.ms": [None],
        "a.json:many.*.ms|mean,max": [2.0, 3], "a.json:many.x.ms,id + a.json:none": [1, "x", {}],
        "items.jsonl:walk.rss_mib.1": [3.0], "items.jsonl:*.rss_mib|peak": [5.0], "a.json:none.*.ms|mean": [None],
        "work:counts|shares": [{"a": 25.0, "b": 75.0}],
    }.items():  # fmt: skip
        assert reader.figures(place) == expected, place
    with pytest.raises(MissingFile):
        reader.figures("b.json:many")
    with pytest.raises(InputError, match=r"a.json: many.\*.id"):
        reader.figures("a.json:many.*.id|mean")
