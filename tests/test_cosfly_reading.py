"""The gate: whatever stands where a file should, a reader gives an InputError, soon and in little memory."""

import gzip
import io
import json
import os
import pickle
import socket
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from shapely.geometry import Polygon
from tables import each
from typer.testing import CliRunner

from cosfly.cli import app
from cosfly.errors import ConfigError, CosflyError, InputError
from cosfly.maps import cityjson
from cosfly.maps.footprints import check_outline, num_crossings
from cosfly.products.boxes import read_boxes
from cosfly.products.frames import depth_bytes, read_depth, rgb_bytes
from cosfly.products.inspection import Inspection, read_inspection, write_inspection
from cosfly.products.roi import read_roi
from cosfly.reading import arrays, documents, files, tables
from cosfly.reading.files import LinkedPath, read_text
from cosfly.work.config import Config, apply_overrides, build, read_yaml
from cosfly.work.journal import Journal
from cosfly.work.stage_folder import Kept, StageFolder, read_failures, result_of
from cosfly.work.store import inside
from release.record import RELEASE_FORMAT, read_record
from specimens import make_playback_tree


class _Dated(Config):
    name: str = ""


# --- what is no regular file (hostile contents, to every reader: tests/test_fuzz.py) ----------------------------------


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
        read_boxes,
        read_failures,
        read_yaml,
        read_text,
        arrays.read_picture,
        files.sha256_file,
        tables.num_rows,
    ):
        with pytest.raises((InputError, ConfigError), match=path.name):
            read(path)


# --- JSON -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [
        (b'{"a": 1e308, "b": -1e-999, "c": 123456789012345678901234567890}',
        [1e308, -0.0, 123456789012345678901234567890]),
        (b'{"a": 0.1000000000000000055511151231257827021181583404541015625}', [0.1]),
        (b'\xef\xbb\xbf{"a": "e9999 \\ud83d\\ude00"}', ["e9999 \U0001f600"]),
        (b'{"a": ' + b"[" * 60 + b"]" * 60 + b"}", None),
    ],
)  # fmt: skip
def test_honest_json_passes(tmp_path, text, value):
    (tmp_path / "x.json").write_bytes(text)
    found = documents.read_json(tmp_path / "x.json")
    assert value is None or list(found.values()) == value


def test_a_key_that_is_given_twice_in_a_file_of_ours(tmp_path):
    (tmp_path / "x.json").write_text('{"result": "rejected", "result": "accepted"}')
    assert documents.read_json(tmp_path / "x.json") == {"result": "accepted"}
    with pytest.raises(InputError, match="'result' is given twice"):
        documents.read_json(tmp_path / "x.json", each_key_once=True)


@pytest.mark.timeout(20)
def test_a_key_given_twice_among_very_many_is_found_soon():
    text = "{" + ", ".join(f'"k{k}": 0' for k in (*range(300_000), 299_999)) + "}"
    with pytest.raises(ValueError, match="'k299999' is given twice"):
        documents.parse_json(text, each_key_once=True)


@pytest.mark.parametrize("field", ["shards", "flights", "maps"])
def test_a_list_of_empty_objects_is_refused_at_the_first(tmp_path, field):
    head = {**RELEASE_FORMAT.header, field: [{}] * 30_000}
    (tmp_path / "release.json").write_text(json.dumps(head))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"release\.json: name: Field required") as caught:
            read_record(tmp_path / "release.json")
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()
    assert len(str(caught.value)) < 500


def test_more_brackets_than_a_text_of_its_size_has_are_refused_before_they_are_lists():
    with pytest.raises(ValueError, match="20,000,000 lists and objects"):
        documents.parse_json(b"[" + b"{},[]," * 9_999_999 + b"{}]")


def test_the_place_of_a_number_is_named(tmp_path):
    (tmp_path / "x.json").write_text('{"a": [0, {"b": 1e999}]}')
    with pytest.raises(InputError, match=r"x\.json: a\[1\]\.b: .*got 1e999"):
        documents.read_json(tmp_path / "x.json")


# --- records of stages ------------------------------------------------------------------------------------------------


def _with_line(out: Path, record) -> StageFolder:
    """A stage folder whose journal holds a line with the right checksum: whoever changes a file can change that too."""
    stage = StageFolder.open(out, "demo", config=_Dated(), inputs={}, seed=0)
    with Journal(stage.path / "items.jsonl") as journal:
        journal.append(record)
    return stage


