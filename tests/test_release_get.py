"""Fetching a release or a part of it: what travels, what is checked, and what a hostile or broken other side gets."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import shutil
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from commands import invoke
from release_tampering import errors_in, forge
from serving import Handler, serving
from specimens_release import (
    CFG,
    NUM_POINTS,
    TOWNS,
    TWO_SPLITS,
    all_bytes,
    build,
    make_caption,
    make_inspection,
    rows_by_id,
)
from tables import each

from cosfly.errors import CosflyError, InputError, ResumeError, VerifyError
from cosfly.products.captions import write_captions
from cosfly.products.flights import find_flights
from cosfly.products.inspection import write_inspection
from cosfly.products.playback import read_flight
from cosfly.work.config import build as build_config
from cosfly.work.store import CHECKSUMS, read_checksums, sha256_bytes
from release.columns import PICTURES
from release.export.contract import ExportConfig
from release.export.stage import run as export
from release.record import read_record
from release.transfer import remote as remotes
from release.transfer import stage
from release.transfer.remote import FsspecRemote, HttpRemote, open_remote, without_secrets
from release.transfer.stage import NOT_ASKED_FOR, Selection
from release.transfer.stage import run as get
from release.verify.verify import verify
from specimens import make_playback_tree


def choice(**wanted) -> Selection:
    return build_config(Selection, wanted, "test")


# --- a server ---------------------------------------------------------------------------------------------------------


class Files(Handler):
    """Files of a folder by ranges; counts what it sends, and misbehaves as its server is told to."""

    def do_GET(self) -> None:
        server = self.server
        path = self.path.partition("?")[0].lstrip("/")
        server.asked.append(self.path)
        file = server.folder / path
        if not file.is_file():
            self.send_error(404)
            return
        data = server.change(path, file.read_bytes())
        if server.fault and server.fault(self, path, data):
            return
        part = self.answer_range(data)
        server.sent += len(part)
        server.sent_by[path] = server.sent_by.get(path, 0) + len(part)


@contextlib.contextmanager
def served(folder: Path, *, fault=None, change=None):
    change = change or (lambda path, data: data)
    with serving(Files, folder=folder, fault=fault, change=change, sent=0, sent_by={}, asked=[]) as server:
        yield server, server.address


@pytest.fixture(autouse=True)
def quick_retries(monkeypatch):
    monkeypatch.setattr(remotes, "FIRST_WAIT_S", 0.01)


# --- all of it --------------------------------------------------------------------------------------------------------


def test_a_whole_release_comes_byte_for_byte(dataset, tmp_path):
    with served(dataset) as (server, address):
        found = get(choice(), address, tmp_path / "out")
    assert all_bytes(found) == all_bytes(dataset)
    assert server.sent < 1.2 * sum(path.stat().st_size for path in dataset.rglob("*") if path.is_file())


def in_memory(dataset: Path) -> str:
    memory = pytest.importorskip("fsspec", reason="extra remote").filesystem("memory")
    for name, data in all_bytes(dataset).items():
        memory.pipe_file(f"/release/{name}", data)
    return "memory://release"


@pytest.mark.parametrize("kind", ["stage folder", "zip", "memory", "http, two processes"])
def test_from_everywhere_the_same(kind, dataset, tmp_path):
    wanted = choice(towns=["Town01"], modalities=["rgb"])
    expected = get(wanted, str(dataset), tmp_path / "expected")
    assert str(dataset.parent).encode() not in b"".join(all_bytes(expected).values())  # nor where that stood

    def same(found: Path) -> None:
        assert all_bytes(found / "data") == all_bytes(expected / "data")

    if kind == "stage folder":
        same(get(wanted, str(dataset.parent), tmp_path / "out"))
    elif kind == "zip":
        with zipfile.ZipFile(tmp_path / "release.zip", "w") as archive:
            for name, data in all_bytes(dataset).items():
                archive.writestr(f"inner/{name}", data)
        same(get(wanted, f"zip://inner::{tmp_path / 'release.zip'}", tmp_path / "out"))
    elif kind == "memory":
        same(get(wanted, in_memory(dataset), tmp_path / "out"))
    else:
        with served(dataset) as (_, address):
            same(get(wanted, address, tmp_path / "out", workers=2))


FIRST = "trajectory_1776047127"


# --- a part -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wanted", "is_wanted"),
    [
        ({"towns": ["Town02"]}, lambda row: row["town"] == "Town02"),
        ({"splits": ["validation"]}, lambda row: row["split"] == "validation"),
        ({"flights": [f"one/Town01/{FIRST}"]}, lambda row: row["trajectory"] == FIRST),
        # a flight brings its twin along
        ({"flights": [f"one/Town01/{FIRST}/ORI"]}, lambda row: row["trajectory"] == FIRST),
        ({"towns": ["Town01"], "modalities": ["depth"]}, lambda row: row["town"] == "Town01"),
    ],
)
def test_a_part_is_a_release_of_the_wanted_rows(wanted, is_wanted, dataset, tmp_path):
    found = get(choice(**wanted), str(dataset), tmp_path / "out")
    report = verify(found)
    assert report.is_ok, report
    pictures = {PICTURES[file].name for file in wanted.get("modalities", PICTURES)}
    gone = {column.name for column in PICTURES.values()} - pictures
    expected = {
        name: {column: value for column, value in row.items() if column not in gone}
        for name, row in rows_by_id(dataset).items()
        if is_wanted(row)
    }
    assert rows_by_id(found) == expected
    record, whole = read_record(found / "release.json"), read_record(dataset / "release.json")
    assert record.part_of.content_digest == whole.content_digest != record.content_digest
    assert record.numbers.frames == len(expected)
    left = whole.numbers.flights - record.numbers.flights
    assert record.history.flights.left_out.get(NOT_ASKED_FOR, 0) == left
    assert (record.licence, record.credits, record.maps) == (whole.licence, whole.credits, whole.maps)
    assert whole.content_digest in (found / "README.md").read_text()


@pytest.fixture(scope="module")
def namesakes(tmp_path_factory) -> Path:
    """A release of two towns whose trajectories have one name, so that ids begin with the town."""
    root = tmp_path_factory.mktemp("namesakes")
    for seed, town in enumerate(TOWNS[:2]):
        make_playback_tree(root / "tree", 1, NUM_POINTS, seed, width_px=96, height_px=54, towns=(town,))
    flights = [read_flight(folder) for folder in find_flights(root / "tree")]
    flights = [replace(f, given_id=f"{f.town}_{f.trajectory}_{f.variant}") for f in flights]
    write_captions(root / "captions.jsonl", [make_caption(flight, 6, window=[2, 3, 4, 5, 6]) for flight in flights])
    write_inspection(root / "inspect.json", make_inspection(root / "tree", {}))
    return build(root, root / "release", CFG.model_copy(update={"num_frames": 400, **TWO_SPLITS}))


def test_a_town_whose_trajectory_has_a_namesake_in_another(namesakes, tmp_path):
    """It keeps its ids, which alone it would not need, in every form; an id of the other town's is still found."""
    found = get(choice(towns=["Town01"]), str(namesakes), tmp_path / "out")
    ids = rows_by_id(found).keys()
    assert ids == {name for name in rows_by_id(namesakes) if name.startswith("Town01_trajectory_")}
    report = verify(export(ExportConfig(format="webdataset", shard_mb=1), found, tmp_path / "export"))
    assert report.is_ok, report

    def of_another_town(rows):
        for row in rows:
            row["sample_id"] = row["sample_id"].replace("Town01_", "Town02_")

    assert "sample_id" in errors_in(forge(found, tmp_path / "forged", of_another_town), "rows")


