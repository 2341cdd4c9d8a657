"""Step 1: the three sources, their conversions, their errors, and known answers on real maps."""

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import shapely
from benchmarks.census_town import CENSUS, census_town
from shapely.geometry import Point, Polygon, box
from tables import each
from test_cosfly_map_kinds import city as two_houses
from test_cosfly_map_kinds import document, load

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.kinds import KINDS
from cosfly.maps.footprints import united
from cosfly.maps.simworld import SimWorldConfig
from cosfly.maps.stage import MapsConfig, load_map, run
from cosfly.runtime.config import build
from cosfly.runtime.errors import ConfigError, InputError, ResumeError
from cosfly.simplify.passes import SimplifyConfig, simplify
from cosfly.simplify.stage import cross_validate


def boxes_of(box_map: BoxMap, *kinds: str) -> BoxMap:
    return box_map.select(np.isin(box_map.kinds, [KINDS[kind] for kind in kinds]))


def footprint(box_map: BoxMap, row: int, *, with_yaw: bool = True) -> Polygon:
    """The exact oriented rectangle of a box."""
    yaw = float(box_map.rotations_deg[row, 1]) if with_yaw else 0.0
    size = 2 * box_map.half_extents[row, :2]
    x, y = box_map.centers[row, :2]
    return shapely.affinity.rotate(box(x - size[0] / 2, y - size[1] / 2, x + size[0] / 2, y + size[1] / 2), yaw)


@each("seed", [0, 1, 2])
def test_a_town_has_what_the_passes_and_the_walks_need(seed):
    town = load_map(MapsConfig(), seed=seed)
    kinds = set(town.counts())
    assert kinds >= {
        "Roads", "Sidewalks", "Terrain", "RoadLines", "Buildings", "Vegetation", "Poles", "TrafficLight",
        "TrafficSigns",
        "Car", "Truck", "Static", "Fences", "Water",
    }  # fmt: skip
    tops = boxes_of(town, "Buildings").maxs[:, 2]
    assert 20 < tops.max() <= 38
    assert (town.maxs[:, 2] < -0.5).any(), "something to crop below the ground"
    result = simplify(town, SimplifyConfig())
    counts = [sum(c.values()) for _, c in result.passes]
    assert counts[1] < counts[0]  # merged
    assert counts[3] < counts[2]  # below the ground
    assert counts[4] < counts[3]  # nested
    walkable = cross_validate(town, result.box_map)
    assert walkable["simplified_largest_part_m2"] > 45_000
    assert walkable["simplified_largest_part_m2"] > 0.98 * walkable["simplified_walkable_m2"]


@pytest.mark.slow
def test_the_census_town_has_the_papers_counts_and_simplifies_to_a_few_thousand():
    town, other = (census_town("Town", seed) for seed in (0, 1))
    assert town.counts() == other.counts() == CENSUS
    assert len(town) == 65_614
    assert not np.array_equal(town.centers, other.centers)
    low, high = town.bounds()
    np.testing.assert_allclose(high[:2] - low[:2], (619, 506))
    result = simplify(town, SimplifyConfig())
    assert 2000 < len(result.box_map) < 4000
    assert result.box_map.counts()["Vegetation"] < 1000
    assert cross_validate(town, result.box_map)["iou"] > 0.92  # the paper's figure


@each(
    ("given", "words"),
    [({"preset": "rivers"}, "did you mean 'river'"), ({"preset": ["park"]}, "valid string"),
        ({"num_blocks": 6}, "raise size_m")],
)  # fmt: skip
def test_a_wrong_town_is_a_config_error(given, words):
    with pytest.raises(ConfigError, match=words):
        build(MapsConfig, {"synthetic": given}, "x")


def node(name: str, x: float, y: float, yaw: float = 0.0, z: float = 0.0, scale: float = 1.0) -> dict:
    return {
        "id": f"GEN_{name}", "instance_name": name,
        "properties": {
            "location": {"x": x, "y": y, "z": z},
            "orientation": {"pitch": 0, "yaw": yaw, "roll": 0},
            "scale": {"x": scale, "y": scale, "z": scale},
        },
    }  # fmt: skip


