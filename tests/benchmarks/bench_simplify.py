"""How long Step 2 takes, how much memory, and how its clustering compares with a spatial tree of a library.

python tests/benchmarks/bench_simplify.py
"""

from __future__ import annotations

import resource

import numpy as np
import scenes
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import KINDS
from cosfly.simplify.merge import clusters
from cosfly.simplify.passes import SimplifyConfig, simplify
from cosfly.simplify.stage import cross_validate


def peer_clusters(mins: np.ndarray, maxs: np.ndarray, gap_m: float) -> np.ndarray:
    """The same clusters by shapely's STRtree and scipy's connected components."""
    boxes = shapely.box(mins[:, 0] - gap_m, mins[:, 1] - gap_m, maxs[:, 0] + gap_m, maxs[:, 1] + gap_m)
    plain = shapely.box(mins[:, 0], mins[:, 1], maxs[:, 0], maxs[:, 1])
    one, other = shapely.STRtree(plain).query(boxes)
    near = (mins[one, 2] <= maxs[other, 2] + gap_m) & (mins[other, 2] <= maxs[one, 2] + gap_m)
    one, other = one[near], other[near]
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(len(mins), len(mins)))
    return connected_components(graph, directed=False)[1]


def measure(name: str, raw: BoxMap) -> list:
    times = [scenes.cpu_ms(lambda: simplify(raw, SimplifyConfig())) for _ in range(3)]
    result = times[-1][1].box_map
    return [name, len(raw), len(result), min(ms for ms, _ in times) / 1e3]


def main() -> None:
    scenes.one_thread_and_machine()
    raw = scenes.town()
    warm_up_ms, result = scenes.cpu_ms(lambda: simplify(raw, SimplifyConfig()))
    rows = [measure("(a) town", raw)]
    # Of (a) alone, with the interpreter and all libraries.
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    city = scenes.city()
    if city is not None:
        rows += [measure("(b) city", city), measure("(c) city 12 x 12", scenes.tiled(city, 12, 12))]
    print(
        f"first call with compilation or its cache: {warm_up_ms / 1e3:.2f} s; peak memory after (a): {peak_mb:.0f} MB\n"
    )
    scenes.print_table("simplify", ["map", "boxes", "left", "s"], rows)

    plants = raw.select(raw.kinds == KINDS["Vegetation"])
    ours_ms, ours = scenes.cpu_ms(lambda: clusters(plants.mins, plants.maxs, 2.0))
    peer_ms, peer = scenes.cpu_ms(lambda: peer_clusters(plants.mins, plants.maxs, 2.0))
    same = len(np.unique(np.column_stack([ours, peer]), axis=0)) == len(np.unique(ours)) == len(np.unique(peer))
    scenes.print_table(
        f"clusters of {len(plants)} vegetation boxes; same clusters: {same}",
        ["ours, ms", "STRtree + connected components, ms"],
        [[ours_ms, peer_ms]],
    )
    grids = []
    for trunk in ("stem", "full"):
        facts = cross_validate(raw, simplify(raw, SimplifyConfig(trunk=trunk)).box_map)
        grids.append([trunk, facts["cell_agreement"], facts["iou"], facts["simplified_walkable_m2"]])
    scenes.print_table(
        f"(a) against its raw map, {facts['cells'][0]} x {facts['cells'][1]} cells, {facts['raw_walkable_m2']:.0f} m2 walkable",
        ["trunk", "cell agreement", "IoU", "walkable, m2"], grids,
    )  # fmt: skip
    assert result is not None
    assert same


if __name__ == "__main__":
    main()
