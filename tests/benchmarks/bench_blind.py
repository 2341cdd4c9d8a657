"""How many labels are told without a picture, and how many hang on what was drawn after their window: on plans, which
need no rendering.

    python tests/benchmarks/bench_blind.py                       six towns of `diverse` to fit on, two to be told
    python tests/benchmarks/bench_blind.py --seeds 0 1 2 3       the same with four times the walks
    python tests/benchmarks/bench_blind.py --delft FILE --simworld FILE    and cities by other makers, flown alike

The walker counts as visible where a ray of five reaches it and the camera looks that way.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from caption.schema import WindowConfig
from caption.stage.windows import current_frames, cut_future, label_motion, order_comes_within
from caption.verification.actions import TABLE, measure
from cosfly.formats.captions import TOKENS
from cosfly.formats.pedestrian_paths import walk_id
from cosfly.formats.playback import Track
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import look_at, wrap_deg
from cosfly.geometry.kernels import obstacle_index
from cosfly.inspection.blind_baseline import FITTED_ON, fit_deciders, is_drawn_ahead, past_of
from cosfly.maps.stage import load_map
from cosfly.pedestrians.stage import make_pedestrian
from cosfly.pedestrians.walkable import walkable_ground
from cosfly.pipeline.settings import RunConfig
from cosfly.planners.stage import draw_styles_of, plan_trajectory, screens_of
from cosfly.runtime.config import load, shipped
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import simplify
from specimens import make_flight

UNSEEN = ("old_town", "market")
HALF_VIEW_DEG = (30.0, 17.0)  # of the narrowest camera
Windows = tuple[np.ndarray, np.ndarray, np.ndarray]  # pasts (n, d), labels (n,), drawn ahead (n,)


def flights_of(cfg: RunConfig, name: str) -> Iterator[DroneTrace]:
    town = cfg.of_town(name)
    box_map = simplify(load_map(town.maps, seed=town.seed), town.simplify).box_map
    ground, ids = walkable_ground(box_map, town.pedestrians), map(walk_id, range(town.pedestrians.num_paths))
    walks = [
        make_pedestrian(id_, ground, town.pedestrians, rng_for(town.seed, "pedestrians", id_)).trajectory for id_ in ids
    ]
    obstacles, screens = obstacle_index(box_map), screens_of(box_map)
    for walk, styles in zip(walks, draw_styles_of(walks, town.plan, town.seed), strict=True):
        trace = plan_trajectory(walk, obstacles, town.plan, town.seed, screens, styles)
        if trace.drop_reason is None:
            yield trace


def flight_of(trace: DroneTrace) -> Track:
    pitch, yaw = np.degrees(look_at(trace.positions_m, trace.targets_m))
    aside = np.abs(wrap_deg(yaw - trace.rotations_deg[:, 1])), np.abs(pitch - trace.rotations_deg[:, 0])
    visible = (trace.visibility > 0) & (aside[0] < HALF_VIEW_DEG[0]) & (aside[1] < HALF_VIEW_DEG[1])
    flight = make_flight(len(trace.time_s))[0]
    return replace(
        flight, time_s=trace.time_s, positions_m=trace.positions_m,
        rotations_deg=trace.rotations_deg, targets_m=trace.targets_m, target=replace(flight.target, visible=visible),
        segments=trace.segments, mission=trace.mission,
    )  # fmt: skip


def windows_of(cfg: RunConfig, names: list[str]) -> Windows:
    cut, numbers = WindowConfig(), {name: k for k, name in enumerate(TOKENS)}
    found = []
    for flight in (flight_of(trace) for name in names for trace in flights_of(cfg, name)):
        motion = label_motion(flight)
        for now in current_frames(len(flight), cut):
            label = TABLE.label_of(measure(cut_future(flight, motion, now, cut.future_frames)))
            if label is None or order_comes_within(flight.mission, now, cut.future_frames):
                continue
            is_ordered = flight.mission is not None and flight.mission.order_at(now) is not None
            past = past_of(flight, range(now - cut.num_frames + 1, now + 1), is_ordered)
            found.append((past, numbers[label], is_drawn_ahead(flight, now, now + cut.future_frames, is_ordered)))
    pasts, labels, ahead = zip(*found, strict=True)
    return np.array(pasts), np.array(labels), np.array(ahead, dtype=bool)


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
    towns = [name for name in cfgs[0].towns if name not in told]

    def all_of(*names: str) -> Windows:
        parts = [windows_of(cfg, list(names)) for cfg in cfgs]
        return tuple(np.concatenate(part) for part in zip(*parts, strict=True))

    pasts, labels, _ = all_of(*(name for name in towns if name not in UNSEEN))
    some = rng_for(0, "bench.blind", "some").permutation(len(labels))[:FITTED_ON]
    pasts, labels = pasts[some], labels[some]
    begun, rules = time.process_time(), {}
    for draw in range(3):
        rules[draw] = fit_deciders(pasts, labels, rng_for(0, "bench.blind", str(draw)))
    seconds = (time.process_time() - begun) / 3
    print(f"fitted on {len(labels):,} windows, {pasts.shape[1]} numbers each, {seconds:.1f} s of processor time a draw")
    print("| town | windows | most frequent | rule | network (three draws) | drawn ahead | of these | of the others |")
    print("|---|---|---|---|---|---|---|---|")
    for title, names in [(" and ".join(UNSEEN), UNSEEN), *((name, (name,)) for name in told)]:
        asked_of, wanted, ahead = all_of(*names)
        right = [rules[draw]["blind"](asked_of) == wanted for draw in rules]
        cells = [(wanted == np.bincount(labels).argmax()).mean(), (rules[0]["rule"](asked_of) == wanted).mean()]
        cells = [f"{100 * cell:.1f}" for cell in cells] + [", ".join(f"{100 * one.mean():.1f}" for one in right)]
        cells += [f"{100 * share:.1f}" for share in (ahead.mean(), right[0][ahead].mean(), right[0][~ahead].mean())]
        print(f"| {title} | {len(wanted):,} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