@pytest.mark.parametrize(
    "record", [{"id": "a"}, {"id": 3, "status": "kept"}, {"id": "a", "status": "kept", "result": 7}], ids=str
)
def test_a_forged_line_of_a_journal_is_an_error(tmp_path, record):
    stage = _with_line(tmp_path / "out", record)
    with pytest.raises(InputError, match=r"items\.jsonl"):
        list(stage.items())
    with pytest.raises(InputError, match=r"items\.jsonl"):
        StageFolder.open(tmp_path / "out", "demo", config=_Dated(name="other"), inputs={}, seed=0)


def test_a_line_of_a_journal_that_is_no_object_is_damage(tmp_path):
    assert list(_with_line(tmp_path / "out", [1]).items()) == []


def test_an_inspection_that_tells_of_a_flight_twice(tmp_path):
    flight = {
        "town": "Town01",
        "trajectory": "t",
        "variant": "ORI",
        "folder": "Town01/t/ORI",
        "trace_id": None,
        "result": "rejected",
        "issues": [],
        "metrics": {},
    }
    counts = {"planned": 1, "dropped": {}, "not_rendered": 0, "rendered": 1, "accepted": 1, "review": 0, "rejected": 0}
    flights = {"inspected": 1, "accepted": 1, "review": 0, "rejected": 0, "without_trace": 0, "reasons": {}}
    funnel = {"trajectories": counts, "flights": flights}
    once = Inspection(settings={}, funnel=funnel, flights=[flight])
    write_inspection(tmp_path / "inspect.json", once)
    assert read_inspection(tmp_path / "inspect.json") == once
    write_inspection(
        tmp_path / "inspect.json",
        Inspection(settings={}, funnel=funnel, flights=[flight, flight | {"result": "accepted"}]),
    )
    with pytest.raises(InputError, match=r"flights: a flight has two records; got Town01/t/ORI"):
        read_inspection(tmp_path / "inspect.json")


def test_a_result_of_another_shape_is_named():
    with pytest.raises(InputError, match=r"items\.jsonl: a: result: name: .*got 7"):
        result_of(Kept(id="a", result={"name": 7}), _Dated)


# --- limits -----------------------------------------------------------------------------------------------------------


def test_text_of_another_coding_is_placed(tmp_path):
    path = tmp_path / "town.csv"
    path.write_bytes("type,name\nBuildings,Köln\n".encode("latin-1"))
    with pytest.raises(
        InputError, match=r"not UTF-8 text; got the byte 0xf6 in line 2; if it is text, save it as UTF-8"
    ):
        read_text(path)


def test_a_limit_is_named_with_what_to_do(tmp_path):
    path = tmp_path / "x.json"
    path.write_text(json.dumps("x" * 1_100_000))
    with pytest.raises(InputError, match=r"over the limit; got 1.1 MB; expected at most 1 MB in one piece; split it"):
        documents.read_json(path, most_mb=1)
    assert len(documents.read_json(path, most_mb=2)) == 1_100_000


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
    with pytest.raises(InputError, match=r"x\.jsonl:2: over the limit; .* at most 1 MB"):
        list(files.read_lines(tmp_path / "x.jsonl"))


def test_a_gzip_bomb_is_refused_while_it_unpacks(tmp_path, monkeypatch):
    path = tmp_path / "city.json.gz"
    path.write_bytes(gzip.compress(b" " * 70_000_000, 1))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"at most 100 times the file"):
            files.read_unpacked(path)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
    monkeypatch.setattr(files, "UNPACK_FACTOR", 1_000)
    assert len(files.read_unpacked(path)) == 70_000_000
    with pytest.raises(InputError, match=r"got more, unpacked; expected at most 60 MB"):
        files.read_unpacked(path, most_mb=60)


def test_very_many_equal_rows_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = tmp_path / "shard.parquet"
    pq.write_table(pa.table({"name": ["x"] * 10_000}), path)
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(tables, "FILE_MB", 9)
    with pytest.raises(InputError, match=r"row group 0: over the limit; got 10 MB; .* smaller row groups"):
        next(tables.rows_of(path))
    monkeypatch.setattr(tables, "FILE_MB", 10)
    assert len(list(tables.rows_of(path))) == 10_000


