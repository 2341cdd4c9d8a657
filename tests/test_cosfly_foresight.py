"""Foresight: lattice, search and smoothing against slow plain versions, and whole flights where looking ahead pays."""

import numpy as np
import pytest
from specimens_planning import WORLDS, scenario_of, town_of, walk_along
from tables import each

from cosfly.geometry import kernels, trajectory_metrics
from cosfly.planners import foresight, smoothing
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import make_scenario, plan_on

CFG = PlanConfig()


def random_town(seed):
    """Forty turned boxes round the origin, some taller than a drone flies, none where the walker goes."""
    rng = np.random.default_rng(seed)
    side = np.where(rng.random(40) < 0.5, -1.0, 1.0)
    centers = np.column_stack([rng.uniform(-70, 90, 40), side * rng.uniform(16, 60, 40), rng.uniform(0, 15, 40)])
    halves = np.column_stack([rng.uniform(0.5, 8, (40, 2)), rng.uniform(0.5, 15, 40)])
    return kernels.obstacle_index(town_of(*zip(centers, halves, rng.uniform(-180, 180, 40), strict=True)))


def straight_scenario(obstacles, length_m=30.0):
    return make_scenario(walk_along("w", [(0, 0), (length_m, 0)]), obstacles, CFG)


def test_the_wished_places_are_in_the_lattice_and_cost_nothing():
    scenario, _ = scenario_of("corner")
    for climbing in (False, True):
        made = foresight.make_lattice(scenario, climbing=climbing)
        requested = scenario.reference.places_m(scenario.targets_m, scenario.ground_m)[made.frames]
        ring = foresight.RINGS.index((0, 0))
        np.testing.assert_allclose(made.places_m[:, ring, 0], requested, atol=1e-9)
        assert (made.costs[:, ring, 0] == 0).all()
        assert (np.delete(made.costs.reshape(len(requested), -1), ring * foresight.NUM_AZIMUTHS, axis=1) > 0).all()
        assert (made.frames[0], made.frames[-1]) == (0, len(scenario.targets_m) - 1)
        away_m = np.hypot(*(made.places_m - scenario.targets_m[made.frames, None, None])[..., :2].T)
        assert made.radius_max_m == pytest.approx(away_m.max())


def cheapest_by_trying_all(places, own, longest_m, index, clearance_m, links, num_azimuths, max_turn, way_cost):
    """The least cost of any sequence of places, each step asked of the kernels."""
    free = kernels.signed_distances(index, places.reshape(-1, 3), 50.0)[0].reshape(own.shape) >= clearance_m
    cost = np.where(free[0], own[0], np.inf)
    for key in range(1, len(places)):
        now = np.full(len(cost), np.inf)
        for c in np.flatnonzero(free[key]):
            for b in np.flatnonzero(np.isfinite(cost)):
                turn = abs(c % num_azimuths - b % num_azimuths)
                length = np.linalg.norm(places[key, c] - places[key - 1, b])
                if min(turn, num_azimuths - turn) > max_turn or b // num_azimuths not in links[c // num_azimuths]:
                    continue
                line = places[key - 1, b][None], places[key, c][None]
                if length > longest_m[key] or kernels.segments_hit(index, *line, clearance_m)[0]:
                    continue
                now[c] = min(now[c], cost[b] + way_cost * length + own[key, c])
        cost = now
    return cost.min()


@each("seed", range(3))
def test_no_sequence_of_places_is_cheaper(seed):
    rng, num_azimuths, obstacles = np.random.default_rng(seed), 8, random_town(seed)
    made = foresight.make_lattice(straight_scenario(obstacles, 6.0), climbing=False)
    places = np.ascontiguousarray(made.places_m[:, :4, ::-4][:, :, :num_azimuths].reshape(len(made.frames), -1, 3))
    own, links = rng.random(places.shape[:2]), made.links[:4, :].clip(max=4)
    links = np.where(links < 4, links, -1)
    links = np.array([sorted(row, key=lambda ring: ring < 0) for row in links])
    gaps = kernels.signed_distances(obstacles, places.reshape(-1, 3), 12.0)[0].reshape(own.shape)
    longest_m = np.full(len(places), 18.0)
    settings = links, num_azimuths, 1, 0.02
    chosen = foresight._cheapest(places, own, gaps, longest_m, obstacles, 3.0, *settings)
    way, keys = places[np.arange(len(places)), chosen], np.arange(len(places))
    cost = own[keys, chosen].sum() + 0.02 * np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    assert cost == pytest.approx(cheapest_by_trying_all(places, own, longest_m, obstacles, 3.0, *settings))


@each("seed", range(3))
def test_smoothing_keeps_sight_and_safety_and_takes_the_jerk(seed):
    obstacles = random_town(seed)
    scenario = straight_scenario(obstacles, 60.0)
    raw = foresight.search_trajectory(scenario, foresight.make_lattice(scenario, climbing=False), obstacles, CFG, 3.0)
    points, facts = smoothing.smooth_trajectory(raw, scenario, obstacles, CFG, 3.0)
    assert facts["smooth"]
    assert not smoothing.unsafe(points, obstacles, 3.0, CFG.speed_max_mps * scenario.dt_s).any()
    assert (points[:, 2] >= 20.0).all()
    seen, seen_raw = (kernels.visibility(obstacles, flight, scenario.targets_m).mean() for flight in (points, raw))
    assert seen >= seen_raw - 0.01
    assert facts["raw_visibility"] == pytest.approx(seen_raw, abs=1e-4)
    assert trajectory_metrics.derivative_rms(points, 3) <= max(0.3 * trajectory_metrics.derivative_rms(raw, 3), 0.05)


@each(
    ("place_m", "velocity_mps"),
    [((-20, 0, 20), (1.2, 0, 0)), ((45, 3, 24), (-6, 0, 2)), ((-60, 0, 30), (-9, 0, 0)), ((5, 2, 12), (0, 0, -2))],
)
def test_a_flight_is_planned_on_from_a_place_and_a_velocity(place_m, velocity_mps):
    box_map, corners = WORLDS["canyon"]
    walk, obstacles = walk_along("canyon", corners), kernels.obstacle_index(box_map)
    targets = walk.positions_m + np.array([0, 0, 0.9])
    flown = np.array(place_m) + np.arange(-9, 1)[:, None] * 0.5 * np.array(velocity_mps, dtype=float)
    points = plan_on("canyon", targets, 0.5, flown, obstacles, CFG)
    np.testing.assert_array_equal(points[: len(flown)], flown)
    ahead, dt_s = points[len(flown) - 3 :], 0.5
    assert np.linalg.norm(np.diff(ahead[2:], axis=0), axis=1).max() <= CFG.speed_max_mps * dt_s + 1e-3
    assert np.linalg.norm(np.diff(ahead, n=2, axis=0), axis=1).max() <= CFG.accel_max_mps2 * dt_s**2 + 1e-3
    assert kernels.swept_distances(obstacles, ahead[2:], 20.0)[0].min() >= CFG.relaxed_safety_m - 0.02
    assert ahead[-1, 2] >= CFG.altitude_min_m - 1e-6
    late = slice(len(flown) + 40, None)  # 20 s later it is where a flight of this style is, and sees the walker
    assert np.linalg.norm((points - targets)[late], axis=1).max() < 40
    assert kernels.visibility(obstacles, points, targets)[late].mean() > 0.95
