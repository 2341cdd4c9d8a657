"""How long stage A (Step 3) takes for 20 paths on two grids, and how its A* compares with scipy's Dijkstra.

python tests/benchmarks/bench_pedestrians.py
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import scenes
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from cosfly.pedestrians.astar import find_route, route_cost
from cosfly.pedestrians.stage import PedestriansConfig, make_walk, run, walkable_ground
from cosfly.products.boxes import BoxMap, write_boxes
from cosfly.work.chance import rng_for

BIG_M = (3784 * 0.5, 2357 * 0.5)
SETTINGS = PedestriansConfig(num_paths=scenes.NUM_WALKS)
Grid = np.ndarray  # (ny, nx) bool


def stage_a(box_map: BoxMap):
    """Grid to A* without files and pictures; gives the ground and the walks."""
    ground = walkable_ground(box_map, SETTINGS)
    names = [f"path_{k:05d}" for k in range(SETTINGS.num_paths)]
    return ground, [make_walk(name, ground, SETTINGS, rng_for(scenes.SEED, "pedestrians", name)) for name in names]


def peer_graph(walkable: Grid) -> coo_array:
    """The octile graph without corner cutting, for scipy."""
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


def compare_with_dijkstra(ground, walks) -> list:
    """Mean times of the first five routes, and the greatest difference of their costs."""
    walkable = ground.walkable
    graph = peer_graph(walkable)
    ours, theirs, worst = [], [], 0.0
    for walk in walks[:5]:
        ends = ground.grid.cells_at(walk.walk.polyline_m[[0, -1]])
        ms, cells = scenes.cpu_ms(lambda ends=ends: find_route(walkable, ends[0], ends[1]))
        ours.append(ms)
        source, goal = (int(y * walkable.shape[1] + x) for x, y in ends)
        ms, lengths = scenes.cpu_ms(lambda source=source: dijkstra(graph, directed=False, indices=source, limit=700.0))
        theirs.append(ms)
        worst = max(worst, abs(lengths[goal] - route_cost(cells)))
    return [float(np.mean(ours)), float(np.mean(theirs)), f"{worst:.1e}"]


def measure(name: str, box_map: BoxMap, rows: list, steps: list, peers: list) -> None:
    times = [scenes.cpu_ms(lambda: stage_a(box_map)) for _ in range(3)]
    ground, walks = times[-1][1]
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "map.json"
        write_boxes(source, box_map)
        whole_ms, _ = scenes.cpu_ms(lambda: run(SETTINGS, source, Path(folder) / "out"))
        seconds = json.loads((Path(folder) / "out/manifest.json").read_text())["seconds_by_step"]
    size = f"{ground.grid.size[0]} x {ground.grid.size[1]}"
    rows.append([name, len(box_map), size, min(ms for ms, _ in times) / 1e3, whole_ms / 1e3])
    steps.append([name, *seconds.values()])
    steps_names[:] = ["map", *seconds]
    peers.append([name, *compare_with_dijkstra(ground, walks)])


steps_names: list[str] = []


def main() -> None:
    scenes.one_thread_and_machine()
    town, city = scenes.simplified(scenes.town()), scenes.city()
    warm_up_ms, _ = scenes.cpu_ms(lambda: stage_a(town))
    rows: list = []
    steps: list = []
    peers: list = []
    measure("(a) town", town, rows, steps, peers)
    if city is not None:
        low, high = city.bounds()
        columns, lines = (int(np.ceil(BIG_M[k] / (high[k] - low[k]))) for k in (0, 1))
        big = scenes.simplified(scenes.cut_to(scenes.tiled(city, columns, lines), BIG_M))
        measure(f"(b) tiled {columns} x {lines}, cut", big, rows, steps, peers)
    print(f"first call with compilation or its cache: {warm_up_ms / 1e3:.2f} s\n")
    scenes.print_table(
        "stage A, 20 paths", ["map", "boxes", "grid", "without files and report, s", "whole stage, s"], rows
    )
    scenes.print_table("seconds of the sub-stages, whole stage", steps_names, steps)
    scenes.print_table(
        "one route", ["map", "A*, ms", "scipy Dijkstra, ms", "greatest difference of costs, cells"], peers
    )


if __name__ == "__main__":
    main()
