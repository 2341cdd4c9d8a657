"""Foreign files and texts: whatever the bytes, a reader reads them or says why not in one line; the terminal obeys no
text, pages and cards show it as it is, and no length of it is too long.
"""

import base64
import io
import json
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from browser import browser
from commands import obeyed
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from pydantic import BaseModel, ValidationError
from rich.table import Table
from specimens_release import build, make_inputs
from test_cosfly_answers import TEXT
from test_cosfly_boxfile import PLAIN, collection, houses
from test_cosfly_inspection import plan_of
from test_cosfly_map_kinds import city, node, write_world
from test_cosfly_viz import EVIL, data_of

from caption.schema import CaptionConfig
from caption.stage.ledger import REPORT_FORMAT, CaptionReport, page_html
from caption.stage.stage import run as caption
from cosfly.formats.boxes import MapHeader, make_box_map, read_boxes, write_boxes
from cosfly.formats.captions import Caption, read_captions
from cosfly.formats.frames import DEPTH_PNG, depth_file, read_depth, read_instance, read_meta, read_rgb
from cosfly.formats.inspection import Inspection, read_inspection
from cosfly.formats.kinds import KINDS
from cosfly.formats.playback_file import read_track
from cosfly.formats.roi import read_roi
from cosfly.formats.traces import write_traces
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import box_corners
from cosfly.inspection.report import report_html
from cosfly.inspection.settings import InspectConfig
from cosfly.inspection.stage import run as inspect
from cosfly.llm.answer_text import parse_answer
from cosfly.llm.answers import BudgetConfig
from cosfly.llm.protocol import check_url
from cosfly.maps import box_rows, boxfile, cityjson, simworld
from cosfly.runtime import console as shared
from cosfly.runtime.errors import ConfigError, CosflyError, InputError
from cosfly.runtime.escaping import LONGEST, for_terminal
from cosfly.runtime.io import CHECKSUMS, read_checksums
from cosfly.runtime.json_io import read_model, write_json
from cosfly.runtime.run_dir import read_manifest
from cosfly.runtime.tables import rows_of
from cosfly.viz.scene_page import run
from release.card.render import render_card
from release.record import ReleaseRecord, read_record
from specimens import make_playback_tree, map_of

INPUTS = 40  # for each reader
LONGEST_LINE = 5_000


FLIGHT = "tree/Town01/*/ORI"
FRAME = f"{FLIGHT}/frames_playback/frame_00003"
# A file below the specimens, as a pattern, and how it is read.
READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "boxes": ("boxes_3d.json", read_boxes),
    "region": ("roi_polygon.json", read_roi),
    "boxes, GeoJSON": ("own.geojson", lambda path: boxfile.load(box_rows.BoxesConfig(path=path))),
    "table of boxes": ("own.csv", lambda path: boxfile.load(box_rows.BoxesConfig(path=path))),
    "city model": ("city.json", lambda path: cityjson.load(cityjson.CityJsonConfig(path=path))),
    "SimWorld": ("world.json", lambda path: simworld.load(simworld.SimWorldConfig(world=path))),
    "flight": (f"{FLIGHT}/trajectory.json", lambda path: read_track(path.parent)),
    "annotation": (f"{FRAME}/meta.json", lambda path: read_meta(path.parent)),
    "picture": (f"{FRAME}/rgb.png", lambda path: read_rgb(path.parent)),
    "instances": (f"{FRAME}/instance.png", lambda path: read_instance(path.parent)),
    "depth": (f"{FRAME}/depth.npy", lambda path: read_depth(path.parent)),
    "depth, packed": (f"{FRAME}/{DEPTH_PNG}".replace("Town01", "Town02"), lambda path: read_depth(path.parent)),
    "captions": ("captions.jsonl", lambda path: list(read_captions(path))),
    "release record": ("release/dataset/release.json", read_record),
    "shard": ("release/dataset/data/*.parquet", lambda path: list(rows_of(path))),
    "checksums": (f"release/dataset/{CHECKSUMS}", lambda path: read_checksums(path.parent)),
    "manifest": ("release/manifest.json", lambda path: read_manifest(path.parent)),
    "answer": ("answer.txt", lambda path: parse_answer(path.read_text(errors="ignore"))),
}


