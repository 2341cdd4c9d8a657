"""`release get` from servers that others wrote: S3, static files over http, the hub's client and its cache."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from owners import S3, python_with
from serving import Handler, serving
from specimens_foreign import hub_snapshot
from specimens_release import all_bytes

from cosfly.work.config import build
from release.record import read_record
from release.transfer.stage import Selection
from release.transfer.stage import run as get

ROOT = Path(__file__).resolve().parents[1]
PART = {"towns": ["Town01"], "splits": ["train"], "modalities": ["rgb"]}
PART_WORDS = ["--town", "Town01", "--split", "train", "--modality", "rgb"]


def choice(**wanted) -> Selection:
    return build(Selection, wanted, "test")


@pytest.fixture(scope="module")
def part(dataset, tmp_path_factory) -> dict[str, bytes]:
    """The shards of a part of it, as they come from the folder."""
    return shards_of(get(choice(**PART), str(dataset), tmp_path_factory.mktemp("part") / "out"))


def shards_of(folder: Path) -> dict[str, bytes]:
    return {name: data for name, data in all_bytes(folder).items() if name.startswith("data/")}


def command(python: Path | str, address: str, out: Path, *words: str) -> list[str]:
    return [str(python), "-m", "cosfly", "release", "get", address, "--out", str(out), "--workers", "0", *words]


def done(words: list[str], env: dict[str, str]) -> None:
    ended = subprocess.run(words, capture_output=True, text=True, check=False, env=env, cwd=ROOT)
    assert ended.returncode == 0, ended.stderr[-3000:]


# --- S3 ---------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def served_by_s3(folder: Path, log: Path, late_s: float = 0.2):
    """Serve a folder at s3://flights/town; gives the interpreter that can ask for it, and its environment."""
    python = python_with(S3)
    env = {
        "PATH": os.environ["PATH"], "HOME": str(log.parent), "PYTHONPATH": str(ROOT), "AWS_ACCESS_KEY_ID": "somebody",
        "AWS_SECRET_ACCESS_KEY": "not-a-real-key", "AWS_DEFAULT_REGION": "us-east-1",
    }  # fmt: skip
    words = [str(python), str(ROOT / "tests/serve_s3.py"), str(folder), str(late_s), str(log)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env) as server:
        try:
            address = server.stdout.readline().strip()
            assert address.startswith("http://"), "the server did not start"
            yield python, env | {"AWS_ENDPOINT_URL": address}
        finally:
            server.kill()


def asked(log: Path) -> list[tuple[str, str]]:
    return [tuple(json.loads(line)) for line in log.read_text().splitlines()]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_part_comes_from_s3(dataset, part, tmp_path):
    with served_by_s3(dataset, tmp_path / "log", 0.0) as (python, env):
        done(command(python, "s3://flights/town", tmp_path / "out", *PART_WORDS), env)
    found = tmp_path / "out/dataset"
    assert shards_of(found) == part
    assert read_record(found / "release.json").part_of.source == "s3://flights/town"
    others = {shard.path for shard in read_record(dataset / "release.json").shards if shard.split != "train"}
    assert not [path for path, _ in asked(tmp_path / "log") if path.removeprefix("/flights/town/") in others]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_what_a_kill_broke_off_goes_on_from_s3(dataset, tmp_path):
    out, log = tmp_path / "out", tmp_path / "log"
    with served_by_s3(dataset, log) as (python, env):
        words = command(python, "s3://flights/town", out)
        with subprocess.Popen(words, env=env, cwd=ROOT, start_new_session=True, stderr=subprocess.DEVNULL) as getting:
            ends = time.monotonic() + 120.0
            while not finished(out) and time.monotonic() < ends:
                time.sleep(0.02)
            os.killpg(getting.pid, signal.SIGKILL)
        before = finished(out)
        assert before
        assert not (out / "dataset").exists()
        log.unlink()
        done(words, env)
    assert all_bytes(out / "dataset") == all_bytes(dataset)
    again = {Path(path).name for path, _ in asked(log)}
    assert {name for name in again if name.endswith(".parquet")} == {
        Path(name).name for name in shards_of(dataset)
    } - before


