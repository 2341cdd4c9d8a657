"""The editor of regions of interest, in a real browser where one is needed: drawn, saved, walked in; what is refused."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import Page, browser
from commands import invoke

from cosfly.errors import CosflyError, EnvironmentMissing, InputError
from cosfly.pedestrians.roi_editor import Server, endpoint_pairs, open_editor, propose
from cosfly.pedestrians.walkable import PedestriansConfig, walkable_ground
from cosfly.products.backdrop import WorldFrame, write_backdrop
from cosfly.products.boxes import BoxMap, MapHeader, make_box_map, read_boxes, write_boxes
from cosfly.products.kinds import KINDS
from cosfly.products.roi import Roi, read_roi
from cosfly.products.walks import read_paths
from cosfly.space.grid import roi_mask

CFG = PedestriansConfig(num_paths=2, min_distance_m=20, max_distance_m=40, min_component_cells=50)
EVIL = "</script><script>window.hacked=1</script><img src=x onerror='window.hacked=2'>"
SQUARE = [[10, 10], [90, 10], [90, 70], [10, 70]]


def town(name: str = "plaza", **header: object) -> BoxMap:
    """A square of 120 m x 80 m with a house, a low wall across half of it, and a bin."""
    rows = [[60, 40, -0.1], [60, 40, 5], [30, 60, 1], [100, 20, 0.5]]
    halves = [[60, 40, 0.1], [8, 6, 5], [14, 0.3, 1], [0.4, 0.4, 0.5]]
    kinds = [KINDS[kind] for kind in ("Ground", "Buildings", "Walls", "Static")]
    turned = [[0, 0, 0], [0, 20, 0], [0, 0, 0], [0, 0, 0]]
    return make_box_map(rows, halves, turned, kinds, header=MapHeader(name=name, ground_z_m=0.0, **header))


@pytest.fixture
def map_file(tmp_path) -> Path:
    write_boxes(tmp_path / "map.json", town())
    return tmp_path / "map.json"


@contextlib.contextmanager
def serving(map_file: Path, roi: Path, **more: object) -> Iterator[Server]:
    server = open_editor(map_file, CFG, roi, 0, more.get("backdrop"))
    thread = threading.Thread(target=server.serve)
    thread.start()
    try:
        yield server
    finally:
        server.http.shutdown()
        thread.join()


def ready(page: Page, server: Server) -> None:
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


def message(page: Page) -> str:
    return page.run("document.getElementById('message').textContent")


def marks(page: Page, grid_shape: tuple[int, int]) -> np.ndarray:
    """Alpha of the page's cells, south up."""
    return np.array(page.run("[...window.editor.marks()]"), dtype=np.uint8).reshape(grid_shape)[::-1]


@pytest.mark.slow
def test_a_polygon_with_a_hole_is_drawn_saved_and_walked_in(map_file, tmp_path):
    """By mouse alone: the page's cells are those of `roi_mask`, one by one, and the walks stay on them."""
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
        found = marks(page, ground.walkable.shape)
        assert page.run("document.getElementById('figure-used').textContent") == f"{ground.counts['cells_used']:,}"
        assert not page.said
    [polygon] = roi.rings()
    assert np.allclose(polygon.points_world, [[10, 10], [90, 10], [105, 72], [10, 70]], atol=0.2)
    assert np.allclose(polygon.holes, [[[40, 30], [80, 30], [80, 52], [40, 52]]], atol=0.2)
    assert ((found > 0) == roi_mask(ground.grid, roi)).all()
    assert ((found == found.max()) == ground.walkable).all()
    settings = [f"--set pedestrians.{name}={getattr(CFG, name)}" for name in CFG.model_fields_set]
    done = invoke(
        f"pedestrians --map {map_file} --roi {out} --out {tmp_path / 'walks'} --workers 1", " ".join(settings)
    )
    assert done.exit_code == 0, done.output
    for walk in read_paths(tmp_path / "walks/path.json"):
        x, y = ground.grid.cells_at(walk.polyline_m).T
        assert ground.is_in_roi[y, x].all()


