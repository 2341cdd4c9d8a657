"""The map from above for the editor of regions: at its place in the world, by the embedded renderer and by CARLA."""

import subprocess
import sys

import cv2
import numpy as np
import pytest
from simulator_serving import AS_FOUND, as_client, carla_settings, serving
from test_renderers_contract import street

from cosfly.formats.boxes import BoxMap, MapHeader, make_box_map, write_boxes
from cosfly.formats.kinds import KINDS
from cosfly.formats.roi import Backdrop
from cosfly.geometry.axes import box_corners
from cosfly.render.backdrop import draw_backdrop
from cosfly.render.settings import RenderConfig
from cosfly.viz.topview import TopView


def pond(ground_z_m: float, yaw_deg: float) -> BoxMap:
    half = [(60.0, 45.0, 0.1), (30.0, 12.0, 0.1)]
    centers = [(3.0, 1.0, ground_z_m - 0.1), (8.0, -4.0, ground_z_m - 0.1)]
    kinds = [KINDS["Terrain"], KINDS["Water"]]
    turns = [(0.0, 0.0, 0.0), (0.0, yaw_deg, 0.0)]
    return make_box_map(centers, half, turns, kinds, [1, 2], MapHeader(name="pond", ground_z_m=ground_z_m))


@pytest.mark.parametrize(("ground_z_m", "yaw_deg"), [(0.0, 0.0), (37.0, 25.0)])
def test_the_ground_lies_where_the_world_has_it(ground_z_m, yaw_deg):
    box_map = pond(ground_z_m, yaw_deg)
    view = TopView(-55.3, 41.2, 3.0, (331, 250))  # no whole number of tiles
    picture = draw_backdrop(RenderConfig(), box_map, view)
    assert picture.shape == (250, 331, 3)
    is_water = picture[..., 2] > picture[..., 0]
    corners = box_corners(box_map.centers[1], box_map.half_extents[1], np.radians(yaw_deg))[[0, 2, 6, 4]]
    expected = np.zeros((250, 331), np.uint8)
    cv2.fillPoly(expected, [np.round(view.pixels(corners) * 16 - 8).astype(np.int32)], 1, shift=4)
    wrong = is_water != (expected == 1)
    edge = cv2.dilate(expected, np.ones((3, 3))) != cv2.erode(expected, np.ones((3, 3)))
    assert is_water.sum() == pytest.approx(4 * 30 * 12 * 9, rel=0.01)
    assert not (wrong & ~edge).any(), "no pixel beyond one from the shore"


@pytest.mark.slow
def test_carla_gives_the_same_picture_by_the_same_way(tmp_path):
    pytest.importorskip("carla")
    boxes = tmp_path / "boxes_3d.json"
    write_boxes(boxes, street())
    pictures = []
    with serving(street(), tmp_path / "town") as port:
        for words in ([], ["--backend", "carla", f"--set=render.carla.port={port}"]):
            out = tmp_path / f"above{len(words)}.png"
            command = [sys.executable, "-m", "cosfly", "maps", "roi-backdrop", "--map", boxes, "--out", out, *words]
            subprocess.run([*command, "--bounds", "-30", "-30", "40", "30", "--pixels-per-m", "2"], check=True)
            above = Backdrop.read(out)
            assert above.frame() == {"west": -30.0, "north": 30.0, "width": 70.0, "height": 60.0}
            pictures.append(above.picture.astype(int))
        assert as_client(carla_settings, port) == AS_FOUND, "the server is left as it was found"
    assert pictures[0].std() > 20
    ours, theirs = (picture[..., 2].reshape(-1) for picture in pictures)
    assert np.corrcoef(ours, theirs)[0, 1] > 0.95, "in blue, which the server's haze and shadows change least"