def test_a_part_opens_with_datasets_by_split(dataset, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    datasets = pytest.importorskip("datasets", reason="extra distill")
    found = get(choice(splits=["train"], modalities=["rgb"]), str(dataset), tmp_path / "out")
    loaded = datasets.load_dataset(str(found), cache_dir=str(tmp_path / "cache"))
    assert set(loaded) == {"train"}
    assert "depth" not in loaded["train"].column_names
    assert set(loaded["train"]["sample_id"]) == rows_by_id(found).keys()


def test_what_is_left_out_does_not_travel(dataset, tmp_path):
    """Bytes counted on the wire."""
    record = read_record(dataset / "release.json")
    sizes = record.numbers.files.bytes_by_modality
    with served(dataset) as (server, address):
        get(choice(modalities=["rgb"]), address, tmp_path / "rgb")
        without_depth = server.sent
    with served(dataset) as (server, address):
        get(choice(splits=["validation"]), address, tmp_path / "split")
        asked = {path for path in server.sent_by if path.endswith(".parquet")}
    assert asked == {shard.path for shard in record.shards if shard.split == "validation"}
    others = sum(path.stat().st_size for path in dataset.iterdir() if path.is_file())
    assert without_depth < sizes["rgb"] + others + 0.25 * (sizes["depth"] + sizes["instance"])
    assert without_depth < 0.6 * record.numbers.files.bytes


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"towns": ["Town1"]}, r"no such town \(did you mean 'Town01'\?\)"),
        ({"flights": ["one/Town01"]}, "no such flight"),
        ({"towns": ["Town01"], "flights": ["one/Town02/trajectory_1776048127"]}, "no flight is all of that"),
        ({"splits": ["test"]}, r"no such split.*train, validation"),
    ],
)
def test_what_is_not_there_is_named(wanted, words, dataset, tmp_path):
    with pytest.raises(InputError, match=words):
        get(choice(**wanted), str(dataset), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_digest_that_is_expected(dataset, tmp_path):
    digest = read_record(dataset / "release.json").content_digest
    get(choice(splits=["train"], expected=digest[:12]), str(dataset), tmp_path / "out")
    with pytest.raises(InputError, match="not the release that is expected"):
        get(choice(expected="0" * 64), str(dataset), tmp_path / "other")


# --- interrupted ------------------------------------------------------------------------------------------------------


def test_a_finished_shard_is_not_fetched_again(dataset, tmp_path):
    last = read_record(dataset / "release.json").shards[-1].path
    lost = [last]

    def gone(handler, path, data):
        if path in lost:
            handler.send_error(503)
            return True

    with served(dataset, fault=gone) as (server, address):
        with pytest.raises(InputError, match="could not be fetched"):
            get(choice(), address, tmp_path / "out")
        assert not (tmp_path / "out/dataset").exists()
        with pytest.raises(ResumeError, match="source was"):
            get(choice(), str(dataset), tmp_path / "out")
        lost.clear()
        server.sent_by.clear()
        found = get(choice(), address, tmp_path / "out")
    assert {path for path in server.sent_by if path.endswith(".parquet")} == {last}
    assert all_bytes(found) == all_bytes(dataset)


@pytest.mark.parametrize("ranges", ["http", "folder of fsspec"])
def test_within_a_shard_it_goes_on_where_it_broke_off(ranges, dataset, tmp_path, monkeypatch):
    shard = max(read_record(dataset / "release.json").shards, key=lambda shard: shard.bytes)
    monkeypatch.setattr(stage, "CHUNK", shard.bytes // 10 + 1)
    kind = HttpRemote if ranges == "http" else FsspecRemote
    read, asked = kind.read, []

    def breaks(self, name, start, length):
        if name == shard.path and length == stage.CHUNK:
            asked.append(start)
            if len(asked) > 6:
                raise InputError("the transfer broke")
        return read(self, name, start, length)

    with served(dataset) as (_, address):
        address = address if ranges == "http" else in_memory(dataset)
        with monkeypatch.context() as broken:
            broken.setattr(kind, "read", breaks)
            with pytest.raises(InputError, match="could not be fetched"):
                get(choice(), address, tmp_path / "out")
        begun = tmp_path / f"out/parts/{Path(shard.path).name}.begun"
        assert begun.stat().st_size == 6 * stage.CHUNK
        begun.write_bytes(begun.read_bytes()[:-5])  # a kill in the middle of a write
        asked_again: list[tuple[int, int]] = []

        def counts(self, name, start, length):
            if name == shard.path:
                asked_again.append((start, length))
            return read(self, name, start, length)

        monkeypatch.setattr(kind, "read", counts)
        found = get(choice(), address, tmp_path / "out")
    assert all_bytes(found) == all_bytes(dataset)
    assert (6 * stage.CHUNK - 5, stage.CHUNK) in asked_again
    assert (0, stage.CHUNK) not in asked_again


def test_a_file_that_is_read_in_parts_is_opened_once(dataset, monkeypatch):
    """Each opening asks another place anew, and unpacks an archive's file from its begin."""
    remote = FsspecRemote(f"local://{dataset}")
    system, _ = remote._system()
    opened, really = [], system.open
    monkeypatch.setattr(
        system, "open", lambda path, *words, **names: opened.append(path) or really(path, *words, **names)
    )
    data = (dataset / "release.json").read_bytes()
    assert b"".join(remote.read("release.json", at, 100) for at in range(0, 1000, 100)) == data[:1000]
    assert remote.read("README.md", 0, 5) == (dataset / "README.md").read_bytes()[:5]
    assert len(opened) == 2
    with pytest.raises(InputError, match="number of bytes"):
        remote.read("README.md", 10**6, 5)
    assert remote.read("README.md", 0, 5) == (dataset / "README.md").read_bytes()[:5]


def test_bytes_of_another_shard_are_not_gone_on_with(dataset, tmp_path):
    shard = read_record(dataset / "release.json").shards[0]
    begun = tmp_path / f"out/parts/{Path(shard.path).name}.begun"
    for first in (b"not of this shard", bytes(shard.bytes), bytes(shard.bytes + 7)):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        copy = _broken(dataset, tmp_path)
        with pytest.raises(InputError, match="could not be fetched"):
            get(choice(), copy, tmp_path / "out")
        begun.parent.mkdir(exist_ok=True)
        begun.write_bytes(first)
        shutil.copytree(dataset, copy, dirs_exist_ok=True)
        found = get(choice(), copy, tmp_path / "out")
        assert all_bytes(found) == all_bytes(dataset)


def _broken(dataset: Path, tmp_path: Path) -> str:
    """A copy whose shards are of another content."""
    copy = shutil.copytree(dataset, tmp_path / "broken", dirs_exist_ok=True)
    for path in (copy / "data").iterdir():
        path.write_bytes(bytes(path.stat().st_size))
    return str(copy)


def test_a_transfer_that_breaks_is_tried_again(dataset, tmp_path):
    broken: set[str] = set()

    def breaks(handler, path, data):
        if handler.headers["range"] not in broken:
            broken.add(handler.headers["range"])
            handler.send_response(206)
            handler.send_header("content-range", f"{handler.headers['range'].replace('=', ' ')}/{len(data)}")
            handler.send_header("content-length", "100000")
            handler.end_headers()
            handler.wfile.write(b"\0" * 10)
            handler.close_connection = True
            handler.connection.close()
            return True

    with served(dataset, fault=breaks) as (_, address):
        remote = open_remote(address)
        name = "release.json"
        assert remote.read(name, 0, 500) == (dataset / name).read_bytes()[:500]


# --- an other side that lies ------------------------------------------------------------------------------------------


def endless(handler, path, data):
    """As much as anybody reads."""
    begin, end = handler.headers["range"].removeprefix("bytes=").split("-")
    handler.send_response(206)
    handler.send_header("content-range", f"bytes {begin}-{end}/{len(data)}")
    handler.send_header("transfer-encoding", "chunked")
    handler.end_headers()
    with contextlib.suppress(OSError):
        for _ in range(4000):
            handler.wfile.write(b"10000\r\n" + b"x" * 65536 + b"\r\n")
    handler.close_connection = True
    return True


def no_ranges(handler, path, data):
    handler.send_response(200)
    handler.send_header("content-length", str(len(data)))
    handler.end_headers()
    with contextlib.suppress(OSError):
        handler.wfile.write(data)
    return True


def huge_size(handler, path, data):
    if path != "release.json":
        return False
    handler.send_response(206)
    handler.send_header("content-range", f"bytes 0-0/{10**12}")
    handler.send_header("content-length", "1")
    handler.end_headers()
    handler.wfile.write(b"{")
    return True


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (endless, "more than was asked for|number of bytes|transfer broke"),
        (no_ranges, "HTTP 200"),
        (huge_size, "too large a record"),
    ],
)
def test_a_server_that_lies_is_refused(fault, words, dataset, tmp_path):
    with served(dataset, fault=fault) as (_, address), pytest.raises(InputError, match=words):
        get(choice(), address, tmp_path / "out")