@pytest.mark.parametrize("within", [lambda texts: texts, lambda texts: pa.StructArray.from_arrays([texts], ["x"]),
lambda texts: pa.ListArray.from_arrays(range(3_001), texts)])  # fmt: skip
@pytest.mark.parametrize("kind", [pa.string(), pa.binary()])
def test_texts_that_a_dictionary_repeats_are_counted_before_they_are_unpacked(tmp_path, monkeypatch, within, kind):
    """300 kB of such a shard took 3.7 GB."""
    path = tmp_path / "shard.parquet"
    texts = pa.DictionaryArray.from_arrays(pa.array([0] * 3_000, pa.int32()), pa.array(["x" * 30_000], kind))
    pq.write_table(pa.table({"text": within(texts)}), path, store_schema=False)
    assert path.stat().st_size < 50_000
    with pytest.raises(InputError, match=r"got .* texts of 90,000,000; expected at most 100 times the row group"):
        next(tables.rows_of(path))
    monkeypatch.setattr(tables, "UNPACK_FACTOR", 10_000_000)
    row = next(tables.rows_of(path))
    assert row == pq.read_table(path).slice(0, 1).to_pylist()[0]


# --- pictures and arrays ----------------------------------------------------------------------------------------------


def _npy(array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_are_read_as_numpy_reads_them(tmp_path, order):
    array = np.asarray(np.random.default_rng(0).random((7, 5)), dtype=np.float32, order=order)
    (tmp_path / "x.npy").write_bytes(_npy(array))
    for found in (
        arrays.read_array(tmp_path / "x.npy", dtype=np.float32, ndim=2),
        arrays.parse_array(_npy(array), "x", dtype=np.float32, ndim=2),
        np.load(io.BytesIO(depth_bytes(array))),
    ):
        assert (found == array).all()
        assert found.flags.writeable


GOOD = _npy(np.zeros((7, 5), np.float32))


@each(
    "data",
    [
        GOOD[:-1], GOOD + b"\0", GOOD[:40], b"", GOOD.replace(b"(7, 5)", b"(5, 7, 1)"), GOOD.replace(b"<f4", b"<f8"),
        GOOD.replace(b"<f4", b"|O4"),
        GOOD.replace(b"<f4", b"<q9"), GOOD.replace(b"(7, 5)", b"(-7,-5)"),
        GOOD.replace(b"(7, 5)", b"(" + b"9" * 99 + b",)"), _npy(np.array([{}], object)),
        _npy(np.zeros((7, 5), ">f4")), GOOD[:8] + b"\xff\xff" + GOOD[10:], GOOD[:6] + b"\7" + GOOD[7:],
        _npy(np.zeros(3, [("a", "<f4")])),
        _npy(np.zeros((0, 5), np.float32)).replace(b"(0, 5)", b"(0, %d)" % 2**61),
    ],
    ids=str,
)  # fmt: skip
def test_other_arrays_are_refused(data):
    with pytest.raises(InputError):
        arrays.parse_array(data, "x", dtype=np.float32, ndim=2)


def _png(width: int, height: int) -> bytes:
    """A PNG whose header and checksums are right, with hardly any pixels."""
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(b"\0" * 9)),
        (b"IEND", b""),
    ]
    chunks = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    ]
    return arrays.PNG_SIGNATURE + b"".join(chunks)


def test_a_picture_is_measured_before_it_is_decoded(monkeypatch):
    picture = rgb_bytes(np.zeros((40, 60, 3), np.uint8))
    assert arrays.png_size(picture) == (60, 40)
    assert arrays.parse_picture(picture, "x").shape == (40, 60, 3)
    monkeypatch.setattr(cv2, "imdecode", None)
    for width, height in ((32_000, 32_000), (2**32 - 1, 2**32 - 1), (8192**2 + 1, 1)):
        with pytest.raises(InputError, match=r"got \d+ x \d+ px; expected at most 8192 x 8192 px"):
            arrays.parse_picture(_png(width, height), "x")


def test_a_chunk_that_goes_on_beyond_the_file_gets_no_memory(monkeypatch):
    picture = bytearray(rgb_bytes(np.zeros((40, 60, 3), np.uint8)))
    assert arrays.parse_picture(bytes(picture) + b"what stands behind", "x").shape == (40, 60, 3)
    place = picture.index(b"IDAT") - 4
    picture[place : place + 4] = struct.pack(">I", 2**31 - 1)
    monkeypatch.setattr(cv2, "imdecode", None)  # a decoder would make room for it
    with pytest.raises(InputError, match="not an image"):
        arrays.parse_picture(bytes(picture), "x")


