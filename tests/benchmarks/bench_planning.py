"""Steps 2 to 4: times of simplification, walks and planners, the flights' quality, each beside a library: scipy's
Dijkstra and L-BFGS-B, shapely's tree.

python tests/benchmarks/bench_planning.py [--maps a b c] [--planners muco ...]
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scenes
import shapely
from scipy.optimize import minimize
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from cosfly.formats.boxes import BoxMap, write_boxes
from cosfly.formats.kinds import KINDS
from cosfly.geometry import trajectory_metrics as metrics
from cosfly.geometry.kernels import BoxIndex, obstacle_index, segments_hit, signed_distances, visibility
from cosfly.pedestrians.astar import find_route, route_cost
from cosfly.pedestrians.stage import PedestriansConfig, make_pedestrian, run, walkable_ground
from cosfly.planners.contract import PLANNERS, PlanConfig, Scenario, load_planner
from cosfly.planners.muco import muco
from cosfly.planners.muco.loss import evaluate, make_state
from cosfly.planners.stage import make_scenario
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import SimplifyConfig, clusters, simplify

SHORT_POINTS = 121  # the paper's SimWorld flight
WALKS = PedestriansConfig(num_paths=scenes.NUM_WALKS)
BIG_M = (3784 * 0.5, 2357 * 0.5)  # the largest map of the paper


def peer_clusters(mins: np.ndarray, maxs: np.ndarray, gap_m: float) -> np.ndarray:
    grown = shapely.box(mins[:, 0] - gap_m, mins[:, 1] - gap_m, maxs[:, 0] + gap_m, maxs[:, 1] + gap_m)
    one, other = shapely.STRtree(shapely.box(mins[:, 0], mins[:, 1], maxs[:, 0], maxs[:, 1])).query(grown)
    near = (mins[one, 2] <= maxs[other, 2] + gap_m) & (mins[other, 2] <= maxs[one, 2] + gap_m)
    graph = coo_array((np.ones(near.sum(), dtype=np.int8), (one[near], other[near])), shape=(len(mins), len(mins)))
    return connected_components(graph, directed=False)[1]


def simplification(maps: dict[str, BoxMap]) -> None:
    rows = []
    for name, raw in maps.items():
        times = [scenes.cpu_ms(lambda raw=raw: simplify(raw, SimplifyConfig())) for _ in range(3)]
        rows.append([name, len(raw), len(times[-1][1].box_map), min(ms for ms, _ in times) / 1e3])
    scenes.print_table("simplify", ["map", "boxes", "left", "s"], rows)
    raw = next(iter(maps.values()))
    plants = raw.select(raw.kinds == KINDS["Vegetation"])
    ours_ms, ours = scenes.cpu_ms(lambda: clusters(plants.mins, plants.maxs, 2.0))
    peer_ms, peer = scenes.cpu_ms(lambda: peer_clusters(plants.mins, plants.maxs, 2.0))
    assert len(np.unique(np.column_stack([ours, peer]), axis=0)) == len(np.unique(ours)) == len(np.unique(peer))
    names = ["ours, ms", "STRtree + connected components, ms"]
    scenes.print_table(f"clusters of {len(plants)} vegetation boxes", names, [[ours_ms, peer_ms]])


def octile_graph(walkable: np.ndarray) -> coo_array:
    """The graph of the walkable cells, (ny, nx) bool, without corner cutting, for scipy."""
    number = np.arange(walkable.size).reshape(walkable.shape)
    ones, others, costs = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        height, width = walkable.shape[0] - dy, walkable.shape[1] - abs(dx)
        a = np.s_[:height, max(-dx, 0) : max(-dx, 0) + width]
        b = np.s_[dy : dy + height, max(dx, 0) : max(dx, 0) + width]
        free = walkable[a] & walkable[b]
        if dx and dy:
            free &= walkable[a[0], b[1]] & walkable[b[0], a[1]]
        ones.append(number[a][free])
        others.append(number[b][free])
        costs.append(np.full(free.sum(), np.hypot(dx, dy)))
    shape = (walkable.size, walkable.size)
    return coo_array((np.concatenate(costs), (np.concatenate(ones), np.concatenate(others))), shape=shape).tocsr()


def stage_a(box_map: BoxMap) -> tuple:
    ground = walkable_ground(box_map, WALKS)
    names = [f"path_{k:05d}" for k in range(WALKS.num_paths)]
    return ground, [make_pedestrian(name, ground, WALKS, rng_for(scenes.SEED, "pedestrians", name)) for name in names]


def walking(maps: dict[str, BoxMap]) -> None:
    rows = []
    for name, box_map in maps.items():
        times = [scenes.cpu_ms(lambda box_map=box_map: stage_a(box_map)) for _ in range(3)]
        ground, walks = times[-1][1]
        with tempfile.TemporaryDirectory() as folder:
            write_boxes(Path(folder) / "map.json", box_map)
            whole_ms, _ = scenes.cpu_ms(lambda f=Path(folder): run(WALKS, f / "map.json", f / "out"))
        graph, ours_ms, peer_ms, worst = octile_graph(ground.walkable), [], [], 0.0
        for walk in walks[:5]:
            ends = ground.grid.cells_at(walk.trajectory.polyline_m[[0, -1]])
            ms, cells = scenes.cpu_ms(lambda ends=ends, ground=ground: find_route(ground.walkable, ends[0], ends[1]))
            ours_ms.append(ms)
            source, goal = (int(y * ground.walkable.shape[1] + x) for x, y in ends)
            ms, lengths = scenes.cpu_ms(lambda s=source, g=graph: dijkstra(g, directed=False, indices=s, limit=700.0))
            peer_ms.append(ms)
            worst = max(worst, abs(lengths[goal] - route_cost(cells)))
        size, means = " x ".join(map(str, ground.grid.size)), [float(np.mean(ours_ms)), float(np.mean(peer_ms))]
        best_s = min(ms for ms, _ in times) / 1e3
        rows.append([name, len(box_map), size, best_s, whole_ms / 1e3, *means, f"{worst:.1e}"])
    names = ["map", "boxes", "grid", "without files and report, s", "whole stage, s", "one route by A*, ms"]
    scenes.print_table("stage A, 20 paths", [*names, "by Dijkstra, ms", "greatest difference of costs, cells"], rows)


def ground_stages() -> None:
    town, city = scenes.town(), scenes.city()
    raw, simple = {"(a) town": town}, {"(a) town": scenes.simplified(town)}
    if city is not None:
        low, high = city.bounds()
        columns, lines = (int(np.ceil(BIG_M[k] / (high[k] - low[k]))) for k in (0, 1))
        raw |= {"(b) city": city, "(c) city 12 x 12": scenes.tiled(city, 12, 12)}
        tiled = scenes.cut_to(scenes.tiled(city, columns, lines), BIG_M)
        simple[f"(b) tiled {columns} x {lines}, cut"] = scenes.simplified(tiled)
    stage_a(simple["(a) town"])  # compiles
    simplification(raw)
    walking(simple)


@dataclass(frozen=True)
class Scene:
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
        for key, (columns, rows) in {"b": (1, 1), "c": (12, 12)}.items():
            if key not in wanted:
                continue
            obstacles = obstacle_index(scenes.tiled(simple, columns, rows))
            low, high = simple.bounds()
            shift = np.append((high - low + scenes.CITY_GAP_M)[:2] * (columns // 2, rows // 2), 0.0)
            scenarios = [make_scenario(scenes.moved(walk, shift), obstacles, PlanConfig()) for walk in walks]
            found.append(Scene(f"({key}) city {columns} x {rows}", obstacles, scenarios))
    return found


def measure(scene: Scene, planner: str, cfg: PlanConfig) -> list:
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
        accel, jerk = metrics.derivative_rms(p, 2), metrics.derivative_rms(p, 3)
        smooth = accel <= cfg.accel_rms_max_mps2 and jerk <= cfg.jerk_rms_max_mps3
        clearance_m = signed_distances(scene.obstacles, p, 100.0)[0].min()
        times.append(ms)
        facts.append((len(p), seen, clearance_m, hits, smooth, metrics.length_m(p), accel, jerk))
    table, all_ms = np.array(facts, dtype=float), np.array(times)
    return [
        scene.name, planner, len(scene.obstacles.rows), f"{len(facts)} + {failed}", round(table[:, 0].mean()),
        float(all_ms.mean()), float(np.percentile(all_ms, 95)), float(all_ms.max()), f"{table[:, 1].mean():.3f}",
        f"{table[:, 1].min():.3f}", f"{table[:, 2].min():.2f}", int(table[:, 3].sum()),
        f"{int(table[:, 4].sum())} of {len(facts)}", float(table[:, 5].mean()),
        f"{table[:, 6].mean():.2f} / {table[:, 7].mean():.2f}",
    ]  # fmt: skip


def compare_with_scipy(scene: Scene, cfg: PlanConfig) -> list:
    """The same loss, start and bounds for both; times of the optimisation alone.

    The rule that takes low-visibility runs out of the gradient is no part of the loss and is off for both; the last
    column has MuCO with it.
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

        heights = [(low, high) for low, _, high in problem.altitudes[1:-1]]
        asked = {
            "jac": True, "method": "L-BFGS-B", "options": {"maxiter": 3000, "maxfun": 6000},
            "bounds": [pair for height in heights for pair in ((None, None), (None, None), height)],
        }  # fmt: skip
        start = first[1:-1].reshape(-1)
        peer_ms, peer = scenes.cpu_ms(lambda f=loss_and_gradient, x=start, a=asked: minimize(f, x, **a))
        counts = solver["iterations"], solver["evaluations"], peer.nfev
        rows.append((ms, peer_ms, solver["loss_end"] / peer.fun, *counts, ruled["loss_end"] / peer.fun))
    table = np.array(rows)
    return [
        scene.name, float(table[:, 0].mean()), float(table[:, 1].mean()),
        f"{table[:, 1].mean() / table[:, 0].mean():.1f}",
        f"{np.median(table[:, 2]):.3f}", f"{table[:, 2].max():.3f}",
        f"{int((table[:, 2] <= 1.05).sum())} of {len(table)}",
        float(table[:, 3].mean()), float(table[:, 4].mean()), float(table[:, 5].mean()),
        f"{int((table[:, 6] <= 1.05).sum())} of {len(table)}, {table[:, 6].max():.3f}",
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--maps", nargs="+", default=["a", "b", "c"], choices=["a", "b", "c"])
    parser.add_argument("--planners", nargs="+", default=list(PLANNERS), choices=list(PLANNERS))
    options = parser.parse_args()
    scenes.one_thread_and_machine()
    ground_stages()
    cfg, found, rows = PlanConfig(), make_scenes(options.maps), []
    for planner in options.planners:
        first = Scene("warm-up", found[0].obstacles, found[0].scenarios[:2])
        warm_up_ms, _ = scenes.cpu_ms(lambda p=planner, s=first: measure(s, p, cfg))
        print(f"{planner}: first two flights with compilation or its cache {warm_up_ms / 1e3:.2f} s")
        rows += [measure(scene, planner, cfg) for scene in found]
    print()
    names = [
        "map", "planner", "obstacles", "flights + failed", "points", "mean ms", "p95 ms", "max ms", "visibility",
        "worst", "clearance, m", "collisions", "smooth", "length, m", "acceleration / jerk, RMS",
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
