"""Files of strangers, one property for each reader: whatever the bytes, it reads them or says why not in one line."""

import json
import random
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from specimens_release import build, make_inputs
from test_cosfly_answers import TEXT

from cosfly.formats.boxes import MapHeader, make_box_map, read_boxes, write_boxes
from cosfly.formats.captions import read_captions
from cosfly.formats.frames import DEPTH_PNG, read_depth, read_instance, read_meta, read_rgb
from cosfly.formats.kinds import KINDS
from cosfly.formats.playback import read_track
from cosfly.formats.roi import read_roi
from cosfly.llm.answer_text import parse_answer
from cosfly.maps import boxfile, cityjson, simworld
from cosfly.runtime.errors import CosflyError
from cosfly.runtime.io import CHECKSUMS, read_checksums
from cosfly.runtime.json_io import write_json
from cosfly.runtime.run_dir import read_manifest
from cosfly.runtime.tables import rows_of
from release.record import read_record
from specimens import pack_depth

INPUTS = 40  # for each reader
LONGEST_LINE = 5_000
Random = random.Random


class Reader(NamedTuple):
    """A file below the specimens, as a pattern, and how it is read."""

    file: str
    read: Callable[[Path], object]


FLIGHT = "tree/Town01/*/ORI"
FRAME = f"{FLIGHT}/frames_playback/frame_00003"
RING = [[-30, -8], [30, -8], [30, 8], [-30, 8], [-30, -8]]
HOUSE = {
    "type": "Feature", "properties": {"type": "Buildings", "height_m": 9, "yaw_deg": 0},
    "geometry": {"type": "Polygon", "coordinates": [RING]},
}  # fmt: skip
CITY = {
    "type": "CityJSON", "version": "2.0",
    "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"},
    "transform": {"scale": [0.001] * 3, "translate": [1000.0, 0.0, 0.0]},
    "vertices": [[x, y, z] for z in (2000, 14_000) for x, y in ((0, 0), (9000, 0), (9000, 8000), (0, 8000))],
    "CityObjects": {"house": {"type": "Building", "geometry": [{"type": "Solid", "lod": "1.2", "boundaries": [
        [[[3, 2, 1, 0]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]]}]}},
}  # fmt: skip
WORLD = {"base_map": "x", "nodes": [{
    "id": "a", "instance_name": "BP_Tree1_C", "properties": {"location": {"x": 100, "y": 200, "z": 0},
        "orientation": {"pitch": 0, "yaw": 0, "roll": 0}, "scale": {"x": 1, "y": 1, "z": 1}},
}]}  # fmt: skip
READERS = {
    "boxes": Reader("boxes_3d.json", read_boxes),
    "region": Reader("roi_polygon.json", read_roi),
    "boxes, GeoJSON": Reader("own.geojson", lambda path: boxfile.load(boxfile.BoxesConfig(path=path))),
    "table of boxes": Reader("own.csv", lambda path: boxfile.load(boxfile.BoxesConfig(path=path))),
    "city model": Reader("city.json", lambda path: cityjson.load(cityjson.CityJsonConfig(path=path))),
    "SimWorld": Reader("world.json", lambda path: simworld.load(simworld.SimWorldConfig(world=path))),
    "flight": Reader(f"{FLIGHT}/trajectory.json", lambda path: read_track(path.parent)),
    "flight, tolerant": Reader(f"{FLIGHT}/trajectory.json", lambda path: read_track(path.parent, strict=False)),
    "annotation": Reader(f"{FRAME}/meta.json", lambda path: read_meta(path.parent)),
    "picture": Reader(f"{FRAME}/rgb.png", lambda path: read_rgb(path.parent)),
    "instances": Reader(f"{FRAME}/instance.png", lambda path: read_instance(path.parent)),
    "depth": Reader(f"{FRAME}/depth.npy", lambda path: read_depth(path.parent)),
    "depth, packed": Reader(f"{FRAME}/{DEPTH_PNG}".replace("Town01", "Town02"), lambda path: read_depth(path.parent)),
    "captions": Reader("captions.jsonl", lambda path: list(read_captions(path))),
    "release record": Reader("release/dataset/release.json", read_record),
    "shard": Reader("release/dataset/data/*.parquet", lambda path: list(rows_of(path))),
    "checksums": Reader(f"release/dataset/{CHECKSUMS}", lambda path: read_checksums(path.parent)),
    "manifest": Reader("release/manifest.json", lambda path: read_manifest(path.parent)),
    "answer": Reader("answer.txt", lambda path: parse_answer(path.read_text(errors="ignore"))),
}