@pytest.mark.parametrize(
    "data",
    [b"", _png(0, 3), b"BM" + b"\0" * 90, cv2.imencode(".jpg", np.zeros((9, 9, 3), np.uint8))[1].tobytes()],
    ids=len,
)
def test_other_pictures_are_refused(data):
    with pytest.raises(InputError):
        arrays.parse_picture(data, "x")


# --- links ------------------------------------------------------------------------------------------------------------


def _frame(tree: Path) -> Path:
    frame = tree / "Town01/trajectory_1/ORI/frames_playback/frame_00000"
    frame.mkdir(parents=True)
    return frame


def test_a_link_out_of_the_tree_is_refused_unless_the_tree_is_trusted(tmp_path):
    private = tmp_path / "private.npy"
    private.write_bytes(depth_bytes(np.zeros((4, 4), np.float32)))
    frame = _frame(tmp_path / "tree")
    (frame / "depth.npy").symlink_to(private)
    with pytest.raises(
        InputError, match=r"a link leads out of its folder; got .*private\.npy; .*--set follow_links=true"
    ):
        read_depth(frame)
    assert read_depth(LinkedPath(frame)).shape == (4, 4)


def test_one_command_follows_links_and_the_next_in_this_process_does_not(tmp_path):
    tree = make_playback_tree(tmp_path / "data/tree", 1, 4, with_augmented=False)
    (picture,) = tree.rglob("frame_00001/rgb.png")
    picture.symlink_to(picture.rename(tmp_path / "rgb.png"))
    words = ["view", str(tree), "--out", str(tmp_path / "out.png")]
    assert CliRunner().invoke(app, [*words, "--set", "follow_links=true"]).exit_code == 0
    assert "leads out" in str(CliRunner().invoke(app, words).exception)


def test_what_is_made_of_a_trusted_path_is_trusted_in_a_worker_too(tmp_path):
    (tmp_path / "x").mkdir()
    tree = LinkedPath(tmp_path)
    made = (tree / "x", *tree.glob("*"), *tree.iterdir(), tree.parent, (tree / "x").parents[0], tree.absolute())
    assert all(isinstance(path, LinkedPath) for path in (*made, pickle.loads(pickle.dumps(tree)), tree.with_name("y")))


def test_links_within_a_tree_and_to_a_tree_are_followed(tmp_path):
    frame = _frame(tmp_path / "disk/tree")
    (frame.parents[4] / "one.npy").write_bytes(depth_bytes(np.zeros((4, 4), np.float32)))
    (frame / "depth.npy").symlink_to(frame.parents[4] / "one.npy")
    (tmp_path / "data").symlink_to(tmp_path / "disk/tree")
    assert read_depth(tmp_path / "data" / frame.relative_to(frame.parents[4])).shape == (4, 4)


def _linked_flight(tree: Path, elsewhere: Path) -> Path:
    """A tree whose one flight is a link to a folder below `elsewhere`; gives its frame by the tree's name."""
    frame = _frame(elsewhere)
    (frame / "depth.npy").write_bytes(depth_bytes(np.zeros((4, 4), np.float32)))
    flight = tree / "Town01/trajectory_1/ORI"
    flight.parent.mkdir(parents=True)
    flight.symlink_to(frame.parents[1])
    return flight / "frames_playback/frame_00000"


def test_a_flight_behind_a_link_is_read_inside_the_folder_of_its_tree_and_refused_outside(tmp_path):
    assert read_depth(_linked_flight(tmp_path / "data/tree", tmp_path / "data/elsewhere")).shape == (4, 4)
    outside = _linked_flight(tmp_path / "other/tree", tmp_path / "elsewhere")
    with pytest.raises(InputError, match="leads out"):
        read_depth(outside)
    assert read_depth(LinkedPath(outside)).shape == (4, 4)


def test_nothing_in_a_linked_flight_leads_out_of_it(tmp_path):
    frame = _linked_flight(tmp_path / "data/tree", tmp_path / "data/elsewhere")
    private = tmp_path / "data/private.npy"
    private.write_bytes(depth_bytes(np.zeros((4, 4), np.float32)))
    (frame / "depth.npy").unlink()
    (frame / "depth.npy").symlink_to(private)
    with pytest.raises(InputError, match="leads out"):
        read_depth(frame)


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
    assert "far: leads to" in caplog.text
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


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/../../x", "a\0b", "\ud800"])
def test_names_that_lead_out_or_nowhere(tmp_path, name):
    with pytest.raises(InputError):
        files.read_bytes(inside(tmp_path, name))


