"""Pages and pictures: the viewer in a browser, the views of a frame for teachers, students and people, boxes over a frame.

The editor of regions of interest: drawn, saved, walked in; what is refused.
"""

import asyncio
import base64
import contextlib
import hashlib
import http.client
import io
import json
import re
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import Page, browser
from commands import obeyed
from PIL import Image
from specimens_captions import VOCABULARY
from specimens_distill import WINDOW, make_caption
from test_renderers_contract import DRAWN, circling, street, write_inputs

from caption.schema import CaptionConfig, ImageConfig, Window, WindowConfig
from caption.stage.window_loop import caption_window
from caption.stage.windows import cut_windows
from caption.teachers.prompts import make_question, question_messages
from caption.teachers.teacher import RuleTeacher, encode_frame
from cosfly.formats.boxes import BoxMap, write_boxes
from cosfly.formats.captions import PICTURES_MARK, Language, write_captions
from cosfly.formats.pedestrian_paths import read_paths
from cosfly.formats.playback_file import read_track
from cosfly.formats.roi import read_roi
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.grid import roi_mask
from cosfly.llm.student_chat import encoded_image
from cosfly.pedestrians.roi_editor import open_editor
from cosfly.pedestrians.walkable import PedestriansConfig, walkable_ground
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import run as render
from cosfly.runtime.errors import InputError
from cosfly.viz.gallery import four_panels
from cosfly.viz.page_server import PageServer
from cosfly.viz.viewer import run
from distill.inference.answers import EngineAnswers
from distill.inference.samples import InferConfig, Inputs
from distill.prepare.stage import PrepareConfig, make_sample
from distill.schema import Sample
from specimens import make_playback_tree, map_of

NUM_POINTS = 24
EVIL = (
    "</script><script>window.hacked=1</script><img src=x onerror='window.hacked=2'>"
    '\u202e\x1b]0;owned\x07 {"a":1} <!-- ${1}'
)


REPAIRED = {
    "strategy": "cascade", "rung": "anchored", "outcome": "repaired", "asks": 2, "first_decision": "hover",
    "first_verdict": "HARD_CONFLICT",
}  # fmt: skip
ODD = {
    7: {"verdict": "HARD_CONFLICT"},
    8: {"repair": REPAIRED},
    9: {"status": "dropped", "drop_reason": "hard_conflict"},
    10: {"verdict": "SOFT_CONFLICT"},
}


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """A run of four flights in two towns with a map and captions: a conflict, a repaired, a dropped, a hostile one."""
    folder = tmp_path_factory.mktemp("runs") / "one"
    tree = make_playback_tree(folder / "render", 2, NUM_POINTS, width_px=96, height_px=54, towns=("Town01", "Town02"))
    captions, read = [], {"values": {"en": {"values_filled": 2}, "zh": {"values_filled": 1, "values_contradicted": 1}}}
    for flight in map(read_track, find_tracks(tree)):
        for i in range(WINDOW - 1, NUM_POINTS - 1):
            more = {"checks": read if i % 2 else {}} | ODD.get(i, {})
            caption = make_caption(flight.town, flight.trajectory, flight.variant, i, **more)
            evil = {"en": caption.en.model_copy(update={"reasoning_trace": EVIL}), "label": EVIL}
            captions.append(caption.model_copy(update=evil if i == 10 else {}))
    (folder / "caption").mkdir()
    write_captions(folder / "caption/captions.jsonl", captions)
    (folder / "simplify").mkdir()
    houses = (("Buildings", (x, 0, 5), (5, 5, 5)) for x in (0, 900))
    write_boxes(folder / "simplify/step2_simplified.json", map_of(*houses, ("Vegetation", (4, 9, 1), (2, 1, 1))))
    return folder


@pytest.fixture(scope="module")
def page(run_folder, tmp_path_factory) -> Path:
    return run(run_folder, tmp_path_factory.mktemp("page") / "viewer.html", most_frames=12, picture_px=64)


