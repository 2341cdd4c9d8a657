"""Triangles that all renderers draw instead of boxes, on sloping ground and for meshes.

On sloping ground, a surface is the outline of its box cut out of the ground's triangles. Layers decide which of several
surfaces at one place is visible.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import GROUND_KINDS, KINDS, LAYERS
from cosfly.geometry.axes import rotation_matrices
from cosfly.geometry.grid import lies_off_ground
from cosfly.render.contract import GROUND_PLANE_HALF_M, LAWN_HALF_M, STANDING_LAYER

DRAPED_KINDS = GROUND_KINDS | {KINDS["Water"]}
BARE_GROUND = -1  # the row of triangles that are no box's
MIN_HALF_EXTENT_M = 1e-3


@dataclass(frozen=True)
class Triangles:
    """Triangles in the world, k of them: corners_m (k, 3, 3), counter-clockwise from above or outside; rows (k,) of the
    map's boxes, or BARE_GROUND."""

    corners_m: np.ndarray
    rows: np.ndarray

    def __len__(self) -> int:
        return len(self.corners_m)

    @property
    def normals(self) -> np.ndarray:
        """Return unit vectors that point up or out, (k, 3); 0 for a triangle without area."""
        normals = np.cross(self.corners_m[:, 1] - self.corners_m[:, 0], self.corners_m[:, 2] - self.corners_m[:, 0])
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def is_draped(box_map: BoxMap) -> np.ndarray:
    """Return which boxes are surfaces on sloping ground, (n,) bool: not the deck of a flyover."""
    if box_map.ground.is_flat:
        return np.zeros(len(box_map), dtype=bool)
    return box_map.is_any_of(DRAPED_KINDS) & ~lies_off_ground(box_map, DRAPED_KINDS)


def drape(box_map: BoxMap) -> Triangles:
    """Return the triangles of the ground and of the surfaces on it, for a map with sloping ground."""
    ground = box_map.ground
    if ground.is_flat:
        raise ValueError("the ground of this map is flat, so it has no triangle mesh")
    bare = ground.triangles(GROUND_PLANE_HALF_M)
    shape = np.array(ground.heights_m.shape[::-1]) + 1  # cells along x and y, those beyond the border too
    cells_x = int(shape[0])
    rows = np.flatnonzero(is_draped(box_map))
    mins, maxs = box_map.mins[rows, :2], box_map.maxs[rows, :2]
    low = np.array([ground.west_m, ground.south_m])
    first, last = (np.clip(np.floor((c - low) / ground.cell_m).astype(int) + 1, 0, shape - 1) for c in (mins, maxs))
    yaws = np.radians(box_map.rotations_deg[rows, 1])
    frames = np.column_stack([box_map.centers[rows, :2], np.cos(yaws), np.sin(yaws)])
    halves = np.maximum(box_map.half_extents[rows, :2], MIN_HALF_EXTENT_M)
    pieces = [bare]
    owners = [np.full(len(bare), BARE_GROUND)]
    for k, row in enumerate(rows):
        x, y = (np.arange(first[k, axis], last[k, axis] + 1) for axis in (0, 1))
        cells = np.add.outer(y * cells_x, x).ravel()
        triangles = bare[np.concatenate([2 * cells, 2 * cells + 1])]
        pieces.append(_cut(triangles, frames[k], halves[k]))
        owners.append(np.full(len(pieces[-1]), row))
    return Triangles(np.concatenate(pieces), np.concatenate(owners))


