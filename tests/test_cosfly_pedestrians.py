import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from tables import each

from cosfly.formats.boxes import MapHeader, make_box_map, read_boxes, write_boxes
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import read_paths
from cosfly.formats.roi import Roi
from cosfly.geometry.axes import DT_S
from cosfly.geometry.grid import OccupancyGrid
from cosfly.geometry.ground import Ground
from cosfly.pedestrians.crossings import costs_of
from cosfly.pedestrians.stage import PedestriansConfig, WalkableGround, make_pedestrian, run, walkable_ground
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.seeding import rng_for

BUILDINGS, ROADS = KINDS["Buildings"], KINDS["Roads"]


def town(size_m: float = 160.0, *, walls: list = (), seed: int = 4):
    rng = np.random.default_rng(seed)
    centers = [[size_m / 2, size_m / 2, -0.1], *np.column_stack([rng.uniform(0, size_m, (40, 2)), np.full(40, 3.0)])]
    extents = [[size_m / 2, size_m / 2, 0.1], *np.column_stack([rng.uniform(1, 5, (40, 2)), np.full(40, 3.0)])]
    yaws = [0.0, *rng.uniform(0, 360, 40), *[0.0] * len(walls)]
    centers += [center for center, _ in walls]
    extents += [half_extents for _, half_extents in walls]
    rotations = np.column_stack([np.zeros(len(yaws)), yaws, np.zeros(len(yaws))])
    return make_box_map(
        centers, extents, rotations, [ROADS] + [BUILDINGS] * (len(yaws) - 1), header=MapHeader(name="Town")
    )


def plain(size_m: float, *walls):
    centers = [[size_m / 2, size_m / 2, -0.1]] + [center for center, _ in walls]
    extents = [[size_m / 2, size_m / 2, 0.1]] + [half_extents for _, half_extents in walls]
    return make_box_map(centers, extents, np.zeros((len(centers), 3)), [ROADS] + [BUILDINGS] * len(walls))


def ground_of(text: str) -> WalkableGround:
    return ground_in(np.array([[int(mark) for mark in row] for row in text.split()], dtype=np.int32))


def ground_in(parts: np.ndarray) -> WalkableGround:
    grid = OccupancyGrid(0.0, 0.0, 1.0, parts == 0)
    return WalkableGround(grid, grid, parts, np.zeros(parts.shape, np.uint8), Ground.flat(0.0), costs_of(1, 1))


def write_roi(path: Path, points: list) -> Path:
    path.write_text(json.dumps({"description": "", "closed": True, "points_world": points}))
    return path


@each("start", [(0, 0), (4, 2), (6, 6)])
def test_goals_are_all_cells_of_the_part_at_the_wanted_distance(start):
    rng = np.random.default_rng(1)
    parts = rng.integers(0, 3, (8, 9)).astype(np.int32)
    parts[start[1], start[0]] = 2
    expected = {
        (x, y)
        for y, x in np.argwhere(parts == 2).tolist()
        if 2.5 <= np.hypot(x - start[0], y - start[1]) <= 5.0
    }  # fmt: skip
    drawn = [ground_in(parts).sample_goal(start, 2.5, 5.0, rng) for _ in range(200 * len(expected))]
    assert set(drawn) == expected
    counts = np.unique(np.array(drawn), axis=0, return_counts=True)[1]
    assert abs(counts - 200).max() < 75  # 5 standard deviations


def test_the_region_of_interest_bounds_every_walk():
    roi = Roi(
        points_world=[(10, 10), (150, 10), (150, 150), (10, 150)], holes=[[(60, 60), (100, 60), (100, 100), (60, 100)]]
    )
    ground = walkable_ground(town(), PedestriansConfig(), roi)
    assert ground.counts["cells_in_roi"] == 280 * 280 - 80 * 80
    walk = make_pedestrian("path_00000", ground, PedestriansConfig(), np.random.default_rng(0))
    for xy in walk.trajectory.polyline_m:
        assert (xy > 10).all()
        assert (xy < 150).all()
        assert not ((xy > 60) & (xy < 100)).all()


