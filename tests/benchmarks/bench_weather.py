"""What weather costs: processor time of a frame without weather and under some skies, and of getting ready for a flight.

python tests/benchmarks/bench_weather.py work/maps/boxes_3d.json work/plan/drone_trace.json
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from cosfly.geometry import intrinsic_matrix, world_from_camera
from cosfly.products.boxes import read_boxes
from cosfly.products.traces import read_traces
from cosfly.products.weather import TIMES, WEATHERS, resolved
from cosfly.render.flight import MARGIN_M
from cosfly.render.person import choose_clothes, gait_of
from cosfly.render.stage import open_renderer

SIZE, FRAMES, ROUNDS = (1280, 720), 20, 3
SKIES = (
    None,
    ("clear", "noon"),
    ("dense_fog", "noon"),
    ("clear", "night"),
    ("heavy_rain", "noon"),
    ("heavy_rain", "night"),
)


def main(boxes: Path, traces: Path) -> None:
    renderer, trace = open_renderer("gl", read_boxes(boxes), *SIZE), read_traces(traces)[0]
    print(renderer.device)
    places, intrinsic = np.concatenate([trace.positions_m, trace.targets_m]), intrinsic_matrix(*SIZE, 67.38)
    clothes, gait = choose_clothes(np.random.default_rng(0)), gait_of(trace.targets_m, trace.time_s)
    print("| sky | ready for a flight, ms | a frame, ms |\n|---|---|---|")
    for sky in SKIES:
        knobs = None if sky is None else resolved(WEATHERS[sky[0]], TIMES[sky[1]])
        ready, frame = [], []
        for _ in range(ROUNDS):
            began = time.process_time()
            renderer.prepare(places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M, knobs)
            ready.append(time.process_time() - began)
            began = time.process_time()
            for i in range(FRAMES):
                pose = world_from_camera(trace.positions_m[i], trace.rotations_deg[i])
                renderer.render(pose, intrinsic, gait.posed(i, trace.targets_m[i], clothes))
            frame.append((time.process_time() - began) / FRAMES)
        name = "without weather" if sky is None else ", ".join(sky).replace("_", " ")
        print(f"| {name} | {1000 * min(ready):.0f} | {1000 * min(frame):.1f} |")
    renderer.close()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