def dripping(handler, path, data):
    """A header a moment, for ever."""
    handler.send_response(206)
    with contextlib.suppress(OSError):
        for k in range(10_000):
            handler.wfile.write(b"x-%d: 0\r\n" % k)
            time.sleep(0.05)
    return True


def wait_a_moment(handler, path, data):
    with contextlib.suppress(OSError):
        for _ in range(10_000):
            handler.wfile.write(b"HTTP/1.1 100 Continue\r\n\r\n")
            time.sleep(0.05)
    return True


@pytest.mark.parametrize("fault", [dripping, wait_a_moment])
def test_an_answer_that_never_ends_is_given_up(fault, dataset, monkeypatch):
    monkeypatch.setattr(remotes, "TIMEOUT_S", 0.5)
    monkeypatch.setattr(remotes, "TRIES", 2)
    with served(dataset, fault=fault) as (_, address), pytest.raises(InputError, match="the transfer broke"):
        open_remote(address).size("release.json")


def leads_to(place: str):
    def fault(handler, path, data):
        if path.startswith("there/"):
            return False
        handler.send_response(302)
        handler.send_header("location", place.format(port=handler.server.server_port, path=path))
        handler.send_header("content-length", "0")
        handler.end_headers()
        return True

    return fault


def test_a_redirect_is_followed_without_user_and_password(dataset, tmp_path, monkeypatch):
    folder = tmp_path / "served"
    shutil.copytree(dataset, folder / "there")
    shutil.copy(dataset / "release.json", folder)
    data, seen = (dataset / "release.json").read_bytes(), []

    def noted(fault):
        def note(handler, path, data):
            seen.append((handler.headers["host"].partition(":")[0], handler.headers["authorization"], handler.path))
            return fault(handler, path, data)

        return note

    monkeypatch.setattr(remotes, "public_address", lambda host: {"cdn.example": "127.0.0.1"}.get(host))
    for place, host in (
        ("/there/{path}", "127.0.0.1"),
        ("http://127.0.0.1:{port}/there/{path}", "127.0.0.1"),
        ("http://me:hush@cdn.example:{port}/there/{path}?own=1", "cdn.example"),
    ):
        with served(folder, fault=noted(leads_to(place))) as (_, address):
            seen.clear()
            remote = open_remote(address.replace("http://", "http://user:hush@") + "?token=hush")
            assert remote.read("release.json", 0, 500) == data[:500]
        (_, authorized, asked), (last, none, path) = seen
        assert (authorized is not None, asked) == (True, "/release.json?token=hush")
        assert (last, none, "hush" in path) == (host, None, False)


