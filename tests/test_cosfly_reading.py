"""The gate: whatever stands where a file should, a reader gives an InputError, soon and in little memory."""

import gzip
import io
import json
import os
import socket
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import invoke
from pydantic import BaseModel

from cosfly.formats.boxes import read_boxes
from cosfly.formats.frames import depth_bytes, read_depth, rgb_bytes
from cosfly.maps import cityjson
from cosfly.runtime import arrays, json_io, png, tables
from cosfly.runtime import io as files
from cosfly.runtime.config import Config, apply_overrides, build, read_yaml
from cosfly.runtime.errors import ConfigError, CosflyError, InputError
from cosfly.runtime.io import LinkedPath, inside, read_text
from cosfly.runtime.run_dir import StageFolder, read_failures
from release.record import RELEASE_FORMAT, read_record
from specimens import make_playback_tree, png_around


class _Dated(Config):
    name: str = ""


def test_a_key_that_is_given_twice_in_a_file_of_ours(tmp_path):
    (tmp_path / "x.json").write_text('{"result": "rejected", "result": "accepted"}')
    assert json_io.read_json(tmp_path / "x.json") == {"result": "accepted"}
    with pytest.raises(InputError, match="'result' is given twice"):
        json_io.read_model(tmp_path / "x.json", BaseModel, RELEASE_FORMAT)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "socket", "missing", "link to itself"])
def test_what_is_no_regular_file_is_refused_and_never_waited_for(tmp_path, monkeypatch, kind):
    path = tmp_path / "boxes_3d.json"
    monkeypatch.chdir(tmp_path)  # the path of a socket may have 100 bytes
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        socket.socket(socket.AF_UNIX).bind(path.name)
    elif kind != "missing":
        path.symlink_to("/dev/zero" if kind == "device" else path)
    for read in (
        read_boxes, read_failures, read_yaml, read_text, png.read_picture, files.sha256_file,
            lambda path: list(tables.row_groups(path)),
    ):  # fmt: skip
        with pytest.raises((InputError, ConfigError), match=path.name):
            read(path)


@pytest.mark.parametrize(("text", "value"), [
    (b'{"a": 1e308, "b": -1e-999, "c": 123456789012345678901234567890}',
        [1e308, -0.0, 123456789012345678901234567890]),
    (b'{"a": 0.1000000000000000055511151231257827021181583404541015625}', [0.1]),
    (b'\xef\xbb\xbf{"a": "e9999 \\ud83d\\ude00"}', ["e9999 \U0001f600"]),
    (b'{"a": ' + b"[" * 60 + b"]" * 60 + b"}", None),
])  # fmt: skip
def test_honest_json_passes(tmp_path, text, value):
    (tmp_path / "x.json").write_bytes(text)
    found = json_io.read_json(tmp_path / "x.json")
    assert value is None or list(found.values()) == value


@pytest.mark.parametrize("field", ["shards", "flights", "maps"])
def test_a_list_of_empty_objects_is_refused_at_the_first(tmp_path, field):
    head = {**RELEASE_FORMAT.header, field: [{}] * 30_000}
    (tmp_path / "release.json").write_text(json.dumps(head))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"release\.json: name: the field is missing") as caught:
            read_record(tmp_path / "release.json")
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 500


def test_more_brackets_than_a_text_of_its_size_has_are_refused_before_they_are_lists():
    with pytest.raises(ValueError, match="too many lists and objects: 20,000,000"):
        json_io.parse_json(b"[" + b"{},[]," * 9_999_999 + b"{}]")


@pytest.mark.parametrize(
    "record", [{"id": "a"}, {"id": 3, "status": "kept"}, {"id": "a", "status": "kept", "result": 7}], ids=str
)
def test_a_forged_line_of_a_journal_is_an_error(tmp_path, record):
    """Its checksum is right: whoever changes a file can change that too."""
    stage = StageFolder.open(tmp_path / "out", "demo", config=_Dated(), inputs={}, seed=0)
    with stage.journal as journal:
        journal.append(record)
    with pytest.raises(InputError, match=r"items\.jsonl"):
        list(stage.items())
    with pytest.raises(InputError, match=r"items\.jsonl"):
        StageFolder.open(tmp_path / "out", "demo", config=_Dated(name="other"), inputs={}, seed=0)


def test_a_sparse_file_is_refused_before_it_is_read(tmp_path):
    with open(tmp_path / "x.json", "wb") as file:
        file.truncate(20_000_000_000)
    city = lambda path: cityjson.load(cityjson.CityJsonConfig(path=path))  # noqa: E731
    for read in (read_boxes, city, read_yaml):
        with pytest.raises(CosflyError, match="over the limit"):
            read(tmp_path / "x.json")


def test_a_long_line_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "LINE_MB", 1)
    (tmp_path / "x.jsonl").write_bytes(b"{}\n" + b" " * 1_200_000)
    with pytest.raises(InputError, match=r"x\.jsonl:2: the input is over the limit; .* at most 1 MB"):
        list(files.read_lines(tmp_path / "x.jsonl"))


