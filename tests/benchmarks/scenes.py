"""What the benchmarks measure on, and how: three maps, walks over them, CPU times, tables. Writes nothing into the
repository."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from census_town import census_town
from threadpoolctl import threadpool_limits

from cosfly.formats.boxes import BoxMap
from cosfly.formats.pedestrian_paths import PedestrianTrajectory
from cosfly.maps.stage import MapsConfig, load_map
from cosfly.pedestrians.stage import PedestriansConfig, make_pedestrian, walkable_ground
from cosfly.pedestrians.walkable import WalkableGround
from cosfly.runtime.config import build
from cosfly.runtime.seeding import rng_for
from cosfly.simplify.passes import SimplifyConfig, simplify

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # specimens and servers of the tests, for who imports this
SHARED_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
NUM_WALKS, SEED = 20, 0
CITY_GAP_M = 20.0  # between the tiles of a larger map


def town(seed: int = SEED) -> BoxMap:
    """Map (a): the synthetic town with the paper's box census, raw; other seeds give other towns."""
    return census_town("Town", seed)


def city() -> BoxMap | None:
    """Map (b): the SimWorld city, raw; None where the shared data are absent."""
    world = SHARED_DATA / "simworld-progen" / "progen_world.json"
    if not world.is_file():
        print(f"(map (b) is left out: {world} is not here)")
        return None
    return load_map(build(MapsConfig, {"source": "simworld", "simworld": {"world": str(world)}}, "benchmark"))


def tiled(box_map: BoxMap, size_m: tuple[float, float]) -> BoxMap:
    """Copies of a map side by side, of which what lies beyond a size is cut off; the first stays where the map is."""
    low, high = box_map.bounds()
    columns, rows = np.ceil(size_m / (high - low)[:2]).astype(int)
    step = high[:2] - low[:2] + CITY_GAP_M
    shifts = np.array([(column * step[0], row * step[1], 0.0) for row in range(rows) for column in range(columns)])
    count, tiles = len(box_map), len(shifts)
    tiles_map = BoxMap(
        (box_map.centers[None] + shifts[:, None]).reshape(-1, 3), np.tile(box_map.half_extents, (tiles, 1)),
        np.tile(box_map.rotations_deg, (tiles, 1)), np.tile(box_map.kinds, tiles),
        np.arange(1, count * tiles + 1, dtype=np.uint64),
        box_map.header.model_copy(update={"name": f"{box_map.name}{columns}x{rows}"}),
    )  # fmt: skip
    return tiles_map.select((tiles_map.maxs[:, :2] <= low[:2] + size_m).all(axis=1))


def simplified(raw: BoxMap) -> BoxMap:
    return simplify(raw, SimplifyConfig())


def walks_on(box_map: BoxMap, **settings: Any) -> tuple[WalkableGround, list[PedestrianTrajectory]]:
    """The ground, and 20 walks; of 75 to 100 m as the crow flies they have about 186 points, as the paper's pilot."""
    cfg = PedestriansConfig(num_paths=NUM_WALKS, **settings)
    ground = walkable_ground(box_map, cfg)
    names = [f"path_{k:05d}" for k in range(cfg.num_paths)]
    return ground, [make_pedestrian(name, ground, cfg, rng_for(SEED, "pedestrians", name)).trajectory for name in names]


def cpu_ms(function: Callable[[], Any]) -> tuple[float, Any]:
    """Processor time of one call, all threads together, and what the call gave."""
    begin = time.process_time()
    result = function()
    return 1e3 * (time.process_time() - begin), result


def one_thread_and_machine() -> None:
    """Say what is measured on; hold BLAS to one thread: its others spin on after a call, and count for what is timed
    next."""
    threadpool_limits(1)
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    print(
        f"{len(models)} cores of {models[0] if models else 'an unknown processor'}; times are CPU times of one "
        f"process\n"
    )


def print_table(title: str, names: list[str], rows: list[list[Any]]) -> None:
    print(f"{title}\n\n| " + " | ".join(names) + " |\n|" + "---|" * len(names))
    for row in rows:
        print("| " + " | ".join(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row) + " |")
    print()
