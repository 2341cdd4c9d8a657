"""Ground: derived where a map has buildings and no streets; made flat where it slopes."""

import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

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

CITY_EAST_M, CITY_NORTH_M, CITY_LOW_M = 2000.0, 340_000.0, 28.0
CITY_SIZE_M = (240.0, 200.0)


def city_height_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height over the datum in a city that rises 18 m to the north-west, bent a little."""
    across = (CITY_SIZE_M[0] - x + y) / (CITY_SIZE_M[0] + CITY_SIZE_M[1])
    return CITY_LOW_M + 18.0 * across + 0.6 * np.sin(x / 30.0)


def sloped_city() -> dict:
    """A CityJSON 2.0 quarter of sixteen houses, three streets and a wall on the slope."""
    vertices: list[list[int]] = []
    objects = {}

    def add(*corners: tuple[float, float, float]) -> list[int]:
        vertices.extend([round(1000 * float(part)) for part in corner] for corner in corners)
        return list(range(len(vertices) - len(corners), len(vertices)))

    def add_sheet(name, kind, low, high, step_m, above_m=0.0, **attributes) -> None:
        """A surface along the ground."""
        xs, ys = (np.linspace(a, b, max(2, round((b - a) / step_m) + 1)) for a, b in zip(low, high, strict=True))
        faces = []
        for (x0, x1), (y0, y1) in itertools.product(itertools.pairwise(xs), itertools.pairwise(ys)):
            places = (x0, y0), (x1, y0), (x1, y1), (x0, y1)
            a, b, c, d = add(*((*place, city_height_m(*place) + above_m) for place in places))
            faces += [[[a, b, c]], [[a, c, d]]]
        sheet = {"type": "MultiSurface", "lod": "1", "boundaries": faces}
        objects[name] = {"type": kind, "attributes": attributes, "geometry": [sheet]}

    for row, column in np.ndindex(4, 4):
        x, y = 20.0 + 55.0 * column, 15.0 + 45.0 * row
        corners = [(x, y), (x + 30.0, y), (x + 30.0, y + 22.0), (x, y + 22.0)]
        foot_m = min(city_height_m(*corner) for corner in corners)  # a flat-roofed house on its lowest foot
        top_m = foot_m + 9.0 + 2.0 * ((row + column) % 3)
        k = add(*((*corner, z) for z in (foot_m, top_m) for corner in corners))
        faces = ([3, 2, 1, 0], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7])
        solid = {"type": "Solid", "lod": "1.2", "boundaries": [[[[k[i] for i in face]] for face in faces]]}
        objects[f"house {row} {column}"] = {"type": "Building", "geometry": [solid]}
    add_sheet("terrain", "TINRelief", (0.0, 0.0), CITY_SIZE_M, 10.0)
    for row in range(3):
        add_sheet(f"street {row}", "Road", (0.0, 43.0 + 45.0 * row), (CITY_SIZE_M[0], 51.0 + 45.0 * row), 8.0)
    add_sheet("wall", "GenericCityObject", (5.0, 20.0), (5.6, 180.0), 5.0, 1.5, bgt_type="muur")
    return {
        "type": "CityJSON", "version": "2.0", "vertices": vertices, "CityObjects": objects,
        "transform": {"scale": [0.001] * 3, "translate": [CITY_EAST_M, CITY_NORTH_M, 0.0]},
    }  # fmt: skip


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
    model = sloped_city()
    of_houses = {name: item for name, item in model["CityObjects"].items() if item["type"] == "Building"}
    path.write_text(json.dumps(model | {"CityObjects": of_houses}))
    cfg = MapsConfig(source="cityjson", cityjson=CityJsonConfig(path=path, credits="Its makers."))
    first, second = (run(cfg, tmp_path / name) for name in ("one", "two"))
    assert first.read_bytes() == second.read_bytes()
    header = read_boxes(first).header
    assert header.derived_ground > 16
    assert header.credits == f"Its makers. {CREDITS}"
    path.write_text(json.dumps(model))
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
