"""Stage 3: pedestrian trajectories, speeds and crossings, and bystanders about a pedestrian."""

import json
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, Polygon, box, contains_xy
from specimens_planning import town_walks

from cosfly.formats.boxes import MapHeader, make_box_map, read_boxes, write_boxes
from cosfly.formats.bystanders import Bystander, Bystanders, read_bystanders, write_bystanders
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import PedestrianTrajectory, read_paths
from cosfly.geometry.axes import DT_S
from cosfly.maps.boxlist import BoxList
from cosfly.pedestrians.astar import _line_cost, corners_of
from cosfly.pedestrians.bystanders import bystanders_of, gaps_m
from cosfly.pedestrians.speed_model import PACES, TimedRoute, take_pace
from cosfly.pedestrians.stage import PedestriansConfig, follow_route, make_pedestrian, run, walkable_ground
from cosfly.pedestrians.walkable import count_on_road
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load, shipped
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import dump_json
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import simplify
from specimens import change_json, map_of

BUILDINGS, ROADS = KINDS["Buildings"], KINDS["Roads"]


def town():
    rng = np.random.default_rng(4)
    centers = [[80, 80, -0.1], *np.column_stack([rng.uniform(0, 160, (40, 2)), np.full(40, 3.0)])]
    extents = [[80, 80, 0.1], *np.column_stack([rng.uniform(1, 5, (40, 2)), np.full(40, 3.0)])]
    rotations = np.column_stack([np.zeros(41), [0.0, *rng.uniform(0, 360, 40)], np.zeros(41)])
    return make_box_map(centers, extents, rotations, [ROADS] + [BUILDINGS] * 40, header=MapHeader(name="Town"))


@pytest.mark.parametrize(("ground", "columns"), [("anywhere", 300), ("surfaces", 240), ("paved", 160)])
def test_people_walk_where_the_settings_say(ground, columns):
    # 80 m of road, 40 m of lawn, 30 m of nothing up to a far wall; boxes of 30 m by 0.2 m.
    road, lawn = ("Roads", (40, 50, -0.1), (40, 50, 0.1)), ("Terrain", (100, 50, 0.1), (20, 50, 0.1))
    box_map = map_of(road, lawn, ("Buildings", (149.95, 50, 5), (0.05, 50, 1)))
    found = walkable_ground(box_map, PedestriansConfig(ground=ground))
    assert np.count_nonzero(found.parts) == columns * 200
    assert not found.parts[:, columns:].any()


def test_the_cells_at_the_edge_of_a_turned_road_are_road():
    boxes = BoxList()
    boxes.add("Roads", (60, 60), (120, 7), -0.3, 0.0, 27.0)
    boxes.add("Sidewalks", (60, 90), (120, 2), -0.3, 0.0, 27.0)
    ground = walkable_ground(boxes.box_map(), PedestriansConfig(road_cost=20, min_component_cells=100))
    rows, columns = np.nonzero(ground.may_end)
    y, x = (ground.grid.centers_of(np.column_stack([columns, rows])) - [60, 90])[:, ::-1].T
    assert np.abs(y * np.cos(np.radians(27)) - x * np.sin(np.radians(27))).max() < 1.5  # on the pavement


def test_walkable_ground_in_small_areas_is_left_out_and_counted(tmp_path, caplog):
    caplog.set_level("INFO")
    # Pavement of 100 m by 100 m, and 50 m away a square of 20 m and one of 10 m.
    squares = ((50, 50, 50), (160, 50, 10), (160, 90, 5))
    box_map = map_of(*(("Sidewalks", (x, y, -0.1), (half, half, 0.1)) for x, y, half in squares))
    write_boxes(tmp_path / "map.json", box_map)
    cfg = PedestriansConfig(safety_radius_m=0, num_paths=1)
    product = run(cfg, tmp_path / "map.json", tmp_path / "out")
    ground = json.loads(product.with_name("pedestrians_report.json").read_text())["ground"]
    assert (ground["cells_walkable"], ground["cells_used"]) == (200 * 200 + 2000, 200 * 200)
    assert caplog.text.count("5 % of the walkable ground is in areas too small") == 1
    caplog.clear()
    run(cfg.model_copy(update={"min_component_cells": 1}), tmp_path / "map.json", tmp_path / "all")
    assert "too small" not in caplog.text


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


