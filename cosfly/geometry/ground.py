"""The height of the ground: one height for a map, or a grid of heights with two flat triangles for each cell.

The surface is made of triangles because renderers draw triangles: feet, rays and pictures agree up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Ground:
    """Heights of the ground, world m.

    heights_m: (ny, nx), the node [y, x] at (west_m + x cell_m, south_m + y cell_m); (1, 1) is flat ground of any
    extent. The diagonal from its south-west to its north-east corner cuts each cell into two triangles. Beyond the grid
    the ground continues at the height of the border.
    """

    heights_m: np.ndarray
    west_m: float = 0.0
    south_m: float = 0.0
    cell_m: float = 1.0

    @classmethod
    def flat(cls, z_m: float) -> Ground:
        return cls(np.array([[z_m]], dtype=np.float64))

    @property
    def is_flat(self) -> bool:
        """Whether the height is the same everywhere."""
        return self.heights_m.size == 1

    def height_at(self, points_m: np.ndarray) -> np.ndarray:
        """Return the height under each of (n, 2 or 3) points, (n,)."""
        points = np.asarray(points_m, dtype=np.float64)
        if self.is_flat:
            return np.full(len(points), self.heights_m[0, 0])
        u, v, (low, east, north, far) = self._cells(points)
        return np.where(u >= v, low + u * (east - low) + v * (far - east), low + v * (north - low) + u * (far - north))

    def slope_at(self, points_m: np.ndarray) -> np.ndarray:
        """Return the slope (rise over run) under (n, 2 or 3) points, (n,); beyond the grid that along the border."""
        points = np.asarray(points_m, dtype=np.float64)
        if self.is_flat:
            return np.zeros(len(points))
        u, v, (low, east, north, far) = self._cells(points)
        rise_x = np.where(u >= v, east - low, far - north)
        rise_y = np.where(u >= v, far - east, north - low)
        num_y, num_x = self.heights_m.shape
        grid_points = (points[:, :2] - [self.west_m, self.south_m]) / self.cell_m
        is_inside = (grid_points >= 0.0) & (grid_points <= [num_x - 1, num_y - 1])
        return np.hypot(rise_x * is_inside[:, 0], rise_y * is_inside[:, 1]) / self.cell_m

    def range_under(self, mins: np.ndarray, maxs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and highest ground under upright boxes (n, 3), at centers and corners, (n,) each."""
        middles = (mins + maxs)[:, :2] / 2
        corners = [np.stack([x, y], axis=1) for x in (mins[:, 0], maxs[:, 0]) for y in (mins[:, 1], maxs[:, 1])]
        heights = np.stack([self.height_at(places) for places in (middles, *corners)])
        return heights.min(axis=0), heights.max(axis=0)

    def _cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
        """Return x and y within cells, 0 to 1, and heights at the south-west, -east, north-west, -east corners."""
        num_y, num_x = self.heights_m.shape
        x = np.clip((points[:, 0] - self.west_m) / self.cell_m, 0.0, num_x - 1.0)
        y = np.clip((points[:, 1] - self.south_m) / self.cell_m, 0.0, num_y - 1.0)
        ix = np.minimum(x.astype(int), num_x - 2)
        iy = np.minimum(y.astype(int), num_y - 2)
        corners = tuple(self.heights_m[iy + dy, ix + dx] for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)))
        return x - ix, y - iy, corners

    def triangles(self, reach_m: float = 0.0) -> np.ndarray:
        """Return the triangles, (2 cells, 3, 3) m, counter-clockwise from above.

        reach_m: Width of further cells around the grid, at the heights of its border; 0: none.
        """
        num_y, num_x = self.heights_m.shape
        x = self.west_m + self.cell_m * np.arange(num_x)
        y = self.south_m + self.cell_m * np.arange(num_y)
        z = self.heights_m
        if reach_m > 0:
            x, y = (np.concatenate([[line[0] - reach_m], line, [line[-1] + reach_m]]) for line in (x, y))
            z = np.pad(z, 1, mode="edge")
        nodes = np.stack([*np.meshgrid(x, y), z], axis=-1)
        low, east, north, far = nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
        pairs = np.stack([np.stack([low, east, far], axis=2), np.stack([low, far, north], axis=2)], axis=2)
        return pairs.reshape(-1, 3, 3)

    def slabs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return boxes that fill the ground from below, one per cell: centers, half_extents (k, 3), turns (k, 3, 3).

        The top of a box is the plane through its cell's corners; if they are not in one plane, it lies lower by a
        quarter of the twist. turns: world_from_box.
        """
        heights = self.heights_m
        low, east, north, far = heights[:-1, :-1], heights[:-1, 1:], heights[1:, :-1], heights[1:, 1:]
        rises = np.stack([east - low + far - north, north - low + far - east], axis=-1)
        gradient = rises.reshape(-1, 2) / (2 * self.cell_m)
        num_y, num_x = self.heights_m.shape
        x, y = np.meshgrid(np.arange(num_x - 1) + 0.5, np.arange(num_y - 1) + 0.5)
        middle_z = ((low + east + north + far) - np.abs(low - east - north + far)).ravel() / 4
        tops = np.column_stack(
            [self.west_m + self.cell_m * x.ravel(), self.south_m + self.cell_m * y.ravel(), middle_z]
        )
        along = np.column_stack([np.ones(len(tops)), np.zeros(len(tops)), gradient[:, 0]])
        up = np.column_stack([-gradient, np.ones(len(tops))])
        along, up = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in (along, up))
        turns = np.stack([along, np.cross(up, along), up], axis=2)
        reach = self.cell_m / 2 * np.array([[sx, sy] for sx in (-1, 1) for sy in (-1, 1)])
        offsets = np.concatenate([np.broadcast_to(reach, (len(tops), 4, 2)), (gradient @ reach.T)[:, :, None]], axis=2)
        half = np.abs(np.einsum("nij,nki->nkj", turns, offsets)).max(axis=1)
        half[:, 2] = (middle_z - self.heights_m.min() + 2.0) / 2  # down to below the lowest ground
        return tops - turns[:, :, 2] * half[:, 2:], half, turns
