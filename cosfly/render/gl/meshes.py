"""Unit meshes of the built-in renderer: each fits into the cube [-1, 1]^3, so a part fits into its half sizes.

Vertices are (n, 6) float32: position and unit normal. Triangles are (k, 3) int32, counter-clockwise seen from outside.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

# Mesh numbers: the order of `all_meshes`.
BOX, BLOB_FINE, BLOB, BLOB_COARSE, CYLINDER, CONE, CABIN, ROUNDED, SPHERE, LIMB = range(10)


@dataclass(frozen=True)
class UnitMesh:
    """A triangle mesh in the cube [-1, 1]^3."""

    vertices: np.ndarray  # (n, 6) float32: position, unit normal
    triangles: np.ndarray  # (k, 3) int32 rows of vertices


def all_meshes() -> list[UnitMesh]:
    """Return every mesh, in the order of the mesh numbers."""
    limb = [(0.0, -1.0), (0.55, -0.96), (0.74, -0.85), (0.92, 0.3), (0.95, 0.85), (0.6, 0.97), (0.0, 1.0)]
    meshes = {
        BOX: prism(1.0, 1.0),
        BLOB_FINE: blob(2),
        BLOB: blob(1),
        BLOB_COARSE: blob(0),
        CYLINDER: revolved([(0.0, -1.0), (1.0, -1.0), (1.0, 1.0), (0.0, 1.0)], 10),
        CONE: revolved([(0.0, -1.0), (1.0, -1.0), (0.42, 0.0), (0.0, 1.0)], 9),
        CABIN: prism(0.66, 0.84),
        ROUNDED: superquadric(0.45, 12, 7),
        SPHERE: superquadric(1.0, 14, 9),
        LIMB: revolved(limb, 10),
    }
    return [meshes[number] for number in range(len(meshes))]


def prism(top_x: float, top_y: float) -> UnitMesh:
    """Return a box whose top face is scaled by top_x and top_y; flat normals, 24 vertices."""
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=np.float64)
    corners[4:, 0] *= top_x
    corners[4:, 1] *= top_y
    quads = corners[[(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]]
    normals = np.cross(quads[:, 1] - quads[:, 0], quads[:, 2] - quads[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = np.concatenate([quads, np.repeat(normals[:, None], 4, axis=1)], axis=-1).reshape(-1, 6)
    triangles = 4 * np.repeat(np.arange(6), 2)[:, None] + np.tile([(0, 1, 2), (0, 2, 3)], (6, 1))
    return UnitMesh(vertices.astype(np.float32), triangles.astype(np.int32))


def revolved(profile: list[tuple[float, float]], num_sides: int) -> UnitMesh:
    """Return the solid of a profile that turns about z, with sharp edges between the segments of the profile.

    Args:
        profile: (radius, z), from the bottom up.
    """
    angles = np.arange(num_sides + 1) * 2.0 * np.pi / num_sides
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for (low_radius, low_z), (high_radius, high_z) in pairwise(profile):
        normal = np.array([high_z - low_z, low_radius - high_radius])  # outward: radial, z
        radial, z = normal / np.hypot(high_z - low_z, high_radius - low_radius)
        first = len(vertices)
        for direction in around:
            vertices.append([*(direction * low_radius), low_z, *(direction * radial), z])
            vertices.append([*(direction * high_radius), high_z, *(direction * radial), z])
        for side in range(num_sides):
            low = first + 2 * side  # its neighbours: low + 1 above it, low + 2 next to it, low + 3 above that
            if low_radius > 0:
                triangles.append((low, low + 2, low + 3))
            if high_radius > 0:
                triangles.append((low, low + 3, low + 1))
    return UnitMesh(np.array(vertices, np.float32), np.array(triangles, np.int32))


def superquadric(exponent: float, num_sides: int, num_rings: int) -> UnitMesh:
    """Return a rounded solid between the cube (exponent 0) and the sphere (exponent 1)."""

    def signed_power(values: np.ndarray, power: float) -> np.ndarray:
        return np.sign(values) * np.abs(values) ** power

    latitude = np.linspace(-np.pi / 2, np.pi / 2, num_rings + 1)[:, None]
    longitude = (np.arange(num_sides + 1) * 2.0 * np.pi / num_sides)[None, :]

    def surface(power: float) -> np.ndarray:
        radius = signed_power(np.cos(latitude), power)
        x = radius * signed_power(np.cos(longitude), power)
        y = radius * signed_power(np.sin(longitude), power)
        z = signed_power(np.sin(latitude), power)
        return np.stack(np.broadcast_arrays(x, y, z), axis=-1).reshape(-1, 3)

    normals = surface(2.0 - exponent)  # the superquadric's normal has the complementary exponent
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    ring, side = np.meshgrid(np.arange(num_rings), np.arange(num_sides), indexing="ij")
    a = (ring * (num_sides + 1) + side).ravel()
    b = a + num_sides + 1
    triangles = np.concatenate([np.stack([a, a + 1, b + 1], 1), np.stack([a, b + 1, b], 1)])
    return UnitMesh(np.hstack([surface(exponent), normals]).astype(np.float32), triangles.astype(np.int32))


def blob(num_subdivisions: int) -> UnitMesh:
    """Return the outline of foliage: an icosphere of radius 1 at most, dented inwards by a fixed smooth pattern."""
    golden = (1.0 + 5.0**0.5) / 2.0
    points = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0), (0, -1, golden), (0, 1, golden)]
    points += [(0, -1, -golden), (0, 1, -golden), (golden, 0, -1), (golden, 0, 1), (-golden, 0, -1), (-golden, 0, 1)]
    unit = np.array(points) / np.linalg.norm(points, axis=1, keepdims=True)
    triangles = np.array([
        (0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6),
        (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7),
        (9, 8, 1),
    ])  # fmt: skip
    for _ in range(num_subdivisions):  # each splits a triangle into four, at the middles of its edges
        a, b, c = triangles.T
        edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
        edges, numbers = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = (len(unit) + numbers.reshape(-1, 3)).T
        middles = unit[edges].sum(axis=1)
        unit = np.concatenate([unit, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        triangles = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], axis=1).reshape(-1, 3)
    waves = [np.sin(unit @ way) for way in ([4.1, 2.3, 1.7], [-1.9, 4.7, 2.9], [7.3, -6.1, 8.2])]
    dents = np.abs(waves[0] * waves[1] + 0.6 * waves[2])
    radius = 1.0 - 0.24 * dents / dents.max()
    return UnitMesh(np.hstack([unit * radius[:, None], unit]).astype(np.float32), np.array(triangles, np.int32))
