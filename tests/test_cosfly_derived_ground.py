"""Ground: derived where a map has buildings and no streets; ground that slopes."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from specimens_slopes import SHAPES, TILT, flat_town, on_ground, plane_m, sampled, sloped_city, sloped_town
from test_renderers_contract import NAMES

from cosfly.formats.boxes import BoxMap, make_box_map, read_boxes, write_boxes
from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.geometry.axes import DT_S, intrinsic_matrix, world_from_camera
from cosfly.geometry.grid import blocks_walking, empty_grid, lies_off_ground, surface_kinds
from cosfly.geometry.kernels import index_boxes, obstacle_index, signed_distances
from cosfly.maps.boxlist import BoxList
from cosfly.maps.cityjson import CityJsonConfig
from cosfly.maps.footprints import CREDITS, NEAR_M, PAVEMENT_M, with_derived_ground
from cosfly.maps.stage import MapsConfig, load_map, run
from cosfly.pedestrians.stage import make_pedestrian
from cosfly.pedestrians.walkable import PedestriansConfig, walkable_ground
from cosfly.planners.contract import PLANNERS, PlanConfig
from cosfly.planners.stage import plan_trajectory
from cosfly.render.stage import open_renderer
from cosfly.render.surfaces import drape, is_draped
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import SimplifyConfig, simplify

ROADS, SIDEWALKS, TERRAIN = (KINDS[name] for name in ("Roads", "Sidewalks", "Terrain"))


def houses(*more: tuple[float, float, float]) -> BoxMap:
    """Two rows of four houses of 30 m by 12 m, 18 m apart, each row along x; more: x, y and yaw of others."""
    boxes = BoxList()
    for x in range(-60, 61, 40):
        for y in (-15, 15):
            boxes.add("Buildings", (x, y), (30, 12), -1.0, 9.0)
    for x, y, yaw_deg in more:
        boxes.add("Buildings", (x, y), (20, 10), -1.0, 9.0, yaw_deg)
    return boxes.box_map()


def kinds_at(box_map: BoxMap, *points) -> list[int]:
    grid = empty_grid(box_map, 0.25)
    x, y = grid.cells_at(np.array(points)).T
    return surface_kinds(box_map, GROUND_KINDS, like=grid)[y, x].tolist()


def test_pavement_lies_along_facades_asphalt_between_near_buildings_and_lawn_elsewhere():
    far = 21.0 + 15.0 + NEAR_M + 15.0
    box_map = with_derived_ground(houses((0.0, far, 30.0)))
    step = PAVEMENT_M - 0.3
    pavement = (-60, 9 - step), (-60, -9 + step), (0, far + 5 / np.cos(np.pi / 6) + 1.0), (75 + step, 15)
    assert kinds_at(box_map, *pavement) == [SIDEWALKS] * 4
    assert kinds_at(box_map, (-60, 0), (0, 0), (40, 0)) == [ROADS] * 3
    assert kinds_at(box_map, (0, 35), (20, far + 8), (-60, -29)) == [TERRAIN] * 3


@pytest.mark.parametrize("shape", ["plane", "hill"])
def test_on_a_slope_all_of_it_lies_in_the_ground(shape):
    box_map = with_derived_ground(on_ground(houses((0.0, 100.0, 30.0)), sampled(shape)))
    assert not lies_off_ground(box_map, GROUND_KINDS).any()
    assert is_draped(box_map).sum() == box_map.header.derived_ground
    draped = drape(box_map)
    np.testing.assert_allclose(
        draped.corners_m[..., 2].ravel(), box_map.ground.height_at(draped.corners_m.reshape(-1, 3)), atol=1e-6
    )
    assert kinds_at(box_map, (0, 0), (-60, 8)) == [ROADS, SIDEWALKS]


def test_a_city_model_without_streets_gets_it_and_the_same_bytes_twice(tmp_path: Path):
    path = tmp_path / "city.json"
    path.write_text(json.dumps(sloped_city(terrain=False, streets=False)))
    cfg = MapsConfig(source="cityjson", cityjson=CityJsonConfig(path=path, credits="Its makers."))
    first, second = (run(cfg, tmp_path / name) for name in ("one", "two"))
    assert first.read_bytes() == second.read_bytes()
    header = read_boxes(first).header
    assert header.derived_ground > 16
    assert header.credits == f"Its makers. {CREDITS}"
    path.write_text(json.dumps(sloped_city()))
    assert load_map(cfg).header.derived_ground == 0


@pytest.mark.slow
def test_people_of_a_foreign_city_of_buildings_alone_walk_on_its_pavements(shared_data: Path):
    path = shared_data / "tudelft-3dbag" / "extension.city.jsonl.gz"
    box_map = load_map(MapsConfig(source="cityjson", cityjson=CityJsonConfig(path=path, solids=False)))
    assert box_map.header.derived_ground < 2.0 * box_map.counts()["Buildings"]
    cfg = PedestriansConfig(road_cost=20, open_cost=3)
    ground = walkable_ground(simplify(box_map, SimplifyConfig()).box_map, cfg)
    walks = [make_pedestrian("p", ground, cfg, rng_for(0, "pedestrians", str(k))).trajectory for k in range(20)]
    places = np.concatenate([walk.positions_m for walk in walks])
    x, y = ground.grid.cells_at(places).T
    assert np.isin(ground.footing[y, x], [0, 1]).mean() > 0.95


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
