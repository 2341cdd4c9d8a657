"""Ground that slopes: everything that stands, walks, flies or is drawn follows the heights in the map's header."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from specimens_slopes import SHAPES, TILT, flat_town, on_ground, plane_m, sampled, sloped_town
from test_renderers_contract import NAMES

from cosfly.formats.boxes import BoxMap, make_box_map, read_boxes, write_boxes
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.geometry.axes import DT_S, intrinsic_matrix, world_from_camera
from cosfly.geometry.grid import blocks_walking
from cosfly.geometry.kernels import index_boxes, obstacle_index, signed_distances
from cosfly.planners.contract import PLANNERS, PlanConfig
from cosfly.planners.stage import plan_trajectory
from cosfly.render.stage import open_renderer


@pytest.fixture(scope="module", params=SHAPES)
def town(request) -> BoxMap:
    return sloped_town(request.param)


@pytest.mark.parametrize("shape", SHAPES)
def test_slabs_fill_the_ground_and_hide_nothing_over_it(shape):
    ground, rng = sampled(shape), np.random.default_rng(2)
    index = index_boxes(*ground.slabs())
    places = rng.uniform(-150.0, 150.0, (2000, 2))
    feet = np.column_stack([places, ground.height_at(places)])
    assert_allclose(signed_distances(index, feet)[0], 0.0, atol=0.04)
    buried = feet - [0.0, 0.0, 2.0]
    # Between slabs in a hollow are wedges of a few centimetres.
    assert (signed_distances(index, buried)[0] < 0.05).all()
    over = signed_distances(index, feet + np.array([0.0, 0.0, 3.0]))[0]
    assert (over > 2.8).all()
    assert (over <= 3.04).all()


def test_a_sloped_map_survives_its_file_and_a_flat_one_says_nothing_of_it(tmp_path: Path):
    town = sloped_town("hill")
    write_boxes(tmp_path / "hill.json", town)
    back = read_boxes(tmp_path / "hill.json")
    assert (back.ground.heights_m == town.ground.heights_m).all()
    assert back.header == town.header
    write_boxes(tmp_path / "flat.json", flat_town())
    assert "ground" not in json.loads((tmp_path / "flat.json").read_text())


def test_what_stands_on_a_slope_is_in_the_way_and_what_hangs_over_it_is_not(town: BoxMap):
    flat = flat_town()
    is_small = flat.half_extents[:, :2].max(axis=1) < 3.0
    assert (blocks_walking(town) == blocks_walking(flat))[is_small].mean() > 0.99
    # A wide box that hangs 2.5 m over its middle reaches down to where somebody walks uphill.
    awning = make_box_map([[0, 0, 30 + 2.6]], [[30, 30, 0.1]], np.zeros((1, 3)), [KINDS["Static"]])
    tilted = sampled("plane")
    lifted = make_box_map(
        awning.centers, awning.half_extents, awning.rotations_deg, awning.kinds, header=sloped_town("plane").header
    )
    assert blocks_walking(lifted).all()
    assert tilted.height_at(np.zeros((1, 2)))[0] == pytest.approx(30.0)


def bare(shape: str) -> BoxMap:
    block = make_box_map([[140, 140, 1]], np.ones((1, 3)), np.zeros((1, 3)), [KINDS["Static"]])
    return on_ground(block, sampled(shape))


def walk_over(box_map: BoxMap, start: tuple[float, float], goal: tuple[float, float]) -> PedestrianTrajectory:
    ends = np.array([start, goal], dtype=np.float64)
    time_s = np.arange(0.0, np.linalg.norm(ends[1] - ends[0]) / 1.2, DT_S)
    xy = ends[0] + (ends[1] - ends[0]) * (1.2 * time_s / np.linalg.norm(ends[1] - ends[0]))[:, None]
    feet = np.column_stack([xy, box_map.ground.height_at(xy)])
    return PedestrianTrajectory("slope", ends, time_s, feet, np.full(len(xy), 1.2))


@pytest.mark.parametrize("planner", PLANNERS)
@pytest.mark.parametrize("shape", SHAPES)
def test_flights_count_their_altitude_from_the_ground_under_the_walker(shape: str, planner: str):
    box_map, cfg = bare(shape), PlanConfig(planner=planner)
    walk = walk_over(box_map, (-60.0, 5.0), (60.0, 5.0))
    assert np.ptp(walk.positions_m[:, 2]) > 4.0
    obstacles = obstacle_index(box_map)
    trace = plan_trajectory(walk, obstacles, cfg, 0)
    over_walker = trace.positions_m[:, 2] - walk.positions_m[:, 2]
    assert over_walker.min() >= cfg.altitude_min_m - 1e-3
    assert over_walker.max() <= cfg.altitude_min_m + 12.0
    assert trace.metrics["altitude_min_m"] == pytest.approx(over_walker.min(), abs=1e-3)
    over_ground = trace.positions_m[:, 2] - box_map.ground.height_at(trace.positions_m)
    assert over_ground.min() >= cfg.relaxed_safety_m
    assert (trace.clearances_m <= over_ground + 0.1).all()  # the ground is what is nearest
    assert (trace.visibility == 1.0).all()


def rays(camera_pose: np.ndarray, intrinsic: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and directions (h, w, 3) of unit z-depth through the middles of pixels."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    across, down = (x - intrinsic[0, 2]) / intrinsic[0, 0], (y - intrinsic[1, 2]) / intrinsic[1, 1]
    return camera_pose[:3, 3], np.stack([across, down, np.ones_like(x)], axis=-1) @ camera_pose[:3, :3].T


@pytest.fixture(params=NAMES)
def renderer_name(request) -> str:
    if request.param == "pyrender":
        pytest.importorskip("pyrender")
    return request.param


def test_the_depth_of_a_tilted_plane_is_that_of_the_analytic_ray(renderer_name: str):
    box_map, size = bare("plane"), (96, 54)
    renderer = open_renderer(renderer_name, box_map, *size)
    eye = np.array([-40.0, 20.0, 30.0 + 22.0])
    pose, intrinsic = world_from_camera(eye, np.array([-35.0, 25.0, 0.0])), intrinsic_matrix(*size, 70.0)
    frame = renderer.render(pose, intrinsic, None)
    renderer.close()
    origin, directions = rays(pose, intrinsic, size)
    # eye + t d meets z = 30 + tilt (x, y): t is the z-depth, since d has a unit part along the view.
    fall = directions[..., 2] - directions[..., :2] @ TILT
    depth = (plane_m(origin[None])[0] - origin[2]) / fall
    hit = origin + depth[..., None] * directions
    on_grid = (np.abs(hit[..., :2]) < 130.0).all(axis=-1) & (fall < 0)
    assert on_grid.mean() > 0.6
    assert np.abs(frame.depth - depth)[on_grid].max() < 0.02
    assert (frame.kinds[on_grid] == KINDS["Terrain"]).all()
    assert (frame.ids[on_grid] == 0).all()