def data_of(page: Path) -> dict:
    text = page.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def test_a_run_is_shown_as_it_is(page):
    data = data_of(page)
    assert len(data["flights"]) == 4
    assert {flight["map"] for flight in data["flights"]} == {"one/Town01", "one/Town02"}
    assert {box["kind"] for box in data["maps"]["one/Town01"]} == {"Buildings", "Vegetation"}  # one house is 900 m away
    flight = data["flights"][1]
    found = flight["track"], flight["num_frames"], flight["num_captions"]
    assert found == ("perturbed", NUM_POINTS, 19)
    by_index = {frame["index"]: frame["caption"] for frame in flight["frames"]}
    assert (len(by_index), by_index[7]["verdict"]) == (12, "HARD_CONFLICT")
    assert by_index[9]["dropped"] == "hard_conflict"
    assert by_index[7]["values"] == {"values_filled": 3, "values_matched": 0, "values_contradicted": 1}
    for frame in flight["frames"]:
        assert set(frame["pictures"]) == {"rgb", "depth", "segmentation"}
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(frame["pictures"]["rgb"]), np.uint8), cv2.IMREAD_COLOR)
        assert pixels.shape[:2] == (36, 64)


def test_the_page_asks_for_nothing_and_names_its_script(page):
    text = page.read_text(encoding="utf-8")
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    script = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script[-1].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy
    assert "unsafe-eval" not in policy
    assert len(re.findall(r"<script", text)) == 2  # the data and ours: no text opened a third
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", text)
    assert "innerHTML" not in script[-1]
    assert all(f"{word}(" not in script[-1] for word in ("insertAdjacentHTML", "document.write", "eval", "fetch"))


def test_of_many_tracks_whole_trajectories_are_shown(run_folder, tmp_path):
    two = data_of(run(run_folder, tmp_path / "two.html", most_tracks=2, most_frames=1))
    assert len({flight["group"] for flight in two["flights"]}) == 1
    assert [len(flight["frames"]) for flight in two["flights"]] == [1, 1]
    assert any("2 of 4 tracks are shown" in note for note in two["notes"])


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("chromium") / "profile") as opened:
        yield opened


COUNT = "document.getElementById('count').textContent"
# How many pixels of the map have a colour of the page's style.
PIXELS = """(name) => {
  const pen = new OffscreenCanvas(1, 1).getContext("2d"), plan = document.getElementById("plan");
  pen.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  pen.fillRect(0, 0, 1, 1);
  const wanted = pen.getImageData(0, 0, 1, 1).data;
  const all = plan.getContext("2d").getImageData(0, 0, plan.width, plan.height).data;
  let count = 0;
  for (let i = 0; i < all.length; i += 4) count += [0, 1, 2].every((k) => all[i + k] === wanted[k]);
  return count;
}"""


@pytest.mark.slow
def test_the_page_opens_offline_and_shows_pictures_map_and_captions(tab, page):
    tab.requests.clear()
    tab.said.clear()
    tab.open(page)
    assert tab.run("document.body.dataset.ready") == "yes"
    assert tab.run(COUNT) == "48 of 48 frames"
    assert tab.run("[...document.images].length") == 3
    found = tab.run("Promise.all([...document.images].map((one) => one.decode().then(() => one.naturalWidth)))")
    assert found == [64, 32, 32]
    assert "2 boxes, 3 trajectories" in tab.run("document.getElementById('plan').getAttribute('aria-label')")
    assert [url for url in tab.requests if not url.startswith(("data:", "about:"))] == [page.absolute().as_uri()]
    assert tab.said == []
    for name in ("--person", "--clean", "--perturbed", "--house"):  # both tracks, the person and a house are on the map
        tab.wait(f"({PIXELS})('{name}') > 0")


@pytest.mark.slow
def test_hostile_text_is_text(tab, page):
    tab.said.clear()
    tab.open(page, "#q=window.hacked")
    assert tab.run(COUNT) == "4 of 48 frames"
    assert tab.run("typeof window.hacked") == "undefined"
    shown = tab.run("document.getElementById('caption').textContent")
    assert "<script>window.hacked=1</script>" in shown
    assert "\\u202e" in shown
    assert "\u202e" not in shown
    assert tab.run("document.querySelectorAll('#caption img, #caption script').length") == 0
    tab.open(page, "#town=%3Cimg%20src%3Dx%3E&flight=%22&frame=NaN&q=%00%3C")
    assert tab.run("document.body.dataset.ready") == "yes"
    assert tab.said == []