def test_a_gzip_bomb_is_refused_while_it_unpacks(tmp_path, monkeypatch):
    path = tmp_path / "city.json.gz"
    path.write_bytes(gzip.compress(b" " * 70_000_000, 1))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"at most 100 times the size of the file"):
            files.read_unpacked(path)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
    monkeypatch.setattr(files, "UNPACK_FACTOR", 1_000)
    assert len(files.read_unpacked(path)) == 70_000_000
    with pytest.raises(InputError, match=r"got more than 60 MB after decompression; expected at most 60 MB"):
        files.read_unpacked(path, most_mb=60)


def test_very_many_equal_rows_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = tmp_path / "shard.parquet"
    pq.write_table(pa.table({"name": ["x"] * 10_000}), path)
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(tables, "FILE_MB", 9)
    with pytest.raises(InputError, match=r"row group 0: the input is over the limit; got 10 MB; .* smaller row groups"):
        next(tables.rows_of(path))
    monkeypatch.setattr(tables, "FILE_MB", 10)
    assert len(list(tables.rows_of(path))) == 10_000


@pytest.mark.parametrize("items", [pa.array([0]).take(pa.array([0] * 2_000_000)), pa.nulls(2_000_000, pa.int32())])
def test_a_long_list_of_equal_items_is_refused_before_it_is_read(tmp_path, items):
    lists = pa.ListArray.from_arrays(pa.array([0, len(items)], pa.int32()), items)
    for column in (lists, pa.StructArray.from_arrays([lists], ["x"]), pa.ListArray.from_arrays([0, 1], lists)):
        path = tmp_path / "shard.parquet"
        pq.write_table(pa.table({"a": column}), path)
        assert path.stat().st_size < 10_000
        with pytest.raises(InputError, match=r"row group 0: the input is over the limit; got lists of 1,999,999 items"):
            next(tables.rows_of(path))


@pytest.mark.parametrize("within", [lambda texts: texts, lambda texts: pa.StructArray.from_arrays([texts], ["x"]),
    lambda texts: pa.ListArray.from_arrays(range(3_001), texts)])  # fmt: skip
@pytest.mark.parametrize("kind", [pa.string(), pa.binary()])
def test_texts_that_a_dictionary_repeats_are_counted_before_they_are_unpacked(tmp_path, monkeypatch, within, kind):
    """300 kB of such a shard took 3.7 GB."""
    path = tmp_path / "shard.parquet"
    texts = pa.DictionaryArray.from_arrays(pa.array([0] * 3_000, pa.int32()), pa.array(["x" * 30_000], kind))
    pq.write_table(pa.table({"text": within(texts)}), path, store_schema=False)
    assert path.stat().st_size < 50_000
    with pytest.raises(
        InputError, match=r"got .* to 90,000,000 bytes of text; expected at most 100 times the stored bytes"
    ):
        next(tables.rows_of(path))
    monkeypatch.setattr(tables, "UNPACK_FACTOR", 10_000_000)
    row = next(tables.rows_of(path))
    assert row == pq.read_table(path).slice(0, 1).to_pylist()[0]


