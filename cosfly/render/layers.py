"""Which of several surfaces in one plane is seen: the higher layer of their kinds; of one layer always the same one.

Two roads that cross at one height are one plane for a depth buffer: rounding would decide pixel by pixel whose paint and id show
(Z-fighting). So surfaces that overlap in one layer get tiers in it, as few as do.
"""

from __future__ import annotations

import numpy as np
import shapely

from cosfly.products.boxes import BoxMap
from cosfly.products.kinds import KINDS
from cosfly.render.contract import LAWN_HALF_M, LAYERS, STANDING_LAYER
from cosfly.render.draping import is_draped

SAME_HEIGHT_M = 0.005  # a layer moves the depth test by 3 mm at 30 m
EDGE_M = 0.01  # surfaces that share no more than an edge do not fight
MOST_TIERS = 8  # in a layer, as many as meet at a junction of SimWorld; float32 depth tells an eighth of one from the next at 50 m
CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def layers_of(box_map: BoxMap) -> np.ndarray:
    """The layer of each box and, in fractions, its tier there, (n,); of two in one plane the greater is seen."""
    table = np.full(256, STANDING_LAYER)
    table[[KINDS[name] for name in LAYERS]] = list(LAYERS.values())
    is_lawn = (box_map.kinds == KINDS["Vegetation"]) & (box_map.half_extents[:, 2] < LAWN_HALF_M)
    layers = np.where(is_lawn, LAYERS["RoadLines"], table[box_map.kinds])
    return layers + _tiers(box_map, layers)


def _tiers(box_map: BoxMap, layers: np.ndarray) -> np.ndarray:
    """Give each surface the lowest tier that no earlier one has that it overlaps, (n,) in [0, 1); beyond MOST_TIERS the highest."""
    tiers = np.zeros(len(box_map), dtype=int)
    for row, others in _overlaps(box_map, layers).items():  # in the map's order, so that those before have theirs
        free = np.setdiff1d(np.arange(MOST_TIERS), tiers[others])
        tiers[row] = free[0] if len(free) else MOST_TIERS - 1
    return tiers / (tiers.max(initial=0) + 1)


def _overlaps(box_map: BoxMap, layers: np.ndarray) -> dict[int, list[int]]:
    """Give of surfaces, in order, the earlier ones that lie in the same layer, plane and place; those that overlap none are left out."""
    rows = np.flatnonzero((layers < STANDING_LAYER) & ~box_map.rotations_deg[:, [0, 2]].any(axis=1))
    yaws = np.radians(box_map.rotations_deg[rows, 1])[:, None]
    x, y = np.moveaxis(np.maximum(box_map.half_extents[rows, None, :2] - EDGE_M, 0.0) * CORNERS, 2, 0)
    turned = np.stack([x * np.cos(yaws) - y * np.sin(yaws), x * np.sin(yaws) + y * np.cos(yaws)], axis=2)
    outlines = shapely.polygons(turned + box_map.centers[rows, None, :2])
    tops_m = np.where(is_draped(box_map), 0.0, box_map.maxs[:, 2])[rows]  # those on a slope all lie in the ground
    found: dict[int, list[int]] = {}
    later, earlier = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    is_same = (earlier < later) & (layers[rows[earlier]] == layers[rows[later]])
    is_same &= np.abs(tops_m[earlier] - tops_m[later]) < SAME_HEIGHT_M
    order = np.lexsort((earlier[is_same], later[is_same]))
    for row, other in zip(rows[later[is_same][order]].tolist(), rows[earlier[is_same][order]].tolist(), strict=True):
        found.setdefault(row, []).append(other)
    return found
