"""What all renderers share: the layers, which decide which of several surfaces at one place is visible, and the
triangles of meshes, which are drawn instead of boxes."""

from dataclasses import dataclass

import numpy as np
import shapely

from cosfly.formats.boxes import BoxMap
from cosfly.formats.kinds import KINDS, LAYERS
from cosfly.geometry.axes import rotation_matrices
from cosfly.render.contract import LAWN_HALF_M, STANDING_LAYER

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
    """Return the tier of each surface as a fraction, (n,) in [0, 1).

    A surface gets the lowest tier that is free: that no earlier surface has which overlaps with it in the same layer
    and plane. If none is free, it gets the highest.
    """
    is_level = ~box_map.rotations_deg[:, [0, 2]].any(axis=1)
    rows = np.flatnonzero((layers < STANDING_LAYER) & is_level)
    yaws = np.radians(box_map.rotations_deg[rows, 1])[:, None]
    x, y = np.moveaxis(np.maximum(box_map.half_extents[rows, None, :2] - EDGE_M, 0.0) * CORNERS, 2, 0)
    turned = np.stack([x * np.cos(yaws) - y * np.sin(yaws), x * np.sin(yaws) + y * np.cos(yaws)], axis=2)
    outlines = shapely.polygons(turned + box_map.centers[rows, None, :2])
    tops_m = box_map.maxs[rows, 2]
    later, earlier = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    is_same = (earlier < later) & (layers[rows[earlier]] == layers[rows[later]])
    is_same &= np.abs(tops_m[earlier] - tops_m[later]) < SAME_HEIGHT_M
    earlier_of: dict[int, list[int]] = {}  # row -> rows of earlier surfaces in one plane with it
    for row, earlier_row in zip(rows[later[is_same]].tolist(), rows[earlier[is_same]].tolist(), strict=True):
        earlier_of.setdefault(row, []).append(earlier_row)
    tiers = np.zeros(len(box_map), dtype=int)
    for row in sorted(earlier_of):  # in the map's order, so that earlier surfaces have their tiers
        free = np.setdiff1d(np.arange(MOST_TIERS), tiers[earlier_of[row]])
        tiers[row] = free[0] if len(free) else MOST_TIERS - 1
    return tiers / (tiers.max(initial=0) + 1)


# --- meshes -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Solids:
    """k triangles of placed meshes."""

    corners_m: np.ndarray  # (k, 3, 3) world, counter-clockwise from outside
    rows: np.ndarray  # (k,) of the map's boxes
    objects: np.ndarray  # (k,) ascending, the number of the placed mesh

    def __len__(self) -> int:
        return len(self.corners_m)

    @property
    def normals(self) -> np.ndarray:
        """Return unit vectors that point up or out, (k, 3); 0 for a triangle without area."""
        normals = np.cross(self.corners_m[:, 1] - self.corners_m[:, 0], self.corners_m[:, 2] - self.corners_m[:, 0])
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def are_solids(box_map: BoxMap) -> np.ndarray:
    """Return which boxes are drawn as meshes, (n,) bool."""
    return np.isin(box_map.ids, np.array(sorted(box_map.meshes.refs), dtype=np.uint64))


def solids_of(box_map: BoxMap) -> Solids:
    """Place the meshes of a map: each in its box, or once in the world for all boxes that name it."""
    corners = [np.zeros((0, 3, 3))]
    rows = []
    counts = []  # of triangles
    meshes = box_map.meshes.resolved()
    placed = set()  # meshes in the world
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
    objects = np.repeat(np.arange(len(counts)), counts)
    return Solids(np.concatenate(corners), np.repeat(np.array(rows, dtype=np.int64), counts), objects)