@pytest.fixture(scope="module")
def specimens(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = make_inputs(tmp_path_factory.mktemp("specimens"))
    build(root, root / "release")
    for path in min(root.glob("tree/Town02/*/ORI")).rglob("depth.npy"):
        path.with_name(DEPTH_PNG).write_bytes(depth_file(read_depth(path.parent), "png")[1])
        path.unlink()
    house, wall = ("Buildings", (0, 14, 8), (12, 5, 8)), ("Walls", (20, -9, 1), (4, 0.2, 1), 30.0)
    write_boxes(root / "boxes_3d.json", map_of(house, wall, name="street"))
    region = {"points_world": [[0, 0], [9, 0], [9, 9]], "holes": [[[1, 1], [2, 1], [2, 2]]]}
    write_json(root / "roi_polygon.json", region)
    write_json(root / "city.json", city())
    write_world(root, node("BP_Tree1_C", 100, 200))
    (root / "own.geojson").write_text(collection(*houses(yaw_deg=0)))
    (root / "own.csv").write_text(PLAIN)
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


def places_in(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield where values stand in JSON: what holds each, and its key there."""
    for key in value if isinstance(value, dict) else range(len(value)):
        yield value, key
        if isinstance(value[key], dict | list):
            yield from places_in(value[key])


def _other_value(data: bytes, rng: Random) -> bytes:
    """Change one value of JSON, or of a line of it; the shape stays."""
    lines = data.split(b"\n") if data.count(b'{"') > 1 and data.startswith(b'{"') else [data]
    k = rng.randrange(len(lines))
    try:
        box = [json.loads(lines[k])]
    except ValueError:
        return _other_bytes(data, rng)
    places = list(places_in(box))
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
    file, read = READERS[name]
    path = min(specimens.glob(file))
    honest = path.read_bytes()
    read(path)
    lines: list[str] = []
    try:
        for number in range(INPUTS):
            path.write_bytes(_changed(file, honest, Random(f"{name}/{number}")))
            try:
                read(path)
            except CosflyError as error:
                lines.append(str(error))
    finally:
        path.write_bytes(honest)
    assert lines or name == "answer"
    assert max(map(len, lines), default=0) < LONGEST_LINE
    assert [line for line in lines if re.search(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\u202e]", line)] == []


OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")  # by a terminal
HOSTILE = (
    "\x1b]0;owned\x07\x1b[31m\u202e</p><script>alert(1)</script><img src=x onerror='alert(2)'>`|[a](javascript:b)[/]"
)


@given(st.text(alphabet=st.characters(codec=None), max_size=200))
def test_a_terminal_is_given_nothing_that_it_obeys(text):
    assert not OBEYED.search(for_terminal(text))
    for_terminal(text).encode("utf-8")  # half of a surrogate pair would stop the stream


def test_lines_and_cells_are_printed_and_not_obeyed(monkeypatch):
    stream, terminal = io.StringIO(), type(shared.console)(stderr=True)
    terminal.file, terminal._force_terminal, terminal.width, terminal.no_color = stream, True, 400, True
    monkeypatch.setattr(shared, "console", terminal)
    table = Table(title=HOSTILE)
    table.add_column(HOSTILE)
    table.add_row(HOSTILE)
    shared.console.print(HOSTILE)
    shared.console.print(table)
    lines = stream.getvalue()
    assert not OBEYED.search(lines)
    assert lines.count("\\x1b]0;owned\\x07") == 4
    assert lines.count("[/]") == 4  # and no MarkupError


def test_an_error_is_one_short_line_whatever_it_names():
    error = InputError("not a number", where=Path(HOSTILE), got=HOSTILE + "9" * 5_000_000, expected="one\nline")
    assert len(str(error)) < 5 * LONGEST
    assert not OBEYED.search(str(error))
    assert "\n" not in str(error)


def test_a_key_in_an_address_is_never_shown():
    for address in (
        "http://user:SECRET99@host/v1", "user:SECRET99@host", "https://user%3ASECRET99%40host/v1",
        "http://host/v1?api_key=SECRET99", "http://host/v1;key=SECRET99", "http://host/v1&key=SECRET99",
        "http://host/v1#access_token=SECRET99", "http://host/v1%3Fkey%3DSECRET99", "http://host/sk-SECRET99/v1",
        "http://host/v1/token/SECRET99", "http://host/hf_SECRET99/v1", "s3://host/x?X-Amz-Signature=SECRET99",
        "http://host/api-key-SECRET99/v1", "wss://user:SECRET99@host",
    ):  # fmt: skip
        shown = str(ConfigError("no answer", where=address, got=f"see '{address}' again", fix=f"try {address}"))
        assert "SECRET99" not in shown
        assert shown.count("***") == 3
        with pytest.raises(ValueError, match="must not contain a user") as refused:
            check_url(address)
        assert "SECRET99" not in str(refused.value)
    for address in ("http://host:SECRET99/v1", "ftp://host/SECRET99", "SECRET99", "Bearer SECRET99"):
        with pytest.raises(ValueError, match="must start with http") as refused:
            check_url(address)
        assert "SECRET99" not in str(refused.value)
    for text in ("https://host.org:8000/openai/gpt-4o/v1", "key=value", "10:30 at Delft", "{change:distance@t2-t4}"):
        assert for_terminal(text) == text


class Tags(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.seen: set[tuple[str, ...]] = set()
        self.links: list[str] = []
        self.policy = ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.seen.add((tag, *sorted(name for name, _ in attrs)))
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if ("http-equiv", "Content-Security-Policy") in attrs:
            self.policy = dict(attrs)["content"] or ""

    handle_startendtag = handle_starttag


def forged(model: type[BaseModel], honest: BaseModel, least: int) -> BaseModel:
    value = honest.model_dump(mode="json")
    count = 0
    for group, key in [place for place in places_in(value) if isinstance(place[0][place[1]], str)]:
        text, group[key] = group[key], HOSTILE
        try:
            model.model_validate(value)
            count += 1
        except ValidationError:
            group[key] = text  # one of a closed set
    assert count >= least
    return model.model_validate(value)


def check_page(page: str, honest: str) -> None:
    """Same tags as in the honest page, none of them the forger's; and a policy that would stop them."""
    found = Tags(page)
    assert found.seen <= Tags(honest).seen | {("ul", "class"), ("li", "class"), ("td", "colspan"), ("tr", "class")}
    assert "script" not in {tag for tag, *_ in found.seen}
    assert all(link.startswith("data:image/jpeg;base64,") for link in found.links)
    assert "default-src 'none'" in found.policy
    assert "script-src" not in found.policy
    assert HOSTILE[:8] not in page
    assert "&lt;script&gt;" in page  # shown, not left out


def test_the_page_of_an_inspection_shows_forged_records(tree, tmp_path):
    inspection = inspect(InspectConfig(jerk_rms_max_mps3=1e6), None, None, tree, tmp_path / "inspected")
    honest = read_inspection(inspection)
    false = forged(Inspection, honest, 8)
    check_page(report_html(HOSTILE, false, {}), (inspection.parent / "report.html").read_text(encoding="utf-8"))


def test_the_page_of_a_captioning_run_shows_forged_captions(tree, tmp_path):
    done = caption(CaptionConfig(), tree, tmp_path / "caption").parent
    report = read_model(done / "caption_report.json", CaptionReport, REPORT_FORMAT, tree=done)
    cards = [forged(Caption, card, 8) for card in list(read_captions(done / "captions.jsonl"))[:3]]
    page = page_html(forged(CaptionReport, report, 1), cards, {}, Path("answers"), BudgetConfig(), HOSTILE)
    check_page(page, (done / "report.html").read_text(encoding="utf-8") + '<div class="gone"></div>')


def test_a_card_shows_forged_texts(specimens):
    card = render_card(forged(ReleaseRecord, read_record(specimens / "release/dataset/release.json"), 8))
    page = MarkdownIt("commonmark", {"html": True}).enable("table").render(card.split("\n---\n", 1)[1])
    assert "alert(1)" in page
    assert not {"script", "img", "a"} & {tag for tag, *_ in Tags(page).seen}
    assert not OBEYED.search(card.replace("\n", ""))


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A map of three boxes with a hostile name, a tree of two walks, and what two planners flew over them."""
    root = tmp_path_factory.mktemp("scene")
    tree = make_playback_tree(root / "tree", 2, 8, width_px=96, height_px=54)
    rows, halves = [[0, 0, -0.1], [6, 3, 5], [30, 4, 2]], [[60, 60, 0.1], [2, 3, 5], [1, 1, 2]]
    kinds = [KINDS[kind] for kind in ("Ground", "Buildings", "Vegetation")]
    turns, header = [[0, 0, 0], [10, 40, 5], [0, 0, 0]], MapHeader(name=EVIL, ground_z_m=0.0)
    write_boxes(root / "map.json", make_box_map(rows, halves, turns, kinds, header=header))
    plans = [plan_of(folder) for folder in find_tracks(tree) if folder.name == "ORI"]
    for name in ("muco", EVIL):
        own = [replace(plan, planner=name, metrics={"length_m": 12.5}) for plan in plans]
        write_traces(root / f"drone_trace_{len(name)}.json", own, {})
    return root


def planners(place: Path) -> list[Path]:
    return sorted(place.glob("drone_trace_*.json"))


def floats(text: str, width: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, width)


def test_what_is_packed_is_what_was_read(place, tmp_path):
    page = run(place / "map.json", tmp_path / "scene.html", traces=planners(place), data=place / "tree")
    data = data_of(page)
    rows = floats(data["boxes"], 12)
    kinds = [(kind["name"], kind["first"], kind["count"]) for kind in data["kinds"]]
    assert kinds == [("Ground", 0, 1), ("Buildings", 1, 1), ("Vegetation", 2, 1)]
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    found = rows[2, :3] + signs @ rows[2, 3:].reshape(3, 3)
    assert np.allclose(found, box_corners(np.array([30, 4, 2]), np.array([1, 1, 2])), atol=1e-4)
    turned = rows[1, 3:].reshape(3, 3)
    assert np.allclose(np.linalg.norm(turned, axis=1), [2, 3, 5], atol=1e-4)
    assert np.allclose(turned @ turned.T, np.diag([4, 9, 25]), atol=1e-3)
    flight = read_track(next(folder for folder in find_tracks(place / "tree") if folder.name == "ORI"))
    number = next(k for k, track in enumerate(data["tracks"]) if track["kind"] == "clean frames")
    assert np.allclose(floats(data["tracks"][number]["rows"], 10)[:, 1:4], flight.positions_m, atol=1e-3)
    assert len(data["tracks"][number]["pictures"]) == len(flight)
    assert len({track["kind"] for track in data["tracks"]}) == 4


@pytest.mark.slow
def test_the_page_works_offline_in_a_browser(place, tmp_path):
    out, files = tmp_path / "scene.html", " ".join(f"--traces {path}" for path in planners(place))
    obeyed(f"view {place / 'map.json'} --out {out} --data {place / 'tree'} {files}")
    with browser(tmp_path / "profile") as page:
        page.open(out)
        page.wait("document.body.dataset.ready === 'yes' && document.body.dataset.matrix === 'yes'")
        drawn = lambda: page.run(  # noqa: E731  # how many pixels boxes cover
            "(() => { const { space } = window.scene, gl = space.gl, { width, height } = space.canvas; space.paint(gl);"
            "const all = new Uint8Array(4 * width * height);"
            "gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, all);"
            "let count = 0; for (let i = 3; i < all.length; i += 4) count += all[i] > 0; return count; })()"
        )
        before = drawn()
        page.run("document.querySelector('#kinds input[type=checkbox]').click()")
        assert 0 < drawn() < before / 2, "without its ground there is little left"
        assert page.run("document.querySelectorAll('#frame img').length") == 2, "both tracks"
        assert page.run("document.querySelectorAll('#compared th').length") == 3, "two planners"
        assert "12.5" in page.run("document.getElementById('compared').textContent")
        page.run("document.querySelector('#legend input').click()")
        assert page.run("document.querySelectorAll('#compared th').length") == 2
        page.press("ArrowRight")
        page.press("ArrowRight")
        assert page.run("document.getElementById('now').textContent") == "1.0 s"
        assert "frame 2" in page.run("document.getElementById('frame').textContent")
        page.press("ArrowDown")
        assert page.run("document.querySelector('.line.here button').textContent") == data_of(out)["paths"][1]["name"]
        page.run("document.querySelector('.line.here input').click()")
        assert page.run("[...document.querySelectorAll('.line.here input')].some((one) => one.checked)") is False
        page.press(" ")
        page.wait("document.getElementById('time').value === document.getElementById('time').max")
        page.wait("!window.scene.state.plays")
        assert page.run("typeof window.hacked") == "undefined"
        assert [said for said in page.said if '"warning"' not in said] == []
        assert all(address.startswith(("file:", "data:")) for address in page.requests)
