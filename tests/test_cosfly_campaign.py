"""Many runs as one job: what a campaign's file means, one that fails among others, and kills in the middle."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from cosfly.app.campaign import PATIENCE_S, Run, load_campaign, share_of, tallies
from cosfly.cli import app
from cosfly.errors import ConfigError
from cosfly.reading.documents import read_json
from cosfly.work.journal import Journal
from cosfly.work.stage_events import read_events

SMALL = {
    "pedestrians": {"num_paths": 1, "min_distance_m": 12, "max_distance_m": 20},
    "render": {"width_px": 160, "height_px": 90, "fovs_deg": [60], "tracks": ["clean"]},
    "caption": {"window": {"stride": 4}},
    "workers": 1,
}


def campaign_file(folder: Path, **settings) -> Path:
    path = folder / "campaign.yaml"
    path.write_text(yaml.safe_dump({"name": "few", "configs": {"small": SMALL}} | settings, sort_keys=False))
    return path


def names(path: Path) -> list[str]:
    return [run.name for run in load_campaign(path, [], path.parent / "out")[1]]


def test_a_campaign_is_of_every_map_configuration_and_seed_but_what_is_left_out(tmp_path):
    maps = {"one": {"source": "synthetic"}, "two": {"source": "synthetic"}}
    path = campaign_file(tmp_path, maps=maps, configs={"small": SMALL, "large": {"base": "quickstart"}}, seeds=[3, 4])
    assert names(path) == [f"{m}-{c}-{s}" for m in ("one", "two") for c in ("small", "large") for s in (3, 4)]
    runs = {run.name: run.cfg for run in load_campaign(path, ["leave_out=['*-large-*', two-small-4]"], None)[1]}
    assert list(runs) == ["one-small-3", "one-small-4", "two-small-3"]
    assert runs["one-small-3"].maps.synthetic.name == "one"
    assert len({cfg.seed for cfg in runs.values()}) == 3, "no two maps share a seed"
    assert runs["one-small-3"].pedestrians.num_paths == 1
    assert names(campaign_file(tmp_path, seeds=[7])) == ["small-7"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"config": {}}, ["config: unknown setting", "did you mean 'configs'"]),
        ({"configs": {"a": {"base": "quickstrat"}}}, ["no such configuration", "quickstrat"]),
        ({"configs": {"a": {"render": {"width": 3}}, "b": {"plan": {"planer": "x"}}}}, ["a-0", "b-0", "2 to mend"]),
        ({"configs": {"../a": SMALL}}, ["configs"]),
        ({"leave_out": ["*"]}, ["every run is left out"]),
        ({"leave_out": ["smal-0"]}, ["leave_out: no run is called 'smal-0'", "did you mean 'small-0'"]),
        ({"seeds": [1, 2, 1]}, ["seeds: a seed is listed twice"]),
        ({"configs": {"a": SMALL | {"release": {"licence": "mit"}}}}, ["configs.a.release", "have one release"]),
        ({"configs": {"a": SMALL | {"render": {"modalities": ["rgb"]}}}}, ["pictures that nobody draws", "no depth"]),
        ({"maps": {"m": {"source": "boxes", "boxes": {"path": "no.csv", "licence": "mit"}}}}, ["no such file", "no.csv"]),
        ({"maps": {"m": {"source": "synthetic"}}, "configs": {"a": {"towns": {"t": {}}}}}, ["towns have maps of their own"]),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_campaign_is_told_before_anything_is_done(tmp_path, settings, words):
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["campaign", str(campaign_file(tmp_path, **settings)), "--out", str(out)])
    assert isinstance(done.exception, ConfigError)
    for word in words:
        assert word in str(done.exception)
    assert not out.exists()


def test_a_mistake_of_all_runs_is_told_once(tmp_path):
    path = campaign_file(tmp_path, configs={"a": {"plan": {"planer": "x"}}}, seeds=[0, 1, 2])
    with pytest.raises(ConfigError) as caught:
        load_campaign(path, [], None)
    assert str(caught.value).count("planer") == 1
    assert "to mend" not in str(caught.value)


def test_the_release_of_the_campaign_is_what_its_runs_are_asked_for(tmp_path):
    """Its licence stands for maps of which nobody knows one, its pictures are those that a run must draw."""
    (tmp_path / "town.csv").write_text("type,x,y,height,length,width\nBuildings,1,1,4,4,4\n")
    maps = {"mine": {"source": "boxes", "boxes": {"path": str(tmp_path / "town.csv")}}}
    configs = {"a": SMALL | {"render": {"modalities": ["rgb"]}}}
    release = {"licence": "mit", "modalities": ["rgb"]}
    cfg, (one,), _ = load_campaign(campaign_file(tmp_path, maps=maps, configs=configs, release=release), [], None)
    assert (one.cfg.release.licence, one.cfg.release.modalities) == ("mit", ("rgb",))
    assert cfg.release.split_by == "town", "no map is in two splits"


def test_the_dry_run_tells_what_is_left(tmp_path):
    path = campaign_file(tmp_path, seeds=[1, 2])
    told = CliRunner().invoke(app, ["campaign", str(path), "--out", str(tmp_path / "out"), "--dry-run"]).output
    rows = [line.split("│") for line in told.splitlines() if "│" in line]
    assert [[cell.strip() for cell in row[1:4]] for row in rows] == [[f"small-{k}", "to do", "0 of 7"] for k in (1, 2)]
    assert "what is left takes about" in told
    assert not (tmp_path / "out").exists()


def test_runs_at_the_same_time_share_the_workers(tmp_path, monkeypatch):
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(8))
    config = {name: value for name, value in SMALL.items() if name != "workers"}
    path = campaign_file(tmp_path, configs={"here": config, "there": config | {"engine": "ray"}}, at_once=3)

    def shares(*overrides: str, num_runs: int = 9) -> list[int]:
        cfg, runs, _ = load_campaign(path, list(overrides), None)
        return [share_of(cfg, run, num_runs) for run in runs]

    assert shares() == [2, 0]
    assert shares(num_runs=2) == [4, 0]
    assert shares("workers=40") == [13, 13]
    assert shares("workers=1") == [1, 1]


def start(path: Path, out: Path) -> subprocess.Popen:
    words = [sys.executable, "-m", "cosfly", "campaign", str(path), "--out", str(out)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True)


def finish(path: Path, out: Path) -> tuple[int, str]:
    process = start(path, out)
    text, _ = process.communicate(timeout=500)
    return process.returncode, text


def digests(out: Path, run: str) -> dict[str, str]:
    """Product -> sha256 of all stages of a run."""
    return {
        f"{stage.parent.name}/{entry['path']}": entry["sha256"]
        for stage in sorted((out / run).glob("*/manifest.json"))
        for entry in read_json(stage)["outputs"]
    }


@pytest.mark.slow
def test_a_run_that_fails_stops_no_other_and_is_told(tmp_path):
    bad = SMALL | {"pedestrians": SMALL["pedestrians"] | {"min_distance_m": 1900, "max_distance_m": 2000}}
    path, out = campaign_file(tmp_path, configs={"bad": bad, "small": SMALL}), tmp_path / "out"
    code, text = finish(path, out)
    assert code == 1
    assert "bad-0: failed: " in text
    assert "small-0: done" in text
    assert "some runs failed; the others are done" in text
    assert not (out / "release").exists()
    assert "failed" in (out / "report.html").read_text()
    # Left out, the others are released, and what stands there is told and left alone.
    path.write_text(path.read_text() + "leave_out: [bad-*]\n")
    code, text = finish(path, out)
    assert code == 0
    assert "1 of 1 runs are done" in text
    assert "not of this campaign, left as they are: bad-0" in text
    assert (out / "release/dataset/release.json").is_file()
    assert (out / "bad-0").is_dir()


@pytest.mark.slow
def test_towns_of_several_seeds_are_released_and_what_is_finished_refuses_other_settings_and_maps(tmp_path):
    """Towns of one name stand in the runs of both seeds."""
    csv = tmp_path / "town.csv"
    csv.write_text("type,x,y,z,height,length,width\nRoads,0,0,-0.1,0.2,90,90\nBuildings,30,30,5,10,8,8\n")
    mine = {"maps": {"source": "boxes", "boxes": {"path": str(csv), "licence": "mit"}}}
    config = SMALL | {"towns": {"mine": mine, "grid": {}}}
    settings = {"configs": {"both": config}, "seeds": [1, 2], "at_once": 2}
    release = {"licence": "mit", "split_by": "walk"}
    path, out = campaign_file(tmp_path, **settings, release=release), tmp_path / "out"
    code, text = finish(path, out)
    assert code == 0, text
    record = read_json(out / "release/dataset/release.json")
    assert record["history"]["flights"]["released"] >= 2
    assert load_campaign(out, [], None)[0].release.split_by == "walk", "the folder goes on as the file said"
    before = {name: digests(out, f"{name}/{town}") for name in ("both-1", "both-2") for town in ("mine", "grid")}
    # Another setting of a stage, then another map under the same name: each run refuses it, and keeps what it has.
    slower = config | {"pedestrians": SMALL["pedestrians"] | {"cruise_speed_mps": 0.9}}
    code, text = finish(campaign_file(tmp_path, **settings | {"configs": {"both": slower}}, release=release), out)
    assert code == 1
    assert text.count("cruise_speed_mps") >= 2, text
    csv.write_text(csv.read_text() + "Buildings,-30,30,5,10,8,8\n")
    code, text = finish(campaign_file(tmp_path, **settings, release=release), out)
    assert code == 1
    assert "0 of 2 runs are done" in text
    assert {name: digests(out, f"{name}/{town}") for name in before for town in ("mine", "grid")} == before


@pytest.mark.slow
def test_six_runs_killed_at_three_moments_end_as_if_undisturbed_and_nothing_is_done_twice(tmp_path):
    maps = {"one": {"source": "synthetic"}, "two": {"source": "synthetic"}}
    path = campaign_file(tmp_path, maps=maps, seeds=[1, 2, 3], at_once=2)
    whole, out = tmp_path / "whole", tmp_path / "out"
    code, text = finish(path, whole)
    assert code == 0, text
    runs = names(path)
    moments = [
        lambda: (out / runs[0] / "render/stage.json").exists(),
        lambda: (out / runs[2] / "pedestrians/manifest.json").exists(),
        lambda: (out / "release/stage.json").exists(),
    ]
    for reached in moments:
        process = start(path, out)
        while not reached():
            assert process.poll() is None, process.stdout.read()
            time.sleep(0.02)
        process.kill()  # alone: what it started must end by itself
        process.wait()
        ours = [p for p in Path("/proc").glob("[0-9]*/cmdline") if str(out).encode() in _read(p)]
        until_s = time.monotonic() + 60
        while ours and time.monotonic() < until_s:
            ours = [p for p in ours if str(out).encode() in _read(p)]
            time.sleep(0.05)
        assert not ours, "a run outlived its campaign"
    code, text = finish(path, out)
    assert code == 0, text
    _, all_runs, _ = load_campaign(path, [], out)
    for run in all_runs:
        assert digests(out, run.name) == digests(whole, run.name)
        for stage in run.look().stages:
            kept = Counter(line["id"] for line in Journal(stage.folder / "items.jsonl").read())
            done = Counter(event.item for event in read_events(stage.folder) if event.event == "item_done")
            assert set(kept.values()) <= {1}, stage
            assert set(done.values()) <= {1}, stage
    assert digests(out, ".") == digests(whole, "."), "the release"
    assert (
        tallies(all_runs)["caption"].kept
        == tallies([Run(r.name, r.cfg, whole / r.name) for r in all_runs])["caption"].kept
    )
    again, told = finish(path, out)
    assert again == 0
    assert "6 of 6 runs are done" in told


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


@pytest.mark.parametrize(
    ("number", "begun", "code"),
    [(signal.SIGINT, "small-1/pedestrians/stage.json", 130), (signal.SIGTERM, "logs/small-1.log", 143)],
)
def test_what_ends_a_campaign_ends_its_runs_too(tmp_path, number, begun, code):
    """Ctrl-C as a terminal sends it: to all processes of its foreground. SIGTERM when a run has just been started and
    has no handlers yet."""
    path, out = campaign_file(tmp_path, seeds=[1, 2]), tmp_path / "out"
    process = start(path, out)
    while not (out / begun).exists():
        assert process.poll() is None, process.stdout.read()
        time.sleep(0.001)
    os.killpg(process.pid, number)
    begun_s = time.monotonic()
    text, _ = process.communicate(timeout=60)
    assert process.returncode == code
    assert time.monotonic() - begun_s < PATIENCE_S, "the run heard it"
    assert "finished work is kept" in text
    assert not (out / "small-2").exists()
    assert not [p for p in Path("/proc").glob("[0-9]*/cmdline") if str(out).encode() in _read(p)]
    assert all(one.look().stages[0].state == "to do" for one in load_campaign(out, [], None)[1][1:])