def test_a_line_crosses_the_cells_that_geometry_says():
    rng = np.random.default_rng(5)
    costs, num_blocked = np.array([1, 9]), 0
    cells = {(x, y): box(x - 0.5, y - 0.5, x + 0.5, y + 0.5) for x, y in np.ndindex(7, 7)}
    for _ in range(300):
        free, classes = rng.random((7, 7)) < 0.9, rng.integers(0, 2, (7, 7)).astype(np.uint8)
        start, end = rng.integers(0, 7, (2, 2))
        free[start[1], start[0]] = free[end[1], end[0]] = True
        if (start == end).all():
            continue
        line = LineString([start, end])
        expected = np.inf
        if all(free[y, x] for (x, y), cell in cells.items() if line.intersects(cell)):
            # Longer than a touched corner.
            through = [place for place, cell in cells.items() if line.intersection(cell).length > 1e-9]
            expected = np.mean([costs[classes[y, x]] for x, y in through]) * line.length
        num_blocked += np.isinf(expected)
        assert _line_cost(start, end, free, classes, costs) == pytest.approx(expected)
    assert 50 < num_blocked < 250


def test_a_straightened_route_around_a_pond_has_few_corners():
    """Half around a pond of 25 cells, at 27 cells: without the cost of a corner there are eight, not six."""
    y, x = np.mgrid[:61, :61]
    angles = np.linspace(0.0, np.pi, 400)
    ring = np.round(30 + 27 * np.column_stack([np.cos(angles), np.sin(angles)])).astype(np.int64)
    cells = ring[np.any(np.diff(ring, axis=0, prepend=-1), axis=1)]
    assert len(corners_of(cells, np.hypot(x - 30, y - 30) > 25, np.zeros_like(x), np.ones(4))) == 6


def test_people_walk_straight_where_the_ground_allows_it(tmp_path):
    """Along a turned street, round a wall and across a road of a higher cost."""
    street = ("Sidewalks", (0, 0, -0.1), (60, 6, 0.1), 20.0)
    walls = [("Walls", (x, y, 1.0), (0.3, 4.5, 1.0), 20.0) for x, y in ((-20, -9), (18, 9))]
    box_map = map_of(street, ("Roads", (0, 0, -0.05), (3, 20, 0.06)), *walls)
    speeds = {}
    for route in ("straight", "cells"):
        cfg = PedestriansConfig(route=route, road_cost=9, safety_radius_m=0.0)
        ground = walkable_ground(box_map, cfg)
        means = []
        for k in range(6):
            rng = rng_for(0, "pedestrians", str(k))
            start = ground.sample_start(rng)
            (goal,) = ground.sample_goals(start, 100, 200, rng)
            cells = ground.route(start, goal)
            waypoints_m = ground.waypoints_m(cells)
            np.testing.assert_allclose(waypoints_m[[0, -1]], ground.grid.centers_of(cells[[0, -1]]))
            pieces_m = np.linalg.norm(np.diff(waypoints_m, axis=0), axis=1)
            assert 0.3 < pieces_m.min() <= pieces_m.max() < 0.76
            dense_m = np.concatenate([a + np.linspace(0, 1, 50)[:, None] * (b - a) for a, b in pairwise(waypoints_m)])
            x, y = ground.grid.cells_at(dense_m).T
            assert ground.walkable[y, x].all()
            costs_m = [np.repeat(pieces_m / 50, 50) @ ground.costs[ground.footing[y, x]]]
            steps = ground.costs[ground.footing[cells[:, 1], cells[:, 0]]]
            costs_m.append(np.linalg.norm(np.diff(cells, axis=0), axis=1) @ (steps[1:] + steps[:-1]) / 2 * 0.5)
            assert costs_m[0] <= costs_m[1] + 2.0  # the cells of a line are counted whole
            walk = follow_route("p", waypoints_m, 0.0, cfg, np.random.default_rng(0), np.random.default_rng(0), "walk")
            means.append(pieces_m.sum() / walk.time_s[-1])
        speeds[route] = np.mean(means)
    assert speeds["cells"] < 0.7
    assert speeds["straight"] > 1.0