@pytest.mark.parametrize(
    "place",
    [
        "http://localhost:{port}/there/{path}", "http://169.254.169.254/{path}", "http://10.0.0.1/",
        "http://[::1]:{port}/x", "http://[::ffff:127.0.0.1]/",
        "http://0x7f000001:{port}/x", "http://0/", "file:///etc/passwd", "http://[::1", "//", "ftp://example.org/",
        "http://x:99999/", "\x1b[31m", "",
        "/{path}", "http://xn--0/",
    ],
)  # fmt: skip
def test_a_redirect_to_a_private_place_or_none_is_refused(place, dataset):
    with served(dataset, fault=leads_to(place)) as (server, address):
        with pytest.raises(InputError, match=r"not what was asked for; got HTTP 302|broke; got .*Protocol"):
            open_remote(address).size("release.json")
        assert len(server.asked) <= max(remotes.MOST_REDIRECTS + 1, remotes.TRIES)
        assert server.sent == 0


def test_a_public_address_has_no_private_one(monkeypatch):
    found = {"one": ["93.184.216.34"], "both": ["93.184.216.34", "10.0.0.1"], "six": ["2606:4700::1"]}
    found["mapped"] = ["::ffff:10.0.0.1"]
    known = lambda host, *_, **__: [(0, 0, 0, "", (address, 0)) for address in found[host]]  # noqa: E731
    monkeypatch.setattr(remotes.socket, "getaddrinfo", known)
    assert [remotes.public_address(host) for host in found] == ["93.184.216.34", None, "2606:4700::1", None]


