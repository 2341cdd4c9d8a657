"""A release on its way to a hub: the library's real client against a server of ours."""

import base64
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from serving import Handler, serving
from tables import each

from cosfly.errors import ConfigError
from release.transfer.push import check_name, pack
from release.verify.verify import verify

pytest.importorskip("huggingface_hub")

KEY = "not-a-real-key-of-anybody"
NAME = "me/town"


def is_public(made: dict) -> bool:
    """How a repository was asked for: versions of the library say it in two ways; a hub takes neither for public."""
    return made.get("private") is not True and made.get("visibility") != "private"


class Hub(Handler):
    """One repository of data: login, making it, its list of files, uploads by LFS, commits."""

    def body(self) -> bytes:
        if "chunked" in self.headers.get("transfer-encoding", ""):
            parts = []
            while size := int(self.rfile.readline(), 16):
                parts.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(parts)
        return self.rfile.read(int(self.headers.get("content-length", 0)))

    def do_GET(self) -> None:
        hub, path = self.server, self.path.partition("?")[0]
        if self.headers.get("authorization") != f"Bearer {KEY}":
            return self.answer(401, {"error": "Invalid credentials"})
        if path == "/api/whoami-v2":
            return self.answer(200, {"name": "me", "type": "user"})
        siblings = [
            {"rfilename": name, "size": len(data), **({"lfs": {"sha256": hashlib.sha256(data).hexdigest(),
            "size": len(data), "pointerSize": 130}} if name.endswith(".parquet") else {})}
            for name, data in hub.files.items()
        ]  # fmt: skip
        return self.answer(200, {"id": NAME, "private": not is_public(hub.made), "siblings": siblings})

    def do_POST(self) -> None:
        hub, path, body = self.server, self.path.partition("?")[0], self.body()
        hub.asked.append(path)
        if path == "/api/repos/create":
            hub.made = json.loads(body)
            return self.answer(200, {"url": f"{hub.address}/datasets/{NAME}"})
        if path == "/api/validate-yaml":  # the header of the card
            return self.answer(200, {"errors": [], "warnings": []})
        if path.endswith("/preupload/main"):
            files = [
                {
                    "path": f["path"],
                    "uploadMode": "lfs" if f["path"].endswith(".parquet") else "regular",
                    "shouldIgnore": False,
                }
                for f in json.loads(body)["files"]
            ]
            return self.answer(200, {"files": files})
        if path.endswith("/info/lfs/objects/batch"):
            objects = [
                {"oid": o["oid"], "size": o["size"], "actions": {"upload": {"href": f"{hub.address}/lfs/{o['oid']}"}}}
                for o in json.loads(body)["objects"]
            ]
            return self.answer(200, {"transfer": "basic", "objects": objects})
        if path.endswith("/commit/main"):
            if hub.commits_left == 0:
                return self.answer(403, {"error": "no"})
            hub.commits_left -= 1
            for line in map(json.loads, body.splitlines()):
                value = line["value"]
                if line["key"] == "file":
                    hub.files[value["path"]] = base64.b64decode(value["content"])
                elif line["key"] == "lfsFile":
                    hub.files[value["path"]] = hub.uploads[value["oid"]]
            return self.answer(
                200, {"commitUrl": f"{hub.address}/datasets/{NAME}/commit/{0:040d}", "commitOid": "0" * 40}
            )
        return self.answer(404, {"error": path})

    def do_PUT(self) -> None:
        data = self.body()
        self.server.uploads[self.path.rpartition("/")[2]] = data
        self.server.sent += len(data)
        self.answer(200)


def hub():
    state = {"files": {"README.md": b"old"}, "uploads": {}, "asked": [], "sent": 0, "made": {}, "commits_left": 99}
    return serving(Hub, **state)