# --- settings ---------------------------------------------------------------------------------------------------------

HOSTILE_YAML = {
    "aliases of aliases": "a: &a [x, x, x, x, x, x, x, x, x]\n"
    + "".join(f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
    "an alias in itself": "a: &a [*a]",
    "60,000 keys": "".join(f"k{i}: 1\n" for i in range(60_000)),
    "deep": "[" * 20_000,
    "deep blocks": "".join(" " * i + "a:\n" for i in range(500)),
    "a tag": "a: !!binary aGk=",
    "a tag of Python": "a: !!python/object/apply:os.system ['x']",
    "a tagged date": "a: !!timestamp 2024-01-01",
    "400 digits": "a: " + "1" * 400,
    "5,000 digits": "a: " + "1" * 5000,
    "half a surrogate pair": 'a: "\\ud800"',
    "a NUL": 'a: "\\0"',
    "a list as key": "? [a]\n: 1",
    "two documents": "a: 1\n---\nb: 2",
    "2 MB": "a: '" + "x" * 2_000_000 + "'",
    "no UTF-8": b"a: \xff",
}  # fmt: skip


@pytest.mark.timeout(60)
@pytest.mark.parametrize("case", HOSTILE_YAML)
def test_hostile_settings_are_one_clear_line(tmp_path, case):
    text = HOSTILE_YAML[case]
    path = tmp_path / "run.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError, match=r"run\.yaml") as caught:
        read_yaml(path)
    assert len(str(caught.value)) < 500
    if isinstance(text, str) and "\0" not in text:
        with pytest.raises(ConfigError, match="--set a"):
            apply_overrides({}, [f"a={text}"])


def test_a_date_is_the_text_that_it_looks_like():
    assert build(_Dated, apply_overrides({}, ["name=2026-11-22"]), "x").name == "2026-11-22"


def test_anchors_that_stay_small_are_fine(tmp_path):
    (tmp_path / "x.yaml").write_text("a: &a {b: 1}\nc:\n  <<: *a\n  d: *a\n")
    assert read_yaml(tmp_path / "x.yaml") == {"a": {"b": 1}, "c": {"b": 1, "d": {"b": 1}}}


def test_a_setting_of_very_many_parts():
    with pytest.raises(ConfigError, match="not an assignment"):
        apply_overrides({}, ["a" + ".a" * 5000 + "=1"])


# --- polygons ---------------------------------------------------------------------------------------------------------


def test_crossings_are_counted():
    square = [(0, 0), (4, 0), (4, 4), (0, 4)]
    assert num_crossings(Polygon(square), 10) == 0
    assert num_crossings(Polygon([(0, 0), (4, 4), (4, 0), (0, 4)]), 10) == 1
    assert num_crossings(Polygon(square, [[(1, 1), (2, 1), (2, 1), (2, 2)]]), 10) == 0
    assert num_crossings(Polygon(square, [[(3, 1), (5, 1), (5, 2)]]), 10) == 2
    assert num_crossings(Polygon([(0, 0), (9, 0), (3, 0), (6, 0), (1, 5)]), 10) > 1  # back and forth


@pytest.mark.timeout(60)
@pytest.mark.parametrize("num_vertices", [300, 3_000])
def test_a_tangled_outline_is_refused_at_once(num_vertices):
    points = np.random.default_rng(0).random((num_vertices, 2)) * 1000
    with pytest.raises(InputError, match=r"lawn: over the limit; .* raise maps\.cityjson\.polygon_crossings"):
        check_outline(Polygon(points), "lawn", 500)


def test_an_outline_that_crosses_itself_now_and_then_is_mended():
    check_outline(Polygon([(0, 0), (4, 4), (4, 0), (0, 4)]), "lawn", 500)


def test_a_region_of_too_many_vertices(tmp_path):
    (tmp_path / "roi.json").write_text(json.dumps({"points_world": [[0, 0], [9, 0], [9, 9], [0, 9]]}))
    with pytest.raises(InputError, match=r"got 4 vertices; expected at most 3; .*pedestrians\.roi_vertices"):
        read_roi(tmp_path / "roi.json", 3)
    assert len(read_roi(tmp_path / "roi.json", 4).rings()) == 1
