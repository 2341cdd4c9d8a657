"""Are the numbers of a map metres? Asked where it is wider, or its boxes are larger, than any town: mostly all of it, or its sizes, are centimetres."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cosfly.errors import InputError
from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import GROUND_KINDS, KINDS

WIDEST_M = 20_000.0  # no map is wider
TALL_M = 400.0  # the usual building is lower
LONG_M = 200.0  # the usual box that stands is shorter
PILED = 0.5  # share of the others whose middle the usual box covers: of a town in any unit it covers nearly none
NUM_LOOKED_AT = 200  # boxes, evenly spread over the map's rows
FACTOR = "--set maps.boxes.metres_per_unit=0.01, if positions and sizes are"
IN_METRES = "write the file in metres, as boxes_3d.json always is"


def check_units(box_map: BoxMap, where: Path) -> None:
    """See that a map is as large as a town can be.

    Raises:
        InputError: it is not; says which numbers seem to be centimetres and what to do.
    """
    low, high = box_map.bounds()
    tall_m = _usual(box_map.half_extents[box_map.kinds == KINDS["Buildings"], 2])
    stands = ~box_map.is_any_of(GROUND_KINDS | {KINDS["Water"], KINDS["Bridge"]})
    long_m = _usual(box_map.half_extents[stands, :2].max(axis=1))
    is_wide, is_tall, is_long = (high - low)[:2].max() > WIDEST_M, tall_m > TALL_M, long_m > LONG_M
    ours = where.suffix.lower() == ".json"  # which no setting gives another unit
    if is_long and _is_piled(box_map.select(stands)):
        raise InputError(
            "the boxes are so large that they lie in each other: are these centimetres?", where=where,
            got=f"boxes of usually {long_m:.6g} m, each over most of the others", expected="sizes in metres, as the positions seem to be",
            fix="divide the sizes by 100" if ours else "divide the columns of sizes by 100; maps.boxes.metres_per_unit would change the positions too",
        )  # fmt: skip
    if is_tall and not is_long and not is_wide:
        raise InputError(
            "the buildings are too high: are these centimetres?", where=where, got=f"usually {tall_m:.6g} m", expected=f"usually less than {TALL_M:g} m",
            fix="divide the heights alone by 100, as lengths and positions seem to be metres" + ("" if ours else "; maps.boxes.metres_per_unit would change those too"),
        )  # fmt: skip
    if is_wide or is_tall:
        raise InputError(
            "the map is too wide, or its buildings too high: are these centimetres?", where=where,
            got=" x ".join(f"{size:.6g}" for size in high - low) + " m", expected="at most 20 km, buildings of usually less than 400 m",
            fix=f"{IN_METRES if ours else FACTOR}; or mend the stray box",
        )  # fmt: skip


def _usual(half_m: np.ndarray) -> float:
    return 2.0 * float(np.median(half_m)) if len(half_m) else 0.0


def _is_piled(boxes: BoxMap) -> bool:
    """Tell whether the usual box covers, seen from above, the middles of most others."""
    if len(boxes) < 2:
        return False
    some = np.unique(np.linspace(0, len(boxes) - 1, NUM_LOOKED_AT).astype(int))
    middles = boxes.centers[None, :, :2]
    covered = (boxes.mins[some, None, :2] <= middles) & (middles <= boxes.maxs[some, None, :2])
    return float(np.median(covered.all(axis=2).sum(axis=1) - 1)) > PILED * (len(boxes) - 1)
