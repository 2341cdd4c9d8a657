"""The planners by the four axes of `cosfly plan compare` on several maps, with intervals over walks; times interleaved walk by walk.

python tests/benchmarks/bench_axes.py [--maps a b b60 delft town5 town9]
"""

from __future__ import annotations

import argparse

import numpy as np
import scenes

from cosfly.planners.compare import axis_differences, axis_scores, flight_figures, mean_figures
from cosfly.planners.contract import PLANNERS, PlanConfig, load_planner
from cosfly.planners.stage import make_scenario, plan_flight, warm_up
from cosfly.products.boxes import BoxMap
from cosfly.products.walks import Walk
from cosfly.space.kernels import obstacle_index
from cosfly.work.chance import rng_for

# name -> raw map, settings of its walks. town5 and town9: other seeds of (a).
MAPS = {
    "a": (scenes.town, {}),
    "b": (scenes.city, {"ground": "paved"}),
    "b60": (scenes.city, {"ground": "paved", "num_paths": 60}),
    "delft": (scenes.quarter, {}),
    "town5": (lambda: scenes.town(5), {}),
    "town9": (lambda: scenes.town(9), {}),
}


def measure(box_map: BoxMap, walks: list[Walk]) -> tuple[dict[str, list[dict]], dict[str, list[float]]]:
    """Give the figures of every planner's flights and the processor time of each, ms."""
    obstacles, settings = obstacle_index(box_map), {name: PlanConfig(planner=name) for name in PLANNERS}
    figures: dict[str, list[dict]] = {name: [] for name in PLANNERS}
    times_ms: dict[str, list[float]] = {name: [] for name in PLANNERS}
    for walk in walks:
        for name, cfg in settings.items():
            scenario, plan = make_scenario(walk, obstacles, cfg), load_planner(name)
            rng = rng_for(scenes.SEED, "plan", walk.path_id)
            ms, _ = scenes.cpu_ms(lambda s=scenario, p=plan, c=cfg, r=rng: p(s, obstacles, c, r))
            times_ms[name].append(ms)
            figures[name].append(flight_figures(plan_flight(walk, obstacles, cfg, scenes.SEED)))
    return figures, times_ms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--maps", nargs="+", default=list(MAPS), choices=list(MAPS))
    options = parser.parse_args()
    scenes.one_thread_and_machine()
    for name in PLANNERS:
        warm_up(PlanConfig(planner=name))
    rows, apart = [], []
    for key in options.maps:
        load, settings = MAPS[key]
        raw = load()
        if raw is None:
            continue
        box_map = scenes.simplified(raw)
        figures, times_ms = measure(box_map, scenes.walks_on(box_map, **settings))
        means = {name: mean_figures(flights) for name, flights in figures.items()}
        for name, scores in axis_scores(means).items():
            ms, least_m = times_ms[name], min(flight["clearance_min_m"] for flight in figures[name])
            cells = [
                *(f"{scores[axis]:.3f}" for axis in scores),
                f"{means[name]['jerk_rms_mps3']:.2f}",
                f"{least_m:.2f}",
            ]
            rows.append([key, name, *cells, f"{np.mean(ms):.1f} / {np.percentile(ms, 95):.1f} / {max(ms):.1f}"])
        for other, axes in axis_differences(figures, rng_for(scenes.SEED, "plan_compare", "intervals")).items():
            cells = [
                f"{d['difference']:+.3f} ({d['low']:+.3f} to {d['high']:+.3f})"
                for d in (axes["mean"], axes["visibility"])
            ]
            apart.append([key, other, *cells])
    names = ["map", "planner", "visibility", "efficiency", "smoothness", "safety", "mean", "jerk", "least clearance, m"]
    scenes.print_table("axes", [*names, "ms mean / p95 / max"], rows)
    first = next(iter(PLANNERS))
    scenes.print_table(
        f"{first} less another, 95 % intervals over walks", ["map", "less", "mean of axes", "visibility"], apart
    )


if __name__ == "__main__":
    main()
