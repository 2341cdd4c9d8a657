"""The rim: what lies beyond a map, in place of a lawn without an end: fields, roads that lead out of the town, houses
and trees that thin out, blocks on the skyline.

Scenery for renderers alone: no stage walks, plans or measures there, and its pixels are nobody's. Fields lie in the
ground plane, under the map too where it shows that plane. What stands begins at SOLIDS_FROM_M, and no flight comes
there. Rectangles are rows of middle and half sizes along x and y; the half height follows.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cosfly.errors import RenderError
from cosfly.geometry import axis_aligned_half_extents
from cosfly.products.boxes import BoxMap, make_box_map
from cosfly.products.kinds import KINDS
from cosfly.products.traces import DroneTrace
from cosfly.render.contract import FAR_M, ground_plane
from cosfly.work.chance import rng_for

# Distances from the map's bounds, m.
REACH_M = FAR_M + 60.0
SOLIDS_FROM_M, FLIGHTS_TO_M = 80.0, 70.0  # the rest is for the shifts of the perturbed track
LANES_M, SKYLINE_M = (8.0, 125.0, 330.0), (420.0, 820.0)  # lanes go round the town
# Longest sides of fields, m: nearer than YARD_M to houses, beside these, and what each metre away from them adds.
YARD_M, PLOT_M, FIELD_M, FIELD_GROWS = 20.0, 30.0, 60.0, 0.25
ROAD_HALF_M, FLAT_HALF_M, OVERLAP_M = 3.0, 0.25, 0.004  # of fields, so that nothing shows between them
STREETS, APART_M, OUTERMOST_M = 2, 90.0, 40.0  # roads of a side; streets that end so near the outermost end lead out
HOUSE_EVERY_M, THINS_M = 21.0, 150.0  # along roads; houses are e times fewer so far on
CLUSTERS, BLOCKS = 6, 12  # of the skyline
WOODS, TREE_M2 = 0.06, 150.0  # share of the fields; a tree's ground


def rim_of(box_map: BoxMap, seed: int) -> BoxMap:
    """Give the boxes beyond a map, with ids that no box of it has: the same for the same map and seed."""
    from scipy.spatial import cKDTree  # half a second, as in contract.py

    rng = rng_for(seed, "render", f"rim/{box_map.name}")
    town = np.stack([corner[:2] for corner in box_map.bounds()])
    out = np.array([[-1.0], [1.0]])
    is_built = box_map.kinds == KINDS["Buildings"]
    built = cKDTree(box_map.centers[is_built if is_built.any() else slice(None), :2]).query
    west_south, east_north = town + REACH_M * out
    fields = np.array(_fields(west_south, east_north, built, rng))
    lanes = [
        _strip(axis, ends[0, axis], ends[1, axis], across)
        for ends in (town + away * out for away in LANES_M)
        for axis in (0, 1)
        for across in ends[:, 1 - axis]
    ]
    roads = np.array([*lanes, *_roads(box_map, town, rng)])
    houses = np.concatenate([_houses(roads, town, rng), _skyline(town, rng)])
    solids = np.concatenate([houses, _plants(fields, houses, rng)])
    is_house = np.arange(len(solids)) < len(houses)
    is_out = _away_m(solids[:, :2], town) - np.hypot(solids[:, 2], solids[:, 3]) > SOLIDS_FROM_M
    is_before = np.arange(len(solids))[:, None] > np.flatnonzero(is_house)
    in_house = (_touch(solids, solids[is_house]) & is_before).any(axis=1)
    stays = is_out & ~in_house & ~_touch(solids, roads).any(axis=1)
    solids, is_house = solids[stays], is_house[stays]
    flat = np.insert(np.concatenate([fields, roads]), 4, FLAT_HALF_M, axis=1)
    kinds = np.repeat([KINDS["Terrain"], KINDS["Roads"]], [len(fields), len(roads)])
    kinds = np.append(kinds, np.where(is_house, KINDS["Buildings"], KINDS["Vegetation"]))
    ground, (plane, plane_half) = box_map.ground, ground_plane(box_map)
    low, high = (np.insert(solids[:, :2] + side * solids[:, 2:4], 2, 0.0, axis=1) for side in (-1.0, 1.0))
    z = np.append(ground.height_at(flat) - FLAT_HALF_M, ground.range_under(low, high)[0] + solids[:, 4])
    if ground.is_flat:
        z += (plane + plane_half)[2] - ground.heights_m[0, 0]
    boxes = np.concatenate([flat, solids])
    ids = np.setdiff1d(np.arange(len(box_map) + len(boxes), dtype=np.uint64), box_map.ids)[: len(boxes)]
    return make_box_map(np.column_stack([boxes[:, :2], z]), boxes[:, 2:], np.zeros((len(boxes), 3)), kinds, ids)


def check_outside_rim(trace: DroneTrace, box_map: BoxMap) -> None:
    """Check that a flight keeps away from what stands in the rim.

    Raises:
        RenderError: it does not; names the flight and how far out it comes.
    """
    town = np.stack([corner[:2] for corner in box_map.bounds()])
    if (away_m := float(_away_m(trace.positions_m[:, :2], town).max())) > FLIGHTS_TO_M:
        got = f"{away_m:.0f} m beyond the map's bounds"
        expected = f"at most {FLIGHTS_TO_M:g} m: houses and trees begin at {SOLIDS_FROM_M:g} m"
        raise RenderError(
            "a flight comes into the rim", where=trace.path_id, got=got, expected=expected, fix="--set render.rim=false"
        )


def _away_m(points: np.ndarray, town: np.ndarray) -> np.ndarray:
    """How far places, (n, 2), lie beyond the bounds, (n,); town: (2, 2) their low and high corner."""
    return np.linalg.norm(np.maximum(np.maximum(town[0] - points, points - town[1]), 0.0), axis=-1)


def _touch(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Tell which rectangles are less than a metre apart, (n, k) bool."""
    gaps = np.abs(some[:, None, :2] - others[:, :2]) - some[:, None, 2:4] - others[:, 2:4]
    return (gaps < 1.0).all(axis=2)