@each(("ground", "columns"), [("anywhere", 300), ("surfaces", 240), ("paved", 160)])
def test_people_walk_where_the_settings_say(ground, columns):
    # 80 m of road, 40 m of lawn, 30 m of nothing up to a far wall; boxes of 30 m by 0.2 m.
    kinds = [ROADS, KINDS["Terrain"], BUILDINGS]
    box_map = make_box_map(
        [[40, 50, -0.1], [100, 50, 0.1], [149.95, 50, 5]], [[40, 50, 0.1], [20, 50, 0.1], [0.05, 50, 1]],
        np.zeros((3, 3)), kinds,
    )  # fmt: skip
    found = walkable_ground(box_map, PedestriansConfig(ground=ground))
    assert np.count_nonzero(found.parts) == columns * 200
    assert not found.parts[:, columns:].any()


@pytest.mark.parametrize(("number", "dt_s"), [*((k, DT_S) for k in range(6)), (6, 0.2), (7, 2.0)])
def test_a_walk_keeps_every_promise(number, dt_s):
    cfg = PedestriansConfig(dt_s=dt_s)
    ground = walkable_ground(town(), cfg)
    path = make_pedestrian(f"path_{number:05d}", ground, cfg, rng_for(0, "pedestrians", str(number))).trajectory
    assert 50 <= np.linalg.norm(path.polyline_m[-1] - path.polyline_m[0]) <= 100
    np.testing.assert_allclose(path.time_s, np.arange(len(path.time_s)) * dt_s)
    np.testing.assert_allclose(path.positions_m[[0, -1], :2], path.polyline_m[[0, -1]], atol=1e-9)
    assert (path.positions_m[:, 2] == 0).all()
    assert ((path.speeds_mps > 0) & (path.speeds_mps <= 1.6)).all()
    steps_m = np.linalg.norm(np.diff(path.positions_m, axis=0), axis=1)
    assert steps_m.max() <= 1.6 * dt_s + 1e-9
    x, y = ground.grid.cells_at(path.positions_m).T
    assert not ground.grid.occupied[y, x].any()
    x, y = ground.grid.cells_at(path.polyline_m).T
    assert (ground.parts[y, x] == ground.parts[y[0], x[0]]).all()


def test_a_walk_depends_on_its_own_random_numbers_only():
    cfg = PedestriansConfig()
    ground = walkable_ground(town(), cfg)
    texts = [
        dump_json(make_pedestrian("p", ground, cfg, rng_for(seed, "pedestrians", name)).trajectory.as_json())
        for seed, name in ((0, "a"), (0, "a"), (0, "b"), (1, "a"))
    ]
    assert (texts[0], len(set(texts))) == (texts[1], 3)


def test_a_detour_is_given_up_and_counted():
    # A wall of 90 m with a way round it at one end only: near the other end, 10 m across are 150 m on foot.
    ground = ground_of("\n".join(["1" * 100] * 5 + ["0" * 95 + "1" * 5] + ["1" * 100] * 5))
    cfg = PedestriansConfig(resolution_m=1.0, min_distance_m=4, max_distance_m=11, num_retries=50, max_detour=2.0)
    walks = [make_pedestrian("p", ground, cfg, np.random.default_rng(k)) for k in range(40)]
    free_walks = [
        make_pedestrian("p", ground, cfg.model_copy(update={"max_detour": 0.0}), np.random.default_rng(k))
        for k in range(40)
    ]

    def worst(walks):
        lines = [w.trajectory.polyline_m for w in walks]
        return max(
            np.linalg.norm(np.diff(p, axis=0), axis=1).sum() / np.linalg.norm(p[-1] - p[0]) for p in lines
        )  # fmt: skip

    assert worst(walks) <= 2.0 < worst(free_walks)
    assert sum(w.retries["detour"] for w in walks) > 0
    assert sum(w.retries["detour"] for w in free_walks) == 0


