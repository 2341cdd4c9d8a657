"""Steps 2 to 4: times of simplification, pedestrian trajectories and planners.

python tests/benchmarks/bench_planning.py [--maps a b] [--planners muco ...]
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scenes

from cosfly.formats.boxes import BoxMap, write_boxes
from cosfly.geometry.kernels import BoxIndex, obstacle_index
from cosfly.pedestrians.stage import PedestriansConfig, make_pedestrian, run, walkable_ground
from cosfly.pedestrians.walkable import WalkableGround
from cosfly.planners.contract import PLANNERS, PlanConfig, Scenario, load_planner
from cosfly.planners.stage import make_scenario
from cosfly.runtime.errors import NoPathError
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import SimplifyConfig, simplify

WALKS = PedestriansConfig(num_paths=scenes.NUM_WALKS)
BIG_M = (3784 * 0.5, 2357 * 0.5)  # the largest map of the paper


def simplification(maps: dict[str, BoxMap]) -> None:
    rows = []
    for name, raw in maps.items():
        times = [scenes.cpu_ms(lambda raw=raw: simplify(raw, SimplifyConfig())) for _ in range(3)]
        rows.append([name, len(raw), len(times[-1][1]), min(ms for ms, _ in times) / 1e3])
    scenes.print_table("simplify", ["map", "boxes", "left", "s"], rows)


def make_walks(box_map: BoxMap) -> WalkableGround:
    ground = walkable_ground(box_map, WALKS)
    for name in (f"path_{k:05d}" for k in range(WALKS.num_paths)):
        make_pedestrian(name, ground, WALKS, rng_for(scenes.SEED, "pedestrians", name))
    return ground


def walking(maps: dict[str, BoxMap]) -> None:
    rows = []
    for name, box_map in maps.items():
        times = [scenes.cpu_ms(lambda box_map=box_map: make_walks(box_map)) for _ in range(3)]
        with tempfile.TemporaryDirectory() as folder:
            write_boxes(Path(folder) / "map.json", box_map)
            whole_ms, _ = scenes.cpu_ms(lambda f=Path(folder): run(WALKS, f / "map.json", f / "out"))
        size, best_s = " x ".join(map(str, times[-1][1].grid.size)), min(ms for ms, _ in times) / 1e3
        rows.append([name, len(box_map), size, best_s, whole_ms / 1e3])
    names = ["map", "boxes", "grid", "without files and report, s", "whole stage, s"]
    scenes.print_table(f"{WALKS.num_paths} pedestrian trajectories", names, rows)


def ground_stages() -> None:
    town, city = scenes.town(), scenes.city()
    raw, simple = {"(a) town": town}, {"(a) town": scenes.simplified(town)}
    if city is not None:
        low, high = city.bounds()
        columns, lines = (int(np.ceil(BIG_M[k] / (high[k] - low[k]))) for k in (0, 1))
        raw |= {"(b) city": city}
        tiled = scenes.cut_to(scenes.tiled(city, columns, lines), BIG_M)
        simple[f"(b) tiled {columns} x {lines}, cut"] = scenes.simplified(tiled)
    make_walks(simple["(a) town"])  # compiles
    simplification(raw)
    walking(simple)


@dataclass(frozen=True)
class Scene:
    name: str
    obstacles: BoxIndex
    scenarios: list[Scenario]


def make_scene(name: str, box_map: BoxMap, **settings: Any) -> Scene:
    obstacles = obstacle_index(box_map)
    walks = scenes.walks_on(box_map, **settings)
    return Scene(name, obstacles, [make_scenario(walk, obstacles, PlanConfig()) for walk in walks])


def make_scenes(wanted: list[str]) -> list[Scene]:
    found = []
    if "a" in wanted:
        found.append(make_scene("(a) town", scenes.simplified(scenes.town())))
    city = scenes.city() if "b" in wanted else None
    if city is not None:
        found.append(make_scene("(b) city", scenes.simplified(city), ground="paved"))
    return found


def measure(scene: Scene, planner: str, cfg: PlanConfig) -> list:
    plan = load_planner(planner)
    times, num_points = [], []
    for scenario in scene.scenarios:
        try:
            ms, made = scenes.cpu_ms(
                lambda s=scenario: plan(s, scene.obstacles, cfg, rng_for(scenes.SEED, "plan", s.path_id))
            )
        except NoPathError:
            continue
        times.append(ms)
        num_points.append(len(made.positions_m))
    return [
        scene.name, planner, len(scene.obstacles.rows), f"{len(times)} of {len(scene.scenarios)}",
        round(np.mean(num_points)), float(np.mean(times)), float(np.percentile(times, 95)), max(times),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--maps", nargs="+", default=["a", "b"], choices=["a", "b"])
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
    names = ["map", "planner", "obstacles", "trajectories", "points", "mean ms", "p95 ms", "max ms"]
    scenes.print_table("planning, start included", names, rows)


if __name__ == "__main__":
    main()