# Views, layout, largest side: every count of views, orders that are not the usual one, both layouts and sizes.
SHAPES = [
    (("rgb",), "separate", 640), (("depth", "rgb"), "tiled", 40), (("segmentation", "rgb", "depth"), "separate", 40),
    (("depth", "segmentation", "rgb"), "tiled", 640),
]  # fmt: skip
NAMES = {
    "en": {"RGB": "rgb", "depth": "depth", "segmentation": "segmentation", "enlarged": "middle"},
    "zh": {"RGB": "rgb", "深度": "depth", "分割": "segmentation", "放大": "middle"},
}


def told_views(text: str, language: Language) -> tuple[str, ...]:
    places = {view: text.find(name) for name, view in NAMES[language].items() if name in text}
    return tuple(sorted(places, key=places.__getitem__))


def told_count(text: str, language: Language) -> int:
    several = {"en": r"given as (\d+) pictures", "zh": r"每帧依次给出 (\d+) 张"}[language]
    found = re.search(several, text)
    if found is None:
        assert {"en": "given as one picture", "zh": "每帧给出一张图像"}[language] in text
    return int(found.group(1)) if found else 1


def told_size(text: str) -> tuple[int, int]:
    [(width, height)] = re.findall(r"(\d+) [x×] (\d+) (?:px|像素)", text)
    return int(width), int(height)


def sent_pictures(messages: list[dict]) -> list[np.ndarray]:
    parts = [part["image_url"]["url"] for part in messages[1]["content"] if part["type"] == "image_url"]
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB")) for url in parts]


@pytest.fixture(scope="module")
def window(tree) -> Window:
    return next(cut_windows(read_track(find_tracks(tree)[0]), WindowConfig()))


def ask(window: Window, cfg: ImageConfig) -> tuple[dict[Language, str], list[np.ndarray]]:
    question = make_question(window.observed, cfg, "prose", VOCABULARY)
    encode = partial(encoded_image, encoding="png")
    frames = [encode_frame(folder, question.pictures, encode) for folder in window.observed.frame_folders]
    messages, _ = question_messages(question, frames)
    assert messages[1]["content"][-1]["text"] == question.asked["en"].user
    return {language: prompt.user for language, prompt in question.asked.items()}, sent_pictures(messages)


def test_a_teacher_is_told_what_it_is_shown(window):
    middle = [(("middle",), "separate", 640), (("rgb", "middle", "depth"), "tiled", 40)]
    for views, layout, max_side_px in [*SHAPES, *middle]:
        cfg = ImageConfig(modalities=views, layout=layout, max_side_px=max_side_px)
        told, pictures = ask(window, cfg)
        for language, text in told.items():
            assert told_views(text, language) == views
            assert len(pictures) == 5 * told_count(text, language)
            width, height = told_size(text)
            assert (width, height) == ((64, 36) if max_side_px == 640 else (40, 22))
            across = len(views) if layout == "tiled" else 1
            assert {picture.shape for picture in pictures} == {(height, across * width, 3)}


