"""How many labels are told without a picture, and how many hang on what was drawn after their window: on plans, which
need no rendering.

    python tests/benchmarks/bench_blind.py                       six towns of `diverse` to fit on, two to be told
    python tests/benchmarks/bench_blind.py --seeds 0 1 2 3       the same with four times the walks
    python tests/benchmarks/bench_blind.py --delft FILE --simworld FILE    and cities by other makers, flown alike

The first table reads exact poses. The second reads facts of poses as they are drawn, on the clean and the perturbed
track: there the embedded rule teacher is compared with a network. Shares are in percent.

The walker counts as visible where a ray of five reaches it and the picture shows its place.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from caption.schema import WindowConfig
from caption.stage.windows import cut_windows, order_comes_within
from caption.teachers.rules import decide
from caption.verification.actions import TABLE, measure
from caption.verification.facts import Facts, measure_facts
from cosfly.formats.boxes import BoxMap
from cosfly.formats.captions import TOKENS
from cosfly.formats.frames import Camera
from cosfly.formats.pedestrian_paths import walk_id
from cosfly.formats.playback import Perturbation, TargetRecord, Track
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import intrinsic_matrix, world_from_camera, wrap_deg
from cosfly.geometry.kernels import obstacle_index
from cosfly.inspection.blind_baseline import FITTED_ON, STANDS_MPS, fit_deciders, fit_network, past_of
from cosfly.maps.stage import load_map
from cosfly.pedestrians.stage import make_pedestrian
from cosfly.pedestrians.walkable import walkable_ground
from cosfly.pipeline.settings import RunConfig
from cosfly.planners.stage import draw_styles_of, plan_trajectory, screens_of
from cosfly.render.camera import view_target
from cosfly.render.perturbation import PerturbationConfig, Poses, Surroundings, perturb
from cosfly.runtime.config import load, shipped
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import simplify
from specimens import make_flight

UNSEEN = ("old_town", "market")
SIZE_PX, FOV_DEG = (640, 360), 50.0
TRACKS = ("clean", "perturbed")
TURNS_DEG = 45.0  # a larger change of heading is a turn


class Windows(NamedTuple):
    """Of n windows.

    Attributes:
        pasts: (n, d) exact geometry. labels: (n,). is_ahead: (n,) whether the label was drawn after the window.
        rows: per track, (n, d) facts as drawn. decisions: per track, (n,) by the rule teacher. is_hard: per track,
            (n, number of decisions) whether a decision is a hard conflict.
    """

    pasts: np.ndarray
    labels: np.ndarray
    is_ahead: np.ndarray
    rows: dict[str, np.ndarray]
    decisions: dict[str, np.ndarray]
    is_hard: dict[str, np.ndarray]


def flights_of(cfg: RunConfig, name: str) -> Iterator[tuple[DroneTrace, BoxMap, PerturbationConfig]]:
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
            yield trace, box_map, town.render.perturbation


def tracks_of(trace: DroneTrace, box_map: BoxMap, cfg: PerturbationConfig) -> tuple[Track, Track]:
    """Return the clean and the perturbed track of a trajectory."""
    camera = Camera(*SIZE_PX, intrinsic_matrix(*SIZE_PX, FOV_DEG))
    poses = Poses(trace.positions_m, trace.rotations_deg, trace.targets_m, trace.clearances_m)
    rng = rng_for(0, "bench.blind", trace.path_id)
    perturbed = perturb(poses, [camera] * len(trace.time_s), Surroundings(box_map), cfg, rng)
    offsets = perturbed.drone_offsets_m, perturbed.rotation_offsets_deg, perturbed.target_offsets_m
    nothing = Perturbation(np.zeros(len(trace.time_s), dtype=bool), *(np.zeros_like(one) for one in offsets))
    clean = track_of(trace, poses, camera, nothing)
    other = track_of(trace, perturbed.poses, camera, Perturbation(perturbed.is_perturbed, *offsets))
    return clean, replace(other, is_original=False, variant="aug_001")


def track_of(trace: DroneTrace, poses: Poses, camera: Camera, perturbation: Perturbation) -> Track:
    matrices = [world_from_camera(*pose) for pose in zip(poses.positions_m, poses.rotations_deg, strict=True)]
    views = [view_target(at_m, pose, camera) for at_m, pose in zip(poses.targets_m, matrices, strict=True)]
    in_view = np.array([view.in_view for view in views])
    target = TargetRecord(
        in_view=in_view, visible=in_view & (trace.visibility > 0), depth_m=np.array([view.depth_m for view in views]),
        uv=np.array([view.uv for view in views]), bbox=np.array([view.bbox_px for view in views]),
        visibility=trace.visibility,
    )  # fmt: skip
    return replace(
        make_flight(len(trace.time_s))[0], folder=Path(), camera=camera, time_s=trace.time_s,
        positions_m=poses.positions_m, rotations_deg=poses.rotations_deg, targets_m=poses.targets_m, target=target,
        perturbation=perturbation, segments=trace.segments, mission=trace.mission,
    )  # fmt: skip


def row_of(facts: Facts) -> np.ndarray:
    """Return the facts of a window that a network reads, (d,); unknown values are 0."""
    turns_deg = [after - before for before, after in pairwise(facts.yaw_deg)]
    climbs_m = [after - before for before, after in pairwise(facts.altitude_m)]
    numbers = [
        *facts.velocity_mps, facts.mean_speed_mps, *(facts.target_velocity_mps or (0.0, 0.0)), facts.target_speed_mps,
        facts.target_turn_deg, *(one for place in facts.place_m[-3:] for one in place or (0.0, 0.0, 0.0)),
        *facts.distance_m[-3:], *facts.bearing_deg[-3:], *turns_deg, *climbs_m, *facts.pitch_deg[-2:],
        facts.yaw_rate_dps[-1], facts.speed_mps[-1], facts.climb_mps[-1], *facts.step_speeds_mps[-3:],
        *(word in ("visible", "partly_occluded") for word in facts.visibility[-3:]), facts.mission is not None,
    ]  # fmt: skip
    return np.array([0.0 if number is None else float(number) for number in numbers])


def is_drawn_ahead(track: Track, now: int, last: int, is_ordered: bool) -> bool | None:
    """Return whether the label may depend on a random event after frame `now`, up to its last frame `last`.

    Another part of the drone trajectory begins, or the target stops, starts to walk or turns by more than TURNS_DEG.

    Random events within a part, such as the times of hops, are not recorded and not counted. While a mission's order is
    in force there are no random events. None means that the target's exact positions are not known.
    """
    if is_ordered:
        return False
    span = slice(max(0, now - 1), last + 1)
    steps_m = np.diff(track.walked_m[span, :2], axis=0)
    steps_s = np.diff(track.time_s[span])
    if now < 1 or not np.isfinite(steps_m).all():
        return None
    moves = np.hypot(*steps_m.T) > STANDS_MPS * steps_s
    headings_deg = np.degrees(np.arctan2(steps_m[:, 1], steps_m[:, 0]))
    turns = moves & moves[0] & (np.abs(wrap_deg(headings_deg - float(headings_deg[0]))) > TURNS_DEG)
    begins = any(now < part.begin <= last for part in track.segments)
    return bool(begins or (moves != moves[0]).any() or turns.any())


def windows_of(cfg: RunConfig, names: list[str]) -> Windows:
    cut, numbers = WindowConfig(), {name: k for k, name in enumerate(TOKENS)}
    found = []
    for clean, perturbed in (tracks_of(*flight) for name in names for flight in flights_of(cfg, name)):
        for pair in zip(cut_windows(clean, cut), cut_windows(perturbed, cut, clean), strict=True):
            now = pair[0].observed.indices[-1]
            label = TABLE.label_of(measure(pair[0].future))
            if label is None or order_comes_within(clean.mission, now, cut.future_frames):
                continue
            is_ordered = clean.mission is not None and clean.mission.order_at(now) is not None
            past = past_of(clean, pair[0].observed.indices, is_ordered)
            is_ahead = is_drawn_ahead(clean, now, now + cut.future_frames, is_ordered)
            facts = [measure_facts(window.observed) for window in pair]
            hard = [TABLE.contradicted_by(motion := measure(w.future), TABLE.label_of(motion)) for w in pair]
            found.append((
                past, numbers[label], is_ahead, *map(row_of, facts), *(numbers[decide(one)] for one in facts),
                *([token in one for token in TOKENS] for one in hard),
            ))  # fmt: skip
    pasts, labels, ahead, *drawn = map(np.array, zip(*found, strict=True))
    by_track = [dict(zip(TRACKS, drawn[i : i + 2], strict=True)) for i in (0, 2, 4)]
    return Windows(pasts, labels, ahead.astype(bool), *by_track)


def joined(parts: list[Windows]) -> Windows:
    arrays = [np.concatenate([part[i] for part in parts]) for i in range(3)]
    tables = [{track: np.concatenate([part[i][track] for part in parts]) for track in TRACKS} for i in range(3, 6)]
    return Windows(*arrays, *tables)


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
        return joined([windows_of(cfg, list(names)) for cfg in cfgs])

    fitted = all_of(*(name for name in towns if name not in UNSEEN))
    some = rng_for(0, "bench.blind", "some").permutation(len(fitted.labels))[:FITTED_ON]
    pasts, labels = fitted.pasts[some], fitted.labels[some]
    begun, rules = time.process_time(), {}
    for draw in range(3):
        rules[draw] = fit_deciders(pasts, labels, rng_for(0, "bench.blind", str(draw)))
    seconds = (time.process_time() - begun) / 3
    print(f"fitted on {len(labels):,} windows, {pasts.shape[1]} numbers each, {seconds:.1f} s of processor time a draw")
    print("| town | windows | most frequent | rule | network (three draws) | drawn ahead | of these | of the others |")
    print("|---|---|---|---|---|---|---|---|")
    unseen = {" and ".join(UNSEEN): all_of(*UNSEEN)} | {name: all_of(name) for name in told}
    for title, asked_of in unseen.items():
        wanted, ahead = asked_of.labels, asked_of.is_ahead
        right = [rules[draw]["blind"](asked_of.pasts) == wanted for draw in rules]
        cells = [(wanted == np.bincount(labels).argmax()).mean(), (rules[0]["rule"](asked_of.pasts) == wanted).mean()]
        cells = [f"{100 * cell:.1f}" for cell in cells] + [", ".join(f"{100 * one.mean():.1f}" for one in right)]
        cells += [f"{100 * share:.1f}" for share in (ahead.mean(), right[0][ahead].mean(), right[0][~ahead].mean())]
        print(f"| {title} | {len(wanted):,} | {' | '.join(cells)} |", flush=True)
    print("\n| town | track | rule teacher: labels | hard conflicts | network: labels | hard conflicts |")
    print("|---|---|---|---|---|---|")
    rows = np.concatenate([fitted.rows[track][some] for track in TRACKS])
    network = fit_network(rows, np.tile(labels, 2), rng_for(0, "bench.blind", "drawn"))
    for title, asked_of in unseen.items():
        for track in TRACKS:
            made = asked_of.decisions[track], network(asked_of.rows[track])
            shares = [share for by in made for share in shares_of(by, asked_of.labels, asked_of.is_hard[track])]
            print(f"| {title} | {track} | {' | '.join(f'{100 * share:.1f}' for share in shares)} |", flush=True)


def shares_of(decisions: np.ndarray, labels: np.ndarray, is_hard: np.ndarray) -> tuple[float, float]:
    """Return the share of decisions that are the label, and that of hard conflicts."""
    return (decisions == labels).mean(), is_hard[np.arange(len(labels)), decisions].mean()


if __name__ == "__main__":
    main()
