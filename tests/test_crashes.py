"""The whole way on a tiny town: every stage, one and two workers; kill -9 at every point of commands that write, all of them
by `python tests/crash_sweep.py`.
"""

import itertools
import re
import shutil
import sys
from pathlib import Path

import pytest
from commands import invoke, obeyed, working_here
from crash_sweep import COMMANDS
from crashes import called_complete, sweep
from processes import ran
from specimens_release import SMALL_RUN
from test_docs import COMMANDS as DOCUMENTED
from toy_workers import stage_in

from cosfly.formats.tracks import find_tracks
from cosfly.pipeline import run as pipeline
from cosfly.pipeline import runs
from cosfly.pipeline.runs import estimate
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load
from cosfly.runtime.errors import ConfigError, ResumeError, VerifyError
from cosfly.runtime.io import atomic_folder
from cosfly.runtime.json_io import read_json, write_json
from cosfly.runtime.run_dir import Tally, read_failures
from release.verify.verify import verify

SWEEP = Path(__file__).with_name("crash_sweep.py")
# Of the commands that need a finished run, those that are swept here.
OF_A_RUN = (*("pedestrians", "inspect review", "caption, limited"), "release build")


def careless(out: Path) -> None:
    """Takes what stands there for finished."""
    if not (out / "product.json").exists():
        (out / "product.json").write_text('{"all": "of it"}')


def careful(out: Path) -> None:
    write_json(out / "product.json", {"all": "of it"})
    with atomic_folder(out / "frames") as folder:
        for number in range(2):
            (folder / f"{number}.txt").write_text("a frame")


@pytest.mark.slow
@pytest.mark.parametrize(("work", "words"), [(careless, "product.json: b'{\"all\": '"), (careful, None)])
def test_what_a_kill_spoils_is_found(work, words, tmp_path):
    swept = sweep([lambda: work(tmp_path / "out")], tmp_path)
    assert swept.num_killed == swept.num_steps
    assert any(words in line for line in swept.wrong) if words else not swept.wrong, swept.wrong
    assert swept.num_steps >= 2


def test_a_product_without_its_records_that_another_stage_would_take_is_found(tmp_path):
    stage = stage_in(tmp_path / "whole")
    write_json(stage.path / "product.json", {"all": "of it"})
    stage.finish([stage.path / "product.json"], Tally(input=1, kept=1))
    write_json(tmp_path / "killed/s/product.json", {"all": "of"})
    assert called_complete(tmp_path / "killed", [tmp_path / "whole"]) == ["s/product.json is taken by the next stage"]


@pytest.mark.parametrize("asked", [
    pytest.param(("caption prompts",), id="at every step"),
    pytest.param(("maps",), id="of a stage", marks=pytest.mark.slow),
    pytest.param(("--few", "run"), id="of a run", marks=pytest.mark.timeout(1800)),
    pytest.param(("--few", "--twice", *OF_A_RUN), id="twice", marks=pytest.mark.timeout(1800)),
])  # fmt: skip
@pytest.mark.slow
def test_killed_commands_go_on(asked):
    assert ran(sys.executable, SWEEP, *asked).stdout.count(" 0 wrong") == sum(name in COMMANDS for name in asked)


def test_every_command_that_writes_is_in_the_sweep():
    told = {
        "show", "doctor", "config check", "config show", "release verify", "caption doctor",
        "caption judge-check", "roi edit",
    }  # fmt: skip
    names = {" ".join(path) for path, _ in DOCUMENTED}
    swept = [text for commands in COMMANDS.values() for text in commands if isinstance(text, str)]
    lacking = {name for name in names if not any(line.startswith(f"{name} ") for line in swept)}
    assert lacking == told


STAGES = ("maps", "simplify", "pedestrians", "plan", "render", "inspect", "caption", "release")


def tiny(**changes) -> RunConfig:
    return load(RunConfig, None, [*SMALL_RUN, *(f"{key}={value}" for key, value in changes.items())])


def products(folder: Path) -> dict[str, str]:
    """Product -> sha256 of a complete stage. Frames stand for themselves by their flight's checksum file."""
    return {entry["path"]: entry["sha256"] for entry in read_json(folder / "manifest.json")["outputs"]}


def begin(small_run: Path, out: Path, stage: str) -> Path:
    for name in STAGES[: STAGES.index(stage)]:
        shutil.copytree(small_run / name, out / name)
    shutil.copy(small_run / "run.yaml", out)
    return out


def work(cfg: RunConfig, out: Path, stage: str) -> None:
    next(s for s in pipeline.stages(cfg, out) if s.name == stage).work()


def test_every_stage_is_complete_and_adds_up(small_run):
    for stage in STAGES:
        manifest = read_json(small_run / stage / "manifest.json")
        counts = manifest["counts"]
        gone = sum(counts["dropped"].values()) + sum(counts["failed"].values())
        assert counts["kept"] + gone == counts["input"], stage
        assert products(small_run / stage), stage
    for picture in ("contact_sheet.png", "viewer.html"):
        assert (small_run / picture).stat().st_size > 10_000


