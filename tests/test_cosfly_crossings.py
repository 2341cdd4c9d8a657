"""cosfly/pedestrians/crossings.py: what is under the feet, what a crossing is, and that walkers keep to it."""

import numpy as np
import pytest
from tables import each

from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.maps.boxlist import BoxList
from cosfly.maps.stage import load_map
from cosfly.pedestrians.bystanders import bystanders_of
from cosfly.pedestrians.crossings import count_on_road
from cosfly.pedestrians.stage import make_pedestrian
from cosfly.pedestrians.walkable import PedestriansConfig, walkable_ground
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load, shipped
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import simplify

CFG = PedestriansConfig(road_cost=20, open_cost=3, min_component_cells=100, min_distance_m=20)


def street(*, marked: bool = False) -> BoxList:
    """Two streets of 8 m that cross at the origin, between pavements of 4 m, on a lawn of 80 m; one has dashes."""
    boxes = BoxList()
    boxes.span("Terrain", (-40, -40), (40, 40), -0.4, -0.1)
    for size in (80, 8), (8, 80):
        boxes.add("Roads", (0, 0), size, -0.36, -0.06)
    for sx in (-1, 1):
        for sy in (-1, 1):
            boxes.add("Sidewalks", (sx * 22, sy * 6), (36, 4), -0.3, 0.0)
            boxes.add("Sidewalks", (sx * 6, sy * 22), (4, 36), -0.3, 0.0)
    for x in (16, 22, 28):
        boxes.add("RoadLines", (x, 0), (3.0, 0.16), -0.1, -0.03)
    for y in np.arange(-3.2, 3.4, 1.2) if marked else ():
        boxes.add("RoadLines", (10, y), (3.0, 0.55), -0.1, -0.03)
    return boxes


@each(("way", "marked", "counts"), [
    ([[20.25, -6.25], [20.25, 6.25]], False, (0, 16)),  # straight across, 8 m at two points a metre
    ([[20.25, -6.25], [20.25, 6.25]], True, (16, 0)),  # beside the stripes
    ([[10.25, -6.25], [10.25, 6.25]], True, (0, 16)),
    ([[14.25, 0.25], [34.25, 0.25]], False, (41, 0)),  # along the street
    ([[14.25, 6.25], [34.25, 6.25]], False, (0, 0)),
    ([[-6.25, -6.25], [6.25, 6.25]], False, (16, 0)),  # over the junction from corner to corner
])  # fmt: skip
def test_points_are_counted_by_where_they_are_and_which_way_they_go(way, marked, counts):
    start, goal = np.array(way)
    length = np.abs(goal - start).max()
    places = start + np.linspace(0, 1, int(2 * length) + 1)[:, None] * (goal - start)
    walk = PedestrianTrajectory(
        "p", places, np.arange(len(places)) * 0.5, np.pad(places, ((0, 0), (0, 1))), np.ones(len(places))
    )
    ground = walkable_ground(street(marked=marked).box_map(), CFG)
    assert count_on_road(walk, ground.footing, ground.grid) == counts


def shares(cfg: RunConfig, name: str, num_others: int = 0) -> tuple[float, float]:
    """Shares of the walked points of a town, on carriageway away from crossings and on crossings; the others' too."""
    town = cfg.of_town(name)
    walking = town.pedestrians.model_copy(update={"others": num_others})
    ground = walkable_ground(simplify(load_map(town.maps, seed=town.seed), town.simplify).box_map, walking)
    counts = np.zeros(3)
    for k in range(walking.num_paths):
        rng = rng_for(town.seed, "pedestrians", f"path_{k:05d}")
        walk = make_pedestrian(f"path_{k:05d}", ground, walking, rng).trajectory
        everybody = [walk.positions_m]
        if num_others:
            everybody += [other.positions_m for other in bystanders_of(walk, ground, [], walking, rng).others]
        for places in everybody:
            moves = np.r_[True, np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1) > 1e-6]
            line = walk.polyline_m if places is walk.positions_m else places[moves, :2]
            one = PedestrianTrajectory("p", line, walk.time_s, places, walk.speeds_mps)
            counts += *count_on_road(one, ground.footing, ground.grid), len(places)
    return counts[0] / counts[2], counts[1] / counts[2]


@pytest.mark.parametrize("name", ["park", *(pytest.param(n, marks=pytest.mark.slow) for n in ("old_town", "river"))])
def test_at_most_a_twentieth_of_the_walked_points_of_shipped_towns_is_on_the_road_away_from_crossings(name):
    away, on_crossings = shares(load(RunConfig, shipped("diverse.yaml")), name)
    assert away <= 0.05
    assert on_crossings > 0.05  # people do cross
    paper, _ = shares(load(RunConfig, shipped("diverse.yaml"), ["pedestrians.road_cost=1"]), name)
    assert paper > 0.1