@pytest.mark.slow
def test_the_keyboard_is_enough(map_file, tmp_path):
    """Draw, move by cells, step back and forth, save; labels in both languages."""
    out = tmp_path / "roi_polygon.json"
    with serving(map_file, out) as server, browser(tmp_path / "profile") as page:
        ready(page, server)
        for keys in (["ArrowLeft"], ["ArrowUp"] * 2, ["ArrowRight"] * 3):
            for key in keys:
                page.press(key, 8)
            page.press(" ")
        assert page.run("document.getElementById('close').disabled") is False
        page.press("Enter")
        page.press("n")
        before = page.run("document.getElementById('x').valueAsNumber")
        page.press("ArrowRight")
        page.press("ArrowRight", 8)
        assert page.run("document.getElementById('x').valueAsNumber") == pytest.approx(before + 11 * 0.5)
        page.press("z", 2)
        page.press("z", 2)
        page.press("y", 2)
        assert page.run("document.getElementById('x').valueAsNumber") == pytest.approx(before + 0.5)
        page.run("const x = document.getElementById('x'); x.value = 33.125; x.dispatchEvent(new Event('change'))")
        settled(page)
        page.press("s", 2)
        page.wait("document.getElementById('message').className === 'accepted'")
        assert read_roi(out).points_world[0][0] == 33.125
        assert set(json.loads(out.read_text())) == {"description", "map", "axes", "closed", "points_world"}
        page.run("document.getElementById('language').click()")
        assert page.run("document.getElementById('save').textContent").startswith("保存")
        assert page.run("document.documentElement.lang") == "zh"
        english, chinese = page.run("document.body.innerText"), "感兴趣区域"
        assert chinese in english


@pytest.mark.slow
def test_what_the_page_refuses(map_file, tmp_path):
    """A ring that touches itself, a hole outside, a file of another town, a mask of another size: said, and nothing
    changes."""
    out, other = tmp_path / "roi_polygon.json", tmp_path / "other.json"
    with serving(map_file, out) as server, browser(tmp_path / "profile") as page:
        ready(page, server)
        page.press("h")
        click_at(page, [30, 30])
        assert "inside a closed polygon" in message(page)
        page.press("p")
        click_at(page, [10, 10], [50, 10], [50, 50], [30, 10], [10, 50])
        page.press("Enter")
        settled(page)
        page.wait("document.getElementById('message').className === 'rejected'")
        assert "a ring crosses itself" in message(page)
        page.press("s", 2)
        page.wait("document.getElementById('message').textContent.includes('crosses itself')")
        page.press("z", 2)
        settled(page)
        for content, words in (
            ({"points_world": SQUARE, "map": "Town07"}, "another map"),
            ({"points_world": SQUARE, "axes": "left-handed, centimetres"}, "another map"),
            ({"points_world": [[5000, 0], [5100, 0], [5100, 90]]}, "0% of it on this map"),
            ({"points_world": [[10, 81], [50, 81], [50, 119], [10, 119]]}, "100% with x and y changed over"),
            ({"points_world": SQUARE, "closed": False}, "not closed"),
            ({"points_world": [[k, k % 7] for k in range(100_001)]}, "over the limit"),
            ([[1, 2]], "not an object"),
        ):
            other.write_text(json.dumps(content))
            choose(page, "open", other)
            page.wait("document.getElementById('message').className === 'rejected'")
            assert words in message(page), message(page)
            page.run("document.getElementById('message').className = ''")
        for size, words in (
            ((160, 240), "same"),
            ((160, 239), "the mask has another size: 239 x 160; expected 240 x 160"),
        ):
            cv2.imwrite(str(tmp_path / "mask.png"), np.full(size, 255, np.uint8))
            choose(page, "mask", tmp_path / "mask.png")
            if words == "same":
                page.wait("!document.getElementById('compared').hidden")
                assert "mask: 38,400" in page.run("document.getElementById('compared').textContent")
            else:
                page.wait("document.getElementById('message').className === 'rejected'")
                assert words in message(page)
        assert page.run("document.body.dataset.rings") == "1", "what was drawn is still there"
    assert not out.exists()


