"""cosfly/closed_loop/stepper.py: what a command does, what is seen then, and how a flight ends."""

import numpy as np
import pytest
from specimens_planning import CANYON, town_of, walk_along

from cosfly.closed_loop.settings import Drone
from cosfly.closed_loop.stepper import Airspace, ClosedLoopTrajectory
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_trajectory
from cosfly.render.settings import RenderConfig

LOOK = {"width_px": 160, "height_px": 90, "fovs_deg": (90.0,)}
PITCH_DEG = -44.0


@pytest.fixture(scope="module")
def airspace():
    town = town_of(*CANYON)
    airspace = Airspace(RenderConfig(**LOOK), town, town, seed=1)
    yield airspace
    airspace.renderer.close()


@pytest.fixture(scope="module")
def planned(airspace):
    walk = walk_along("path_00000", [(0, 0), (100, 0)])
    return plan_trajectory(walk, airspace.surroundings.obstacles, PlanConfig(), 1)


def flown(flight: ClosedLoopTrajectory, *commands) -> list:
    moments = list(flight.reset())
    for command in commands:
        if flight.ended is None:
            moments.append(flight.step(np.array([*command, PITCH_DEG])))
    return moments


def test_the_same_commands_give_the_same_flight_and_the_same_pictures_whatever_was_flown_beside_it(airspace, planned):
    commands = [(1.2, 0.3, 0.1, 4.0), (2.0, 0, 0, -8.0), (0, 0, 0, 0)]
    first = flown(ClosedLoopTrajectory(airspace, planned), *commands)
    other = ClosedLoopTrajectory(airspace, planned)
    again = []
    for moment in flown(ClosedLoopTrajectory(airspace, planned), *commands):
        again.append(moment)
        other.reset()
    for one, two in zip(first, again, strict=True):
        assert np.array_equal(one.position_m, two.position_m)
        assert np.array_equal(one.rotation_deg, two.rotation_deg)
        assert np.array_equal(one.frame.rgb, two.frame.rgb)
        assert one.target.model_dump() == two.target.model_dump()


def test_a_held_command_is_reached_as_fast_as_the_drone_can_and_no_faster(airspace, planned):
    drone = Drone(accel_max_mps2=2.0, yaw_accel_max_degps2=20.0)
    flight = ClosedLoopTrajectory(airspace, planned, drone=drone)
    moments = flown(flight, *[(0.0, 0.0, 1.0, 20.0)] * 6)[4:]
    velocities = np.array([m.velocity_mps for m in moments])
    assert np.linalg.norm(np.diff(velocities, axis=0), axis=1).max() <= 2.0 * flight.dt_s + 1e-9
    assert velocities[-1] == pytest.approx([0, 0, 1.0])
    yaws = np.unwrap([m.rotation_deg[1] for m in moments], period=360.0)
    assert yaws[-1] - yaws[-2] == pytest.approx(20.0 * flight.dt_s)
    assert moments[-1].position_m[2] - moments[-2].position_m[2] == pytest.approx(0.5)


def test_velocities_are_in_the_axes_of_the_drone(airspace, planned):
    flight = ClosedLoopTrajectory(airspace, planned)
    moments = flown(flight, *[(0.0, 1.0, 0.0, 0.0)] * 4)
    yaw = np.radians(moments[-1].rotation_deg[1])
    assert moments[-1].velocity_mps == pytest.approx([-np.sin(yaw), np.cos(yaw), 0.0], abs=1e-6)


def test_who_flies_into_the_ground_or_a_house_has_crashed_before_it_and_flies_no_more(airspace, planned):
    for command in ((0, 0, -4.0, 0), (0, 8.0, -2.0, 0)):
        flight = ClosedLoopTrajectory(airspace, planned)
        last = flown(flight, *[command] * 40)[-1]
        assert flight.ended == "crashed"
        assert last.clearance_m < flight.drone.radius_m
        assert last.position_m[2] > 0
        assert abs(last.position_m[1]) < 8  # the houses begin there
        with pytest.raises(ValueError, match="ended with 'crashed'"):
            flight.step(np.zeros(5))


def test_who_leaves_the_person_is_lost_and_who_leaves_the_map_has_left(airspace, planned):
    flight = ClosedLoopTrajectory(airspace, planned, lost_s=2.0)
    flown(flight, *[(0, 0, 0, 60.0)] * 3, *[(0, 0, 0, 0.0)] * 20)
    assert flight.ended == "lost"
    small = ClosedLoopTrajectory(airspace, planned)
    small.airspace.bounds_m, kept = (np.full(3, 0.0), np.full(3, 1.0)), small.airspace.bounds_m
    try:
        flown(small, *[(-10.0, 0, 4.0, 0)] * 40)
    finally:
        small.airspace.bounds_m = kept
    assert small.ended == "left"
