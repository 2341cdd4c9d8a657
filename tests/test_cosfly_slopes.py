"""Ground that slopes: everything that stands, walks, flies or is drawn follows the heights in the map's header."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from specimens_slopes import CELL_M, SHAPES, TILT, flat_town, on_ground, plane_m, sampled, sloped_town
from test_renderers_contract import NAMES

from cosfly.formats.boxes import BoxMap, make_box_map, read_boxes, write_boxes
from cosfly.formats.ground import Ground
from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.geometry.axes import DT_S, intrinsic_matrix, world_from_camera
from cosfly.geometry.grid import blocks_walking
from cosfly.geometry.kernels import index_boxes, obstacle_index, signed_distances
from cosfly.pedestrians.stage import PedestriansConfig, walkable_ground
from cosfly.planners.contract import PLANNERS, PlanConfig
from cosfly.planners.stage import plan_trajectory
from cosfly.render.draping import BARE_GROUND, drape, is_draped
from cosfly.render.stage import open_renderer
from cosfly.simplify.passes import SimplifyConfig, simplify


@pytest.fixture(scope="module", params=SHAPES)
def town(request) -> BoxMap:
    return sloped_town(request.param)


# --- the product ---


def test_heights_are_those_of_the_triangles_and_go_on_beyond_the_border():
    rng = np.random.default_rng(0)
    ground = Ground(rng.uniform(0.0, 3.0, (6, 9)), -7.0, 3.0, 2.5)
    triangles = ground.triangles(reach_m=50.0)
    shares = rng.dirichlet([1.0, 1.0, 1.0], len(triangles))
    places = np.einsum("nk,nki->ni", shares, triangles)
    assert_allclose(ground.height_at(places), places[:, 2], atol=1e-9)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (normals[:, 2] > 0).all()  # counter-clockwise from above
    slopes = np.linalg.norm(normals[:, :2], axis=1) / normals[:, 2]
    assert_allclose(ground.slope_at(triangles.mean(axis=1)), slopes, atol=1e-9)


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


# --- simplify and walk ---


def test_simplify_counts_heights_from_the_ground_under_each_box():
    alone = {"merge": False, "prune_nested": False}  # in a flat world parts of a crown may share a top
    flat, tilted = flat_town(), sloped_town("plane")
    for cfg in (SimplifyConfig(**alone), SimplifyConfig(**alone, crop_strategy="adaptive", below_ground="clip")):
        low, high = simplify(flat, cfg), simplify(tilted, cfg)
        assert high.passes == low.passes
        lifted = on_ground(low.box_map, tilted.ground)
        assert_allclose(high.box_map.centers, lifted.centers, atol=1e-6)
        assert_allclose(high.box_map.half_extents, low.box_map.half_extents, atol=1e-6)
        assert high.box_map.header.ground == tilted.header.ground


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


def test_nobody_walks_on_ground_as_steep_as_a_roof():
    # 45 degrees in the east.
    heights = np.add.outer(np.zeros(40), np.where(np.arange(40) < 20, 0.0, np.arange(40) - 19.0))
    flat = make_box_map([[80, 80, -0.1]], [[80, 80, 0.1]], np.zeros((1, 3)), [KINDS["Roads"]])
    box_map = on_ground(flat, Ground(CELL_M * heights, 0.0, 0.0, CELL_M))
    found = walkable_ground(box_map, PedestriansConfig())
    x, _ = found.grid.centers_of(np.argwhere(found.walkable)[:, ::-1]).T
    assert x.max() < 80.0
    assert found.counts["cells_steep"] > 20_000
    assert set(box_map.kinds) <= GROUND_KINDS


# --- plan ---


def bare(shape: str) -> BoxMap:
    """A slope with one small block far off, so that nothing but the ground counts."""
    block = make_box_map([[140, 140, 1]], np.ones((1, 3)), np.zeros((1, 3)), [KINDS["Static"]])
    return on_ground(block, sampled(shape))


def walk_over(box_map: BoxMap, start: tuple[float, float], goal: tuple[float, float]) -> PedestrianTrajectory:
    """A straight walk at 1.2 m/s with its feet on the ground."""
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


# --- draw ---


def test_draped_surfaces_lie_on_the_ground_and_keep_their_areas(town: BoxMap):
    draped, lies = drape(town), is_draped(town)
    assert lies.sum() == town.is_any_of(GROUND_KINDS).sum()
    middles = draped.corners_m.mean(axis=1)
    inside = (np.abs(middles[:, :2]) < 160.0).all(axis=1)
    assert_allclose(middles[inside, 2], town.ground.height_at(middles[inside]), atol=1e-6)
    edges = draped.corners_m[:, 1:, :2] - draped.corners_m[:, :1, :2]
    areas = 0.5 * (edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    assert (areas >= -1e-9).all()
    is_box = draped.rows != BARE_GROUND
    sums = np.bincount(draped.rows[is_box], areas[is_box], len(town))
    expected = np.where(lies, 4.0 * town.half_extents[:, 0] * town.half_extents[:, 1], 0.0)
    assert_allclose(sums, expected, rtol=1e-6, atol=1e-6)


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