def command(folder: Path, home: Path, *more: str, address: str = "http://127.0.0.1:9", key: str | None = KEY):
    """Run the command as a user does; the library reads its environment when it is loaded."""
    env = {
        **{name: value for name, value in os.environ.items() if not name.startswith("HF_")},
        "HF_ENDPOINT": address, "HF_HUB_DISABLE_XET": "1", "HF_HOME": str(home), "HOME": str(home),
        **({"HF_TOKEN": key} if key else {}),
    }  # fmt: skip
    words = ["release", "push", str(folder), "--repo", NAME, "--level", "structure", *more]
    return subprocess.run(
        [sys.executable, "-m", "cosfly", *words], env=env, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.fixture(scope="module")
def dataset(dataset, tmp_path_factory) -> Path:
    """A copy: some tests change it for a moment."""
    return shutil.copytree(dataset, tmp_path_factory.mktemp("push") / "dataset")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_without_yes_nothing_is_sent(dataset, tmp_path):
    (dataset / "notes.txt").write_text("mine")
    try:
        done = command(dataset, tmp_path)
    finally:
        (dataset / "notes.txt").unlink()
    assert done.returncode == 1  # what is not of the release is found by the verification
    assert "stays here, as it is not of the release: notes.txt" in done.stdout
    with hub() as server:
        done = command(dataset, tmp_path, address=server.address)
    assert done.returncode == 0, done.stderr
    assert "dry run: nothing was sent" in done.stdout
    assert all(name in done.stdout for name in contents(dataset))
    assert server.asked == []


@pytest.mark.slow
def test_what_arrives_is_the_release_and_the_key_stands_nowhere(dataset, tmp_path):
    log = tmp_path / "push.log"
    with hub() as server:
        done = command(dataset, tmp_path, "--yes", "-v", "--log-file", str(log), address=server.address)
        assert done.returncode == 0, done.stderr
        assert server.files == contents(dataset)
        assert not is_public(server.made)
        first = server.sent
        again = command(dataset, tmp_path, "--yes", address=server.address)
        assert again.returncode == 0, again.stderr
        assert server.sent == first  # shards that are there do not travel again
    assert KEY not in done.stdout + done.stderr + log.read_text()
    arrived = tmp_path / "arrived"
    for name, data in server.files.items():
        (arrived / name).parent.mkdir(parents=True, exist_ok=True)
        (arrived / name).write_bytes(data)
    assert verify(arrived, level="rows").is_ok


@pytest.mark.slow
def test_a_push_that_was_refused_half_way_goes_on(dataset, tmp_path):
    with hub() as server:
        server.commits_left = 1
        done = command(dataset, tmp_path, "--yes", address=server.address)
        assert done.returncode == 1
        assert "the hub refuses; got HTTP 403" in done.stderr
        assert "Traceback" not in done.stderr
        assert "release.json" not in server.files  # the card and the records come last
        server.commits_left = 99
        sent = server.sent
        assert command(dataset, tmp_path, "--yes", "--public", address=server.address).returncode == 0
        assert server.sent == sent
        assert server.files == contents(dataset)


@pytest.mark.parametrize(
    ("key", "words"), [(None, "hf auth login"), pytest.param("another", "HTTP 401", marks=pytest.mark.slow)]
)
def test_who_is_not_logged_in_is_told(dataset, tmp_path, key, words):
    with hub() as server:
        done = command(dataset, tmp_path, "--yes", address=server.address, key=key)
    assert done.returncode == 1
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert server.files == {"README.md": b"old"}


@pytest.mark.slow
def test_a_changed_release_does_not_go_out(dataset, tmp_path):
    card = dataset / "README.md"
    before = card.read_bytes()
    card.write_bytes(before + b"\nmore\n")
    try:
        with hub() as server:
            done = command(dataset, tmp_path, "--yes", address=server.address)
    finally:
        card.write_bytes(before)
    assert done.returncode == 1
    assert "does not verify" in done.stderr
    assert server.asked == []


@each("name", ["town", "me/", "/x", "me/a b", "me/../x", "me/x.git", "https://hub/me/x", "me/x/y", ""])
def test_a_name_that_is_none_is_refused(name):
    with pytest.raises(ConfigError, match="OWNER/NAME"):
        check_name(name)


def test_shards_go_before_the_records(dataset):
    names = list(pack(dataset).files)
    assert names[-1] == "checksums.sha256"
    assert len(names) > 4
    assert all(name.startswith("data/") for name in names[: len(names) - 4])