def retold(change):
    """Serve a record that was changed, with the checksum made right."""

    def changed(folder: Path):
        record = json.loads((folder / "release.json").read_text())
        change(record)
        data = json.dumps(record).encode()
        lines = (folder / CHECKSUMS).read_text().splitlines()
        lines = [f"{sha256_bytes(data)}  release.json" if line.endswith("  release.json") else line for line in lines]
        texts = {"release.json": data, CHECKSUMS: ("\n".join(lines) + "\n").encode()}
        return lambda path, data: texts.get(path, data)

    return changed


RECORDS = [
    (retold(lambda r: r["shards"][0].update(path="../../../tmp/escaped.parquet")), "contradicts itself"),
    (retold(lambda r: r["shards"][0].update(path="/etc/passwd")), "contradicts itself"),
    (retold(lambda r: r["shards"][0].update(sha256="0" * 64)), "contradicts itself"),
    (retold(lambda r: r["shards"][0].update(bytes=-1)), "contradicts itself"),
    (retold(lambda r: r.update(schema_version="2.0")), "unknown version"),
    (retold(lambda r: r.update(licence=5)), "licence"),
    (lambda _: lambda path, data: data + b" " if path == "release.json" else data, "not the one of the checksums"),
]


@pytest.mark.parametrize(("change", "words"), RECORDS)
def test_a_record_that_lies_is_refused_before_any_data(change, words, dataset, tmp_path):
    with served(dataset, change=change(dataset)) as (server, address):
        with pytest.raises(InputError, match=words):
            get(choice(), address, tmp_path / "out")
        assert not [path for path in server.sent_by if path.endswith(".parquet")]


