"""Boxes that are drawn as meshes: what both renderers draw in their place; everybody else knows the boxes alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.geometry.axes import rotation_matrices


@dataclass(frozen=True)
class Solids:
    """Triangles of meshes in the world, k of them, each on its own: corners_m (k, 3, 3), counter-clockwise from
    outside; rows (k,) of the boxes whose id and kind they show; colors (k, 3) linear RGB, NaN where the kind's own is
    taken; things (k,) ascending, a number for each mesh that stands somewhere.
    """

    corners_m: np.ndarray
    rows: np.ndarray
    colors: np.ndarray
    things: np.ndarray

    def __len__(self) -> int:
        return len(self.corners_m)

    @property
    def normals(self) -> np.ndarray:
        """(k, 3) unit vectors that point out; 0 of a triangle without an area."""
        normals = np.cross(self.corners_m[:, 1] - self.corners_m[:, 0], self.corners_m[:, 2] - self.corners_m[:, 0])
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def are_solids(box_map: BoxMap) -> np.ndarray:
    """Return which boxes are drawn as meshes, (n,) bool."""
    return np.isin(box_map.ids, np.array(sorted(box_map.meshes.refs), dtype=np.uint64))


def solids_of(box_map: BoxMap) -> Solids:
    """Place the meshes of a map: each in its box, or one for all boxes that name one of the map's own places."""
    corners, rows, colors, counts = [np.zeros((0, 3, 3))], [], [np.zeros((0, 3))], []
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
            corners.append(mesh.corners_m)
        else:
            low, high = mesh.corners_m.min(axis=(0, 1)), mesh.corners_m.max(axis=(0, 1))
            stretch = 2.0 * box_map.half_extents[row] / np.where(high > low, high - low, 1.0)
            corners.append((mesh.corners_m - (low + high) / 2.0) * stretch @ turns[row].T + box_map.centers[row])
        colors.append(mesh.colors)
        rows.append(row)
        counts.append(len(mesh))
    things = np.repeat(np.arange(len(counts)), counts)
    return Solids(
        np.concatenate(corners), np.repeat(np.array(rows, dtype=np.int64), counts), np.concatenate(colors), things
    )