@pytest.mark.parametrize(("views", "layout", "max_side_px"), SHAPES)
def test_a_student_is_told_what_it_is_shown_and_sees_what_its_teacher_saw(tree, window, views, layout, max_side_px):
    image = {"layout": layout, "max_side_px": max_side_px, "depth_range_m": 40.0}
    cfg = CaptionConfig.model_validate({"image": image, "window": {"require_images": True}})
    caption = asyncio.run(caption_window(window, RuleTeacher(0), cfg, VOCABULARY))
    _, shown = ask(window, cfg.image)
    if layout == "tiled":
        shown = [part for picture in shown for part in np.split(picture, 3, axis=1)]
    teachers = [dict(zip(cfg.image.modalities, shown[3 * i : 3 * i + 3], strict=True)) for i in range(5)]
    assert caption.status == "accepted"
    for language in ("en", "zh"):
        sample = make_sample(caption, language, PrepareConfig(modalities=views))
        assert isinstance(sample, Sample)
        text = sample.prompt.user
        pictures = [picture for frame in sample.frames for picture in sample.pictures.read(tree / frame)]
        assert PICTURES_MARK not in text
        assert told_views(text, language) == views
        assert len(pictures) == 5 * told_count(text, language) == 5 * len(views)
        assert told_size(text) == pictures[0].shape[1::-1]
        assert ("40 m and beyond" in text or "40 米及更远" in text) == ("depth" in views)
        expected = [teachers[i][view] for i in range(5) for view in views]
        for picture, wanted in zip(pictures, expected, strict=True):
            assert np.array_equal(picture, wanted)
        inputs, cfg = Inputs((), {"": tree}, "", None), InferConfig(engine="endpoint")
        request = EngineAnswers(None, None, inputs, cfg)._request(sample)  # as `vllm` is asked too
        kinds = [part.get("text", "picture") for part in request.messages[1]["content"]]
        assert kinds == [word for i in range(5) for word in (f"t{i}:", *["picture"] * len(views))] + [text]
        for picture, wanted in zip(sent_pictures(request.messages), expected, strict=True):
            assert np.array_equal(picture, wanted)


def test_four_pictures_of_a_frame(tmp_path):
    boxes, *others = write_inputs(tmp_path / "inputs", [circling(3)])
    cfg = RenderConfig.model_validate({**DRAWN, "tracks": ["clean"]})
    street_tree = render(cfg, boxes, *others, tmp_path / "render")
    result = obeyed("view", street_tree, "--frame best --out", tmp_path / "a.png", "--map", boxes)
    assert Image.open(tmp_path / "a.png").size == (640, 2 * (180 + 36))
    name = four_panels(street_tree, tmp_path / "b.png", box_map=street())
    assert name in result
    for frame in (name, str(street_tree / name)):
        assert four_panels(street_tree, tmp_path / "b.png", frame=frame, box_map=street()) == name
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), np.asarray(Image.open(tmp_path / "b.png")))
    with pytest.raises(InputError):
        four_panels(street_tree, tmp_path / "a.png", frame="../../elsewhere", box_map=street())


CFG = PedestriansConfig(num_paths=2, min_distance_m=20, max_distance_m=40, min_component_cells=50)
SQUARE = [[10, 10], [90, 10], [90, 70], [10, 70]]


def town() -> BoxMap:
    """A square of 120 m x 80 m with a house, a low wall across half of it, and a bin."""
    return map_of(
        ("Ground", (60, 40, -0.1), (60, 40, 0.1)), ("Buildings", (60, 40, 5), (8, 6, 5), 20.0),
        ("Walls", (30, 60, 1), (14, 0.3, 1)), ("Static", (100, 20, 0.5), (0.4, 0.4, 0.5)), name="plaza", ground_z_m=0.0,
    )  # fmt: skip


@pytest.fixture
def map_file(tmp_path) -> Path:
    write_boxes(tmp_path / "map.json", town())
    return tmp_path / "map.json"


@contextlib.contextmanager
def serving(map_file: Path, roi: Path) -> Iterator[PageServer]:
    server = open_editor(map_file, CFG, roi, 0)
    thread = threading.Thread(target=server.serve)
    thread.start()
    try:
        yield server
    finally:
        server.http.shutdown()
        thread.join()


def click_at(page: Page, *places: list[float]) -> None:
    for place in places:
        page.click(*pixel_of(page, place))


def pixel_of(page: Page, place: list[float]) -> tuple[float, float]:
    return tuple(page.run(f"window.editor.map.at({json.dumps(place)})"))  # the board begins at the window's corner


def settled(page: Page) -> None:
    """The cells are those of what is drawn."""
    for _ in range(2):  # what was changed while it asked is asked for afterwards
        page.run("new Promise((done) => setTimeout(done, 150))")  # ends after the 100 ms that it waits for more changes
        page.wait("!document.body.dataset.asks")