def test_the_stage_writes_paths_report_and_picture(tmp_path):
    write_boxes(tmp_path / "step2_simplified.json", town())
    map_file = tmp_path / "step2_simplified.json"
    roi = tmp_path / "roi.json"
    corners, hole = [[2, 2], [158, 2], [158, 140], [2, 140]], [[60, 60], [100, 60], [100, 100], [60, 100]]
    roi.write_text(json.dumps({"closed": True, "points_world": corners, "holes": [hole]}))
    product = run(PedestriansConfig(num_paths=3), map_file, tmp_path / "out", seed=7, roi=roi)
    paths = read_paths(product)
    assert [p.path_id for p in paths] == ["path_00000", "path_00001", "path_00002"]
    header = json.loads(product.read_text())
    assert (header["map"], header["seed"], header["dt_s"]) == ("Town", 7, 0.5)
    facts = json.loads((tmp_path / "out" / "pedestrians_report.json").read_text())
    assert facts["total"]["paths"] == len(facts["paths"]) == 3
    assert facts["total"]["points"] == sum(len(p.time_s) for p in paths)
    assert facts["ground"]["cells_in_roi"] == 312 * 276 - 80 * 80
    region = Polygon(corners, [hole])
    assert all(contains_xy(region, path.polyline_m).all() for path in paths)
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["counts"] == {"input": 3, "kept": 3, "dropped": {}, "failed": {}}
    steps = {"read", "grid", "project", "inflate", "connectivity", "footing", "sample", "astar", "report"}
    assert set(manifest["seconds_by_step"]) == steps
    picture = cv2.imread(str(tmp_path / "out" / "paths.png"))
    assert picture.shape[1] == 1600
    assert len(np.unique(picture[::7, ::7].reshape(-1, 3), axis=0)) > 5


def test_a_path_that_fails_is_counted_and_the_others_go_on(tmp_path):
    # A yard of 40 m beside a field: starts in the yard have no goal 60 m off.
    box_map = map_of(
        ("Roads", (60.0, 60.0, -0.1), (60.0, 60.0, 0.1)), ("Buildings", (41.0, 60.0, 1.0), (1.0, 60.0, 1.0)),
        ("Buildings", (20.0, 41.0, 1.0), (20.0, 1.0, 1.0)), ("Buildings", (20.0, 80.0, 1.0), (20.0, 38.0, 1.0)),
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
    from cosfly.simplify.passes import SimplifyConfig

    folder = shared_data / "simworld-progen"
    city = load(SimWorldConfig(world=folder / "progen_world.json", sizes=[folder / "Bbox.json"]))
    write_boxes(tmp_path / "map.json", simplify(city, SimplifyConfig()))
    product = run(PedestriansConfig(), tmp_path / "map.json", tmp_path / "out")
    assert len(read_paths(product)) == 20
    ground = json.loads((tmp_path / "out" / "pedestrians_report.json").read_text())["ground"]
    assert ground["component_sizes_used"][0] > 0.9 * ground["cells_walkable"]  # one large walkable component
    assert len(read_boxes(tmp_path / "map.json")) == ground["boxes"]


def test_others_round_trip_and_bad_files(tmp_path):
    path = tmp_path / "others.json"
    walks = Bystander(np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 0.0]]), np.full(2, np.arctan2(3, 4)))
    stands = Bystander(np.tile([1.0, 1.0, 0.0], (2, 1)), np.zeros(2), is_look_alike=True)
    write_bystanders(path, [Bystanders("p", [walks, stands]), Bystanders("q", [])], {"map": "T"})
    first, second = read_bystanders(path)
    assert (first.path_id, second.path_id, second.others) == ("p", "q", [])
    assert [other.is_look_alike for other in first.others] == [False, True]
    np.testing.assert_allclose(first.others[0].positions_m, [[0, 0, 0], [4, 3, 0]])
    np.testing.assert_allclose(first.others[0].headings_rad, np.arctan2(3, 4), atol=1e-5)
    for old, new, words in (
        ('"Pedestrians"', '"Car"', r"paths\[0\]\.others\[0\]\.kind: .*'Car'.*Pedestrians"),
        ('"Pedestrians"', '["Pedestrians"]', r"paths\[0\]\.others\[0\]\.kind"),
        ('"x":[0.0,4.0]', '"x":[0.0]', r"paths\[0\]\.others\[0\]\.y"),
        ('"x":[0.0,4.0]', '"x":[0.0,null]', r"paths\[0\]\.others\[0\]\.x"),
        ('"id":"q"', '"id":7', r"paths\[1\]\.id"),
    ):
        text = path.read_text()
        assert old in text
        (tmp_path / "bad.json").write_text(text.replace(old, new, 1))
        with pytest.raises(InputError, match=words):
            read_bystanders(tmp_path / "bad.json")
    axes = ("x", "y", "z", "yaw")
    change_json(path, lambda value: [value["paths"][0]["others"][1][axis].append(1.0) for axis in axes])
    with pytest.raises(InputError, match=r"paths\[0\]\.others.*|different lengths"):
        read_bystanders(path)


CFG = PedestriansConfig(others=6, look_alikes=2, pace={"walk": 1, "stop_and_look": 1, "turn_back": 1})