def damaged(path: str, data: bytes) -> bytes:
    """One byte of a picture is another one."""
    at = data.index(b"\x89PNG") + 400 if path.endswith(".parquet") else len(data)
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :] if at < len(data) else data


def garbage(path: str, data: bytes) -> bytes:
    return bytes(len(data)) if path.endswith(".parquet") else data


PART = {"towns": ["Town01"], "modalities": ["rgb"]}
DATA = {
    "another size": (retold(lambda r: r["shards"][0].update(bytes=10**15)), {}, "a shard of another size"),
    "a damaged byte": (lambda _: damaged, {}, "not the one of the record"),
    "other rows of a part": (retold(lambda r: [flight.update(frames=flight["frames"] + 1) for flight in r["flights"]]),
     PART, "other rows than the record says"),
    "garbage": (lambda _: garbage, {"modalities": ["rgb"]}, "not a whole parquet file"),
}  # fmt: skip


@pytest.mark.parametrize("name", DATA)
def test_data_that_lie_fail_their_shard(name, dataset, tmp_path):
    change, wanted, words = DATA[name]
    with (
        served(dataset, change=change(dataset)) as (_, address),
        pytest.raises(InputError, match="could not be fetched"),
    ):
        get(choice(**wanted), address, tmp_path / "out")
    failures = (tmp_path / "out/failures.jsonl").read_text()
    assert words in failures
    assert '"bug"' not in failures


def test_a_release_whose_rows_cannot_be_true_is_kept_if_asked(dataset, tmp_path, caplog):
    def lie(rows):
        rows[0]["visibility"] = 1.7

    forged = forge(dataset, tmp_path / "forged", lie)
    with pytest.raises(VerifyError, match="--findings accept"):
        get(choice(), str(forged), tmp_path / "out")
    assert not (tmp_path / "out/dataset").exists()
    found = get(choice(), str(forged), tmp_path / "out", findings="accept")
    assert all_bytes(found) == all_bytes(forged)
    assert "does not verify" in caplog.text
    told = json.loads((tmp_path / "out/findings.json").read_text())
    assert not told["ok"]
    assert any("visibility" in place for finding in told["findings"] for place in finding["examples"])


# --- addresses --------------------------------------------------------------------------------------------------------


