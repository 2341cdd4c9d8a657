"""How many labels are predicted without a picture, from the past geometry of planned trajectories, which need no
rendering.

    python tests/benchmarks/bench_blind.py                       six towns of `diverse` to fit on, two to be asked about
    python tests/benchmarks/bench_blind.py --delft FILE --simworld FILE    and cities by other makers

Shares are in percent. The target counts as visible where a ray of five reaches it and the picture shows its place.
"""

import argparse

import numpy as np
import scenes  # noqa: F401  # finds the specimens
from specimens_planning import town_flights, track_of

from caption.schema import WindowConfig
from caption.stage.windows import cut_windows, order_comes_within
from caption.verification.actions import TABLE, measure
from cosfly.formats.captions import TOKENS
from cosfly.inspection.blind_baseline import FITTED_ON, fit_deciders, past_of
from cosfly.pipeline.settings import RunConfig
from cosfly.runtime.config import load, shipped
from cosfly.runtime.seeding import rng_for

UNSEEN = ("old_town", "market")
SIZE_PX, FOV_DEG = (640, 360), 50.0


def windows_of(cfg: RunConfig, names: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the pasts, (n, d), and the labels, (n,), of all windows that have a label."""
    cut, numbers = WindowConfig(), {name: k for k, name in enumerate(TOKENS)}
    found = []
    towns = [cfg.of_town(name) for name in names]
    traces = [trace for town in towns for trace in town_flights(town, [None] * town.pedestrians.num_paths)]
    for track in (track_of(trace, SIZE_PX, FOV_DEG) for trace in traces if trace.drop_reason is None):
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
    parser.add_argument("--delft", help="a CityJSON file")
    parser.add_argument("--simworld", help="a SimWorld world, its tables beside it")
    asked = parser.parse_args()
    told = {"delft": f"{{source: cityjson, cityjson: {{path: {asked.delft}}}}}"} if asked.delft else {}
    told |= {"simworld": f"{{source: simworld, simworld: {{world: {asked.simworld}}}}}"} if asked.simworld else {}
    cities = [f"towns.{name}={{maps: {maps}}}" for name, maps in told.items()]
    cfg = load(RunConfig, shipped("diverse.yaml"), cities)
    pasts, labels = windows_of(cfg, [name for name in cfg.towns if name not in (*told, *UNSEEN)])
    some = rng_for(0, "bench.blind", "some").permutation(len(labels))[:FITTED_ON]
    pasts, labels = pasts[some], labels[some]
    rules = [fit_deciders(pasts, labels, rng_for(0, "bench.blind", str(draw))) for draw in range(3)]
    print(f"fitted on {len(labels):,} windows, {pasts.shape[1]} numbers each")
    print("| town | windows | most frequent | rule | network (three draws) |\n|---|---|---|---|---|")
    for names in (UNSEEN, *((name,) for name in told)):
        own, wanted = windows_of(cfg, list(names))
        answers = [np.full(len(wanted), np.bincount(labels).argmax()), rules[0]["rule"](own)]
        shares = [f"{100 * (one == wanted).mean():.1f}" for one in (*answers, *(rule["blind"](own) for rule in rules))]
        print(f"| {' and '.join(names)} | {len(wanted):,} | {shares[0]} | {shares[1]} | {', '.join(shares[2:])} |")


if __name__ == "__main__":
    main()
