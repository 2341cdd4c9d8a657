"""How long planners take for a flight, how good the flights are, and how MuCO's optimiser compares with scipy's L-BFGS-B.

python tests/benchmarks/bench_planning.py [--maps a b c] [--planners muco ...]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
import scenes
from scipy.optimize import minimize

from cosfly.errors import NoPathError
from cosfly.geometry import DT_S
from cosfly.planners.contract import PLANNERS, PlanConfig, Scenario, load_planner
from cosfly.planners.muco import muco
from cosfly.planners.muco.loss import evaluate, make_state
from cosfly.planners.stage import make_scenario
from cosfly.space import flight_metrics as metrics
from cosfly.space.kernels import BoxIndex, obstacle_index, segments_hit, signed_distances, visibility
from cosfly.work.chance import rng_for

SHORT_POINTS = 121  # the paper's SimWorld flight


@dataclass(frozen=True)
class Scene:
    """Twenty scenarios on one map."""

    name: str
    obstacles: BoxIndex
    scenarios: list[Scenario]


def make_scenes(wanted: list[str]) -> list[Scene]:
    found = []
    if "a" in wanted:
        town = scenes.simplified(scenes.town())
        walks, obstacles = scenes.walks_on(town), obstacle_index(town)
        short = [scenes.first_points(walk, SHORT_POINTS) for walk in walks if len(walk.time_s) >= SHORT_POINTS]
        for name, chosen in (("(a) town", walks), (f"(a) first {SHORT_POINTS} points", short)):
            found.append(Scene(name, obstacles, [make_scenario(walk, obstacles, PlanConfig()) for walk in chosen]))
    city = scenes.city() if {"b", "c"} & set(wanted) else None
    if city is not None:
        simple = scenes.simplified(city)
        walks = scenes.walks_on(simple, ground="paved")
        tiles = {"b": (1, 1), "c": (12, 12)}
        for key, (columns, rows) in tiles.items():
            if key not in wanted:
                continue
            obstacles = obstacle_index(scenes.tiled(simple, columns, rows))
            low, high = simple.bounds()
            shift = np.append((high - low + scenes.CITY_GAP_M)[:2] * (columns // 2, rows // 2), 0.0)
            scenarios = [make_scenario(scenes.moved(walk, shift), obstacles, PlanConfig()) for walk in walks]
            found.append(Scene(f"({key}) city {columns} x {rows}", obstacles, scenarios))
    return found


def measure(scene: Scene, planner: str, cfg: PlanConfig) -> list:
    """Times and quality of one planner over a scene."""
    plan = load_planner(planner)
    times, facts, failed = [], [], 0
    for scenario in scene.scenarios:
        try:
            ms, made = scenes.cpu_ms(
                lambda s=scenario: plan(s, scene.obstacles, cfg, rng_for(scenes.SEED, "plan", s.path_id))
            )
        except NoPathError:
            failed += 1
            continue
        p = made.positions_m
        seen = visibility(scene.obstacles, p, scenario.targets_m).mean()
        hits = segments_hit(scene.obstacles, p[:-1], p[1:]).any()
        accel, jerk = metrics.accel_rms(p), metrics.jerk_rms(p)
        smooth = accel <= cfg.accel_rms_max_mps2 and jerk <= cfg.jerk_rms_max_mps3
        clearance_m = signed_distances(scene.obstacles, p, 100.0)[0].min()
        times.append(ms)
        facts.append((len(p), seen, clearance_m, hits, smooth, metrics.length_m(p), accel, jerk))
    table, all_ms = np.array(facts, dtype=float), np.array(times)
    return [
        scene.name, planner, len(scene.obstacles.rows), f"{len(facts)} + {failed}", round(table[:, 0].mean()), float(all_ms.mean()),
        float(np.percentile(all_ms, 95)), float(all_ms.max()), f"{table[:, 1].mean():.3f}", f"{table[:, 1].min():.3f}",
        f"{table[:, 2].min():.2f}", int(table[:, 3].sum()), f"{int(table[:, 4].sum())} of {len(facts)}", float(table[:, 5].mean()),
        f"{table[:, 6].mean():.2f} / {table[:, 7].mean():.2f}",
    ]  # fmt: skip


def muco_ring(cfg: PlanConfig) -> np.ndarray:
    """Places where MuCO's loss wants the drone, relative to the ground below the walker: 72 directions, (72, 3) m."""
    turns, height = np.arange(72) * (2.0 * np.pi / 72), cfg.altitude_preferred_m
    radius = np.sqrt(cfg.muco.track_distance_m**2 - (height - 1.0) ** 2)
    return np.column_stack([radius * np.cos(turns), radius * np.sin(turns), np.full(72, height)])


def wide_lattice(cfg: PlanConfig) -> np.ndarray:
    """24 directions, seven distances up to 55 m, seven altitudes up to the greatest: (1,015, 3) m."""
    radii, turns = np.array([0.0, 6.0, 12.0, 20.0, 28.0, 40.0, 55.0]), np.arange(24) * (2.0 * np.pi / 24)
    heights = np.geomspace(cfg.altitude_min_m, cfg.altitude_max_m, 7)
    radius, turn, height = (a.ravel() for a in np.meshgrid(radii, turns, heights, indexing="ij"))
    return np.unique(np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height]).round(9), axis=0)