def _cut(triangles: np.ndarray, frame: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Clip triangles, (n, 3, 3), to a rotated rectangle; return the parts inside, (k, 3, 3), with the same winding.

    Args:
        frame: (4,) middle x, y, cosine and sine of the yaw. half: (2,) half sizes, m.
    Source: Sutherland and Hodgman 1974, for all triangles at once.
    """
    axes = np.array([[frame[2], frame[3]], [-frame[3], frame[2]]])
    corners = triangles
    sizes = np.full(len(triangles), 3)
    every = np.arange(len(triangles))
    for axis, reach, sign in zip(axes[[0, 0, 1, 1]], half[[0, 0, 1, 1]], (-1.0, 1.0, -1.0, 1.0), strict=True):
        inside = reach - sign * ((corners[..., :2] - frame[:2]) @ axis)  # (n, m) m, negative outside
        kept = np.zeros((len(corners), corners.shape[1] + 1, 3))
        counts = np.zeros(len(corners), dtype=int)
        for i in range(corners.shape[1]):
            after = np.where(i + 1 < sizes, i + 1, 0)
            here, there = inside[:, i], inside[every, after]
            stays = (i < sizes) & (here >= 0.0)
            kept[every[stays], counts[stays]] = corners[stays, i]
            counts += stays
            crosses = (i < sizes) & ((here >= 0.0) != (there >= 0.0))
            share = (here[crosses] / (here[crosses] - there[crosses]))[:, None]
            ends = corners[crosses, i], corners[every[crosses], after[crosses]]
            kept[every[crosses], counts[crosses]] = ends[0] + share * (ends[1] - ends[0])
            counts += crosses
        corners, sizes = kept, counts
    fans = [corners[sizes > i + 1][:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
    return np.concatenate(fans)


# --- layers -----------------------------------------------------------------------------------------------------------
# Two roads that cross at one height are one plane for a depth buffer: rounding would decide at each pixel which one is
# visible (Z-fighting). So surfaces that overlap in one layer get different tiers, as few as possible.

SAME_HEIGHT_M = 0.005  # a layer moves the depth test by 3 mm at 30 m
EDGE_M = 0.01  # surfaces that share only an edge do not fight
MOST_TIERS = 8  # as at a junction of SimWorld; float32 depth resolves an eighth of a layer at 50 m
CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def layers_of(box_map: BoxMap) -> np.ndarray:
    """Return the layer of each box plus its tier as a fraction, (n,); of two in one plane the greater is visible."""
    table = np.full(256, STANDING_LAYER)
    table[[KINDS[name] for name in LAYERS]] = list(LAYERS.values())
    is_lawn = (box_map.kinds == KINDS["Vegetation"]) & (box_map.half_extents[:, 2] < LAWN_HALF_M)
    layers = np.where(is_lawn, LAYERS["RoadLines"], table[box_map.kinds])
    return layers + _tiers(box_map, layers)


def _tiers(box_map: BoxMap, layers: np.ndarray) -> np.ndarray:
    """Return the tier of each surface, (n,) in [0, 1).

    It is the lowest tier that no earlier surface has which overlaps in the same layer and plane, or else the highest.
    """
    rows = np.flatnonzero((layers < STANDING_LAYER) & ~box_map.rotations_deg[:, [0, 2]].any(axis=1))
    yaws = np.radians(box_map.rotations_deg[rows, 1])[:, None]
    x, y = np.moveaxis(np.maximum(box_map.half_extents[rows, None, :2] - EDGE_M, 0.0) * CORNERS, 2, 0)
    turned = np.stack([x * np.cos(yaws) - y * np.sin(yaws), x * np.sin(yaws) + y * np.cos(yaws)], axis=2)
    outlines = shapely.polygons(turned + box_map.centers[rows, None, :2])
    tops_m = np.where(is_draped(box_map), 0.0, box_map.maxs[:, 2])[rows]  # those on a slope all lie in the ground
    later, earlier = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    is_same = (earlier < later) & (layers[rows[earlier]] == layers[rows[later]])
    is_same &= np.abs(tops_m[earlier] - tops_m[later]) < SAME_HEIGHT_M
    overlapped: dict[int, list[int]] = {}
    for row, other in zip(rows[later[is_same]].tolist(), rows[earlier[is_same]].tolist(), strict=True):
        overlapped.setdefault(row, []).append(other)
    tiers = np.zeros(len(box_map), dtype=int)
    for row in sorted(overlapped):  # in the map's order, so that earlier ones have theirs
        free = np.setdiff1d(np.arange(MOST_TIERS), tiers[overlapped[row]])
        tiers[row] = free[0] if len(free) else MOST_TIERS - 1
    return tiers / (tiers.max(initial=0) + 1)


# --- meshes -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Solids(Triangles):
    """Triangles of meshes. things: (k,) ascending, a number for each placed mesh."""

    things: np.ndarray


def are_solids(box_map: BoxMap) -> np.ndarray:
    """Return which boxes are drawn as meshes, (n,) bool."""
    return np.isin(box_map.ids, np.array(sorted(box_map.meshes.refs), dtype=np.uint64))


def solids_of(box_map: BoxMap) -> Solids:
    """Place the meshes of a map: each in its box, or once in the world for all boxes that name it."""
    corners = [np.zeros((0, 3, 3))]
    rows = []
    counts = []
    meshes = box_map.meshes.resolved()
    placed = set()
    turns = rotation_matrices(np.radians(box_map.rotations_deg)) if meshes else np.zeros((0, 3, 3))
    for row in np.flatnonzero(are_solids(box_map)):
        ref = box_map.meshes.refs[int(box_map.ids[row])]
        if ref in placed:
            continue
        mesh = meshes[ref]
        if ref.fit == "world":
            placed.add(ref)
            corners.append(mesh)
        else:
            low, high = mesh.min(axis=(0, 1)), mesh.max(axis=(0, 1))
            stretch = 2.0 * box_map.half_extents[row] / np.where(high > low, high - low, 1.0)
            corners.append((mesh - (low + high) / 2.0) * stretch @ turns[row].T + box_map.centers[row])
        rows.append(row)
        counts.append(len(mesh))
    things = np.repeat(np.arange(len(counts)), counts)
    return Solids(np.concatenate(corners), np.repeat(np.array(rows, dtype=np.int64), counts), things)