def test_the_stage_writes_paths_report_and_picture(tmp_path):
    write_boxes(tmp_path / "step2_simplified.json", town())
    map_file = tmp_path / "step2_simplified.json"
    roi = write_roi(tmp_path / "roi.json", [[2, 2], [158, 2], [158, 140], [2, 140]])
    product = run(PedestriansConfig(num_paths=3), map_file, tmp_path / "out", seed=7, roi=roi)
    paths = read_paths(product)
    assert [p.path_id for p in paths] == ["path_00000", "path_00001", "path_00002"]
    header = json.loads(product.read_text())
    assert (header["map"], header["seed"], header["dt_s"]) == ("Town", 7, 0.5)
    facts = json.loads((tmp_path / "out" / "pedestrians_report.json").read_text())
    assert facts["total"]["paths"] == len(facts["paths"]) == 3
    assert facts["total"]["points"] == sum(len(p.time_s) for p in paths)
    assert facts["ground"]["cells_in_roi"] == 312 * 276
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["counts"] == {"input": 3, "kept": 3, "dropped": {}, "failed": {}}
    steps = {"read", "grid", "project", "inflate", "connectivity", "footing", "sample", "astar", "report"}
    assert set(manifest["seconds_by_step"]) == steps
    picture = cv2.imread(str(tmp_path / "out" / "paths.png"))
    assert picture.shape[1] == 1600
    assert len(np.unique(picture[::7, ::7].reshape(-1, 3), axis=0)) > 5


def test_a_path_that_fails_is_counted_and_the_others_go_on(tmp_path):
    # A yard of 40 m beside a field: starts in the yard have no goal 60 m off.
    box_map = plain(
        120.0, ((41.0, 60.0, 1.0), (1.0, 60.0, 1.0)), ((20.0, 41.0, 1.0), (20.0, 1.0, 1.0)),
        ((20.0, 80.0, 1.0), (20.0, 38.0, 1.0)),
    )  # fmt: skip
    write_boxes(tmp_path / "map.json", box_map)
    cfg = PedestriansConfig(num_paths=12, num_retries=0, min_distance_m=60)
    product = run(cfg, tmp_path / "map.json", tmp_path / "out")
    counts = json.loads((tmp_path / "out" / "manifest.json").read_text())["counts"]
    assert counts["failed"]["no_path"] > 0
    assert counts["kept"] == len(read_paths(product)) > 0
    assert counts["kept"] + counts["failed"]["no_path"] == 12
    failures = [json.loads(line) for line in (tmp_path / "out" / "failures.jsonl").read_text().splitlines()]
    assert len(failures) == counts["failed"]["no_path"]
    assert json.loads((tmp_path / "out" / "pedestrians_report.json").read_text())["failed"] == counts["failed"]


def test_simworld_gives_twenty_of_twenty(shared_data, tmp_path):
    from cosfly.maps.simworld import SimWorldConfig, load
    from cosfly.simplify.passes import SimplifyConfig, simplify

    folder = shared_data / "simworld-progen"
    city = load(SimWorldConfig(world=folder / "progen_world.json", sizes=[folder / "Bbox.json"]))
    write_boxes(tmp_path / "map.json", simplify(city, SimplifyConfig()).box_map)
    product = run(PedestriansConfig(), tmp_path / "map.json", tmp_path / "out")
    assert len(read_paths(product)) == 20
    ground = json.loads((tmp_path / "out" / "pedestrians_report.json").read_text())["ground"]
    assert ground["component_sizes_used"][0] > 0.9 * ground["cells_walkable"]  # one large walkable component
    assert len(read_boxes(tmp_path / "map.json")) == ground["boxes"]