def write_world(folder: Path, *nodes: dict, sizes: dict | None = None) -> SimWorldConfig:
    table = {"BP_Building_01_C": (2000, 1000, 3000), "BP_Tree1_C": (800, 600, 1200), "BP_Can_C": (256, 256, 256)}
    groups = {"all": {name: {"bbox": dict(zip("xyz", size, strict=True))} for name, size in (sizes or table).items()}}
    (folder / "world.json").write_text(json.dumps({"base_map": "x", "nodes": list(nodes)}))
    (folder / "Bbox.json").write_text(json.dumps(groups))
    return SimWorldConfig(world=folder / "world.json")


def simworld(cfg: SimWorldConfig) -> BoxMap:
    return load_map(MapsConfig(source="simworld", simworld=cfg))


def test_unreal_axes_become_right_handed_metres(tmp_path: Path):
    city = simworld(write_world(tmp_path, node("BP_Building_01_C", 5000, 3000, yaw=30.0)))
    house = boxes_of(city, "Buildings")
    np.testing.assert_allclose(house.centers, [(50, -30, 15)])
    np.testing.assert_allclose(house.half_extents, [(10, 5, 15)])
    np.testing.assert_allclose(house.rotations_deg, [(0, -30, 0)])


def test_a_building_on_the_road_leaves_a_carriageway(tmp_path: Path):
    city = simworld(write_world(tmp_path, node("BP_Building_01_C", 100, 200), node("BP_Road1_C", 100, 200)))
    assert city.header.roads == {"carriageway_m": 4.0, "front_to_front_m": 6.0}
    with pytest.raises(InputError, match=r"location\.z"):
        simworld(write_world(tmp_path, node("BP_Building_01_C", 0, 0, z=1e300)))


def test_an_asset_without_a_size_is_an_error_or_counted(tmp_path: Path):
    cfg = write_world(tmp_path, node("BP_Building_01_C", 0, 0), node("BP_Building_99_C", 9000, 0))
    with pytest.raises(InputError, match=r"has no size.*BP_Building_99_C.*unknown=drop"):
        simworld(cfg)
    cfg = cfg.model_copy(update={"unknown": "drop"})
    assert simworld(cfg).header.dropped_objects == {"unknown_asset": 1}
    run(MapsConfig(source="simworld", simworld=cfg), tmp_path / "out")
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert manifest["counts"] == {"input": 2, "kept": 1, "dropped": {"unknown_asset": 1}, "failed": {}}


def overlapping_pairs(buildings: BoxMap, *, with_yaw: bool) -> int:
    shapes = [
        footprint(buildings, row, with_yaw=with_yaw).buffer(-0.025, join_style="mitre") for row in range(len(buildings))
    ]
    return sum(one.intersects(other) for one, other in combinations(shapes, 2))


def test_known_answer_no_buildings_overlap_with_yaw_and_19_pairs_without(shared_data: Path):
    city = simworld(SimWorldConfig(world=shared_data / "simworld-progen" / "progen_world.json"))
    buildings = boxes_of(city, "Buildings")
    assert len(buildings) == 66
    assert overlapping_pairs(buildings, with_yaw=True) == 0
    assert overlapping_pairs(buildings, with_yaw=False) == 19
    assert city.counts()["Vegetation"] == 214
    assert city.header.extent_sources | {"road": 0} == {"road": 0, "bbox": 280, "engine": 0, "default": 155}


@pytest.mark.slow
@pytest.mark.parametrize(("world", "pairs"), [("middle_mode_road_20", 24), ("sample_task_dist_11", 27)])
def test_known_answers_of_the_robotics_worlds(shared_data: Path, world: str, pairs: int):
    folder = shared_data / "simworld-robotics"
    sizes = [folder / "Bbox_total.json", shared_data / "simworld-progen" / "Bbox.json"]
    city = simworld(SimWorldConfig(world=folder / world / "progen_world.json", sizes=sizes))
    buildings = boxes_of(city, "Buildings")
    assert overlapping_pairs(buildings, with_yaw=True) == 0
    assert overlapping_pairs(buildings, with_yaw=False) == pairs