@pytest.fixture(scope="module")
def specimens(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = make_inputs(tmp_path_factory.mktemp("specimens"))
    build(root, root / "release")
    pack_depth(min(root.glob("tree/Town02/*/ORI")))
    write_boxes(root / "boxes_3d.json", make_box_map(
        [(0, 14, 8), (20, -9, 1)], [(12, 5, 8), (4, 0.2, 1)], [(0, 0, 0), (0, 30, 0)],
        [KINDS["Buildings"], KINDS["Walls"]], header=MapHeader(name="street"),
    ))  # fmt: skip
    for name, value in (
        ("roi_polygon.json", {"points_world": [[0, 0], [9, 0], [9, 9]], "holes": [[[1, 1], [2, 1], [2, 2]]]}),
        ("city.json", CITY), ("world.json", WORLD),
        ("own.geojson", {"type": "FeatureCollection", "features": [HOUSE]}),
    ):  # fmt: skip
        write_json(root / name, value)
    write_json(root / "Bbox.json", {"all": {"BP_Tree1_C": {"bbox": {"x": 800, "y": 600, "z": 1200}}}})
    (root / "own.csv").write_text("id,type,x_m,y_m,z_m,length_m,width_m,height_m,yaw_deg\n1,Buildings,0,0,4,9,9,8,30\n")
    (root / "answer.txt").write_text(f"<think>hm</think>\n```json\n{TEXT}\n```")
    return root


WHOLE = [
    b"", b"\0", b"null", b"[]", b"{}", b'"word"', b"[" * 100_000, b'{"a":' * 50_000, b"\xff" * 1000, b"7" * 5000,
    "{}".encode("utf-16"), b"PAR1" + b"\0" * 40 + b"\xff\xff\xff\x7fPAR1", b"\x1f\x8b\x08\0", b"[[]," * 50_000,
]  # fmt: skip
TOKENS = [b"NaN", b"1e999", b"7" * 400, b"\0", b"\xff\xfe", b"\\ud800", b"\x1b[31m", b"\n", b"[" * 300, b'"']
VALUES: list[Any] = [
    None, True, -1, 0, 1.5, 1e308, 2**63, 10**39, "", "\0", "\x1b[31m", "../../../etc/passwd", "/dev/zero", "a" * 300,
    "<script>", "\u202e", [], {}, [None], ["x"], {"x": 0}, [{}] * 20_000, float("nan"), float("inf"), "\ud800",
]  # fmt: skip


def _changed(file: str, data: bytes, rng: Random) -> bytes:
    if rng.random() < 0.5:
        if file.endswith(("json", "jsonl")):
            return _other_value(data, rng)
        if file.endswith(".png"):
            return _other_size(data, rng)
        if file.endswith(".npy"):
            return data.replace(b"'<f4'", rng.choice((b"'|O8'", b"'<f8'", b"'|V4'", b"[('a', '<f4')]")), 1)
    return _other_bytes(data, rng)


def _other_bytes(data: bytes, rng: Random) -> bytes:
    begin = rng.randrange(len(data))
    end = begin + rng.choice((1, 4, 64, 4096))
    flipped = bytearray(data)
    flipped[begin] ^= 1 << rng.randrange(8)
    return rng.choice([
        rng.choice(WHOLE), bytes(flipped), data[:begin], data[:begin] + data[end:], data + data,
        data[:begin] + rng.choice(TOKENS) + data[end:], data[:begin] + rng.randbytes(end - begin) + data[end:],
    ])  # fmt: skip


def _other_value(data: bytes, rng: Random) -> bytes:
    """Change one value of JSON, or of a line of it; the shape stays."""
    lines = data.split(b"\n") if data.count(b'{"') > 1 and data.startswith(b'{"') else [data]
    k = rng.randrange(len(lines))
    try:
        box = [json.loads(lines[k])]
    except ValueError:
        return _other_bytes(data, rng)
    places: list[tuple[Any, Any]] = []
    waiting: list[Any] = [box]
    while waiting:
        group = waiting.pop()
        for key in group if isinstance(group, dict) else range(len(group)):
            places.append((group, key))
            if isinstance(group[key], dict | list):
                waiting.append(group[key])
    group, key = min(rng.sample(places, min(3, len(places))), key=lambda place: len(str(place[1])))
    if isinstance(group, dict) and rng.random() < 0.2:
        del group[key]
    else:
        group[key] = rng.choice(VALUES)
    lines[k] = json.dumps(box[0]).encode()
    return b"\n".join(lines)


def _other_size(data: bytes, rng: Random) -> bytes:
    sizes = (0, 1, 7000, 32_000, 2**31 - 1, 2**32 - 1)
    header = b"IHDR" + struct.pack(">II", rng.choice(sizes), rng.choice(sizes)) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


@pytest.mark.parametrize("name", READERS)
@pytest.mark.timeout(300)
def test_a_reader_takes_any_bytes_or_refuses_them_in_one_line(specimens, name):
    reader = READERS[name]
    path = min(specimens.glob(reader.file))
    honest = path.read_bytes()
    reader.read(path)
    lines: list[str] = []
    try:
        for number in range(INPUTS):
            path.write_bytes(_changed(reader.file, honest, Random(f"{name}/{number}")))
            try:
                reader.read(path)
            except CosflyError as error:
                lines.append(str(error))
    finally:
        path.write_bytes(honest)
    assert lines or name == "answer"
    assert max(map(len, lines), default=0) < LONGEST_LINE
    assert [line for line in lines if re.search(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u202e]", line)] == []