def choose(page: Page, field: str, file: Path) -> None:
    """Give a file to a field."""
    found = page.send("Runtime.evaluate", expression=f"document.getElementById('{field}')")["result"]["objectId"]
    page.send("DOM.setFileInputFiles", files=[str(file)], objectId=found)


@pytest.mark.slow
def test_a_hostile_map_does_nothing(tmp_path):
    write_boxes(tmp_path / "map.json", town(EVIL))
    with serving(tmp_path / "map.json", tmp_path / "roi.json") as server, browser(tmp_path / "profile") as page:
        ready(page, server)
        page.run("document.getElementById('propose').click()")
        page.wait("document.body.dataset.rings > 0")
        settled(page)
        assert page.run("typeof window.hacked") == "undefined"
        assert EVIL in page.run("document.querySelector('h1').textContent")
        assert not page.said
        assert all(address.startswith((server.address, "data:", "about:")) for address in page.requests)


def asked(server: Server, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(server.host, timeout=20)
    own = {"Origin": f"http://{server.host}"} | headers
    connection.request(method, path, body, own)
    reply = connection.getresponse()
    return reply.status, reply.read()


def test_only_our_own_page_is_answered(map_file, tmp_path):
    """No token, another token, another host's name, another page's request, a path that leads elsewhere: nothing."""
    out = tmp_path / "roi.json"
    body = json.dumps({"points_world": SQUARE}).encode()
    with serving(map_file, out) as server:
        ours = f"/{server.token}/"
        assert server.host.startswith("127.0.0.1:")
        assert asked(server, "GET", ours)[0] == 200
        for path in (
            "/",
            "/save",
            f"/{server.token}x/",
            f"/{server.token[:-1]}/",
            "/../../etc/passwd",
            f"{ours}../../etc/passwd",
            f"{ours}save",
        ):
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
        assert (status, b"changed by somebody else" in said) == (400, True)
        assert len(read_roi(out).points_world) == 3


def test_the_command_says_what_is_wrong_in_one_line(map_file, tmp_path):
    held = socket.create_server(("127.0.0.1", 0))
    port = held.getsockname()[1]
    bare = town()
    write_boxes(tmp_path / "bare.json", bare.select(~bare.is_any_of({KINDS["Ground"]})))
    value = json.loads((tmp_path / "bare.json").read_text())
    del value["ground_z_m"]
    (tmp_path / "bare.json").write_text(json.dumps(value))
    roi = tmp_path / "roi_polygon.json"
    roi.write_text(json.dumps({"points_world": SQUARE, "map": "Town07_Opt"}))
    kept = roi.read_bytes()
    far = WorldFrame(west_m=9000, north_m=0, metres_per_px=0.1)
    write_backdrop(tmp_path / "far.png", cv2.imencode(".png", np.zeros((9, 9, 3), np.uint8))[1].tobytes(), far)
    for words, error, text in (
        (f"{map_file} --roi {tmp_path / 'new.json'} --port {port}", EnvironmentMissing, "cannot listen"),
        (f"{tmp_path / 'bare.json'}", InputError, "the map has no ground"),
        (f"{map_file} --roi {roi}", InputError, "another map"),
        (
            f"{map_file} --roi {tmp_path / 'new.json'} --backdrop {tmp_path / 'far.png'}",
            InputError,
            "no part of the map",
        ),
        (
            f"{map_file} --roi {tmp_path / 'new.json'} --set pedestrians.resolution_m=0.005",
            InputError,
            "too large for a page",
        ),
    ):
        done = invoke(f"roi edit {words}")
        assert isinstance(done.exception, error), (words, done.output, done.exception)
        assert text in str(done.exception)
        assert "\n" not in str(done.exception)
    held.close()
    done = invoke(f"pedestrians --map {map_file} --roi {roi} --out {tmp_path / 'walks'}")
    assert "another map" in str(done.exception)
    assert isinstance(invoke(f"roi propose {map_file} --out {roi}").exception, InputError), "nothing is overwritten"
    assert roi.read_bytes() == kept


def test_a_backdrop_is_shown_where_it_lies(map_file, tmp_path):
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[..., 0] = 200  # red
    world = WorldFrame(west_m=10, north_m=70, metres_per_px=0.5)
    write_backdrop(tmp_path / "above.png", cv2.imencode(".png", picture[..., ::-1])[1].tobytes(), world)
    with serving(map_file, tmp_path / "roi.json", backdrop=tmp_path / "above.png") as server:
        assert server.editor.backdrop.frame() == {"west": 10, "north": 70, "width": 30, "height": 20}
        for name, color in (("picture", [0, 0, 200]), ("above", None)):
            status, data = asked(server, "POST", f"/{server.token}/{name}")
            found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            assert status == 200
            assert color is None or found[0, 0].tolist() == color


def test_a_proposal_is_a_region_that_keeps_the_ground(map_file, tmp_path):
    out = tmp_path / "roi.json"
    settings = " ".join(f"--set pedestrians.{name}={getattr(CFG, name)}" for name in CFG.model_fields_set)
    done = invoke(f"roi propose {map_file} --out {out} {settings}")
    assert done.exit_code == 0, done.output
    roi, box_map = read_roi(out), read_boxes(map_file)
    assert (roi.map, len(roi.rings()), len(roi.rings()[0].holes)) == ("plaza", 1, 1), (
        "the house is a hole, the bin is not"
    )
    free, within = walkable_ground(box_map, CFG).walkable, walkable_ground(box_map, CFG, roi).walkable
    assert (free & within).sum() > 0.99 * free.sum()


def test_a_proposal_of_thin_ground_is_a_region(subtests):
    """Lines of single cells, parts that touch by a corner: still rings that the reader takes."""
    rng = np.random.default_rng(3)
    for number in range(6):
        with subtests.test(number):
            centers = np.column_stack([rng.uniform(0, 40, (120, 2)), np.ones(120)])
            halves = np.column_stack([rng.uniform(0.2, 3.0, (120, 2)), np.ones(120)])
            rows, sizes = np.vstack([centers, [[20, 20, -0.1]]]), np.vstack([halves, [[20, 20, 0.1]]])
            box_map = make_box_map(rows, sizes, np.zeros((121, 3)), [KINDS["Walls"]] * 120 + [KINDS["Ground"]])
            cfg = PedestriansConfig(min_component_cells=1, safety_radius_m=0)
            try:
                ground = walkable_ground(box_map, cfg)
            except CosflyError:
                continue
            roi = propose(ground, "x")
            again = Roi.model_validate(roi.model_dump())
            assert (roi_mask(ground.grid, again) & ground.walkable).any()


def test_pairs_of_ends_are_counted():
    """Against every pair of cells, on a small ground of two parts."""
    box_map, cfg = (
        town(),
        PedestriansConfig(min_distance_m=6, max_distance_m=9.2, min_component_cells=5, resolution_m=2.0),
    )
    roi = Roi(
        points_world=[(10, 60), (44, 60), (44, 76), (10, 76)],
        polygons=[{"points_world": [(90, 5), (112, 5), (112, 20), (90, 20)]}],
    )
    ground = walkable_ground(box_map, cfg, roi)
    cells = np.argwhere(ground.may_end)
    part = ground.parts[tuple(cells.T)]
    away = np.linalg.norm(cells[:, None] - cells[None], axis=2) * cfg.resolution_m
    fits = (away >= 6) & (away <= 9.2) & (part[:, None] == part[None])
    assert len(set(part)) == 2
    assert endpoint_pairs(ground, cfg) == (fits.sum() // 2, fits.any(axis=1).mean())
