"""The editor of regions of interest, in a real browser where one is needed: drawn, saved, walked in; what is refused."""

import contextlib
import http.client
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Page, browser
from commands import obeyed

from cosfly.formats.boxes import BoxMap, write_boxes
from cosfly.formats.pedestrian_paths import read_paths
from cosfly.formats.roi import read_roi
from cosfly.geometry.grid import roi_mask
from cosfly.pedestrians.roi_editor import open_editor
from cosfly.pedestrians.walkable import PedestriansConfig, walkable_ground
from cosfly.viz.page_server import PageServer
from specimens import map_of

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


def ready(page: Page, server: PageServer) -> None:
    page.open(server.address)
    page.wait("document.body.dataset.ready === 'yes'")


def click_at(page: Page, *places: list[float]) -> None:
    for place in places:
        page.click(*pixel_of(page, place))


def pixel_of(page: Page, place: list[float]) -> tuple[float, float]:
    x, y = page.run(f"window.editor.map.at({json.dumps(place)})")
    return x, y  # the board begins at the window's corner


def settled(page: Page) -> None:
    """The cells are those of what is drawn."""
    for _ in range(2):  # what was changed while it asked is asked for afterwards
        page.run("new Promise((done) => setTimeout(done, 150))")  # ends after the 100 ms that it waits for more changes
        page.wait("!document.body.dataset.asks")


@pytest.mark.slow
def test_a_polygon_with_a_hole_is_drawn_saved_and_walked_in(map_file, tmp_path):
    out = tmp_path / "roi_polygon.json"
    with serving(map_file, out) as server, browser(tmp_path / "profile") as page:
        ready(page, server)
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
