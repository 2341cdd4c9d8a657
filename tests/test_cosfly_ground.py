"""The map's header owns the ground's height: a town lifted by 2 m gives the same walks, flights, pictures, 2 m up."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from cosfly.geometry import intrinsic_matrix, world_from_camera
from cosfly.maps.synthetic import SyntheticConfig, load
from cosfly.pedestrians.stage import PedestriansConfig, make_walk, walkable_ground
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_flight
from cosfly.products.boxes import BoxMap, read_boxes, write_boxes
from cosfly.products.kinds import KINDS
from cosfly.render.contract import GROUND_PLANE_DROP_M
from cosfly.render.stage import open_renderer
from cosfly.simplify.passes import SimplifyConfig, simplify
from cosfly.simplify.stage import report
from cosfly.space.kernels import obstacle_index
from cosfly.work.chance import rng_for

LIFT_M = 2.0
LIFT = np.array([0.0, 0.0, LIFT_M])


def lifted(box_map: BoxMap) -> BoxMap:
    header = box_map.header.model_copy(update={"ground_z_m": LIFT_M})
    return replace(box_map, centers=box_map.centers + LIFT, header=header)


@pytest.fixture(scope="module")
def towns(tmp_path_factory) -> tuple[BoxMap, BoxMap]:
    """A small town at 0 m, and the same at 2 m, read back from their files."""
    folder = tmp_path_factory.mktemp("towns")
    town = load(SyntheticConfig(size_m=150.0, num_blocks=1), 3)
    for name, box_map in (("low", town), ("high", lifted(town))):
        write_boxes(folder / f"{name}.json", box_map)
    return read_boxes(folder / "low.json"), read_boxes(folder / "high.json")


def test_simplify_counts_heights_from_the_ground(towns):
    for cfg in (SimplifyConfig(crop_strategy="adaptive", below_ground="clip"), SimplifyConfig()):
        low, high = (simplify(town, cfg) for town in towns)
        assert low.passes == high.passes
        assert high.box_map.header.ground_z_m == LIFT_M
        assert_allclose(high.box_map.centers, low.box_map.centers + LIFT, atol=1e-9)
    assert report(towns[1], high, cfg) == report(towns[0], low, cfg)


def test_walks_flights_and_pictures_stand_on_the_ground(towns):
    flights = []
    for town in towns:
        simplified = simplify(town, SimplifyConfig()).box_map
        cfg = PedestriansConfig(min_distance_m=20.0, max_distance_m=40.0, min_component_cells=400)
        walk = make_walk(
            "path_00000", walkable_ground(simplified, cfg), cfg, rng_for(0, "pedestrians", "path_00000")
        ).walk
        flights.append((town, walk, plan_flight(walk, obstacle_index(simplified), PlanConfig(), 0)))
    (_, low, low_flight), (_, high, high_flight) = flights
    assert (low.positions_m[:, 2] == 0.0).all()
    assert (high.positions_m[:, 2] == LIFT_M).all()
    assert_allclose(high.positions_m[:, :2], low.positions_m[:, :2])
    assert low_flight.metrics["altitude_mean_m"] == pytest.approx(20.0, abs=3.0)
    assert high_flight.metrics["altitude_mean_m"] == pytest.approx(low_flight.metrics["altitude_mean_m"], abs=0.1)
    assert_allclose(high_flight.positions_m, low_flight.positions_m + LIFT, atol=0.1)

    frames = []
    for number, (town, _, _) in enumerate(flights):
        eye = np.array([-60.0, -90.0, 12.0 + number * LIFT_M])  # outside the town, so that the ground plane is seen
        renderer = open_renderer("gl", town, 96, 54)
        frames.append(
            renderer.render(world_from_camera(eye, np.array([-15.0, 60.0, 0.0])), intrinsic_matrix(96, 54, 70.0), None)
        )
        renderer.close()
    assert_allclose(frames[1].depth, frames[0].depth, atol=0.01)
    assert (frames[1].ids == frames[0].ids).all()
    assert (frames[0].ids == 0).sum() > 500  # the plane


def test_a_map_without_ground_boxes_has_its_plane_at_the_headers_height(towns):
    bare = towns[1].select(towns[1].kinds == KINDS["Buildings"])
    renderer = open_renderer("gl", bare, 32, 32)
    down = world_from_camera(np.array([500.0, 500.0, 12.0]), np.array([-90.0, 0.0, 0.0]))
    depth = renderer.render(down, intrinsic_matrix(32, 32, 20.0), None).depth
    renderer.close()
    assert_allclose(depth, 12.0 - LIFT_M + GROUND_PLANE_DROP_M, atol=1e-3)
