"""Where the target is in the picture, how fast drone, person and camera move on both tracks, and whether a turn goes to
the side on which the target is: on plans of `diverse`, which need no rendering.

    python tests/benchmarks/bench_camera.py --seeds 1001 1002 1003
    python tests/benchmarks/bench_camera.py --seeds 1001 --delft FILE --simworld FILE    and cities by other makers
    python tests/benchmarks/bench_camera.py --set plan.gimbal.bandwidth_hz=0 --set render.perturbation.correlation_s=0

The field of view is 50 degrees. Speeds are medians and 95 % quantiles, m/s; accelerations the same, m/s^2.
"""

import argparse
from collections.abc import Iterator

import numpy as np
from bench_blind import SIZE_PX, flights_of, tracks_of

from caption.schema import WindowConfig
from caption.stage.windows import cut_windows, order_comes_within
from caption.verification.actions import TABLE, measure
from cosfly.formats.playback import Track
from cosfly.geometry.axes import step_s, wrap_deg
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load, shipped

SIDES = {"yaw_left_to_follow": -1, "yaw_right_to_follow": 1}
OFF_CENTRE = 0.05  # of the width; nearer to the middle the target is on no side


def sides_of(track: Track) -> Iterator[tuple[int, float]]:
    """Yield of each window the side to which the decision turns (0: none) and the target's place in the width."""
    cut = WindowConfig()
    for window in cut_windows(track, cut):
        now = window.observed.indices[-1]
        label = TABLE.label_of(measure(window.future))
        if label is not None and not order_comes_within(track.mission, now, cut.future_frames):
            yield SIDES.get(label, 0), track.target.uv[now][0] / SIZE_PX[0] - 0.5


def motion_of(tracks: list[Track]) -> str:
    """Return the cells of the motion on one kind of track."""
    cells = []
    for name in ("positions_m", "targets_m"):
        for order in (1, 2):
            parts = [
                np.linalg.norm(np.diff(getattr(track, name), n=order, axis=0), axis=1) / step_s(track.time_s) ** order
                for track in tracks
            ]
            cells.append("{:.2f}, {:.2f}".format(*np.percentile(np.concatenate(parts), [50, 95])))
    turns = [np.abs(wrap_deg(np.diff(track.rotations_deg[:, 1]))).max() / step_s(track.time_s) for track in tracks]
    return " | ".join([*cells, f"{max(turns):.0f}"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--num-paths", type=int, default=10, help="pedestrian trajectories of each town")
    parser.add_argument("--delft", help="a CityJSON file")
    parser.add_argument("--simworld", help="a SimWorld world, its tables beside it")
    parser.add_argument("--set", action="append", default=[], dest="sets", help="a setting, as for cosfly run")
    asked = parser.parse_args()
    told = {"delft": f"{{source: cityjson, cityjson: {{path: {asked.delft}}}}}"} if asked.delft else {}
    told |= {"simworld": f"{{source: simworld, simworld: {{world: {asked.simworld}}}}}"} if asked.simworld else {}
    sets = [*asked.sets, *(f"towns.{name}={{maps: {maps}}}" for name, maps in told.items())]
    sets += [f"pedestrians.num_paths={asked.num_paths}"]
    cfgs = [load(RunConfig, shipped("diverse.yaml"), [f"seed={seed}", *sets]) for seed in asked.seeds]
    groups = {"own towns": [name for name in cfgs[0].towns if name not in told]} | {name: [name] for name in told}
    pairs = {
        title: [tracks_of(*flight) for cfg in cfgs for name in names for flight in flights_of(cfg, name)]
        for title, names in groups.items()
    }
    print("| map | flights | windows | place in the width, 5 and 95 % | in the picture | turns | to its side |")
    print("|---|---|---|---|---|---|---|")
    for title, tracks in pairs.items():
        clean = [pair[0] for pair in tracks]
        places = np.concatenate([track.target.uv[:, 0] / SIZE_PX[0] - 0.5 for track in clean])
        in_view = np.concatenate([track.target.in_view for track in clean])
        sides = np.array([row for track in clean for row in sides_of(track)])
        turns, agrees = sides[:, 0] != 0, sides[:, 0] * sides[:, 1] > OFF_CENTRE
        low, high = np.nanpercentile(places, [5, 95])
        shares = [f"{100 * share:.1f} %" for share in (in_view.mean(), turns.mean(), agrees[turns].mean())]
        place = f"{100 * low:.1f} %, {100 * high:.1f} %"
        print(f"| {title} | {len(clean)} | {len(sides):,} | {place} | {' | '.join(shares)} |")
    print("\n| map | track | drone: speed | acceleration | person: speed | acceleration | greatest yaw rate, deg/s |")
    print("|---|---|---|---|---|---|---|")
    for title, tracks in pairs.items():
        for k, name in enumerate(("clean", "perturbed")):
            print(f"| {title} | {name} | {motion_of([pair[k] for pair in tracks])} |")


if __name__ == "__main__":
    main()