@pytest.fixture(scope="module")
def placed():
    boxes = street(reach_m=80.0)
    for x in (-40, 40):
        boxes.add("Buildings", (x, 40), (40, 40), 0.0, 10.0)
    ground = walkable_ground(boxes.box_map(), CFG)
    made = []
    for k in range(4):
        walk = make_pedestrian(f"p{k}", ground, CFG, rng_for(0, "pedestrians", str(k))).trajectory
        made.append((walk, bystanders_of(walk, ground, CFG, rng_for(0, "others", str(k)))))
    return ground, made


def test_people_walk_where_people_walk_and_nobody_meets_anybody(placed):
    ground, made = placed
    assert sum(len(bystanders.others) for _, bystanders in made) >= 20
    for walk, bystanders in made:
        everybody = np.stack([walk.positions_m, *(other.positions_m for other in bystanders.others)])[:, :, :2]
        for k, one in enumerate(everybody):
            assert len(one) == len(walk.time_s)
            for two in everybody[:k]:
                assert gaps_m(one, two[None]).min() >= 0.0
                assert np.linalg.norm(one - two, axis=1).min() >= 0.6
        for other in bystanders.others:
            step_mps = np.linalg.norm(np.diff(other.positions_m, axis=0), axis=1) / np.diff(walk.time_s)
            assert 0.5 < step_mps.max() <= 2.0
            x, y = ground.grid.cells_at(other.positions_m).T
            assert not ground.grid.occupied[y, x].any()


def test_other_numbers_give_other_company_and_more_keep_the_first(placed):
    ground, made = placed
    walk, bystanders = made[0]
    other = bystanders_of(walk, ground, CFG, rng_for(1, "others", "0"))
    assert dump_json(other.as_json()) != dump_json(bystanders.as_json())
    fewer = bystanders_of(walk, ground, CFG.model_copy(update={"others": 2}), rng_for(0, "others", "0"))
    assert [o.as_json() for o in fewer.others] == [o.as_json() for o in bystanders.others[:2]]


@pytest.mark.slow
def test_the_stage_writes_others_only_where_they_are_wanted(tmp_path: Path, caplog):
    write_boxes(tmp_path / "map.json", street(reach_m=80.0).box_map())
    plain = PedestriansConfig(num_paths=3)
    run(plain, tmp_path / "map.json", tmp_path / "none")
    assert not (tmp_path / "none/others.json").exists()
    assert "others" not in json.loads((tmp_path / "none/pedestrians_report.json").read_text())
    cfg = plain.model_copy(update={"others": 3})
    for folder, workers in (("one", 1), ("two", 2)):
        run(cfg, tmp_path / "map.json", tmp_path / folder, workers=workers)
    one, two = ((tmp_path / folder / "others.json").read_bytes() for folder in ("one", "two"))
    assert one == two
    walks, companions = read_paths(tmp_path / "one/path.json"), read_bystanders(tmp_path / "one/others.json")
    assert [walk.path_id for walk in walks] == [bystanders.path_id for bystanders in companions]
    for before, walk in zip(read_paths(tmp_path / "none/path.json"), walks, strict=True):
        np.testing.assert_array_equal(before.positions_m, walk.positions_m)
    counts = json.loads((tmp_path / "one/pedestrians_report.json").read_text())["others"]
    assert counts == {"wanted": 9, "placed": sum(len(bystanders.others) for bystanders in companions)}


def street(*, marked: bool = False, reach_m: float = 40.0) -> BoxList:
    """Two streets of 8 m that cross at the origin, between pavements of 4 m, on a lawn; one has dashes."""
    boxes, middle_m, length_m = BoxList(), (reach_m + 4) / 2, reach_m - 4
    boxes.span("Terrain", (-reach_m, -reach_m), (reach_m, reach_m), -0.4, -0.1)
    for size in (2 * reach_m, 8), (8, 2 * reach_m):
        boxes.add("Roads", (0, 0), size, -0.36, -0.06)
    for sx in (-1, 1):
        for sy in (-1, 1):
            boxes.add("Sidewalks", (sx * middle_m, sy * 6), (length_m, 4), -0.3, 0.0)
            boxes.add("Sidewalks", (sx * 6, sy * middle_m), (4, length_m), -0.3, 0.0)
    for x in (16, 22, 28):
        boxes.add("RoadLines", (x, 0), (3.0, 0.16), -0.1, -0.03)
    for y in np.arange(-3.2, 3.4, 1.2) if marked else ():
        boxes.add("RoadLines", (10, y), (3.0, 0.55), -0.1, -0.03)
    return boxes