def test_a_run_goes_on_by_its_folder_whatever_is_begun(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(pipeline, "run", lambda cfg, out, **_: asked.append(out) or [])
    monkeypatch.setattr("cosfly.cli.run.print_run", lambda out: None)
    for number, begun in enumerate(("", "one/maps", "maps")):
        run = tmp_path / str(number)
        write_json(run / begun / "stage.json", {}) if begun else run.mkdir()
        (run / "run.yaml").write_text("towns: {one: {}, two: {}}\n" if begun != "maps" else "seed: 2\n")
        assert invoke("run", run).exit_code == 0
        assert invoke("run", run, "--out", tmp_path / "new").exit_code == 0
        assert asked[-2:] == [run, tmp_path / "new"]


def test_a_dry_run_writes_nothing(small_run):
    beside = small_run.parent / "other"
    rows = {row.name: row for row in estimate(tiny(), beside)}
    frames = sum(flight["num_frames"] for flight in read_json(small_run / "render/manifest.json")["flights"])
    for name in ("render", "release"):
        found = sum(path.stat().st_size for path in (small_run / name).rglob("*") if path.is_file())
        assert 0.5 < rows[name].count / frames < 2.0
        assert 0.5 < rows[name].bytes / found < 2.0
    shown = obeyed("run", small_run, "--out", beside, "--dry-run")
    assert "total: about" in shown
    assert not beside.exists()


def test_a_release_of_the_papers_shape_is_estimated(monkeypatch, tmp_path):
    """250 trajectories of 618 to 770 frames, 400 of each: 100,000 frames a track."""
    monkeypatch.setattr(runs, "num_frames", lambda cfg, out: [618 + i % 153 for i in range(250)])
    release = estimate(tiny(), tmp_path)[-1]
    assert (release.name, release.count) == ("release", 200_000)
    clean = estimate(tiny(**{"render.tracks": ["clean"], "release.tracks": ["clean"]}), tmp_path)[-1]
    assert clean.count == 100_000


def test_a_finished_run_costs_nothing_more_and_an_unfinished_one_the_rest(small_run, tmp_path):
    assert all(row.is_done and row.seconds == 0 for row in estimate(tiny(), small_run))
    frames = sum(flight["num_frames"] for flight in read_json(small_run / "render/manifest.json")["flights"])
    for stage in ("render", "inspect"):
        unfinished = begin(small_run, tmp_path / stage, stage)
        before = sorted(unfinished.rglob("*"))
        rows = estimate(tiny(), unfinished)
        assert tuple(row.name for row in rows if not row.is_done) == STAGES[STAGES.index(stage) :]
        assert rows[-1].count == frames
        assert sorted(unfinished.rglob("*")) == before


def test_every_file_of_a_run_stands_in_the_files_page(small_run):
    page = (Path(__file__).parents[1] / "docs/files.md").read_text(encoding="utf-8")
    names = {path.name for path in small_run.rglob("*") if path.is_file()}
    assert len(names) > 30
    assert sorted(name for name in names if name not in page and not name.endswith(".parquet")) == []


def test_running_again_changes_nothing(small_run):
    before = {p: p.stat().st_mtime_ns for p in small_run.rglob("*") if p.is_file() and p.name != "run.yaml"}
    results = pipeline.run(tiny(), small_run)
    assert all(result.was_complete for result in results)
    assert {p: p.stat().st_mtime_ns for p in before} == before


def test_other_settings_are_refused_by_name_and_nothing_is_touched(small_run, tmp_path, caplog):
    out = begin(small_run, tmp_path / "run", "render")
    before = (out / "run.yaml").read_bytes()
    caplog.set_level("INFO")
    with pytest.raises(ResumeError, match=r"safety_distance_m was 3\.0, is 3\.5"):
        pipeline.run(tiny(**{"plan.safety_distance_m": 3.5}), out)
    assert (out / "run.yaml").read_bytes() == before
    assert "plan: already complete" not in caplog.text
    assert not (out / ".lock").exists(), "who failed holds nobody up"


CHANGES = {
    "edited": lambda data, other: data[:-2] + bytes([data[-2] ^ 1]) + data[-1:],
    "cut": lambda data, other: data[: len(data) // 2],
    "emptied": lambda data, other: b"",
    "exchanged": lambda data, other: other,
}
# Which stages refuse a changed file when they begin. Those that are missing here read pictures: of them below.
PICTURES = ("rgb.png", "depth_float32.png", "instance.png")
REFUSED_BY = {
    "maps/boxes_3d.json": ("simplify", "render"),
    "simplify/step2_simplified.json": ("pedestrians", "plan", "render", "inspect"), "pedestrians/path.json": ("plan",),
    "plan/drone_trace.json": ("render", "inspect"), "render/Town_SynthTown/instance_ids.json": ("caption", "release"),
    "render/Town_SynthTown/map.json": ("caption", "release"),
    "render/Town_SynthTown/trajectory_*/ORI/trajectory.json": ("caption", "release"),
    "render/Town_SynthTown/trajectory_*/aug_*/trajectory.json": ("caption", "release"),
    "render/Town_SynthTown/trajectory_*/ORI/checksums.sha256": ("caption", "release"),
    "render/Town_SynthTown/trajectory_*/aug_*/checksums.sha256": ("caption", "release"),
    "inspect/inspect.json": ("release",), "caption/captions.jsonl": ("release",),
}  # fmt: skip


def test_a_changed_file_is_refused_by_the_stages_that_read_it(small_run, tmp_path):
    tampered = shutil.copytree(small_run, tmp_path / "run")
    cases = [(pattern, stage) for pattern, stages in REFUSED_BY.items() for stage in stages]
    for (pattern, stage), change in zip(cases, itertools.cycle(CHANGES.values())):
        path, *others = sorted(tampered.glob(pattern))
        data, other = path.read_bytes(), others[0].read_bytes() if others else b"of another run"
        path.write_bytes(change(data, data + b" " if other == data else other))
        with pytest.raises(VerifyError, match=re.escape(path.name)):
            work(tiny(), tampered, stage)
        path.write_bytes(data)


@pytest.mark.slow
def test_no_changed_picture_reaches_a_release(small_run, tmp_path):
    out = begin(small_run, tmp_path / "run", "release")
    flights = find_tracks(out / "render")
    for flight, name in zip(flights[:3], PICTURES, strict=True):
        frames = flight / "frames_playback"
        shutil.copy(frames / "frame_00001" / name, frames / "frame_00000" / name)
    with pytest.raises(VerifyError, match="nothing is released"):
        work(tiny(), out, "release")
    messages = [failure.message for failure in read_failures(out / "release/failures.jsonl")]
    assert messages
    for message in messages:  # each shard names its first problem
        assert "has changed since its digest was recorded" in message
        assert any(f"frame_00000/{name}: the file" in message for name in PICTURES)
    assert not (out / "release/dataset").exists()
    assert not (out / "release/manifest.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["pedestrians", "plan", "render", "inspect", "caption", "release"])
def test_two_workers_give_the_same_products(small_run, tmp_path, stage):
    out = begin(small_run, tmp_path / "run", stage)
    work(tiny(workers=2), out, stage)
    assert products(out / stage) == products(small_run / stage)


OF_TOWNS = (
    "render.width_px=160", "render.height_px=90", "render.fovs_deg=[60]", "inspect.legible_min=0",
    "caption.window.stride=4",
)  # fmt: skip
TOWNS = """
towns={
  one: {maps: {synthetic: {size_m: 150, num_blocks: 1}}},
  two: {maps: {synthetic: {size_m: 160, num_blocks: 1, preset: village}}, pedestrians: {num_paths: 1}},
}"""


@pytest.fixture(scope="module")
def towns(tmp_path_factory):
    out = tmp_path_factory.mktemp("towns") / "run"
    with working_here():
        pipeline.run(load(RunConfig, None, [*SMALL_RUN, *OF_TOWNS, TOWNS.strip()]), out)
    return out


@pytest.mark.slow
def test_several_towns_are_runs_of_their_own_and_one_release(towns):
    assert sorted(path.name for path in towns.iterdir()) == ["one", "release", "run.yaml", "two"]
    for town, paths in (("one", 2), ("two", 1)):
        assert read_json(towns / town / "pedestrians/manifest.json")["counts"]["input"] == paths
        assert not (towns / town / "release").exists()
        assert (towns / town / "contact_sheet.png").exists()
    numbers = read_json(towns / "release/dataset/release.json")["numbers"]
    assert set(numbers["counts"]["town"]) == {"Town_one", "Town_two"}
    assert verify(towns / "release/dataset").is_ok


@pytest.mark.slow
def test_the_stages_one_by_one_make_a_town_as_the_run_does(towns, tmp_path, in_this_process):
    made = [tmp_path / "maps/boxes_3d.json", tmp_path / "simplify/step2_simplified.json"]
    made += [tmp_path / "pedestrians/path.json", tmp_path / "plan/drone_trace.json"]
    inputs = ([], ["--map", made[0]], ["--map", made[1]], ["--map", made[1], "--paths", made[2]])
    for product, needed in zip(made, inputs, strict=True):
        command = [product.parent.name, *needed, "--config", towns / "run.yaml", "--town", "one"]
        done = obeyed(command, "--out", product.parent)
        assert "--town" not in done
        assert product.read_bytes() == (towns / "one" / product.relative_to(tmp_path)).read_bytes()
    nobody = ["maps", "--config", str(towns / "run.yaml"), "--out", str(tmp_path / "none")]
    told = " ".join(invoke(nobody).output.split())
    assert "no --town is given, so the settings that the towns one, two share are used" in told
    found = invoke(nobody, "--town oen").exception
    assert isinstance(found, ConfigError)
    assert re.search(r"--town: .*no town of this name .did you mean 'one'.*got oen; expected", str(found))