def most_visible(scene: Scene, places: np.ndarray, every: int, cfg: PlanConfig) -> tuple[float, float]:
    """Exhaustive search for the flights that see most, from places given relative to the walker; means over the scenarios.

    Every `every`-th frame. First: the best free place of each frame, whatever the way between them. Second: the best sequence that
    keeps the speed limit (dynamic programming), through buildings if need be. No flight over these places can see more.
    """
    jumping, moving, reach_m = [], [], cfg.speed_max_mps * DT_S * every
    for scenario in scene.scenarios:
        targets, best, greatest = scenario.targets_m[::every], np.zeros(len(places)), []
        grounds_m = scenario.ground_m[::every]
        for k, target in enumerate(targets):
            there = places + np.array([target[0], target[1], grounds_m[k]])
            is_free = signed_distances(scene.obstacles, there, cfg.safety_distance_m)[0] >= cfg.relaxed_safety_m
            seen = visibility(scene.obstacles, there, np.repeat(target[None], len(there), axis=0))
            seen = np.where(is_free, seen, -np.inf)
            greatest.append(seen.max())
            if k > 0:
                step = np.append((target - targets[k - 1])[:2], 0.0)
                far = ((places[:, None] + step - places[None]) ** 2).sum(axis=-1) > reach_m**2
                best = np.where(far, -np.inf, best[None]).max(axis=1)
            best = best + seen
        jumping.append(np.mean(greatest))
        moving.append(best.max() / len(targets))
    return float(np.mean(jumping)), float(np.mean(moving))


def compare_with_scipy(scene: Scene, cfg: PlanConfig) -> list:
    """The same loss, start and bounds for both; times of the optimisation alone.

    The rule that takes low-visibility runs out of the gradient is no part of the loss and is off for both; the last column has MuCO with it.
    """
    rows, without_rule = [], cfg.muco.model_copy(update={"low_visibility_frames": 1_000_000})
    for scenario in scene.scenarios:
        problem = muco.make_problem(scenario, cfg)
        first, _ = muco.start_trajectory(scenario, problem, scene.obstacles, cfg)
        ms, (_, solver) = scenes.cpu_ms(lambda f=first, p=problem: muco.optimize(f, p, scene.obstacles, without_rule))
        _, ruled = muco.optimize(first, problem, scene.obstacles, cfg.muco)
        state, unmasked = make_state(len(first), len(scene.obstacles.rows)), np.zeros(len(first), dtype=bool)

        def loss_and_gradient(interior, first=first, problem=problem, state=state, unmasked=unmasked):
            points = np.vstack([first[:1], interior.reshape(-1, 3), first[-1:]])
            value = evaluate(points, problem, scene.obstacles, unmasked, state)
            return value, (state.gradient + state.visibility_gradient)[1:-1].reshape(-1)

        bounds = [
            pair for low, _, high in problem.altitudes[1:-1] for pair in ((None, None), (None, None), (low, high))
        ]
        peer_ms, peer = scenes.cpu_ms(
            lambda f=first, call=loss_and_gradient, b=bounds: minimize(
                call, f[1:-1].reshape(-1), jac=True, method="L-BFGS-B", bounds=b, options={"maxiter": 3000, "maxfun": 6000}
            )
        )  # fmt: skip
        rows.append(
            (
                ms,
                peer_ms,
                solver["loss_end"] / peer.fun,
                solver["iterations"],
                solver["evaluations"],
                peer.nfev,
                ruled["loss_end"] / peer.fun,
            )
        )
    table = np.array(rows)
    return [
        scene.name, float(table[:, 0].mean()), float(table[:, 1].mean()), f"{table[:, 1].mean() / table[:, 0].mean():.1f}",
        f"{np.median(table[:, 2]):.3f}", f"{table[:, 2].max():.3f}", f"{int((table[:, 2] <= 1.05).sum())} of {len(table)}",
        float(table[:, 3].mean()), float(table[:, 4].mean()), float(table[:, 5].mean()),
        f"{int((table[:, 6] <= 1.05).sum())} of {len(table)}, {table[:, 6].max():.3f}",
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--maps", nargs="+", default=["a", "b", "c"], choices=["a", "b", "c"])
    parser.add_argument("--planners", nargs="+", default=list(PLANNERS), choices=list(PLANNERS))
    options = parser.parse_args()
    scenes.one_thread_and_machine()
    cfg, found, rows = PlanConfig(), make_scenes(options.maps), []
    for planner in options.planners:
        first = Scene("warm-up", found[0].obstacles, found[0].scenarios[:2])
        warm_up_ms, _ = scenes.cpu_ms(lambda p=planner, s=first: measure(s, p, cfg))
        print(f"{planner}: first two flights with compilation or its cache {warm_up_ms / 1e3:.2f} s")
        rows += [measure(scene, planner, cfg) for scene in found]
    print()
    lattices = {"MuCO's ring, every frame": (muco_ring(cfg), 1), "wide lattice, every 4th": (wide_lattice(cfg), 4)}
    bounds = [
        [scene.name, name] + [f"{share:.3f}" for share in most_visible(scene, places, every, cfg)]
        for scene in found
        if scene.name in ("(a) town", "(b) city 1 x 1")
        for name, (places, every) in lattices.items()
    ]
    scenes.print_table("mean visibility that no flight can exceed", ["map", "places", "jumping", "moving"], bounds)
    names = [
        "map", "planner", "obstacles", "flights + failed", "points", "mean ms", "p95 ms", "max ms", "visibility", "worst",
        "clearance, m", "collisions", "smooth", "length, m", "acceleration / jerk, RMS",
    ]  # fmt: skip
    scenes.print_table("planning, start included", names, rows)
    names = [
        "map", "MuCO, ms", "L-BFGS-B, ms", "times faster", "median loss ratio", "greatest", "within 5 %", "iterations",
        "evaluations", "of L-BFGS-B", "with the low-visibility rule",
    ]  # fmt: skip
    scenes.print_table(
        "the same loss from the same start", names, [compare_with_scipy(s, cfg) for s in found if "(c)" not in s.name]
    )


if __name__ == "__main__":
    main()