def _strip(axis: int, begin: float, end: float, across: float) -> np.ndarray:
    """A road along an axis, (4,)."""
    road = np.array([across, across, ROAD_HALF_M, ROAD_HALF_M])
    road[axis], road[2 + axis] = (begin + end) / 2.0, abs(end - begin) / 2.0 + ROAD_HALF_M
    return road


def _fields(low: np.ndarray, high: np.ndarray, built: Callable, rng: np.random.Generator) -> list[np.ndarray]:
    """Cut a rectangle into fields, (4,) each, small ones among and near houses, `built` finds the nearest."""
    size = high - low
    away = float(built((low + high) / 2.0)[0]) - size.max() / 2.0 - YARD_M
    if size.max() < (FIELD_M + FIELD_GROWS * away if away > 0.0 else PLOT_M) * rng.uniform(0.8, 1.6):
        return [np.concatenate([low + high, size]) / 2.0 + [0.0, 0.0, OVERLAP_M, OVERLAP_M]]
    axis, cut = int(size.argmax()), rng.uniform(0.35, 0.65)
    ends, begins = high.copy(), low.copy()
    ends[axis] = begins[axis] = low[axis] + size[axis] * cut
    return _fields(low, ends, built, rng) + _fields(begins, high, built, rng)


def _roads(box_map: BoxMap, town: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Roads that leave the town at each side, in line with the widest streets that lead there, or anywhere without."""
    streets = box_map.select(box_map.kinds == KINDS["Roads"])
    half = axis_aligned_half_extents(streets.half_extents, streets.rotations_deg)
    roads = []
    for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
        reach = np.where(
            half[:, axis] > 2.0 * half[:, 1 - axis], sign * streets.centers[:, axis] + half[:, axis], -np.inf
        )
        leads = np.flatnonzero(reach > reach.max(initial=-np.inf) - OUTERMOST_M)
        order = np.lexsort((rng.random(len(leads)), -half[leads, 1 - axis].round()))
        low, high = town[:, 1 - axis]
        places = streets.centers[leads[order], 1 - axis] if len(leads) else rng.uniform(low, high, 1)
        taken: list[float] = []
        for place in places.tolist():
            if len(taken) < STREETS and all(abs(place - other) > APART_M for other in taken):
                taken.append(place)
        edge = town[int(sign > 0), axis]
        roads += [_strip(axis, edge + sign * LANES_M[0], edge + sign * REACH_M, place) for place in taken]
    return roads


def _houses(roads: np.ndarray, town: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Low houses on both sides of roads, fewer far from the town, (n, 5)."""
    found: list[np.ndarray] = []
    for road in np.repeat(roads, 2, axis=0):
        axis, side = int(road[3] > road[2]), (-1.0) ** len(found)
        along = np.arange(-road[2 + axis], road[2 + axis], HOUSE_EVERY_M)
        middle = np.tile(road[:2], (len(along), 1))
        middle[:, axis] += along + rng.uniform(0.0, 5.0, len(along))
        middle[:, 1 - axis] += side * rng.uniform(13.0, 17.0, len(along))
        half = rng.uniform([4.0, 4.0, 2.4], [7.0, 6.0, 4.2], (len(along), 3))
        is_built = rng.random(len(along)) < np.exp((SOLIDS_FROM_M - _away_m(middle, town)) / THINS_M)
        found.append(np.column_stack([middle, half])[is_built])
    return np.concatenate(found)


def _skyline(town: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Groups of blocks far out, (n, 5), the highest in the middle of theirs."""
    turn = rng.uniform(0.0, 2.0 * np.pi, (CLUSTERS, 1))
    away = np.ptp(town, axis=0) / 2.0 + rng.uniform(*SKYLINE_M, (CLUSTERS, 1))
    middle = town.mean(axis=0) + away * np.concatenate([np.cos(turn), np.sin(turn)], axis=1)
    aside = rng.normal(0.0, 45.0, (CLUSTERS, BLOCKS, 2))
    tall = 5.0 + 22.0 * np.exp(-np.square(aside / 45.0).sum(axis=2)) * rng.uniform(0.4, 1.0, aside.shape[:2])
    blocks = [middle[:, None] + aside, rng.uniform(6.0, 14.0, aside.shape), tall[..., None]]
    return np.concatenate(blocks, axis=2).reshape(-1, 5)


def _plants(fields: np.ndarray, houses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Hedges and trees along one side of fields, woods, and trees in gardens, (n, 5)."""
    around = rng.uniform(-1.0, 1.0, (2, len(houses), 2))
    hedges, places = (
        [np.zeros((0, 5))],
        [(houses[:, :2] + 14.0 * around / np.abs(around).max(axis=2, keepdims=True)).reshape(-1, 2)],
    )
    for field in fields:
        axis, half = int(rng.integers(2)), field[2:]
        hedge = np.array([*field[:2], 0.6, 0.6, rng.uniform(0.6, 1.1)])
        hedge[1 - axis] -= half[1 - axis]
        hedge[2 + axis] = half[axis] - 1.0
        hedges += [hedge[None]] * (rng.random() < 0.6)
        places.append(hedge[:2] + hedge[2:4] * rng.uniform(-1.0, 1.0, (rng.poisson(1.5), 2)))
        num_trees = (rng.random() < WOODS) * min(25, int(4.0 * half.prod() / TREE_M2))
        places.append(field[:2] + half * rng.uniform(-0.9, 0.9, (num_trees, 2)))
    where = np.concatenate(places)
    wide = rng.uniform(2.0, 4.2, len(where))
    trees = np.column_stack([where, wide, wide, rng.uniform(3.0, 6.5, len(where))])
    return np.concatenate([*hedges, trees])