@pytest.mark.slow
def test_a_polygon_with_a_hole_is_drawn_saved_and_walked_in(map_file, tmp_path, tab):
    page, out = tab, tmp_path / "roi_polygon.json"
    page.said.clear()
    with serving(map_file, out) as server:
        page.open(server.address)
        page.wait("document.body.dataset.ready === 'yes'")
        click_at(page, *SQUARE)
        page.run("document.getElementById('close').click()")
        page.run("document.getElementById('hole').click()")
        click_at(page, [40, 30], [80, 30], [80, 52], [40, 52])
        page.run("document.getElementById('close').click()")
        page.drag(pixel_of(page, [90, 70]), pixel_of(page, [105, 72]))
        page.drag(pixel_of(page, [60, 20]), pixel_of(page, [50, 25]), "right")
        page.mouse("mouseWheel", 300, 300, "none", deltaX=0, deltaY=-200)
        settled(page)
        page.run("document.getElementById('save').click()")
        page.wait("document.getElementById('message').className === 'accepted'")
        roi = read_roi(out)
        ground = walkable_ground(town(), CFG, roi)
        found = np.array(page.run("[...window.editor.marks()]"), dtype=np.uint8).reshape(ground.walkable.shape)[::-1]
        assert page.run("document.getElementById('figure-used').textContent") == f"{ground.counts['cells_used']:,}"
        assert not page.said
    [polygon] = roi.rings()
    assert np.allclose(polygon.points_world, [[10, 10], [90, 10], [105, 72], [10, 70]], atol=0.2)
    assert np.allclose(polygon.holes, [[[40, 30], [80, 30], [80, 52], [40, 52]]], atol=0.2)
    assert ((found > 0) == roi_mask(ground.grid, roi)).all()
    assert ((found == found.max()) == ground.walkable).all()
    settings = [f"--set pedestrians.{name}={getattr(CFG, name)}" for name in CFG.model_fields_set]
    obeyed(f"pedestrians --map {map_file} --roi {out} --out {tmp_path / 'walks'} --workers 1", " ".join(settings))
    for walk in read_paths(tmp_path / "walks/path.json"):
        x, y = ground.grid.cells_at(walk.polyline_m).T
        assert ground.is_in_roi[y, x].all()


def asked(server: PageServer, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(server.host, timeout=60)
    own = {"Origin": f"http://{server.host}"} | headers
    connection.request(method, path, body, own)
    reply = connection.getresponse()
    return reply.status, reply.read()


def test_only_our_own_page_is_answered(map_file, tmp_path):
    out = tmp_path / "roi.json"
    body = json.dumps({"points_world": SQUARE}).encode()
    with serving(map_file, out) as server:
        ours = f"/{server.token}/"
        assert server.host.startswith("127.0.0.1:")
        assert asked(server, "GET", ours)[0] == 200
        for path in (
            "/", "/save", f"/{server.token}x/", f"/{server.token[:-1]}/", "/../../etc/passwd",
            f"{ours}../../etc/passwd", f"{ours}save",
        ):  # fmt: skip
            assert asked(server, "GET", path)[0] == 404, path
        assert asked(server, "GET", ours, Host="evil.example")[0] == 404
        assert asked(server, "POST", f"{ours}save", body, Origin="http://evil.example")[0] == 404
        assert asked(server, "POST", "/x/save", body)[0] == 404
        assert asked(server, "POST", f"{ours}save/../../x.json", body)[0] == 404
        assert not out.exists()
        assert b"too large" in asked(server, "POST", f"{ours}cells", **{"Content-Length": "99999999999"})[1]
        assert asked(server, "POST", f"{ours}save", body)[0] == 200
        assert read_roi(out).points_world == [(10, 10), (90, 10), (90, 70), (10, 70)]
        out.write_text(json.dumps({"points_world": SQUARE[:3]}))
        status, said = asked(server, "POST", f"{ours}save", body)
        assert (status, b"another program changed the file" in said) == (400, True)
        assert len(read_roi(out).points_world) == 3
