"""The viewer's page of a map in 3D: what is packed is what was read, it stays below its size, and it works in a browser."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import browser
from commands import invoke
from test_cosfly_inspection import plan_of

from cosfly.formats.boxes import MapHeader, make_box_map, write_boxes
from cosfly.formats.kinds import KINDS
from cosfly.formats.playback import read_track
from cosfly.formats.traces import write_traces
from cosfly.formats.tracks import find_tracks
from cosfly.geometry.axes import box_corners
from cosfly.viz.scene_page import run
from specimens import make_playback_tree

EVIL = "</script><script>window.hacked=1</script><img src=x onerror='window.hacked=2'>"


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A map of three boxes with a hostile name, a tree of two walks, and what two planners flew over them."""
    root = tmp_path_factory.mktemp("scene")
    tree = make_playback_tree(root / "tree", 2, 8, width_px=96, height_px=54)
    rows, halves = [[0, 0, -0.1], [6, 3, 5], [30, 4, 2]], [[60, 60, 0.1], [2, 3, 5], [1, 1, 2]]
    kinds = [KINDS[kind] for kind in ("Ground", "Buildings", "Vegetation")]
    header = MapHeader(name=EVIL, ground_z_m=0.0)
    write_boxes(
        root / "map.json", make_box_map(rows, halves, [[0, 0, 0], [10, 40, 5], [0, 0, 0]], kinds, header=header)
    )
    flights = [read_track(folder) for folder in find_tracks(tree) if folder.name == "ORI"]
    plans = [plan_of(flight.folder) for flight in flights]
    for name in ("muco", EVIL):
        own = [replace(plan, planner=name, metrics={"length_m": 12.5}) for plan in plans]
        write_traces(root / f"drone_trace_{len(name)}.json", own, {})
    return root


def planners(place: Path) -> list[Path]:
    return sorted(place.glob("drone_trace_*.json"))


def data_of(page: Path) -> dict:
    return json.loads(re.search(r'id="data">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)[1])


def floats(text: str, width: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, width)


def test_what_is_packed_is_what_was_read(place, tmp_path):
    page = run(place / "map.json", tmp_path / "scene.html", traces=planners(place), data=place / "tree")
    data = data_of(page)
    rows = floats(data["boxes"], 12)
    assert [(kind["name"], kind["first"], kind["count"]) for kind in data["kinds"]] == [
        ("Ground", 0, 1), ("Buildings", 1, 1), ("Vegetation", 2, 1),
    ]  # fmt: skip
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
    done = invoke(f"view {place / 'map.json'} --out {out} --data {place / 'tree'} {files}")
    assert done.exit_code == 0, done.output
    with browser(tmp_path / "profile") as page:
        page.open(out)
        page.wait("document.body.dataset.ready === 'yes' && document.body.dataset.matrix === 'yes'")
        drawn = lambda: page.run(  # noqa: E731  # how many pixels boxes cover
            "(() => { const { space } = window.scene, gl = space.gl, { width, height } = space.canvas; space.paint(gl);"
            "const all = new Uint8Array(4 * width * height); gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, all);"
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