def city_model() -> dict:
    model = two_houses()
    model["vertices"] += [[80_000, 60_000, 2000], [110_000, 60_000, 2000], [80_000, 90_000, 2000]]
    model["vertices"] += [[110_000, 90_000, 10_000]]
    surfaces = {"type": "MultiSurface", "lod": "1", "boundaries": [[[20, 21, 22]], [[21, 23, 22]]]}
    model["CityObjects"]["lawn"] = {"type": "PlantCover", "geometry": [surfaces]}
    return model


def city(tmp_path: Path, model: dict) -> BoxMap:
    return load(tmp_path, document(model))


def test_a_city_model_becomes_boxes_round_the_origin(tmp_path: Path):
    boxes = city(tmp_path, city_model())
    assert boxes.header.offset_m == {"x": 110.0, "y": 65.0, "z": 2.0}
    house = boxes_of(boxes, "Buildings")
    np.testing.assert_allclose(np.r_[house.mins[0], house.maxs[0]], (-10, -15, 0, 0, -9, 12), atol=1e-6)
    assert boxes.header.building_area_ratio == pytest.approx(1.0, abs=1e-3)
    roads = boxes_of(boxes, "Roads")
    assert roads.maxs[:, 2].max() <= 0
    assert roads.half_extents.max() <= 30
    assert united([footprint(roads, k) for k in range(len(roads))]).area == pytest.approx(360, rel=0.01)
    trees = boxes_of(boxes, "Vegetation")
    assert len(trees) > 1
    assert (trees.mins[:, 2] == 0).all()
    assert 2.5 < trees.maxs[:, 2].min() < trees.maxs[:, 2].max() <= 8.0
    assert trees.half_extents[:, :2].max() <= 3.0
    assert (boxes.header.dropped_objects, boxes.header.num_objects) == ({"no_geometry": 1}, 5)


def test_courtyards_stay_open(tmp_path: Path):
    model = city_model()
    outer = [[0, 0], [40, 0], [40, 40], [0, 40]]
    inner = [[10, 10], [10, 30], [30, 30], [30, 10]]
    first = len(model["vertices"])
    model["vertices"] += [[1000 * x, 1000 * y, z] for z in (2000, 9000) for x, y in outer + inner]
    roof, floor = ([[first + k + 4 * (2 * level + part) for k in range(4)] for part in (0, 1)] for level in (1, 0))
    model["CityObjects"]["court"] = {
        "type": "BuildingPart",
        "geometry": [{"type": "MultiSurface", "lod": "1", "boundaries": [roof, floor]}],
    }
    boxes = city(tmp_path, model)
    houses = boxes_of(boxes, "Buildings")
    union = united([footprint(houses, k) for k in range(len(houses))])
    court = Point(20 - boxes.header.offset_m["x"], 20 - boxes.header.offset_m["y"])
    assert union.distance(court) > 7  # 10 m, less what a fill of 0.9 may take
    assert 1319.9 < union.area < 1320 / 0.9


def test_stage_writes_the_same_bytes_and_resumes(tmp_path: Path):
    product = run(MapsConfig(), tmp_path / "one", seed=5)
    run(MapsConfig(), tmp_path / "two", seed=5)
    names = ("boxes_3d.json", "map.png")
    first = [(tmp_path / "one" / name).read_bytes() for name in names]
    assert first == [(tmp_path / "two" / name).read_bytes() for name in names]
    for name in ("manifest.json", "map.png"):  # as a kill before the end leaves it
        (tmp_path / "one" / name).unlink()
    run(MapsConfig(), tmp_path / "one", seed=5)
    assert first == [(tmp_path / "one" / name).read_bytes() for name in names]
    with pytest.raises(ResumeError, match="seed was 5, is 6"):
        run(MapsConfig(), tmp_path / "one", seed=6)
    assert read_boxes(product).header.source.seed == 5


def test_surfaces_of_a_town_do_not_share_a_plane():
    town = load_map(MapsConfig())
    for one, other in combinations(("Roads", "Sidewalks", "RoadLines"), 2):
        tops = [boxes_of(town, kind).maxs[:, 2] for kind in (one, other)]
        assert abs(tops[0].max() - tops[1].max()) > 0.015
