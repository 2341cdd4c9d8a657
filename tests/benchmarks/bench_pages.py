"""How fast the pages are: the editor's and the viewer's, on a town of the paper's size, in a headless Chromium.

`python tests/benchmarks/bench_pages.py`: a minute. WebGL is drawn by the processor there.
"""

import tempfile
import threading
import time
from pathlib import Path

import scenes
from browser import Page, browser

from cosfly.formats.boxes import write_boxes
from cosfly.pedestrians.roi_editor import open_editor
from cosfly.pedestrians.walkable import PedestriansConfig
from cosfly.simplify.passes import SimplifyConfig, simplify
from cosfly.viz.scene_page import run as write_scene

READY = "document.body.dataset.ready === 'yes'"
TURNS = 3


def opened_s(page: Page, address: Path | str) -> float:
    times = []
    for _ in range(TURNS):
        start = time.perf_counter()
        page.open(address)
        page.wait(READY)
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    box_map = scenes.town()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        root = Path(name)
        write_boxes(root / "map.json", box_map)
        write_boxes(root / "simple.json", simplify(box_map, SimplifyConfig()))
        with browser(root / "profile") as page:
            open_editor(root / "simple.json", PedestriansConfig(), root / "warm.json", 0).http.server_close()
            start = time.perf_counter()
            server = open_editor(root / "simple.json", PedestriansConfig(), root / "roi.json", 0)
            listens_s = time.perf_counter() - start
            threading.Thread(target=server.serve, daemon=True).start()
            size = "{} x {}".format(*server.site.whole_ground.grid.size)
            print(f"editor, {size} cells: listens after {listens_s:.2f} s, page after ", end="")
            print(f"{opened_s(page, server.address):.2f} s", flush=True)
            server.http.shutdown()
            scene = write_scene(root / "map.json", root / "scene.html")
            print(f"viewer of {len(box_map):,} boxes: opens in {opened_s(page, scene):.2f} s")


if __name__ == "__main__":
    main()