def finished(out: Path) -> set[str]:
    """The shards that a journal has."""
    journal = out / "items.jsonl"
    text = journal.read_text() if journal.is_file() else ""
    return {Path(name).name for name in re.findall(r"data/[\w-]+\.parquet", text.rpartition("\n")[0])}


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_shard_that_changed_at_s3_is_refused(dataset, tmp_path):
    changed = shutil.copytree(dataset, tmp_path / "changed")
    shard = max((changed / "data").iterdir(), key=lambda path: path.stat().st_size)
    data = bytearray(shard.read_bytes())
    data[data.index(b"\x89PNG") + 400] ^= 1
    shard.write_bytes(data)
    with served_by_s3(changed, tmp_path / "log", 0.0) as (python, env):
        words = command(python, "s3://flights/town", tmp_path / "out")
        ended = subprocess.run(words, capture_output=True, text=True, check=False, env=env, cwd=ROOT)
    assert ended.returncode == 1
    assert "Traceback" not in ended.stderr
    assert "not the one of the record" in (tmp_path / "out/failures.jsonl").read_text()
    assert not (tmp_path / "out/dataset").exists()


# --- static files over http -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def served_as_static_files(folder: Path):
    uvicorn, static = pytest.importorskip("uvicorn"), pytest.importorskip("starlette.staticfiles")
    config = uvicorn.Config(
        static.StaticFiles(directory=folder), host="127.0.0.1", port=0, log_level="error", ws="none"
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(10.0)


def test_a_web_server_of_static_files(dataset, part, tmp_path):
    with served_as_static_files(dataset.parent) as address:
        assert shards_of(get(choice(**PART), f"{address}/{dataset.name}/", tmp_path / "part")) == part


# --- the hub ----------------------------------------------------------------------------------------------------------


def test_a_snapshot_in_the_hubs_cache(dataset, part, tmp_path):
    snapshot = hub_snapshot(dataset, tmp_path)
    assert shards_of(get(choice(**PART), str(snapshot), tmp_path / "part")) == part
    assert all_bytes(get(choice(), str(snapshot), tmp_path / "all")) == all_bytes(dataset)


class Hub(Handler):
    """As much of a hub as its client's file system asks: what there is, and bytes of files by ranges."""

    def do_POST(self) -> None:
        wanted = json.loads(self.rfile.read(int(self.headers["content-length"])))["paths"]
        paths = [wanted] if isinstance(wanted, str) else wanted
        self.answer(200, [self.told(path) for path in paths if (self.server.folder / path).exists()])

    def told(self, name: str) -> dict[str, object]:
        path = self.server.folder / name
        if path.is_dir():
            return {"type": "directory", "oid": "0" * 40, "path": name}
        return {"type": "file", "oid": "0" * 40, "size": path.stat().st_size, "path": name}

    def do_GET(self) -> None:
        asked = self.path.partition("?")[0]
        name = asked.partition("/resolve/main/")[2]
        if "/tree/main" in asked:
            folder = self.server.folder / asked.partition("/tree/main")[2].strip("/")
            names = [path.relative_to(self.server.folder).as_posix() for path in folder.iterdir()]
            return self.answer(200, [self.told(name) for name in names])
        if not name:
            return self.answer(200, {"id": "me/town", "sha": "0" * 40, "siblings": []})
        data = (self.server.folder / name).read_bytes()
        self.server.sent.append(name)
        self.answer_range(data)
        return None


@pytest.mark.slow
def test_the_hubs_own_client(dataset, part, tmp_path):
    pytest.importorskip("huggingface_hub")
    with serving(Hub, folder=dataset, sent=[]) as server:
        own = {"HF_ENDPOINT": server.address, "HF_HOME": str(tmp_path / "home"), "HF_HUB_OFFLINE": "0"}
        address = "hf://datasets/me/town"
        done(command(sys.executable, address, tmp_path / "out", *PART_WORDS), os.environ | own)
    assert shards_of(tmp_path / "out/dataset") == part
    shards = {name for name in server.sent if name.endswith(".parquet")}
    splits = {shard.path: shard.split for shard in read_record(dataset / "release.json").shards}
    assert {splits[name] for name in shards} == {"train"}
