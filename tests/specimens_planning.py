"""Hand-made worlds for planners, and the check that a flight through them is safe."""

import itertools
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from cosfly.formats.boxes import BoxMap, write_boxes
from cosfly.formats.frames import Camera
from cosfly.formats.pedestrian_paths import PedestrianTrajectory, walk_id, write_paths
from cosfly.formats.playback import Perturbation, TargetRecord, Track
from cosfly.formats.traces import DroneTrace
from cosfly.geometry import kernels
from cosfly.geometry.axes import DT_S, intrinsic_matrix
from cosfly.maps.stage import load_map
from cosfly.pedestrians.stage import make_pedestrian
from cosfly.pedestrians.walkable import WalkableGround, walkable_ground
from cosfly.pipeline.settings import RunConfig
from cosfly.planners.contract import PlanConfig
from cosfly.planners.muco.loss import evaluate, make_state
from cosfly.planners.stage import draw_styles_of, make_scenario, plan_trajectory, screens_of
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import simplify
from specimens import make_flight, map_of, seen_by


def walk_along(path_id, corners, speed_mps=1.2, dt_s=DT_S):
    """Walk a polyline at constant speed, sampled every dt_s."""
    corners = np.asarray(corners, dtype=np.float64)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    time_s = np.arange(0, along[-1] / speed_mps, dt_s)
    xy = np.stack([np.interp(time_s * speed_mps, along, corners[:, k]) for k in (0, 1)], axis=1)
    positions = np.column_stack([xy, np.zeros(len(xy))])
    return PedestrianTrajectory(path_id, corners, time_s, positions, np.full(len(xy), speed_mps))


def town_of(*rows):
    """(centre, half extents[, yaw_deg]) of buildings, on a large ground slab that must not count as an obstacle."""
    return map_of(("Ground", (0, 0, -0.5), (500, 500, 0.5)), *(("Buildings", *row) for row in rows), name="hand")


CANYON = [((x, side * 16, 20), (9, 8, 20)) for x in range(-40, 140, 20) for side in (-1, 1)]
WORLDS = {
    "empty": (town_of(), [(0, 0), (60, 0), (60, 50)]),
    "canyon": (town_of(*CANYON), [(0, 0), (100, 0)]),
    "u_turn": (town_of(*CANYON), [(0, 0), (50, 0), (50, 2), (0, 2)]),
    "tower_behind": (town_of(((-18, 0, 40), (6, 6, 40), 30)), [(0, 0), (60, 0)]),  # the plain start is inside it
    "tower_midway": (town_of(((30, 14, 60), (8, 8, 60), 30)), [(0, 0), (30, 0), (60, 0), (60, 60)]),
    "corner": (town_of(((-20, 20, 25), (30, 12, 25)), ((40, 40, 25), (12, 40, 25))), [(-30, 0), (20, 2), (22, 70)]),
    "short": (town_of(((10, 9, 5), (2, 2, 5))), [(0, 0), (1.3, 0)]),  # three points
}  # fmt: skip


def written(folder: Path, box_map: BoxMap, **walks: list[tuple]) -> tuple[Path, Path]:
    """Write a map and walks of these names and corners, and give both files."""
    write_boxes(folder / "map.json", box_map)
    made = [walk_along(name, corners) for name, corners in walks.items()]
    write_paths(folder / "path.json", made, {"map": "hand", "seed": 0})
    return folder / "map.json", folder / "path.json"


def scenario_of(world):
    box_map, corners = WORLDS[world]
    obstacles = kernels.obstacle_index(box_map)
    return make_scenario(walk_along(world, corners), obstacles, PlanConfig()), obstacles


def solved_by_scipy(first, problem, obstacles, **options):
    """Minimize MuCO's loss from a start by L-BFGS-B, within its altitudes."""
    state, unmasked = make_state(len(first), len(obstacles.rows)), np.zeros(len(first), dtype=bool)

    def loss_and_gradient(interior):
        points = np.vstack([first[:1], interior.reshape(-1, 3), first[-1:]])
        value = evaluate(points, problem, obstacles, unmasked, state)
        return value, (state.gradient + state.visibility_gradient)[1:-1].reshape(-1)

    bounds = [pair for low, _, high in problem.altitudes[1:-1] for pair in ((None, None), (None, None), (low, high))]
    start = first[1:-1].reshape(-1)
    return minimize(loss_and_gradient, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)


def assert_safe(positions, obstacles, cfg=PlanConfig(), ground_m=0.0):
    """Check a flight point by point and, between points, every ten centimetres: independent of `is_feasible`."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert steps.max() <= cfg.speed_max_mps * DT_S + 1e-3
    assert positions[:, 2].min() - ground_m >= cfg.altitude_min_m - 1e-3
    assert positions[:, 2].max() - ground_m <= cfg.altitude_max_m + 1e-3
    assert kernels.signed_distances(obstacles, positions)[0].min() >= cfg.relaxed_safety_m - 1e-3
    shares = np.linspace(0, 1, 51)[:, None, None]
    between = (positions[None, :-1] * (1 - shares) + positions[None, 1:] * shares).reshape(-1, 3)
    assert kernels.signed_distances(obstacles, between)[0].min() > 0


def town_walks(
    town: RunConfig, paces: Sequence[str | None]
) -> tuple[BoxMap, WalkableGround, list[PedestrianTrajectory]]:
    """Return the simplified map of a town of a run, its walkable ground, and a walk of each pace; None: any."""
    box_map = simplify(load_map(town.maps, seed=town.seed), town.simplify)
    ground, walks = walkable_ground(box_map, town.pedestrians), []
    for name, pace in zip(map(walk_id, itertools.count()), paces, strict=False):
        rng = rng_for(town.seed, "pedestrians", name)
        walks.append(make_pedestrian(name, ground, town.pedestrians, rng, pace).trajectory)
    return box_map, ground, walks


def town_flights(town: RunConfig, paces: Sequence[str | None]) -> Iterator[DroneTrace]:
    """Yield the planned trajectories of such walks."""
    box_map, _, walks = town_walks(town, paces)
    obstacles, screens = kernels.obstacle_index(box_map), screens_of(box_map)
    for walk, styles in zip(walks, draw_styles_of(walks, town.plan, town.seed), strict=True):
        with suppress(NoPathError):  # a failure that the stage counts
            yield plan_trajectory(walk, obstacles, town.plan, town.seed, screens, styles)


def track_of(trace: DroneTrace, size_px: tuple[int, int], fov_deg: float) -> Track:
    """Return the clean track of a trajectory, without pictures."""
    camera = Camera(*size_px, intrinsic_matrix(*size_px, fov_deg))
    seen = seen_by(camera, trace.positions_m, trace.rotations_deg, trace.targets_m)
    visible = seen["in_view"] & (trace.visibility > 0)
    target = TargetRecord(**seen, visible=visible, visibility=trace.visibility)
    zero = np.zeros((len(trace.time_s), 3))
    return replace(
        make_flight(len(trace.time_s))[0], folder=Path(), camera=camera, time_s=trace.time_s,
        positions_m=trace.positions_m, rotations_deg=trace.rotations_deg, targets_m=trace.targets_m, target=target,
        perturbation=Perturbation(np.zeros(len(zero), dtype=bool), zero, zero, zero), segments=trace.segments,
        mission=trace.mission,
    )  # fmt: skip