@each(
    ("address", "shown"),
    [
        ("https://me:hush@host:8/a/b?token=hush#x", "https://host:8/a/b"),
        ("zip://in::https://me:hush@host/a.zip?sig=hush", "zip://in::https://host/a.zip"),
        ("s3://bucket/key", "s3://bucket/key"),
        ("https://me:hush@[::1]:8/a?hush", "https://[::1]:8/a"),
        ("https://[::1/a?hush", "https://...::1/a"),
        ("plain/folder", "plain/folder"),
    ],
)
def test_addresses_are_shown_without_secrets(address, shown):
    assert without_secrets(address) == shown


def test_secrets_reach_no_log_record_or_error(dataset, tmp_path, caplog):
    caplog.set_level(logging.DEBUG, logger="cosfly")
    with served(dataset) as (server, address):
        secret = address.replace("http://", "http://user:hush@") + "?token=hush"
        found = get(choice(modalities=["rgb"]), secret, tmp_path / "out")
        assert all(path.endswith("?token=hush") for path in server.asked)  # it is sent
        with pytest.raises(CosflyError) as told:
            open_remote(secret).size("no-such-file")
    assert "hush" not in str(told.value)
    assert "hush" not in caplog.text
    assert b"hush" not in b"".join(all_bytes(tmp_path / "out").values())
    assert read_record(found / "release.json").part_of.source == address


@pytest.mark.parametrize(
    ("shown", "published"),
    [
        ("/data/people/me/release", "release"),
        ("../release/dataset", "dataset"),
        ("https://host/a/b", "https://host/a/b"),
        ("file:///data/people/me/a.zip", "a.zip"),
        ("zip://in::/data/people/me/a.zip", "zip://in::a.zip"),
    ],
)
def test_the_record_of_a_part_names_no_place_on_this_machine(shown, published):
    assert remotes.published_address(shown) == published


def test_finished_shards_that_are_gone_are_told_of(dataset, tmp_path):
    get(choice(modalities=["rgb"]), str(dataset), tmp_path / "out")
    shutil.rmtree(tmp_path / "out/dataset")
    (tmp_path / "out/manifest.json").unlink()  # as after a kill, and somebody tidied up
    with pytest.raises(CosflyError, match="finished before is missing"):
        get(choice(modalities=["rgb"]), str(dataset), tmp_path / "out")


@pytest.mark.parametrize(
    "address",
    [
        "http://[::1", "reference://x", "", "http://", "http://host:99999/x", "http://xn--0/", "http://127.0.0.1:9/",
        "zip://", "::", "nosuchprotocol://x",
        "data:text/plain,x", "x" * 100_000, "http://\0/", "a\0b", "\ud800", "hf://", "memory://nothing",
        "simplecache::reference://",
        "file:///proc/self",
    ],
    ids=lambda address: repr(address[:30]),
)  # fmt: skip
def test_what_cannot_be_opened_is_one_clear_line(address, tmp_path):
    with pytest.raises(CosflyError) as told:
        get(choice(), address, tmp_path / "out")
    assert len(str(told.value)) < 5000


def test_a_pipe_in_a_folder_is_not_waited_for(dataset, tmp_path):
    copy = shutil.copytree(dataset, tmp_path / "copy")
    (copy / "release.json").unlink()
    os.mkfifo(copy / "release.json")
    for address in (str(copy), f"file://{copy}"):
        with pytest.raises(InputError, match="a named pipe"):
            get(choice(), address, tmp_path / "out")


# --- the command ------------------------------------------------------------------------------------------------------


def test_the_command(dataset, tmp_path):
    words = ["release", "get", dataset, "--town", "Town01", "--modality", "rgb", "--workers", "0"]
    words += ["--out", tmp_path / "out"]
    done = invoke(words)
    assert done.exit_code == 0, done.output
    found = tmp_path / "out/dataset"
    assert {row["town"] for row in rows_by_id(found).values()} == {"Town01"}
    assert set(read_checksums(found)) >= {"release.json", "README.md", "croissant.json"}
    assert invoke(words).exit_code == 0  # there is nothing more to do
    (shard,) = (found / "data").iterdir()
    assert pq.ParquetFile(io.BytesIO(shard.read_bytes())).metadata.num_rows == len(rows_by_id(found))
    shutil.rmtree(found)
