"""Rendering: where a frame's processor time goes, frames/s to disk, a map of 62,640 boxes, memory over thousands of
frames.

    python tests/benchmarks/bench_render.py parts                          # one process, no workers
    python tests/benchmarks/bench_render.py disk --workers 2               # the stage as it is used
    python tests/benchmarks/bench_render.py tiles                          # the SimWorld city 12 x 12
    python tests/benchmarks/bench_render.py memory --frames 5000

1280x720, all files, the synthetic town and the SimWorld city, flights of the default planner; `disk` at 90 degrees, one
flight a process. On a machine with a GPU the same commands use it (the device is printed).
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scenes

from cosfly.formats import frames
from cosfly.formats.boxes import BoxMap, read_boxes, write_boxes
from cosfly.formats.traces import DroneTrace, read_traces, write_traces
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.geometry.kernels import obstacle_index
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_trajectory
from cosfly.render import track as flight
from cosfly.render.contract import Renderer
from cosfly.render.person import choose_clothes, gait_of
from cosfly.render.perturbation import Surroundings
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import make_track_script, open_renderer
from cosfly.render.track import MARGIN_M, render_track

SIZE = (1280, 720)
FOVS_DEG = (60.0, 90.0)
FILES = ("boxes_3d.json", "drone_trace.json")
REPOSITORY = Path(__file__).resolve().parents[2]
WORKER = """
import json, os, sys, tempfile, time
from dataclasses import replace
from pathlib import Path
from cosfly.formats.boxes import read_boxes
from cosfly.formats.traces import read_traces
from cosfly.render.settings import RenderConfig
from cosfly.render.stage import make_track_script, open_renderer
from cosfly.render.track import render_track
boxes, traces, out, number = *map(Path, sys.argv[1:4]), int(sys.argv[4])
cfg = RenderConfig(fovs_deg=(90.0,), first_timestamp=1776000000)
trace = read_traces(traces)[number]
renderer = open_renderer("gl", read_boxes(boxes), cfg.width_px, cfg.height_px)
script = make_track_script(trace, number, "clean", "Town", None, cfg, 0)
with tempfile.TemporaryDirectory() as scratch:
    render_track(renderer, script, Path(scratch), cfg)  # compiles; nothing of it is counted
