"""How many decisions a second the closed loop takes: 64 flights of 200 decisions with the rule teacher; and how many
steps a second an environment: alone, and two side by side in processes.

    python tests/benchmarks/bench_flying.py                     a town of our own, two workers, 640x360
    python tests/benchmarks/bench_flying.py --flights 8 --decisions 50 --rounds 3
    python tests/benchmarks/bench_flying.py --envs --rounds 3   cosfly/Follow-v0, 640x360; --size 64 48 for another

Planning is done first and not counted; starting workers, maps, drawing and deciding are. Of an environment its steps
alone are counted, from the second on.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

from caption.schema import CaptionConfig
from cosfly.closed_loop import stage
from cosfly.closed_loop.settings import FlyConfig
from cosfly.formats.boxes import write_boxes
from cosfly.formats.captions import TOKENS
from cosfly.maps.stage import MapsConfig, load_map
from cosfly.pedestrians import stage as pedestrians
from cosfly.pedestrians.walkable import PedestriansConfig
from cosfly.planners.contract import PlanConfig
from cosfly.render.settings import RenderConfig
from cosfly.runtime.run_dir import read_manifest
from cosfly.simplify.passes import SimplifyConfig, simplify
from distill.inference.samples import InferConfig

SEED = 64


def time_envs(rounds: int, size_px: tuple[int, int]) -> None:
    import gymnasium

    from cosfly.envs.episodes import NUM_DECISIONS

    hover = TOKENS.index("hover")  # which crashes nowhere, so that no town is made meanwhile
    how = {"shared_memory": False, "context": "spawn"}
    for _ in range(rounds):
        for num in (1, 2):
            mode = "async" if num > 1 else "sync"
            envs = gymnasium.make_vec(
                "cosfly/Follow-v0",
                num_envs=num,
                vectorization_mode=mode,
                vector_kwargs=how if num > 1 else {},
                size_px=size_px,
            )
            envs.reset(seed=SEED)
            envs.step([hover] * num)
            load, begun_s = os.getloadavg()[0], time.monotonic()
            for _ in range(NUM_DECISIONS - 2):
                envs.step([hover] * num)
            seconds = time.monotonic() - begun_s
            print(
                f"{num} side by side: {num * (NUM_DECISIONS - 2) / seconds:.1f} steps a second; load before {load:.1f}"
            )
            envs.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=64)
    parser.add_argument("--decisions", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--envs", action="store_true", help="steps of environments in place of flights")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 360), help="width and height of pictures of --envs")
    asked = parser.parse_args()
    if asked.envs:
        time_envs(asked.rounds, tuple(asked.size))
        return
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        box_map = load_map(MapsConfig(), seed=SEED)
        write_boxes(root / "boxes_3d.json", box_map)
        write_boxes(root / "step2_simplified.json", simplify(box_map, SimplifyConfig()))
        walks = PedestriansConfig(num_paths=asked.flights, min_distance_m=140, max_distance_m=220, ground="paved")
        how = {"seed": SEED, "workers": asked.workers}
        paths = pedestrians.run(walks, root / "step2_simplified.json", root / "walks", **how)
        fly = FlyConfig(most_decisions=asked.decisions, lost_s=0, tree=False)
        render = RenderConfig(width_px=640, height_px=360, fovs_deg=(60.0, 90.0))
        cfg = stage.ClosedLoopConfig(
            fly=fly, plan=PlanConfig(), render=render, caption=CaptionConfig(), infer=InferConfig()
        )
        for number in range(asked.rounds):
            load, out = os.getloadavg()[0], root / str(number)
            stage.run(cfg, root / "boxes_3d.json", root / "step2_simplified.json", paths, out, **how)
            seconds = read_manifest(out).seconds - read_manifest(out / stage.PLAN).seconds
            decisions = read_manifest(out).facts["flown"]["decisions"]
            print(f"{read_manifest(out).counts.kept} flights, {decisions} decisions in {seconds:.0f} s, "
                  f"{decisions / seconds:.1f} a second; load before {load:.1f}")  # fmt: skip


if __name__ == "__main__":
    main()
