"""Rendering: where a frame's processor time goes.

    python tests/benchmarks/bench_render.py --frames 24                    # one process, no workers

1280x720, all files, the synthetic town and the SimWorld city, flights of the default planner. On a
machine with a GPU the same commands use it (the device is printed).
"""

import argparse
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scenes

from cosfly.formats import frames
from cosfly.formats.boxes import read_boxes, write_boxes
from cosfly.formats.traces import DroneTrace, read_traces, write_traces
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.geometry.kernels import obstacle_index
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_trajectory
from cosfly.render import track as flight
from cosfly.render.contract import PERSON_ID
from cosfly.render.person import choose_clothes, gait_of
from cosfly.render.stage import open_renderer
from cosfly.render.track import MARGIN_M

SIZE = (1280, 720)
FOVS_DEG = (60.0, 90.0)
FILES = ("boxes_3d.json", "drone_trace.json")


def make_inputs(root: Path) -> dict[str, Path]:
    folders = {}
    for name, raw in (("town", scenes.town()), ("city", scenes.city())):
        if raw is None:
            continue
        simple, cfg = scenes.simplified(raw), PlanConfig()
        (walk,) = scenes.walks_on(simple, num_paths=1)
        trace = plan_trajectory(walk, obstacle_index(simple), cfg, scenes.SEED)
        folders[name] = root / name
        folders[name].mkdir()
        write_boxes(folders[name] / FILES[0], raw)
        write_traces(folders[name] / FILES[1], [replace(trace, drop_reason=None)], {})
    return folders


def views(trace: DroneTrace, num_frames: int) -> list[tuple]:
    gait, clothes, found = gait_of(trace.targets_m, trace.time_s), choose_clothes(np.random.default_rng(0)), []
    for number, i in enumerate(np.linspace(0, len(trace.time_s) - 1, num_frames).astype(int)):
        pose = world_from_camera(trace.positions_m[i], trace.rotations_deg[i])
        intrinsic = intrinsic_matrix(*SIZE, FOVS_DEG[number % len(FOVS_DEG)])
        found.append((pose, intrinsic, {PERSON_ID: gait.posed(int(i), trace.targets_m[i], clothes)}))
    return found


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
    (trace,) = read_traces(folder / FILES[1])
    renderer: Any = open_renderer("gl", read_boxes(folder / FILES[0]), *SIZE)
    places = np.concatenate([trace.positions_m, trace.targets_m])
    renderer.prepare(places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M)
    todo = views(trace, num_frames)
    for view in todo[:: max(1, num_frames // 6)]:
        renderer.render(*view)  # compiles what this flight needs
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40, help="frames of a measurement")
    given = parser.parse_args()
    scenes.one_thread_and_machine()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as root:
        folders = make_inputs(Path(root))
        found = {name: parts(folder, given.frames) for name, folder in folders.items()}
    names = ["map", "draw", "read", "PNG rgb", "PNG ids", "npy", "hash", "write", "sum"]
    rows = [[name, *used, sum(used)] for name, (_, used) in found.items()]
    scenes.print_table(f"CPU ms a frame, {next(iter(found.values()))[0]}", names, rows)


if __name__ == "__main__":
    main()