def _npy(array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


GOOD = _npy(np.zeros((7, 5), np.float32))


@pytest.mark.parametrize("data", [
    GOOD[:-1], GOOD[:40], b"", GOOD.replace(b"(7, 5)", b"(5, 7, 1)"), GOOD.replace(b"<f4", b"|O4"),
    GOOD.replace(b"(7, 5)", b"(" + b"9" * 99 + b",)"), _npy(np.array([{}], object)),
    _npy(np.zeros((7, 5), ">f4")), GOOD[:8] + b"\xff\xff" + GOOD[10:], GOOD[:6] + b"\7" + GOOD[7:],
    _npy(np.zeros(3, [("a", "<f4")])),
    _npy(np.zeros((0, 5), np.float32)).replace(b"(0, 5)", b"(0, %d)" % 2**61),
])  # fmt: skip
def test_other_arrays_are_refused(data):
    with pytest.raises(InputError):
        arrays.parse_array(data, "x", dtype=np.float32, ndim=2)


def test_a_picture_is_measured_before_it_is_decoded(monkeypatch):
    picture = rgb_bytes(np.zeros((40, 60, 3), np.uint8))
    assert png.png_size(picture) == (60, 40)
    assert png.colours_of(picture, "x").shape == (40, 60, 3)
    monkeypatch.setattr(png.Image, "open", None)
    for width, height in ((32_000, 32_000), (2**32 - 1, 2**32 - 1), (8192**2 + 1, 1)):
        with pytest.raises(InputError, match=r"got \d+ x \d+ px; expected at most 8192 x 8192 px"):
            png.colours_of(png_around(zlib.compress(b"\0" * 9), width, height), "x")


def test_one_command_follows_links_and_the_next_in_this_process_does_not(tmp_path):
    tree = make_playback_tree(tmp_path / "data/tree", 1, 4, with_augmented=False)
    (picture,) = tree.rglob("frame_00001/rgb.png")
    picture.symlink_to(picture.rename(tmp_path / "rgb.png"))
    words = ["view", str(tree), "--out", str(tmp_path / "out.png")]
    assert invoke(words, "--set follow_links=true").exit_code == 0
    assert "leads out" in str(invoke(words).exception)


def _linked_flight(tree: Path, elsewhere: Path) -> Path:
    frame = elsewhere / "Town01/trajectory_1/ORI/frames_playback/frame_00000"
    frame.mkdir(parents=True)
    (frame / "depth.npy").write_bytes(depth_bytes(np.zeros((4, 4), np.float32)))
    flight = tree / "Town01/trajectory_1/ORI"
    flight.parent.mkdir(parents=True)
    flight.symlink_to(frame.parents[1])
    return flight / "frames_playback/frame_00000"


def test_a_flight_behind_a_link_is_read_inside_the_folder_of_its_tree_and_refused_outside(tmp_path):
    frame = _linked_flight(tmp_path / "data/tree", tmp_path / "data/elsewhere")
    assert read_depth(frame).shape == (4, 4)
    (tmp_path / "linked").symlink_to(tmp_path / "data")
    assert read_depth(tmp_path / "linked" / frame.relative_to(tmp_path / "data")).shape == (4, 4)
    (frame / "depth.npy").rename(tmp_path / "data/private.npy")
    (frame / "depth.npy").symlink_to(tmp_path / "data/private.npy")
    with pytest.raises(InputError, match="leads out"):
        read_depth(frame)
    outside = _linked_flight(tmp_path / "other/tree", tmp_path / "elsewhere")
    with pytest.raises(InputError, match="leads out"):
        read_depth(outside)
    assert read_depth(LinkedPath(outside)).shape == (4, 4)


def test_files_are_found_through_links_that_stay_beside_their_tree(tmp_path, caplog):
    tree = tmp_path / "data/tree"
    for place in ("tree/Town01/a/ORI", "beside/Town02/b/ORI", "tree/Town01/.hidden/ORI"):
        (tmp_path / "data" / place).mkdir(parents=True)
        (tmp_path / "data" / place / "trajectory.json").write_text("{}")
    (tmp_path / "far/ORI").mkdir(parents=True)
    (tmp_path / "far/ORI/trajectory.json").write_text("{}")
    (tree / "Town02").symlink_to(tmp_path / "data/beside/Town02")
    (tree / "Town01/far").symlink_to(tmp_path / "far")
    (tree / "Town01/round").symlink_to(tree)  # and round again
    (tree / "Town01/gone").symlink_to(tmp_path / "nowhere")
    (tree / "Town01/itself").symlink_to(tree / "Town01/itself")

    def found(tree: Path) -> list[str]:
        return [path.parent.relative_to(tree).as_posix() for path in files.files_named(tree, "trajectory.json")]

    assert found(tree) == ["Town01/a/ORI", "Town02/b/ORI"]
    assert "far: skipped, because this link leads to" in caplog.text
    assert "--set follow_links=true" in caplog.text
    assert found(LinkedPath(tree)) == ["Town01/a/ORI", "Town01/far/ORI", "Town02/b/ORI"]


def test_the_cache_of_the_hub_is_one_tree(tmp_path):
    repository = tmp_path / "hub/datasets--somebody--flights"
    (repository / "blobs").mkdir(parents=True)
    (repository / "blobs/abc").write_bytes(b"card")
    snapshot = repository / "snapshots/0123"
    (snapshot / "data").mkdir(parents=True)
    (snapshot / "data/card").symlink_to("../../../blobs/abc")
    (snapshot / "data/secret").symlink_to("../../../../secret")
    (tmp_path / "hub/secret").write_bytes(b"secret")
    assert files.read_bytes(inside(snapshot, "data/card"), tree=snapshot) == b"card"
    with pytest.raises(InputError, match="leads out"):
        inside(snapshot, "data/secret")


HOSTILE_YAML = {
    "deep": "[" * 20_000,
    "a tag": "a: !!binary aGk=",
    "a tag of Python": "a: !!python/object/apply:os.system ['x']",
    "a key twice": "a: 1\na: 2",
    "5,000 digits": "a: " + "1" * 5000,
    "a list as key": "? [a]\n: 1",
    "2 MB": "a: '" + "x" * 2_000_000 + "'",
    "no UTF-8": b"a: \xff",
}  # fmt: skip


@pytest.mark.timeout(60)
@pytest.mark.parametrize("case", HOSTILE_YAML)
def test_hostile_settings_are_one_clear_line(tmp_path, case):
    text = HOSTILE_YAML[case]
    path = tmp_path / "run.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError, match=r"run\.yaml"):
        read_yaml(path)


def test_a_date_is_the_text_that_it_looks_like():
    assert build(_Dated, apply_overrides({}, ["name=2026-11-22"]), "x").name == "2026-11-22"
