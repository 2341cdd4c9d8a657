"""TA*+Smooth: sight and search against slow plain versions, whole flights over hand-made maps."""

import itertools

import numpy as np
import pytest
from specimens_planning import WORLDS, first_points, walk_along

import cosfly.planners.stage as planners
from cosfly.geometry import kernels
from cosfly.planners import track_astar
from cosfly.planners.contract import PlanConfig, TrackAStarConfig


def cost_of(places, targets, obstacles, cfg, start):
    """The cost of a sequence of places, straight from the docstring of the module."""
    s, total = cfg.track_astar, 0.0
    for k, (p, x) in enumerate(zip(places, targets, strict=True)):
        aside, climb = np.hypot(*(p - x)[:2]) - cfg.behind_distance_m, p[2] - cfg.altitude_preferred_m
        total += s.weight_tracking * np.hypot(aside, climb) / s.voxel_m
        total += s.weight_visibility * (1 - kernels.visibility(obstacles, p[None], x[None])[0])
        gap = kernels.signed_distances(obstacles, p[None])[0][0]
        total += s.weight_safety * max(0, 1 - gap / s.influence_m) ** 2
        total += s.weight_path * np.linalg.norm(p - (places[k - 1] if k else start)) / s.voxel_m
        before = places[k - 1] - places[k - 2] if k > 1 else np.zeros(3)
        total += s.weight_smoothness * (((p - places[k - 1] - before) / s.voxel_m) ** 2).sum() if k else 0.0
    return total


def exhaustive(voxels, targets, obstacles, cfg, start):
    """The cheapest way over all cells and layers, without smoothness, by plain dynamic programming."""
    cells = [c for c in itertools.product(*map(range, voxels.shape)) if voxels.columns[c[0], c[1]]]
    places = voxels.low + np.array(cells) * voxels.size
    free = kernels.signed_distances(obstacles, places)[0] >= cfg.safety_distance_m
    steps = np.abs(np.array(cells)[:, None] - np.array(cells)[None]).max(axis=2) <= 1
    starts, ends = np.nonzero(steps)
    hit = kernels.segments_hit(obstacles, places[starts], places[ends], cfg.safety_distance_m)
    way = np.full(steps.shape, np.inf)
    way[starts, ends] = np.linalg.norm(places[starts] - places[ends], axis=1) / cfg.track_astar.voxel_m
    way[starts[hit], ends[hit]] = np.inf

    def own(target):
        only = [cost_of(p[None], target[None], obstacles, cfg, p) for p in places]
        return np.where(free, only, np.inf)

    cost = own(targets[0]) + np.linalg.norm(places - start, axis=1) / cfg.track_astar.voxel_m
    for target in targets[1:]:
        cost = (cost[:, None] + way).min(axis=0) + own(target)
    return cost.min()


@pytest.mark.parametrize("world", ["tower_behind", "corner"])
def test_a_wide_beam_finds_the_cheapest_way(world, monkeypatch):
    coarse = {"voxel_m": 8.0, "voxel_height_m": 8.0, "corridor_m": 28.0, "weight_smoothness": 0.0}
    for name, value in coarse.items():
        monkeypatch.setattr(TrackAStarConfig, name, value)
    box_map, corners = WORLDS[world]
    obstacles = kernels.obstacle_index(box_map)
    settings = TrackAStarConfig(beam=100000)
    cfg = PlanConfig(altitude_max_m=40, relaxed_safety_m=3.0, track_astar=settings)
    scenario = planners.make_scenario(walk_along(world, corners), obstacles, cfg)
    scenario = first_points(scenario, 16)  # layers of three frames
    raw, facts = track_astar.search_trajectory(scenario, obstacles, cfg, 3.0)
    layers = np.arange(0, 16, track_astar.frames_per_layer(cfg))
    targets = scenario.targets_m[layers]
    ahead = (targets[1] - targets[0])[:2] / np.linalg.norm(targets[1] - targets[0])
    start = np.array([*(targets[0, :2] - 20 * ahead), 20])
    voxels = track_astar.make_voxels(scenario, cfg)
    best = exhaustive(voxels, targets, obstacles, cfg, start)
    assert facts["cost"] == pytest.approx(cost_of(raw[layers], targets, obstacles, cfg, start), abs=1e-6)
    # The plain version grows boxes by the distance; the search, which measures first, may pass a corner more closely.
    assert facts["cost"] <= best + 1e-6
