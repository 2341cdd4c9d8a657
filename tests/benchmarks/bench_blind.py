"""How many labels are predicted without a picture, from the past geometry of planned trajectories, which need no
rendering.

    python tests/benchmarks/bench_blind.py                       six towns of `diverse` to fit on, two to be asked about
    python tests/benchmarks/bench_blind.py --seeds 0 1 2 3       the same with four times the trajectories
    python tests/benchmarks/bench_blind.py --delft FILE --simworld FILE    and cities by other makers

Shares are in percent. The target counts as visible where a ray of five reaches it and the picture shows its place.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import scenes  # noqa: F401  # finds the specimens

from caption.schema import WindowConfig
from caption.stage.windows import cut_windows, order_comes_within
from caption.verification.actions import TABLE, measure
from cosfly.formats.captions import TOKENS
from cosfly.formats.frames import Camera
from cosfly.formats.pedestrian_paths import walk_id
from cosfly.formats.playback import Perturbation, TargetRecord, Track
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera
from cosfly.geometry.kernels import obstacle_index
from cosfly.inspection.blind_baseline import FITTED_ON, fit_deciders, past_of
from cosfly.maps.stage import load_map
from cosfly.pedestrians.stage import make_pedestrian
from cosfly.pedestrians.walkable import walkable_ground
from cosfly.pipeline.settings import RunConfig
from cosfly.planners.stage import draw_styles_of, plan_trajectory, screens_of
from cosfly.render.camera import view_target
from cosfly.runtime.config import load, shipped
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import simplify
from specimens import make_flight

UNSEEN = ("old_town", "market")
SIZE_PX, FOV_DEG = (640, 360), 50.0


def traces_of(cfg: RunConfig, name: str) -> Iterator[DroneTrace]:
    town = cfg.of_town(name)
    box_map = simplify(load_map(town.maps, seed=town.seed), town.simplify)
    ground, ids = walkable_ground(box_map, town.pedestrians), map(walk_id, range(town.pedestrians.num_paths))
    walks = [
        make_pedestrian(id_, ground, town.pedestrians, rng_for(town.seed, "pedestrians", id_)).trajectory for id_ in ids
    ]
    obstacles, screens = obstacle_index(box_map), screens_of(box_map)
    for walk, styles in zip(walks, draw_styles_of(walks, town.plan, town.seed), strict=True):
        trace = plan_trajectory(walk, obstacles, town.plan, town.seed, screens, styles)
        if trace.drop_reason is None:
            yield trace


def track_of(trace: DroneTrace) -> Track:
    """Return the clean track of a trajectory."""
    camera = Camera(*SIZE_PX, intrinsic_matrix(*SIZE_PX, FOV_DEG))
    matrices = [world_from_camera(*pose) for pose in zip(trace.positions_m, trace.rotations_deg, strict=True)]
    views = [view_target(at_m, pose, camera) for at_m, pose in zip(trace.targets_m, matrices, strict=True)]
    in_view = np.array([view.in_view for view in views])
    target = TargetRecord(
        in_view=in_view, visible=in_view & (trace.visibility > 0), depth_m=np.array([view.depth_m for view in views]),
        uv=np.array([view.uv for view in views]), bbox=np.array([view.bbox_px for view in views]),
        visibility=trace.visibility,
    )  # fmt: skip
    zero = np.zeros((len(trace.time_s), 3))
    return replace(
        make_flight(len(trace.time_s))[0], folder=Path(), camera=camera, time_s=trace.time_s,
        positions_m=trace.positions_m, rotations_deg=trace.rotations_deg, targets_m=trace.targets_m, target=target,
        perturbation=Perturbation(np.zeros(len(zero), dtype=bool), zero, zero, zero), segments=trace.segments,
        mission=trace.mission,
    )  # fmt: skip


def windows_of(cfg: RunConfig, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the pasts, (n, d), and the labels, (n,), of all windows that have a label."""
    cut, numbers = WindowConfig(), {name: k for k, name in enumerate(TOKENS)}
    found = []
    for track in (track_of(trace) for name in names for trace in traces_of(cfg, name)):
        for window in cut_windows(track, cut):
            now = window.observed.indices[-1]
            label = TABLE.label_of(measure(window.future))
            if label is None or order_comes_within(track.mission, now, cut.future_frames):
                continue
            is_ordered = track.mission is not None and track.mission.order_at(now) is not None
            found.append((past_of(track, window.observed.indices, is_ordered), numbers[label]))
    pasts, labels = zip(*found, strict=True)
    return np.array(pasts), np.array(labels)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--delft", help="a CityJSON file")
    parser.add_argument("--simworld", help="a SimWorld world, its tables beside it")
    asked = parser.parse_args()
    told = {"delft": f"{{source: cityjson, cityjson: {{path: {asked.delft}}}}}"} if asked.delft else {}
    told |= {"simworld": f"{{source: simworld, simworld: {{world: {asked.simworld}}}}}"} if asked.simworld else {}
    cities = [f"towns.{name}={{maps: {maps}}}" for name, maps in told.items()]
    cfgs = [load(RunConfig, shipped("diverse.yaml"), [f"seed={seed}", *cities]) for seed in asked.seeds]

    def all_of(*names: str) -> tuple[np.ndarray, np.ndarray]:
        pasts, labels = zip(*(windows_of(cfg, list(names)) for cfg in cfgs), strict=True)
        return np.concatenate(pasts), np.concatenate(labels)

    pasts, labels = all_of(*(name for name in cfgs[0].towns if name not in (*told, *UNSEEN)))
    some = rng_for(0, "bench.blind", "some").permutation(len(labels))[:FITTED_ON]
    pasts, labels = pasts[some], labels[some]
    rules = [fit_deciders(pasts, labels, rng_for(0, "bench.blind", str(draw))) for draw in range(3)]
    print(f"fitted on {len(labels):,} windows, {pasts.shape[1]} numbers each")
    print("| town | windows | most frequent | rule | network (three draws) |\n|---|---|---|---|---|")
    for names in (UNSEEN, *((name,) for name in told)):
        own, wanted = all_of(*names)
        answers = [np.full(len(wanted), np.bincount(labels).argmax()), rules[0]["rule"](own)]
        shares = [f"{100 * (one == wanted).mean():.1f}" for one in (*answers, *(rule["blind"](own) for rule in rules))]
        print(f"| {' and '.join(names)} | {len(wanted):,} | {shares[0]} | {shares[1]} | {', '.join(shares[2:])} |")


if __name__ == "__main__":
    main()
