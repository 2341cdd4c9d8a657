"""The rim: scenery around a map in place of an endless lawn. Fields, roads, houses and trees thin out to a skyline.

Rectangles are rows of middle and half sizes along x and y, then the half height; `town`: (2, 2) low and high corner.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cosfly.formats.boxes import BoxMap, make_box_map
from cosfly.formats.kinds import KINDS
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import axis_aligned_half_extents
from cosfly.render.contract import FAR_M, ground_plane
from cosfly.runtime.errors import RenderError
from cosfly.runtime.seeding import rng_for

# Distances from the map's bounds, m.
REACH_M = FAR_M + 60.0
SOLIDS_FROM_M = 80.0  # houses and trees begin here
FLIGHTS_TO_M = 70.0  # planned trajectories end here; the gap is for the shifts of the perturbed track
LANES_M = (8.0, 125.0, 330.0)  # lanes around the town
SKYLINE_M = (420.0, 820.0)  # nearest and farthest groups of the skyline

# Sizes, m.
YARD_M = 20.0  # within this distance of a house, fields are plots
PLOT_M = 30.0  # longest side of a plot
FIELD_M = 60.0  # longest side of the nearest fields
FIELD_GROWS = 0.25  # growth of that side per metre of distance
ROAD_HALF_M = 3.0  # half width of a road
FLAT_HALF_M = 0.25  # half height of roads and fields
OVERLAP_M = 0.004  # fields overlap by this, so that nothing shows between them
SUNK_M = 1.0  # solid things begin this far under the ground, which may slope
STREETS = 2  # most roads that leave the town on one side
APART_M = 90.0  # least distance between these
OUTERMOST_M = 40.0  # a street that ends this near the outermost end of all streets continues outwards
HOUSE_EVERY_M = 21.0  # distance of houses along a road
THINS_M = 150.0  # each time this far on, houses are e times fewer
CLUSTERS = 6  # groups of the skyline
BLOCKS = 12  # blocks in a group


def rim_of(box_map: BoxMap, seed: int) -> BoxMap:
    """Return the boxes of the rim, with ids that no box of the map has. They depend on map and seed only."""
    from scipy.spatial import cKDTree  # takes half a second to import, as in contract.py

    rng = rng_for(seed, "render", f"rim/{box_map.name}")
    town = np.stack([corner[:2] for corner in box_map.bounds()])
    is_built = box_map.kinds == KINDS["Buildings"]
    built = cKDTree(box_map.centers[is_built if is_built.any() else slice(None), :2]).query
    fields = _fields(town[0] - REACH_M, town[1] + REACH_M, built, rng)
    roads = _roads(box_map, town, rng)
    houses = np.concatenate([_houses(roads, town, rng), _skyline(town, rng)])
    rows = np.concatenate([fields, roads, houses, _plants(fields, houses, rng)])
    num_flat = len(fields) + len(roads)
    num_hard = len(roads) + len(houses)
    kinds = np.full(len(rows), KINDS["Vegetation"])
    kinds[: num_flat + len(houses)] = KINDS["Buildings"]
    kinds[:num_flat] = KINDS["Roads"]
    kinds[: len(fields)] = KINDS["Terrain"]
    # Solid things stay if they are far enough out, on no road and in no earlier house.
    hard, standing = rows[len(fields) :][:num_hard], rows[num_flat:]
    gaps = np.abs(standing[:, None, :2] - hard[:, :2]) - standing[:, None, 2:4] - hard[:, 2:4]
    is_before = np.arange(len(standing))[:, None] + len(roads) > np.arange(num_hard)
    is_taken = ((gaps < 1.0).all(axis=2) & is_before).any(axis=1)
    is_far = _away_m(standing[:, :2], town) - np.hypot(standing[:, 2], standing[:, 3]) > SOLIDS_FROM_M
    stays = np.append(np.ones(num_flat, dtype=bool), is_far & ~is_taken)
    z = box_map.ground.height_at(rows)
    if box_map.ground.is_flat:
        z[:] = np.sum(ground_plane(box_map), axis=0)[2]
    z += np.where(np.arange(len(rows)) < num_flat, -FLAT_HALF_M, rows[:, 4] - SUNK_M)
    ids = np.setdiff1d(np.arange(len(box_map) + len(rows), dtype=np.uint64), box_map.ids)[: len(rows)]
    centers = np.column_stack([rows[:, :2], z])
    return make_box_map(centers, rows[:, 2:], np.zeros((len(rows), 3)), kinds, ids).select(stays)


def check_outside_rim(trace: DroneTrace, box_map: BoxMap) -> None:
    """Raise RenderError if a trajectory comes near the solid things of the rim."""
    town = np.stack([corner[:2] for corner in box_map.bounds()])
    if (away_m := float(_away_m(trace.positions_m[:, :2], town).max())) > FLIGHTS_TO_M:
        raise RenderError(
            "the trajectory flies too far into the rim around the map",
            where=trace.path_id,
            got=f"{away_m:.0f} m outside the bounds of the map",
            expected=f"at most {FLIGHTS_TO_M:g} m, because houses and trees begin at {SOLIDS_FROM_M:g} m",
            fix="render without the rim: --set render.rim=false",
        )


def _away_m(points: np.ndarray, town: np.ndarray) -> np.ndarray:
    """Return how far places, (n, 2), are beyond the bounds, (n,) m; 0 within them."""
    return np.linalg.norm(np.maximum(np.maximum(town[0] - points, points - town[1]), 0.0), axis=1)


def _fields(low: np.ndarray, high: np.ndarray, built: Callable, rng: np.random.Generator) -> np.ndarray:
    """Cut a rectangle into fields, which are small near houses; `built` returns the distance to the nearest house."""
    middle, size = (low + high) / 2.0, high - low
    away = float(built(middle)[0]) - size.max() / 2.0 - YARD_M
    if size.max() < (FIELD_M + FIELD_GROWS * away if away > 0.0 else PLOT_M) * rng.uniform(0.8, 1.6):
        return np.array([[*middle, *(size / 2.0 + OVERLAP_M), FLAT_HALF_M]])
    axis = int(size.argmax())
    cut = low[axis] + size[axis] * rng.uniform(0.35, 0.65)
    ends, begins = (np.where(np.arange(2) == axis, cut, corner) for corner in (high, low))
    return np.concatenate([_fields(low, ends, built, rng), _fields(begins, high, built, rng)])


def _roads(box_map: BoxMap, town: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return lanes around the town, and roads that continue its widest streets outwards (without streets, any)."""
    streets = box_map.select(box_map.kinds == KINDS["Roads"])
    half = axis_aligned_half_extents(streets.half_extents, streets.rotations_deg)
    roads = []
    for axis, side in ((0, 0), (0, 1), (1, 0), (1, 1)):
        sign, across = 2.0 * side - 1.0, 1 - axis
        lies = half[:, axis] > 2.0 * half[:, across]
        reach = np.where(lies, sign * streets.centers[:, axis] + half[:, axis], -np.inf)
        leads = np.flatnonzero(reach > reach.max(initial=-np.inf) - OUTERMOST_M)
        order = np.lexsort((rng.random(len(leads)), -half[leads, across].round()))
        offsets_m = streets.centers[leads[order], across] if len(leads) else rng.uniform(town[0], town[1])[[across]]
        chosen_m: list[float] = []
        for offset_m in offsets_m.tolist():
            if len(chosen_m) < STREETS and all(abs(offset_m - other) > APART_M for other in chosen_m):
                chosen_m.append(offset_m)
        ends = town[side, axis] + sign * np.array([LANES_M[0], REACH_M])
        strips = [(axis, *ends, offset_m) for offset_m in chosen_m]
        strips += [(across, town[0, across] - m, town[1, across] + m, town[side, axis] + sign * m) for m in LANES_M]
        for along, begin, end, offset_m in strips:
            turn = 1 if along == 0 else -1
            middle = ((begin + end) / 2.0, offset_m)[::turn]
            size = (abs(end - begin) / 2.0 + ROAD_HALF_M, ROAD_HALF_M)
            roads.append([*middle, *size[::turn], FLAT_HALF_M])
    return np.array(roads)


