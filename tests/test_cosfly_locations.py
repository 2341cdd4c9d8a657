"""Work at a location: what is sent in which order, who may write, and what becomes of breaks, by `memory://` and S3."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import pytest
from test_pipeline_tiny import STAGES, TINY, products
from test_release_get_servers import served_by_s3

from cosfly.app.settings import RunConfig
from cosfly.cli.located import located
from cosfly.errors import ConfigError, EnvironmentMissing, InputError, ResumeError, StorageError
from cosfly.work import locations
from cosfly.work.config import load
from cosfly.work.journal import Journal
from cosfly.work.locations import WorkingFolder, name_of, path_of

ROOT = Path(__file__).resolve().parents[1]
RUN = "memory://bucket/run"


@pytest.fixture
def memory(monkeypatch):
    system = pytest.importorskip("fsspec", reason="extra remote").filesystem("memory")
    system.store.clear()
    monkeypatch.setattr(locations, "SETTLE_S", 0.0)
    return system


def taken(cache: Path, address: str = RUN) -> WorkingFolder:
    folder = WorkingFolder(address, cache, is_written=True)
    folder.take()
    return folder


def put(folder: WorkingFolder, **files: str) -> None:
    for name, text in files.items():
        path = folder.local / name.replace("__", "/").replace("_json", ".json")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def there(system) -> dict[str, str]:
    return {
        name.removeprefix("/bucket/run/"): file.getvalue().decode()
        for name, file in system.store.items()
        if "/bucket/run/" in name
    }


def watched(system, monkeypatch) -> list[str]:
    """Note what is sent and removed, in order."""
    told, send, remove = list[str](), system.put, system.rm
    names = lambda paths: [path.partition("bucket/run/")[2] for path in paths]  # noqa: E731
    monkeypatch.setattr(system, "put", lambda here, paths: (told.extend(names(paths)), send(here, paths)))
    monkeypatch.setattr(system, "rm", lambda paths: (told.extend(f"-{n}" for n in names(paths)), remove(paths)))
    return told


def test_files_go_before_journals_and_manifests_last(memory, tmp_path, monkeypatch):
    folder = taken(tmp_path)
    put(folder, maps__a_json="1", maps__items_jsonl="", maps__manifest_json="{}")
    told = watched(memory, monkeypatch)
    folder.copy_out()
    assert told == ["maps/a.json", "maps/items.jsonl", "maps/manifest.json"]
    told.clear()
    put(folder, maps__a_json="22")
    folder.copy_out()
    assert told == ["-maps/manifest.json", "maps/a.json", "maps/manifest.json"]
    told.clear()
    folder.copy_out()
    assert told == []
    (folder.local / "maps/a.json").unlink()
    folder.copy_out()
    assert told == ["-maps/manifest.json", "-maps/a.json", "maps/manifest.json"]


def test_an_item_that_is_finished_while_files_travel_is_in_no_journal_there_without_its_file(memory, tmp_path):
    folder = taken(tmp_path)
    journal, send, finished = Journal(folder.local / "items.jsonl"), memory.put, []

    def finish(number: int) -> None:
        put(folder, **{f"item{number}_json": "done"})
        journal.append({"id": f"item{number}"})
        finished.append(number)

    def put_while_work_goes_on(here, paths):
        finish(len(finished))
        send(here, paths)
        seen = there(memory)
        ids = [json.loads(line.split(" ", 1)[1])["id"] for line in seen.get("items.jsonl", "").splitlines()]
        assert {f"{name}.json" for name in ids} <= seen.keys()

    finish(0)
    memory.put = put_while_work_goes_on
    try:
        for _ in range(3):
            folder.copy_out()
    finally:
        del memory.put
    assert len(finished) > 4
    assert "item3" in there(memory)["items.jsonl"]


def test_a_manifest_that_changes_goes_away_first_and_comes_back_as_it_is(memory, tmp_path):
    folder = taken(tmp_path)
    put(folder, maps__a_json="1", maps__manifest_json="old", plan__manifest_json="plan")
    folder.copy_out()
    put(folder, maps__a_json="22", maps__manifest_json="newer")
    send = memory.put
    memory.put = lambda here, paths: (_ for _ in ()).throw(ConnectionError)
    try:
        with pytest.raises(StorageError):
            folder.copy_out()
    finally:
        memory.put = send
        del memory.put
    assert there(memory) == {"maps/a.json": "1", "plan/manifest.json": "plan"}
    folder.copy_out()
    assert there(memory) == {"maps/a.json": "22", "maps/manifest.json": "newer", "plan/manifest.json": "plan"}


def test_another_machine_is_refused_then_takes_over(memory, tmp_path, monkeypatch, caplog):
    first = taken(tmp_path / "a")
    put(first, a_json="1")
    first.copy_out()
    with pytest.raises(ResumeError, match=r"another machine is at work there; got process \d+ on .*, 0 s ago"):
        taken(tmp_path / "b")
    monkeypatch.setattr(locations, "STALE_S", 0.0)
    second = taken(tmp_path / "b")
    assert "no sign of life of process" in caplog.text
    assert (second.local / "a.json").read_text() == "1"
    with pytest.raises(ResumeError, match="another machine took over"), first.at_work():
        put(first, b_json="2")
    assert "b.json" not in there(memory)
    with second.at_work():
        put(second, c_json="3")
    assert there(memory) == {"a.json": "1", "c.json": "3"}


def test_a_sign_of_life_is_given_while_many_files_travel(memory, tmp_path, monkeypatch):
    folder = taken(tmp_path)
    put(folder, **{f"{number}_json": "1" for number in range(3)})
    monkeypatch.setattr(locations, "BATCH", 1)
    monkeypatch.setattr(locations, "BEAT_S", 0.0)
    told, pipe = list[str](), memory.pipe_file
    monkeypatch.setattr(memory, "pipe_file", lambda path, data: (told.append(path), pipe(path, data)))
    folder.copy_out()
    assert told == ["/bucket/.run.writer.json"] * 3


def test_what_was_not_sent_when_a_folder_went_on_elsewhere_is_set_aside(memory, tmp_path, caplog):
    first = taken(tmp_path / "a")
    with first.at_work():
        put(first, a_json="1")
    second = taken(tmp_path / "b")
    with second.at_work():
        put(second, a_json="other")
    put(first, b_json="lost otherwise")
    again = taken(tmp_path / "a")
    assert "1 files that were not sent are in" in caplog.text
    (kept,) = (tmp_path / "a").rglob("aside-*/b.json")
    assert kept.read_text() == "lost otherwise"
    assert {path.name: path.read_text() for path in again.local.iterdir()} == {"a.json": "other"}


def test_what_was_made_before_a_break_goes_on_from_here(memory, tmp_path):
    first = taken(tmp_path)
    put(first, a_json="1", b_json="2")
    first.copy_out()
    put(first, c_json="not sent")
    (first.local / "b.json").unlink()
    again = taken(tmp_path)  # as after a kill: the mark is ours
    assert (again.local / "c.json").read_text() == "not sent"
    with again.at_work():
        pass
    assert there(memory) == {"a.json": "1", "c.json": "not sent"}


def test_inputs_travel_once_and_what_is_gone_there_goes_here(memory, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    memory.pipe({"/bucket/run/a.json": b"1", "/bucket/run/d/b.json": b"2"})
    WorkingFolder(RUN, tmp_path, is_written=False).fetch()
    memory.pipe("/bucket/run/c.json", b"3")
    memory.rm("/bucket/run/a.json")
    folder = WorkingFolder(RUN, tmp_path, is_written=False)
    folder.fetch()
    assert "1 files fetched, 1 were here" in caplog.text
    assert sorted(path.name for path in folder.local.rglob("*.json")) == ["b.json", "c.json"]
    assert name_of(folder.local / "d/b.json") == f"{RUN}/d/b.json"
    assert path_of(f"{RUN}/d/b.json") == folder.local / "d/b.json"
    assert name_of(tmp_path) == str(tmp_path)
    assert path_of(f"{RUN}2/a") == Path(f"{RUN}2/a")


def test_a_file_comes_with_the_records_of_its_stage(memory, tmp_path):
    memory.pipe({f"/bucket/run/{name}": b"{}" for name in ("map.json", "stage.json", "other.json")})
    folder = WorkingFolder(f"{RUN}/map.json", tmp_path, is_written=False)
    folder.fetch()
    assert sorted(path.name for path in folder.local.parent.iterdir()) == ["map.json", "stage.json"]


def test_no_name_leads_out_of_the_folder(memory, tmp_path):
    memory.pipe({"/bucket/run/a.json": b"1", "/bucket/run/x": b"1"})
    for name in ("../../../../evil", "d/../../run2/evil", "./a", "d//a"):
        memory.store[f"/bucket/run/{name}"] = memory.store["/bucket/run/x"]
        with pytest.raises(InputError, match="leads"):
            WorkingFolder(RUN, tmp_path / "cache", is_written=False).fetch()
        del memory.store[f"/bucket/run/{name}"]
    assert not list(tmp_path.rglob("*evil*"))


def test_a_link_in_the_working_folder_is_not_followed_out(memory, tmp_path):
    memory.pipe("/bucket/run/d/a.json", b"1")
    folder = WorkingFolder(RUN, tmp_path / "cache", is_written=False)
    (tmp_path / "elsewhere").mkdir()
    folder.local.mkdir(parents=True)
    (folder.local / "d").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="leads out"):
        folder.fetch()
    assert not any((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize(
    ("words", "kind", "told"),
    [
        (["doctor", "--out", RUN], ConfigError, "the disk of this machine"),
        (["show", "memory://bucket/none"], InputError, "there is nothing"),
        (["show", "gs://bucket/run"], EnvironmentMissing, "pip install gcsfs"),
        (["show", "nonsense://bucket/run"], InputError, "no such address"),
        (["maps", "--out", "memory://bucket"], InputError, "BUCKET/FOLDER"),
        (["maps", "--out", "zip://a::memory://b/c"], InputError, "release get"),
        (["caption", "--data", RUN], ConfigError, "give --out"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(memory, tmp_path, words, kind, told):
    with contextlib.ExitStack() as held, pytest.raises(kind, match=told) as error:
        located(words, tmp_path, held)
    assert "\n" not in str(error.value)


def test_words_that_are_no_addresses_stay(memory, tmp_path):
    words = ["caption", "--teacher", "http://127.0.0.1:1/v1", "--data", "file:///tmp/x", "-s", "a=s3://b/c"]
    with contextlib.ExitStack() as held:
        assert located(words, tmp_path, held) == [*words[:4], "/tmp/x", *words[5:]]
        get = ["release", "get", "hf://datasets/a/b", "--out", "out"]
        assert located(get, tmp_path, held) == get


def test_an_address_among_the_settings_is_refused_in_one_line(tmp_path):
    (tmp_path / "a.yaml").write_text(
        "maps: {source: boxes, boxes: {path: s3://bucket/town.csv}}\nroi: s3://bucket/roi.json"
    )
    with pytest.raises(ConfigError, match=r"roi: an address.*copy it.*maps\.boxes\.path: an address") as error:
        load(RunConfig, tmp_path / "a.yaml")
    assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match=r"fly\.controller: an address"):
        load(RunConfig, None, ["fly.controller=s3://bucket/controller.yaml"])
    assert load(RunConfig, None, ["roi=a:b/roi.json"]).roi == Path("a:b/roi.json")


def test_a_full_disk_here_is_told_as_that(memory, tmp_path):
    memory.pipe("/bucket/run/a.json", b"1")

    def full(*_):
        raise OSError(28, "No space left on device")

    memory.get = full
    try:
        with pytest.raises(StorageError, match=r"the disk of this machine is full.*--cache"):
            WorkingFolder(RUN, tmp_path, is_written=False).fetch()
    finally:
        del memory.get


# --- a real S3 server -------------------------------------------------------------------------------------------------

HURRIED = """
import os
from cosfly.work import locations
locations.COPY_EVERY_S, locations.STALE_S = 0.3, float(os.environ["STALE_S"])
from cosfly.__main__ import main
main()
"""


@pytest.fixture
def s3(tmp_path):
    (tmp_path / "empty").mkdir()
    with served_by_s3(tmp_path / "empty", tmp_path / "log", 0.0) as (python, env):
        kernels = os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))  # compiled once on a machine
        (tmp_path / "packages").mkdir()  # as an installation has them
        (tmp_path / "packages/cosfly_configs").symlink_to(ROOT / "configs")
        path = f"{ROOT}:{tmp_path / 'packages'}"
        yield python, env | {"XDG_CACHE_HOME": kernels, "PYTHONPATH": path}, tmp_path


def cosfly(python, env, cache: Path, *words: str, stale_s: float = 1e6) -> subprocess.CompletedProcess:
    command = [str(python), "-c", HURRIED, "--cache", str(cache), *words]
    env = {**env, "STALE_S": str(stale_s)}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=env, cwd=ROOT)


def objects(python, env) -> dict[str, str]:
    """Give what the server has below s3://flights/run: name -> content tag."""
    code = "import fsspec, json; f = fsspec.filesystem('s3').find('flights/run', detail=True)"
    code += "; print(json.dumps({n: i['ETag'] for n, i in f.items()}))"
    return json.loads(subprocess.run([str(python), "-c", code], capture_output=True, check=True, env=env).stdout)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_refusals_of_s3_are_one_line_each(s3):
    python, env, folder = s3
    words = ("maps", "--out", "s3://flights/run/maps")
    ended = cosfly(python, {**env, "AWS_ACCESS_KEY_ID": "wrong"}, folder / "a", *words)
    assert ended.returncode == 1
    assert re.search("got (403|InvalidAccessKeyId); check the key", ended.stderr), ended.stderr
    assert ended.stderr.count("\n") == 1
    assert "not-a-real-key" not in ended.stderr
    ended = cosfly(python, env, folder / "b", "maps", "--out", "s3://no-such-bucket/run/maps")
    assert "check that there is such a bucket" in ended.stderr
    (folder / "log.faults").write_text("deny PUT")
    ended = cosfly(python, env, folder / "c", *words)
    assert "AccessDenied; check the key" in ended.stderr
    assert not list((folder / "c").rglob("stage.json"))  # refused before the work began
    (folder / "log.faults").write_text("cut PUT")
    ended = cosfly(python, env, folder / "d", *words)
    assert ended.returncode == 1
    assert "cannot write" in ended.stderr.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_a_run_that_was_killed_goes_on_on_another_machine(s3):
    python, env, folder = s3
    sets = [word for one in TINY for word in ("--set", one)]
    command = [str(python), "-c", HURRIED, "--cache", str(folder / "a"), "run", "quickstart"]
    command += ["--out", "s3://flights/run", *sets]
    with (
        open(folder / "told", "w") as told,
        subprocess.Popen(
            command, env={**env, "STALE_S": "1e6"}, cwd=ROOT, start_new_session=True, stderr=told
        ) as process,
    ):
        ends = time.monotonic() + 600
        while time.monotonic() < ends and process.poll() is None:
            time.sleep(0.1)
            if "PUT /flights/run/render/items.jsonl" in (folder / "log.all").read_text():
                break
        assert process.poll() is None, (folder / "told").read_text()[-3000:]
        os.killpg(process.pid, signal.SIGKILL)
    at_kill, journal = objects(python, env), text(python, env, "flights/run/render/items.jsonl")
    assert journal
    assert "flights/run/plan/manifest.json" in at_kill
    assert "flights/run/render/manifest.json" not in at_kill
    ended = cosfly(python, env, folder / "b", "show", "s3://flights/run")
    assert "not finished, as there is no manifest.json: run/render/" in ended.stderr  # as a reader is told
    build = ("release", "build", "s3://flights/run", "--out", str(folder / "x"))
    assert cosfly(python, env, folder / "b", *build).returncode == 1
    again = ("run", "s3://flights/run", *sets)
    assert "another machine is at work there" in cosfly(python, env, folder / "b", *again).stderr
    ended = cosfly(python, env, folder / "b", *again, stale_s=0.0)
    assert "taken over; no sign of life of process" in ended.stderr
    assert ended.returncode == 0, ended.stderr[-3000:]
    assert text(python, env, "flights/run/render/items.jsonl").startswith(journal)  # nothing was done again
    ended = cosfly(python, env, folder / "c", "run", "quickstart", "--out", str(folder / "plain/run"), *sets)
    assert ended.returncode == 0, ended.stderr[-3000:]
    verify = ("release", "verify", "s3://flights/run/release/dataset")
    assert cosfly(python, env, folder / "c", *verify).returncode == 0
    (fetched,) = (folder / "b/written").glob("*/flights/run")
    for stage in STAGES:
        made, plain = (products(run / stage) for run in (fetched, folder / "plain/run"))
        for one in (made, plain):
            one.pop("report.html", None)  # it names the folder that it stands in
        assert made == plain, stage


def text(python, env, name: str) -> str:
    code = f"import fsspec, sys; sys.stdout.write(fsspec.filesystem('s3').cat({name!r}).decode())"
    return subprocess.run([str(python), "-c", code], capture_output=True, text=True, check=True, env=env).stdout