used_s, start_s = time.process_time(), time.perf_counter()
(out / str(number)).mkdir()
count = len(render_track(renderer, script, out / str(number), cfg))
print(json.dumps([count, time.process_time() - used_s, time.perf_counter() - start_s]))
"""


def make_inputs(root: Path, num_flights: int) -> dict[str, Path]:
    folders = {}
    for name, raw in (("town", scenes.town()), ("city", scenes.city())):
        if raw is None:
            continue
        simple, cfg = scenes.simplified(raw), PlanConfig()
        walks = scenes.walks_on(simple, num_paths=num_flights)
        obstacles = obstacle_index(simple)
        traces = [plan_trajectory(walk, obstacles, cfg, scenes.SEED) for walk in walks]
        folders[name] = root / name
        folders[name].mkdir()
        write_boxes(folders[name] / FILES[0], raw)
        write_traces(folders[name] / FILES[1], [replace(trace, drop_reason=None) for trace in traces], {})
    return folders


def views(traces: list[DroneTrace], num_frames: int) -> list[tuple]:
    found = []
    for trace in traces:
        gait, clothes = gait_of(trace.targets_m, trace.time_s), choose_clothes(np.random.default_rng(0))
        for number, i in enumerate(np.linspace(0, len(trace.time_s) - 1, num_frames // len(traces)).astype(int)):
            pose = world_from_camera(trace.positions_m[i], trace.rotations_deg[i])
            intrinsic = intrinsic_matrix(*SIZE, FOVS_DEG[number % len(FOVS_DEG)])
            found.append((pose, intrinsic, gait.posed(int(i), trace.targets_m[i], clothes)))
    return found


def prepare(renderer: Renderer, trace: DroneTrace) -> None:
    places = np.concatenate([trace.positions_m, trace.targets_m])
    renderer.prepare(places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M)


class Parts:
    """Processor time by name, of calls that do not overlap."""

    def __init__(self) -> None:
        self.used_ms: Counter[str] = Counter()

    def of(self, name: str, function: Any) -> Any:
        def timed(*args: Any) -> Any:
            used_ms, result = scenes.cpu_ms(lambda: function(*args))
            self.used_ms[name] += used_ms
            return result

        return timed


def parts(folder: Path, num_frames: int) -> tuple[str, list[Any]]:
    """One process draws and writes frames one after the other. Gives the device and ms a frame."""
    traces = read_traces(folder / FILES[1])
    renderer: Any = open_renderer("gl", read_boxes(folder / FILES[0]), *SIZE)
    prepare(renderer, traces[0])
    todo = views(traces[:1], num_frames)
    for pose, intrinsic, person in todo[:: max(1, num_frames // 6)]:
        renderer.render(pose, intrinsic, person)  # compiles what this flight needs
    measured = Parts()
    plain = renderer.render, renderer._read, renderer.context.finish

    def read() -> Any:
        plain[2]()
        return measured.of("read back, soften, split", plain[1])()

    renderer._read = read
    with tempfile.TemporaryDirectory() as scratch:
        for number, view in enumerate(todo):
            frame = measured.of("render", plain[0])(*view)
            contents = [
                measured.of("PNG of colours", frames.rgb_bytes)(frame.rgb),
                measured.of("PNG of kinds and ids", frames.instance_bytes)(frame.kinds, frame.ids),
                measured.of("depth packed", frames.depth_file)(frame.depth, "png")[1],
            ]
            for k, data in enumerate(contents):
                measured.of("hash", flight.sha256_bytes)(data)
                measured.of("write", Path(scratch, f"{number}_{k}").write_bytes)(data)
    device = renderer.device
    renderer.close()
    used = measured.used_ms
    used["draw"] = used.pop("render") - used["read back, soften, split"]
    names = (
        "draw", "read back, soften, split", "PNG of colours", "PNG of kinds and ids", "depth packed", "hash", "write",
    )  # fmt: skip
    return device, [used[name] / num_frames for name in names]


def to_disk(folder: Path, out: Path, workers: int, num_points: int) -> list[float]:
    """Draw and write a flight with each of some processes at once, as the stage's workers do. Gives frames, CPU ms a
    frame, frames/s."""
    columns = ("time_s", "positions_m", "rotations_deg", "targets_m", "visibility", "clearances_m")
    traces = read_traces(folder / FILES[1])
    every = [np.linspace(0, len(trace.time_s) - 1, num_points).astype(int) for trace in traces]
    cut = [
        replace(trace, segments=(), **{name: getattr(trace, name)[rows] for name in columns})
        for trace, rows in zip(traces, every, strict=True)
    ]
    write_traces(folder / "shortened.json", cut, {})
    program = folder / "worker.py"
    program.write_text(WORKER)
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    if workers > 1:
        environment["LP_NUM_THREADS"] = str(max(1, len(os.sched_getaffinity(0)) // workers))  # as the stage does
    out.mkdir()
    command = [sys.executable, str(program), str(folder / FILES[0]), str(folder / "shortened.json"), str(out)]
    running = [
        subprocess.Popen([*command, str(number)], env=environment, stdout=subprocess.PIPE, text=True)
        for number in range(workers)
    ]
    found = [json.loads(process.communicate()[0]) for process in running]
    count = sum(frames for frames, _, _ in found)
    return [count, 1e3 * sum(used_s for _, used_s, _ in found) / count, sum(n / clock_s for n, _, clock_s in found)]


def tiles(num_frames: int) -> list[list[Any]]:
    """The same flight over the city, and over 12 x 12 of them; drawn in turns."""
    city = scenes.city()
    if city is None:
        return []
    simple, cfg = scenes.simplified(city), PlanConfig()
    (walk,) = scenes.walks_on(simple, num_paths=1)
    trace = plan_trajectory(walk, obstacle_index(simple), cfg, scenes.SEED)
    maps: dict[str, BoxMap] = {"one city": city, "12 x 12": scenes.tiled(city, 12, 12)}
    renderers, opened_s = {}, {}
    for name, box_map in maps.items():
        used_ms, renderers[name] = scenes.cpu_ms(lambda box_map=box_map: open_renderer("gl", box_map, *SIZE))
        opened_s[name] = used_ms / 1e3
        prepare(renderers[name], trace)
    used: Counter[str] = Counter()
    for count, view in enumerate(views([trace], num_frames + 6)):
        for name, renderer in renderers.items():
            used_ms, _ = scenes.cpu_ms(lambda renderer=renderer, view=view: renderer.render(*view))
            used[name] += used_ms if count >= 6 else 0.0
    once = used["one city"]
    return [[name, len(maps[name]), used[name] / num_frames, used[name] / once, opened_s[name]] for name in maps]


def resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def memory(num_frames: int) -> list[list[Any]]:
    """Resident memory of a process that draws and writes one flight after the other, small frames."""
    box_map = scenes.town()
    simple, cfg = scenes.simplified(box_map), PlanConfig()
    (walk,) = scenes.walks_on(simple, num_paths=1)
    trace = plan_trajectory(walk, obstacle_index(simple), cfg, scenes.SEED)
    small = RenderConfig(width_px=160, height_px=90, fovs_deg=(90.0,), first_timestamp=1776000000)
    renderer = open_renderer("gl", box_map, small.width_px, small.height_px)
    rows, done = [], 0
    while done < num_frames:
        script = make_track_script(trace, 0, "clean", "Town", Surroundings(simple), small, 0)
        with tempfile.TemporaryDirectory() as scratch:
            done += len(render_track(renderer, script, Path(scratch), small))
        if not rows or done - rows[-1][0] >= num_frames // 10:
            rows.append([done, resident_mib()])
    return [[count, mib, 100.0 * (mib / rows[min(1, len(rows) - 1)][1] - 1.0)] for count, mib in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("parts", "disk", "tiles", "memory"))
    parser.add_argument("--frames", type=int, help="frames of a measurement; of `disk`, of each flight")
    parser.add_argument("--workers", type=int, nargs="+")
    given = parser.parse_args()
    scenes.one_thread_and_machine()
    cv2.setNumThreads(1)
    if given.what == "tiles":
        names = ["map", "boxes", "CPU ms a frame", "times the city's", "CPU s to open"]
        scenes.print_table("A large map", names, tiles(given.frames or 40))
        return
    if given.what == "memory":
        scenes.print_table("Memory", ["frames", "MiB", "% over the second row"], memory(given.frames or 5000))
        return
    given.workers = given.workers or [2]
    with tempfile.TemporaryDirectory() as root:
        folders = make_inputs(Path(root), max(given.workers))
        if given.what == "parts":
            names = ["map", "draw", "read", "PNG rgb", "PNG ids", "npy", "hash", "write", "sum"]
            found = {name: parts(folder, given.frames or 40) for name, folder in folders.items()}
            rows = [[name, *used, sum(used)] for name, (_, used) in found.items()]
            scenes.print_table(f"CPU ms a frame, {next(iter(found.values()))[0]}", names, rows)
            return
        rows = []
        for name, folder in folders.items():
            for workers in given.workers:
                with tempfile.TemporaryDirectory() as scratch:
                    rows.append([name, workers, *to_disk(folder, Path(scratch, "out"), workers, given.frames or 60)])
        names = ["map", "workers", "frames", "CPU ms a frame", "frames/s on the clock"]
        scenes.print_table("To disk", names, rows)


if __name__ == "__main__":
    main()
