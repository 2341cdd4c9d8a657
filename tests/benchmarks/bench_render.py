"""Rendering: where a frame's processor time goes.

    python tests/benchmarks/bench_render.py --frames 24                    # one process, no workers

1280x720, the synthetic town, a flight of the default planner. On a machine with a GPU the same command uses it (the
device is printed).
"""

import argparse
from collections import Counter
from typing import Any

import cv2
import numpy as np
import scenes

from cosfly.formats import frames
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.geometry.kernels import obstacle_index
from cosfly.planners.contract import PlanConfig
from cosfly.planners.stage import plan_trajectory
from cosfly.render.contract import PERSON_ID
from cosfly.render.person import choose_clothes, gait_of
from cosfly.render.stage import open_renderer
from cosfly.render.track import MARGIN_M

SIZE = (1280, 720)
FOVS_DEG = (60.0, 90.0)


def views(trace: DroneTrace, num_frames: int) -> list[tuple]:
    gait, clothes, found = gait_of(trace.targets_m, trace.time_s), choose_clothes(np.random.default_rng(0)), []
    for number, i in enumerate(np.linspace(0, len(trace.time_s) - 1, num_frames).astype(int)):
        pose = world_from_camera(trace.positions_m[i], trace.rotations_deg[i])
        intrinsic = intrinsic_matrix(*SIZE, FOVS_DEG[number % len(FOVS_DEG)])
        found.append((pose, intrinsic, {PERSON_ID: gait.posed(int(i), trace.targets_m[i], clothes)}))
    return found


class Parts:
    """Processor time by name."""

    def __init__(self) -> None:
        self.used_ms: Counter[str] = Counter()

    def of(self, name: str, function: Any) -> Any:
        def timed(*args: Any) -> Any:
            used_ms, result = scenes.cpu_ms(lambda: function(*args))
            self.used_ms[name] += used_ms
            return result

        return timed


def measure(renderer: Any, trace: DroneTrace, num_frames: int) -> list[float]:
    """Draw and encode frames one after the other; return ms a frame of drawing, reading back and both pictures."""
    places = np.concatenate([trace.positions_m, trace.targets_m])
    renderer.prepare(places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M)
    todo, measured = views(trace, num_frames), Parts()
    for view in todo[:: max(1, num_frames // 6)]:
        renderer.render(*view)  # compiles what this flight needs
    plain = renderer._read

    def read() -> Any:
        renderer.context.finish()
        return measured.of("read", plain)()

    renderer._read = read
    for view in todo:
        frame = measured.of("render", renderer.render)(*view)
        measured.of("colours", frames.rgb_bytes)(frame.rgb)
        measured.of("ids", frames.instance_bytes)(frame.kinds, frame.ids)
    used = measured.used_ms
    return [one / num_frames for one in (used["render"] - used["read"], used["read"], used["colours"], used["ids"])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40, help="frames of a measurement")
    given = parser.parse_args()
    scenes.one_thread_and_machine()
    cv2.setNumThreads(1)
    raw = scenes.town()
    simple = scenes.simplified(raw)
    (walk,) = scenes.walks_on(simple, num_paths=1)
    trace = plan_trajectory(walk, obstacle_index(simple), PlanConfig(), scenes.SEED)
    renderer = open_renderer("gl", raw, *SIZE)
    row = measure(renderer, trace, given.frames)
    names = ["draw", "read back, soften, split", "PNG of colours", "PNG of kinds and ids", "sum"]
    scenes.print_table(f"CPU ms a frame, {renderer.device}", names, [[*row, sum(row)]])
    renderer.close()


if __name__ == "__main__":
    main()
