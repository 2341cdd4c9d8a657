"""The viewer: what it chooses, how large it gets, that foreign text stays text, and that it works in a browser."""

import base64
import hashlib
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import browser
from specimens_distill import WINDOW, make_caption

from cosfly.formats.boxes import make_box_map, write_boxes
from cosfly.formats.captions import write_captions
from cosfly.formats.kinds import KINDS
from cosfly.formats.playback import read_track
from cosfly.formats.tracks import find_tracks
from cosfly.viz.viewer import run
from specimens import make_playback_tree

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
    town = make_box_map(
        [[0, 0, 5], [4, 9, 1], [900, 0, 5]],
        [[5, 5, 5], [2, 1, 1], [5, 5, 5]],
        np.zeros((3, 3)),
        [KINDS["Buildings"], KINDS["Vegetation"], 3],
    )
    write_boxes(folder / "simplify/step2_simplified.json", town)
    return folder


@pytest.fixture(scope="module")
def page(run_folder, tmp_path_factory) -> Path:
    return run(run_folder, tmp_path_factory.mktemp("page") / "viewer.html", most_frames=12, picture_px=64)


def data_of(text: str) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def test_a_run_is_shown_as_it_is(page):
    data = data_of(page.read_text(encoding="utf-8"))
    assert len(data["flights"]) == 4
    assert {flight["map"] for flight in data["flights"]} == {"one/Town01", "one/Town02"}
    assert {box["kind"] for box in data["maps"]["one/Town01"]} == {"Buildings", "Vegetation"}  # the third is 900 m away
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
    two = data_of(run(run_folder, tmp_path / "two.html", most_tracks=2, most_frames=1).read_text(encoding="utf-8"))
    assert len({flight["group"] for flight in two["flights"]}) == 1
    assert [len(flight["frames"]) for flight in two["flights"]] == [1, 1]
    assert any("2 of 4 tracks are shown" in note for note in two["notes"])


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("chromium") / "profile"
    folder.mkdir()
    with browser(folder) as opened:
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
