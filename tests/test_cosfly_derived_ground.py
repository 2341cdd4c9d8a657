"""Ground: derived where a map has buildings and no streets; made flat where it slopes."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from specimens_slopes import sloped_city

from cosfly.formats.boxes import BoxMap, read_boxes
from cosfly.formats.kinds import GROUND_KINDS, KINDS
from cosfly.geometry.grid import empty_grid, surface_kinds
from cosfly.maps.boxlist import BoxList
from cosfly.maps.cityjson import CityJsonConfig
from cosfly.maps.footprints import CREDITS, NEAR_M, PAVEMENT_M, with_derived_ground
from cosfly.maps.stage import MapsConfig, load_map, run
from cosfly.pedestrians.stage import make_pedestrian
from cosfly.pedestrians.walkable import PedestriansConfig, walkable_ground
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
    cfg = PedestriansConfig(road_cost=20)
    ground = walkable_ground(simplify(box_map, SimplifyConfig()), cfg)
    walks = [make_pedestrian("p", ground, cfg, rng_for(0, "pedestrians", str(k))).trajectory for k in range(20)]
    places = np.concatenate([walk.positions_m for walk in walks])
    x, y = ground.grid.cells_at(places).T
    assert np.isin(ground.footing[y, x], [0, 1]).mean() > 0.95


def test_a_sloping_city_becomes_flat_and_its_buildings_keep_their_heights(tmp_path: Path, caplog):
    path = tmp_path / "city.json"
    path.write_text(json.dumps(sloped_city()))
    box_map = load_map(MapsConfig(source="cityjson", cityjson=CityJsonConfig(path=path)))
    (told,) = (record.message for record in caplog.records if "made flat" in record.message)
    assert 12.0 < float(re.search(r"rises by ([\d.]+) m", told)[1]) < 20.0
    assert box_map.ground_z_m == 0.0
    low, high = box_map.mins[:, 2], box_map.maxs[:, 2]
    houses = box_map.kinds == KINDS["Buildings"]
    assert_allclose(np.unique(np.round(high[houses] - low[houses])), [9.0, 11.0, 13.0])  # as sloped_city makes them
    assert_allclose(low[houses], 0.0, atol=0.01)
    surfaces = box_map.is_any_of(GROUND_KINDS)
    assert surfaces.any()
    assert_allclose(high[surfaces], 0.0, atol=0.11)
    walls = box_map.kinds == KINDS["Walls"]
    assert walls.any()
    assert_allclose(high[walls], 1.5, atol=0.1)
    meshes = box_map.meshes.resolved().values()  # whose roofs are level
    assert sorted({round(float(np.ptp(mesh[..., 2]))) for mesh in meshes}) == [9, 11, 13]