def test_points_are_counted_by_where_they_are():
    for way, marked, counts in [
        ([[20.25, -6.25], [20.25, 6.25]], False, (16, 0)),  # straight across, 8 m at two points a metre
        ([[20.25, -6.25], [20.25, 6.25]], True, (16, 0)),  # beside the stripes
        ([[10.25, -6.25], [10.25, 6.25]], True, (0, 16)),
        ([[14.25, 0.25], [34.25, 0.25]], False, (41, 0)),  # along the street
        ([[14.25, 6.25], [34.25, 6.25]], False, (0, 0)),
        ([[-6.25, -6.25], [6.25, 6.25]], False, (16, 0)),  # over the junction from corner to corner
    ]:  # fmt: skip
        start, goal = np.array(way)
        length = np.abs(goal - start).max()
        places = start + np.linspace(0, 1, int(2 * length) + 1)[:, None] * (goal - start)
        walk = PedestrianTrajectory(
            "p", places, np.arange(len(places)) * 0.5, np.pad(places, ((0, 0), (0, 1))), np.ones(len(places))
        )
        cfg = PedestriansConfig(road_cost=20, min_component_cells=100)
        ground = walkable_ground(street(marked=marked).box_map(), cfg)
        assert count_on_road(walk, ground.footing, ground.grid) == counts


def shares(cfg: RunConfig, name: str) -> tuple[float, float]:
    """Shares of the walked points of a town, on carriageway away from crossings and on crossings."""
    town = cfg.of_town(name)
    _, ground, walks = town_walks(town, [None] * town.pedestrians.num_paths)
    counts = np.zeros(3)
    for walk in walks:
        counts += *count_on_road(walk, ground.footing, ground.grid), len(walk.positions_m)
    return counts[0] / counts[2], counts[1] / counts[2]


@pytest.mark.parametrize("name", ["park", *(pytest.param(n, marks=pytest.mark.slow) for n in ("old_town", "river"))])
def test_at_most_a_twentieth_of_the_walked_points_of_shipped_towns_is_on_the_road_away_from_crossings(name):
    away, on_crossings = shares(load(RunConfig, shipped("diverse.yaml")), name)
    assert away <= 0.05
    assert on_crossings > 0.05  # people do cross
    paper, _ = shares(load(RunConfig, shipped("diverse.yaml"), ["pedestrians.road_cost=1"]), name)
    assert paper > 0.1


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(2, 12))
def test_samples_agree_with_a_walk_in_tiny_steps(seed, count):
    rng = np.random.default_rng(seed)
    polyline = np.cumsum(rng.uniform(0.2, 1.0, (count, 2)), axis=0)
    speeds = rng.uniform(0.1, 1.6, count)
    route = TimedRoute(polyline, speeds, np.zeros(count))
    times = route.times_s
    time_s, positions, sampled = route.resample(0.5)
    np.testing.assert_allclose(time_s, 0.5 * np.arange(len(time_s)))
    # The slow way: speed is linear in time between waypoints, the way walked is its integral.
    fine_s = np.linspace(0.0, times[-1], 200_001)
    fine_mps = np.interp(fine_s, times, speeds)
    walked_m = np.concatenate([[0.0], np.cumsum(0.5 * (fine_mps[1:] + fine_mps[:-1]) * np.diff(fine_s))])
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(polyline, axis=0), axis=1))])
    now_s = np.minimum(time_s, times[-1])
    wanted_m = np.interp(now_s, fine_s, walked_m)
    expected = np.column_stack([np.interp(wanted_m, along_m, polyline[:, k]) for k in (0, 1)])
    np.testing.assert_allclose(positions, expected, atol=1e-3)
    np.testing.assert_allclose(sampled, np.interp(now_s, times, speeds), atol=1e-9)
    np.testing.assert_allclose(positions[[0, -1]], polyline[[0, -1]], atol=1e-9)
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() <= 1.6 * 0.5 + 1e-9


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(1, 30), st.sampled_from(sorted(PACES)), st.floats(0.5, 20.0))
def test_every_way_arrives(seed, count, name, cell_m):
    route = np.column_stack([cell_m * np.arange(count + 1), np.zeros(count + 1)])
    polyline, stops = take_pace(route, PACES[name], np.random.default_rng(seed))
    assert np.isfinite(TimedRoute(polyline, np.full(len(stops), 1.2), stops).times_s).all()
    np.testing.assert_array_equal(polyline[0], route[0])
