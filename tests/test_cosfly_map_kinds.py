"""Kinds of maps as they are met outside: one table of city models in every form; the next such case is added to it."""

import copy
import gzip
import json
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import shapely
from benchmarks.census_town import CENSUS, census_town
from shapely.geometry import Point

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS
from cosfly.maps.cityjson import CityJsonConfig
from cosfly.maps.footprints import footprints, united
from cosfly.maps.simworld import SimWorldConfig
from cosfly.maps.stage import MapsConfig, load_map, run
from cosfly.runtime.errors import InputError
from cosfly.simplify.passes import SimplifyConfig, simplify
from cosfly.simplify.stage import cross_validate

Model = dict


def prism(x: float, y: float, top: float) -> tuple[list, list]:
    """Vertices, mm, and the outer shell of a house of 10 x 6 m on the ground at 2 m."""
    corners = [(x, y), (x + 10, y), (x + 10, y + 6), (x, y + 6)]
    vertices = [[round(1000 * c) for c in (*corner, z)] for z in (2.0, top) for corner in corners]
    return vertices, [[[3, 2, 1, 0]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]


def counted_from(value: list | int, first: int) -> list | int:
    """Boundaries that begin at another vertex."""
    return [counted_from(item, first) for item in value] if isinstance(value, list) else value + first


def city() -> Model:
    """CityJSON 2.0: a building whose part has the walls, a second house, a road."""
    house, shell = prism(100.0, 50.0, 14.0)
    other, _ = prism(120.0, 50.0, 8.0)
    road = [[80_000, 40_000, 2000], [140_000, 40_000, 2000], [140_000, 46_000, 2000], [80_000, 46_000, 2000]]
    solid = {"type": "Solid", "lod": "1.2"}
    return {
        "type": "CityJSON", "version": "2.0",
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"},
        "transform": {"scale": [0.001] * 3, "translate": [0.0, 0.0, 0.0]}, "vertices": house + other + road,
        "CityObjects": {
            "house": {"type": "Building", "children": ["part"]},
            "part": {"type": "BuildingPart", "parents": ["house"], "geometry": [solid | {"boundaries": [shell]}]},
            "other": {"type": "Building", "geometry": [solid | {"boundaries": [counted_from(shell, 8)]}]},
            "road": {
                "type": "Road",
                "geometry": [{"type": "MultiSurface", "lod": "1", "boundaries": [[[16, 17, 18, 19]]]}],
            },
        },
    }  # fmt: skip


def document(model: Model) -> bytes:
    return json.dumps(model).encode()


def v11_with_a_group(model: Model) -> Model:
    model = copy.deepcopy(model) | {"version": "1.1"}
    model["CityObjects"]["quarter"] = {"type": "CityObjectGroup", "children": ["house", "other"]}
    return model


def with_an_outline(model: Model) -> Model:
    """As 3D BAG has it: the building has its outline at level 0, its part the walls."""
    model = copy.deepcopy(model)
    model["CityObjects"]["house"]["geometry"] = [{"type": "MultiSurface", "lod": "0", "boundaries": [[[0, 1, 2, 3]]]}]
    return model


def in_a_composite(model: Model) -> Model:
    """The second house one solid of several, below an outline of level 0."""
    model = copy.deepcopy(model) | {"version": "1.1"}
    (solid,) = model["CityObjects"]["other"]["geometry"]
    outline = {"type": "MultiSurface", "lod": "0", "boundaries": [solid["boundaries"][0][0]]}
    several = solid | {"type": "CompositeSolid", "boundaries": [solid["boundaries"]]}
    model["CityObjects"]["other"]["geometry"] = [outline, several]
    return model


def sequence(model: Model, end: str = "\n", start: str = "") -> bytes:
    """A text sequence: first the document without objects, then features with vertices of their own."""
    head = {key: value for key, value in model.items() if key not in ("CityObjects", "vertices")}
    lines = [head | {"CityObjects": {}, "vertices": []}]
    for number, names in enumerate((("house", "part"), ("other",), ("road",)), 1):
        objects = copy.deepcopy({name: model["CityObjects"][name] for name in names})
        for geometry in (g for value in objects.values() for g in value.get("geometry", [])):
            geometry["boundaries"] = counted_from(geometry["boundaries"], number)
        vertices = number * model["vertices"][:1] + model["vertices"]
        lines.append({"type": "CityJSONFeature", "id": names[0], "CityObjects": objects, "vertices": vertices})
    return "".join(start + json.dumps(line) + end for line in lines).encode()


# name -> what makes the file's bytes of city(); LEFT_OUT: what is left out but for one object without geometry
FORMS: dict[str, Callable[[Model], bytes]] = {
    "2.0 printed over many lines": lambda m: json.dumps(m, indent=2).encode(),
    "2.0 with an outline": lambda m: document(with_an_outline(m)),
    "1.1 with a group": lambda m: document(v11_with_a_group(m)),
    "1.1 gzipped, a composite": lambda m: gzip.compress(document(in_a_composite(m)), mtime=0),
    "1.1.3": lambda m: document(copy.deepcopy(m) | {"version": "1.1.3"}),
    "sequence 1.1": lambda m: sequence(m | {"version": "1.1"}),
    "sequence with CR LF": lambda m: sequence(m, "\r\n"),
    "sequence with blank lines": lambda m: sequence(m, "\n\n"),
    "sequence after RFC 7464": lambda m: sequence(m, start="\x1e"),
    "sequence gzipped": lambda m: gzip.compress(sequence(m), mtime=0),
    "sequence that repeats a feature": lambda m: sequence(m) + sequence(m).splitlines()[2] + b"\n",
    "sequence whose document holds the road": lambda m: b"\n".join(
        [document(m | {"CityObjects": {"road": m["CityObjects"]["road"]}}), *sequence(m).splitlines()[1:3]]
    ),
}
LEFT_OUT = {
    "2.0 with an outline": {"outline_of_parts": 1},
    "1.1 with a group": {"no_geometry": 1, "group": 1},
    "sequence that repeats a feature": {"no_geometry": 1, "repeated_id": 1},
}


def load(tmp_path: Path, data: bytes, **settings: object) -> BoxMap:
    path = tmp_path / "model.city"
    path.write_bytes(data)
    return load_map(MapsConfig(source="cityjson", cityjson=CityJsonConfig(path=path, **settings)))


@pytest.mark.slow
def test_every_form_of_a_city_model_gives_the_same_map(tmp_path: Path, subtests):
    plain = load(tmp_path, document(city()))
    assert plain.counts()["Buildings"] == 2
    for form, write in FORMS.items():
        with subtests.test(form):
            found, dropped = load(tmp_path, write(city())), LEFT_OUT.get(form, {"no_geometry": 1})
            np.testing.assert_allclose(np.sort(found.mins, axis=0), np.sort(plain.mins, axis=0), atol=1e-6)
            np.testing.assert_allclose(np.sort(found.maxs, axis=0), np.sort(plain.maxs, axis=0), atol=1e-6)
            assert found.counts() == plain.counts()
            assert found.header.offset_m == plain.header.offset_m
            assert found.header.dropped_objects == dropped
            assert found.header.num_objects == 3 + sum(dropped.values())
    model = with_an_outline(city())
    model["CityObjects"]["house"]["children"] = ["somewhere else"]
    assert "outline_of_parts" not in load(tmp_path, document(model)).header.dropped_objects, "parts are not in the file"


def test_an_older_city_model_is_refused_with_the_command_that_upgrades_it(tmp_path: Path):
    for version in ("0.8", "1.0", "3.0", None):
        with pytest.raises(InputError, match=r"version.*1\.1 or 2\.0.*cjio OLD upgrade"):
            load(tmp_path, document(city() | {"version": version}))


@pytest.mark.slow
def test_a_real_sequence_of_buildings_is_read(shared_data: Path):
    path = shared_data / "tudelft-3dbag" / "extension.city.jsonl.gz"
    box_map, coarse = (
        load_map(MapsConfig(source="cityjson", cityjson=CityJsonConfig(path=path, solids=solids, derive_ground=False)))
        for solids in (True, False)
    )
    assert box_map.header.num_objects == 199
    assert box_map.header.dropped_objects == {"outline_of_parts": 99}
    assert set(box_map.kinds) == {KINDS["Buildings"]}
    assert coarse.maxs[:, 2].max() == pytest.approx(26.396 + 0.075, abs=1e-3)  # at level 1.2
    assert box_map.maxs[:, 2].max() == pytest.approx(76.224 + 0.075, abs=1e-3)  # as drawn, at level 2.2


def boxes_of(box_map: BoxMap, *kinds: str) -> BoxMap:
    return box_map.select(np.isin(box_map.kinds, [KINDS[kind] for kind in kinds]))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_town_has_what_the_passes_and_the_walks_need(seed):
    town = load_map(MapsConfig(), seed=seed)
    assert town.header.source.seed == seed
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
    counts = [sum(one.counts.values()) for one in result.header.passes]
    assert counts[1] < counts[0]  # merged
    assert counts[3] < counts[2]  # below the ground
    assert counts[4] < counts[3]  # nested
    walkable = cross_validate(town, result)
    assert walkable["simplified_largest_part_m2"] > 45_000
    assert walkable["simplified_largest_part_m2"] > 0.98 * walkable["simplified_walkable_m2"]


@pytest.mark.slow
def test_the_census_town_has_the_papers_counts_and_simplifies_to_a_few_thousand():
    town, other = (census_town("Town", seed) for seed in (0, 1))
    assert town.counts() == other.counts() == CENSUS
    assert not np.array_equal(town.centers, other.centers)
    low, high = town.bounds()
    np.testing.assert_allclose(high[:2] - low[:2], (619, 506))
    result = simplify(town, SimplifyConfig())
    assert 2000 < len(result) < 4000
    assert result.counts()["Vegetation"] < 1000
    assert cross_validate(town, result)["iou"] > 0.92  # the paper's figure


def node(name: str, x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> dict:
    return {
        "id": f"GEN_{name}", "instance_name": name,
        "properties": {
            "location": {"x": x, "y": y, "z": z},
            "orientation": {"pitch": 0, "yaw": yaw, "roll": 0}, "scale": {"x": 1.0, "y": 1.0, "z": 1.0},
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


def test_an_asset_without_a_size_is_an_error_or_counted(tmp_path: Path, caplog):
    cfg = write_world(tmp_path, node("BP_Building_01_C", 0, 0), node("BP_Building_99_C", 9000, 0))
    with pytest.raises(
        InputError, match=r"GEN_BP_Building_99_C: the asset BP_Building_99_C has no size.*simworld.sizes"
    ):
        simworld(cfg)
    cfg = cfg.model_copy(update={"most_skipped": 0.5})
    assert simworld(cfg).header.dropped_objects == {"unknown_asset": 1}
    assert "the asset BP_Building_99_C has no size" in caplog.text
    run(MapsConfig(source="simworld", simworld=cfg), tmp_path / "out")
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert manifest["counts"] == {"input": 2, "kept": 1, "dropped": {"unknown_asset": 1}, "failed": {}}


def overlapping_pairs(buildings: BoxMap, *, with_yaw: bool) -> int:
    upright = replace(buildings, rotations_deg=buildings.rotations_deg * with_yaw)
    shapes = shapely.buffer(footprints(upright), -0.025, join_style="mitre")
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
    model = city()
    model["vertices"] += [[80_000, 60_000, 2000], [110_000, 60_000, 2000], [80_000, 90_000, 2000]]
    model["vertices"] += [[110_000, 90_000, 10_000]]
    surfaces = {"type": "MultiSurface", "lod": "1", "boundaries": [[[20, 21, 22]], [[21, 23, 22]]]}
    model["CityObjects"]["lawn"] = {"type": "PlantCover", "geometry": [surfaces]}
    return model


def test_a_city_model_becomes_boxes_round_the_origin(tmp_path: Path):
    boxes = load(tmp_path, document(city_model()))
    assert boxes.header.offset_m == {"x": 110.0, "y": 65.0, "z": 2.0}
    house = boxes_of(boxes, "Buildings")
    np.testing.assert_allclose(np.r_[house.mins[0], house.maxs[0]], (-10, -15, 0, 0, -9, 12), atol=1e-6)
    roads = boxes_of(boxes, "Roads")
    assert roads.maxs[:, 2].max() <= 0
    assert roads.half_extents.max() <= 30
    assert united([*footprints(roads)]).area == pytest.approx(360, rel=0.01)
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
    boxes = load(tmp_path, document(model))
    houses = boxes_of(boxes, "Buildings")
    union = united([*footprints(houses)])
    court = Point(20 - boxes.header.offset_m["x"], 20 - boxes.header.offset_m["y"])
    assert union.distance(court) > 7  # 10 m, less what a fill of 0.9 may take
    assert 1319.9 < union.area < 1320 / 0.9


def outlines(**attributes: object) -> Model:
    """A city of footprints without heights, and a road."""
    model = with_an_outline(city())
    (outline,) = model["CityObjects"]["house"]["geometry"]
    model["CityObjects"] = {
        "a": {"type": "Building", "attributes": attributes, "geometry": [outline]},
        "b": {"type": "Building", "attributes": {"measuredHeight": 7.5}, "geometry": [
            outline | {"boundaries": counted_from(outline["boundaries"], 8)}]},
        "road": model["CityObjects"]["road"],
    }  # fmt: skip
    return model


def test_declared_heights_raise_footprints(tmp_path):
    for attributes, height_m in [
        ({"measuredHeight": 9}, 9.0),
        ({"measuredHeight": "9 m"}, 9.0),
        ({"measuredHeight": {"value": 30, "uom": "m"}}, 30.0),
        ({"storeysAboveGround": 4}, 12.0),
        ({"measuredHeight": None, "storeysAboveGround": 2}, 6.0),
        ({}, None),
        ({"measuredHeight": -3}, None),
        ({"measuredHeight": "high"}, None),
        ({"measuredHeight": 1e9}, None),
    ]:
        box_map = load(tmp_path, document(outlines(**attributes)))
        header, standing = box_map.header, box_map.select(box_map.kinds == KINDS["Buildings"])
        heights = [7.5] if height_m is None else [height_m, 7.5]
        np.testing.assert_allclose(2 * standing.half_extents[:, 2], heights)
        assert header.dropped_objects == ({"no_height": 1} if height_m is None else {})
        assert len(box_map.meshes.refs) == len(heights)


def test_units_of_a_city_model_are_used_or_refused_by_name(tmp_path, subtests):
    def declared(text: object) -> bytes:
        return document(city() | {"metadata": {"referenceSystem": text}})

    root = "https://www.opengis.net/def/crs/EPSG/0/"
    for text in (f"{root}28992", "urn:ogc:def:crs:EPSG::7415", None):
        assert len(load(tmp_path, declared(text))) > 2
    for text in (f"{root}2263", f"{root}4979", "urn:ogc:def:crs,crs:EPSG::2263,crs:EPSG::6360", "NAD83 (ftUS)", 3857):
        with (
            subtests.test(text),
            pytest.raises(InputError, match=r"referenceSystem: the declared.*maps\.cityjson\.units"),
        ):
            load(tmp_path, declared(text))
    metres = load(tmp_path, declared(None))
    feet = load(tmp_path, declared(f"{root}2263"), units="ft")
    np.testing.assert_allclose(feet.half_extents[:2, :2], 0.3048 * metres.half_extents[:2, :2], atol=1e-6)


def test_a_bad_object_is_skipped_and_counted_and_an_empty_map_is_an_error(tmp_path, caplog):
    for number, spoil in enumerate((
        lambda item: item["geometry"][0].update(boundaries=[[[[0, 1, 999]]]]),
        lambda item: item["geometry"][0].update(boundaries="x"),
        lambda item: item.update(type=5),
        lambda item: item.update(geometry=None),
    )):  # fmt: skip
        model = city()
        for k in range(5):
            model["CityObjects"][f"more {k}"] = copy.deepcopy(model["CityObjects"]["other"])
        spoil(model["CityObjects"]["more 4"])
        header = load(tmp_path, document(model)).header
        reason = {"no_geometry": 2} if number == 3 else {"no_geometry": 1, "invalid": 1}
        assert header.dropped_objects == reason
    assert "CityObjects.more 4" in caplog.text
    model["vertices"].append([10**10, 0, 0])
    model["CityObjects"]["more 4"] |= {"type": "Building", "geometry": [
        {"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, len(model["vertices"]) - 1]]]}]}  # fmt: skip
    assert load(tmp_path, document(model)).header.dropped_objects == {"no_geometry": 1, "far_away": 1}
    assert "skipped: more 4: it is more than 20 km" in caplog.text
    model["CityObjects"] = {"wall": {"type": "Building", "geometry": [
        {"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, 5, 4]]]}]}}  # fmt: skip
    (tmp_path / "upright.json").write_bytes(document(model))
    cfg = MapsConfig(source="cityjson", cityjson=CityJsonConfig(path=tmp_path / "upright.json"))
    with pytest.raises(InputError, match="the map has no boxes; got 1 objects, dropped: no_footprint 1"):
        run(cfg, tmp_path / "out")
    assert not (tmp_path / "out/boxes_3d.json").exists()


@pytest.mark.parametrize("kind", ["PlantCover", "Road", "WaterBody", "Bridge"])
def test_a_vast_surface_gets_larger_pieces(tmp_path, kind):
    """One polygon of 20 km made 65,536 boxes in 90 s, or took 7 GB."""
    corners = [[0, 0, 9000], [19_999_000, 0, 9000], [19_999_000, 19_999_000, 9000], [0, 19_999_000, 9000]]
    geometry = {"type": "MultiSurface", "lod": "1", "boundaries": [[[0, 1, 2, 3]]]}
    model = city() | {"vertices": corners, "CityObjects": {"p": {"type": kind, "geometry": [geometry]}}}
    box_map = load(tmp_path, document(model), derive_ground=False)
    assert 500 < len(box_map) < 5_000
    np.testing.assert_allclose(
        np.ptp([box_map.mins.min(axis=0), box_map.maxs.max(axis=0)], axis=0)[:2], 19_999, rtol=0.01
    )