def _houses(roads: np.ndarray, town: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return low houses on both sides of roads, fewer far from the town."""
    houses: list[np.ndarray] = []
    for road in np.repeat(roads, 2, axis=0):
        axis = int(road[3] > road[2])
        side = (-1.0) ** len(houses)
        along = np.arange(-road[2 + axis], road[2 + axis], HOUSE_EVERY_M)
        middle = np.tile(road[:2], (len(along), 1))
        middle[:, axis] += along + rng.uniform(0.0, 5.0, len(along))
        middle[:, 1 - axis] += side * rng.uniform(13.0, 17.0, len(along))
        half = rng.uniform([4.0, 4.0, 2.9], [7.0, 6.0, 4.7], (len(along), 3))
        is_built = rng.random(len(along)) < np.exp((SOLIDS_FROM_M - _away_m(middle, town)) / THINS_M)
        houses.append(np.column_stack([middle, half])[is_built])
    return np.concatenate(houses)


def _skyline(town: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return groups of blocks far out, the highest in the middle of each."""
    aside = rng.normal(0.0, 1.0, (CLUSTERS, BLOCKS))
    turn = rng.uniform(0.0, 2.0 * np.pi, (CLUSTERS, 1)) + 0.08 * aside
    away = rng.uniform(*SKYLINE_M, (CLUSTERS, 1)) + rng.normal(0.0, 45.0, aside.shape)
    tall = 5.5 + 22.0 * np.exp(-np.square(aside)) * rng.uniform(0.4, 1.0, aside.shape)
    out = np.stack([np.cos(turn), np.sin(turn)], axis=2) * (np.ptp(town, axis=0) / 2.0 + away[..., None])
    size = rng.uniform(6.0, 14.0, out.shape)
    return np.concatenate([town.mean(axis=0) + out, size, tall[..., None]], axis=2).reshape(-1, 5)


def _plants(fields: np.ndarray, houses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return hedges and trees along one side of fields, woods, and trees in gardens."""
    hedges = fields.copy()
    around = rng.uniform(-1.0, 1.0, (2, len(houses), 2))
    around *= 14.0 / np.abs(around).max(axis=2, keepdims=True)
    every = np.arange(len(fields))
    across = rng.integers(0, 2, len(fields))
    hedges[every, across] -= fields[every, 2 + across]
    hedges[every, 2 + across] = 0.6
    hedges[:, 4] = rng.uniform(1.1, 1.6, len(fields))
    in_hedge = rng.poisson(1.5, len(fields))
    in_wood = np.where(rng.random(len(fields)) < 0.06, 25, 0)
    ground = np.repeat(np.concatenate([hedges, fields]), np.concatenate([in_hedge, in_wood]), axis=0)
    places = ground[:, :2] + ground[:, 2:4] * rng.uniform(-0.9, 0.9, (len(ground), 2))
    places = np.concatenate([places, (houses[:, :2] + around).reshape(-1, 2)])
    wide = rng.uniform(2.0, 4.2, len(places))
    trees = np.column_stack([places, wide, wide, rng.uniform(3.5, 7.0, len(places))])
    return np.concatenate([hedges[rng.random(len(fields)) < 0.6], trees])
