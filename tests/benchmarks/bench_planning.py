"""Steps 2 to 4: times of simplification, pedestrian trajectories and planners.

python tests/benchmarks/bench_planning.py [--planners muco ...]
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import scenes

from cosfly.formats.boxes import write_boxes
from cosfly.geometry.kernels import BoxIndex, obstacle_index
from cosfly.pedestrians.stage import PedestriansConfig, run
from cosfly.planners.contract import PLANNERS, PlanConfig, Scenario, load_planner
from cosfly.planners.stage import make_scenario
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.seeding import rng_for

WALKS = PedestriansConfig(num_paths=scenes.NUM_WALKS)
BIG_M = (3784 * 0.5, 2357 * 0.5)  # the largest map of the paper


def ground_stages() -> None:
    town, city = scenes.town(), scenes.city()
    maps = {"(a) town": scenes.simplified(town)}
    times_ms = [scenes.cpu_ms(lambda: scenes.simplified(town))[0] for _ in range(3)]
    rows = [["(a) town", len(town), len(maps["(a) town"]), min(times_ms) / 1e3]]
    scenes.print_table("simplify", ["map", "boxes", "left", "s"], rows)
    if city is not None:
        maps["(b) city, tiled"] = scenes.simplified(scenes.tiled(city, BIG_M))
    scenes.walks_on(maps["(a) town"])  # compiles
    rows = []
    for name, box_map in maps.items():
        times = [scenes.cpu_ms(lambda box_map=box_map: scenes.walks_on(box_map)) for _ in range(3)]
        with tempfile.TemporaryDirectory() as folder:
            write_boxes(Path(folder) / "map.json", box_map)
            whole_ms, _ = scenes.cpu_ms(lambda f=Path(folder): run(WALKS, f / "map.json", f / "out"))
        size, best_s = " x ".join(map(str, times[-1][1][0].grid.size)), min(ms for ms, _ in times) / 1e3
        rows.append([name, len(box_map), size, best_s, whole_ms / 1e3])
    names = ["map", "boxes", "grid", "without files and report, s", "whole stage, s"]
    scenes.print_table(f"{WALKS.num_paths} pedestrian trajectories", names, rows)


def measure(planner: str, scenarios: list[Scenario], obstacles: BoxIndex, cfg: PlanConfig) -> list:
    plan = load_planner(planner)
    times, num_points = [], []
    for scenario in scenarios:
        try:
            ms, made = scenes.cpu_ms(
                lambda s=scenario: plan(s, obstacles, cfg, rng_for(scenes.SEED, "plan", s.path_id))
            )
        except NoPathError:
            continue
        times.append(ms)
        num_points.append(len(made.positions_m))
    flown = f"{len(times)} of {len(scenarios)}"
    return [planner, len(obstacles.rows), flown, round(np.mean(num_points)), float(np.mean(times))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--planners", nargs="+", default=list(PLANNERS), choices=list(PLANNERS))
    options = parser.parse_args()
    scenes.one_thread_and_machine()
    ground_stages()
    cfg, town, rows = PlanConfig(), scenes.simplified(scenes.town()), []
    obstacles = obstacle_index(town)
    scenarios = [make_scenario(walk, obstacles, cfg) for walk in scenes.walks_on(town, min_distance_m=75.0)[1]]
    for planner in options.planners:
        warm_up_ms, _ = scenes.cpu_ms(lambda p=planner: measure(p, scenarios[:2], obstacles, cfg))
        print(f"{planner}: first two flights with compilation or its cache {warm_up_ms / 1e3:.2f} s")
        rows.append(measure(planner, scenarios, obstacles, cfg))
    print()
    names = ["planner", "obstacles", "trajectories", "points", "mean ms"]
    scenes.print_table("planning, start included, map (a)", names, rows)


if __name__ == "__main__":
    main()
