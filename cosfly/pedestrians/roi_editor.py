"""`cosfly roi`: the region of interest of a map, drawn on a local page (subsec:appendix_g_editor).

The page only draws: this module computes the walkable ground of a region with the code of the pedestrian stage.
"""

import base64
import json
import logging
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cosfly.formats.boxes import AXES, BoxMap, check_ground, read_boxes
from cosfly.formats.roi import Roi, parse_roi, write_roi
from cosfly.geometry.grid import empty_grid
from cosfly.pedestrians.walkable import PedestriansConfig, WalkableGround, check_roi, walkable_ground
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import read_bytes, read_text, sha256_bytes
from cosfly.viz.page import page, scripts
from cosfly.viz.page_server import MOST_BYTES, PageServer
from cosfly.viz.topview import TopView, draw_map, png_bytes

log = logging.getLogger(__name__)

MOST_SIDE, MOST_CELLS = 16_000, 64_000_000  # what browsers draw on one canvas
OCCUPIED, MARGIN, UNUSED, FREE = 128, 190, 228, 255  # grey levels of the backdrop
IN_REGION, WALKABLE = (90, 160, 230, 60), (60, 150, 240, 110)  # RGBA over the backdrop
FROM_ABOVE_PX = 2400


class Editor:
    """What the page asks for: one map, and one file of a region that it may write. JSON keys are those of the page."""

    def __init__(self, box_map: BoxMap, cfg: PedestriansConfig, roi_path: Path, map_path: Path) -> None:
        num_x, num_y = empty_grid(box_map, cfg.resolution_m).size
        if max(num_x, num_y) > MOST_SIDE or num_x * num_y > MOST_CELLS:
            what = "the grid is too large for the editor's page"
            expected = f"at most {MOST_SIDE} cells a side and {MOST_CELLS:,} cells in all"
            fix = "set a larger pedestrians.resolution_m to draw; the region, which is stored in metres, stays valid"
            raise InputError(what, where=map_path, got=f"{num_x} x {num_y} cells", expected=expected, fix=fix)
        self.box_map = box_map
        self.cfg = cfg
        self.roi_path = roi_path
        self.map_path = map_path  # for messages
        self.lock = threading.Lock()
        self.whole_ground = walkable_ground(box_map, cfg, where=map_path)  # without a region
        self.first_roi: dict[str, Any] | None = None  # the region in the file when the editor starts
        self.digest: str | None = None  # of the file as it was read or written last; None where there was none
        if roi_path.exists():
            data = read_bytes(roi_path, what="region of interest")
            self.first_roi = self.region_of(data, roi_path)["roi"]
            self.digest = sha256_bytes(data)

    def page_html(self) -> str:
        folder = Path(__file__).parent
        ground = self.whole_ground
        grid = ground.grid
        levels = np.full(ground.walkable.shape, FREE, dtype=np.uint8)
        levels[~ground.walkable] = UNUSED
        levels[ground.inflated.occupied] = MARGIN
        levels[grid.occupied] = OCCUPIED
        data = {
            "map": self.box_map.name, "most_bytes": MOST_BYTES, "axes": AXES, "roi": self.first_roi,
            "x_min": grid.x_min_m, "y_min": grid.y_min_m, "cell": grid.resolution_m, "size": grid.size,
            "grid": _encoded(levels), "levels": [OCCUPIED, MARGIN, UNUSED, FREE],
            "alphas": [IN_REGION[3], WALKABLE[3]], "walkable": (*WALKABLE[:3], WALKABLE[3] / 255),
            **self.cells(None),
        }  # fmt: skip
        style = read_text(folder / "roi_editor.css")
        script = scripts("tools.js", "canvas.js") + read_text(folder / "roi_editor.js")
        template = "cosfly/pedestrians/roi_editor.html"
        return page(template, title=self.box_map.name, style=style, script=script, asks=True, data=data)

    def region_of(self, data: bytes, where: Path) -> dict[str, Any]:
        """Return the region in a file's bytes and its cells."""
        roi = parse_roi(data, where)
        check_roi(roi, self.box_map, where, refuse=True)
        return {"roi": roi.model_dump(), **self.cells(roi, where)}

    def cells(self, roi: Roi | None, where: str | Path = "region of interest") -> dict[str, Any]:
        """Return the cells of a region, a PNG over the backdrop in base64, and its figures."""
        ground = self._ground_of(roi, where)
        picture = np.zeros((*ground.walkable.shape, 4), dtype=np.uint8)
        if ground.is_in_roi is not None:
            picture[ground.is_in_roi] = IN_REGION
        picture[ground.walkable] = WALKABLE
        return {"cells": _encoded(picture), "figures": _figures(ground)}

    def _ground_of(self, roi: Roi | None, where: str | Path) -> WalkableGround:
        if roi is None:
            return self.whole_ground
        return walkable_ground(self.box_map, self.cfg, roi, where=self.map_path, roi_where=where)

    def save(self, data: bytes) -> dict[str, Any]:
        """Write the region, unless somebody else has written the file meanwhile."""
        roi = parse_roi(data, Path("the page"))
        figures = _figures(self._ground_of(roi, "region of interest"))
        with self.lock:
            digest = sha256_bytes(read_bytes(self.roi_path)) if self.roi_path.exists() else None
            if digest != self.digest:
                what = "another program changed the file of the region, so the editor does not overwrite it"
                raise InputError(what, where=self.roi_path, fix="restart the editor, which then loads the changed file")
            write_roi(self.roi_path, roi)
            self.digest = sha256_bytes(read_bytes(self.roi_path))
        log.info("saved %s", self.roi_path)
        return {"figures": figures, "saved": str(self.roi_path)}

    def answer(self, name: str, data: bytes) -> bytes:
        """Answer a request of the page; errors become messages of the page, a KeyError is "not found"."""
        match name:
            case "above":
                return self._from_above_png()
            case "cells":
                answer = self.cells(parse_roi(data, Path("the page")) if data else None)
            case "open":
                answer = self.region_of(data, Path("the file"))
            case "save":
                answer = self.save(data)
            case _:
                raise KeyError(name)
        return json.dumps(answer).encode()

    def _from_above_png(self) -> bytes:
        """Draw the map over the area of the grid."""
        grid = self.whole_ground.grid
        size_m = np.array(grid.size) * grid.resolution_m
        px_per_m = FROM_ABOVE_PX / size_m.max()
        width, height = (max(1, round(side)) for side in size_m * px_per_m)
        # Pixel coordinates are 0 at the centre of the first pixel.
        corner = grid.x_min_m + 0.5 / px_per_m, grid.y_min_m + size_m[1] - 0.5 / px_per_m
        return png_bytes(draw_map(self.box_map, TopView(*corner, px_per_m, (width, height))))


def _figures(ground: WalkableGround) -> dict[str, int]:
    """Return the counts of cells and components that the page shows."""
    counts = ground.counts
    return {
        "region": counts["cells_in_roi"],
        "walkable": counts["cells_walkable"],
        "used": counts["cells_used"],
        "components": counts["components"],
        "large": counts["components_used"],
        "largest": counts["component_sizes_used"][0],
    }


def _encoded(picture: np.ndarray) -> str:
    """Encode cells, (ny, nx) or RGBA, as a PNG in base64, north up."""
    if picture.ndim == 3:
        picture = picture[..., [2, 1, 0, 3]]
    done, data = cv2.imencode(".png", np.ascontiguousarray(picture[::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert done, "OpenCV encodes any 8-bit picture"
    return base64.b64encode(data.tobytes()).decode()


def open_editor(map_: Path, cfg: PedestriansConfig, roi: Path, port: int) -> PageServer:
    """Read all that the page shows, and listen; `PageServer.serve` answers until it is interrupted."""
    box_map = read_boxes(map_)
    check_ground(box_map, map_)
    return PageServer(Editor(box_map, cfg, roi, map_), port)
