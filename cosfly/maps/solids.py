"""The surfaces of solids as triangles: real roofs and walls, for those who draw; obstacles stay boxes."""

from __future__ import annotations

import numpy as np
import shapely
from shapely.geometry import Polygon

from cosfly.maps.footprints import Rectangle, polygons_of
from cosfly.reading.meshes import Mesh

FOOT_M = 0.01  # vertices this near to the lowest one are the solid's foot
EDGE_M = 0.05  # what only touches a rectangle is not over it


def solid_mesh(surfaces: list[list[np.ndarray]], foot_m: float) -> Mesh | None:
    """Triangulate surfaces; None where none has an area.

    Args:
        surfaces: rings of vertices, (n, 3) m, of each; ring 0 is the outline, others are holes.
        foot_m: height that the foot comes down to, so that no house floats over ground that a map made flat.
    """
    lowest = min(float(ring[:, 2].min()) for surface in surfaces for ring in surface)
    lowered = [[_founded(ring, lowest, foot_m) for ring in surface] for surface in surfaces]
    found = [part for surface in lowered if len(part := triangles_of(surface))]
    if not found:
        return None
    corners = np.concatenate(found)
    return Mesh(corners, np.full((len(corners), 3), np.nan))


def top_within(mesh: Mesh, rectangle: Rectangle, otherwise: float) -> float:
    """Height of the highest triangle whose bounds meet a rectangle; `otherwise` where none does."""
    yaw = np.radians(rectangle.yaw_deg)
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    flat, half = (mesh.corners_m[..., :2] - rectangle.center) @ axes.T, np.array(rectangle.size) / 2.0 - EDGE_M
    over = ((flat.min(axis=1) < half) & (flat.max(axis=1) > -half)).all(axis=1)
    return float(mesh.corners_m[over, :, 2].max()) if over.any() else otherwise


def _founded(ring: np.ndarray, lowest: float, foot_m: float) -> np.ndarray:
    low = ring.copy()
    low[ring[:, 2] <= lowest + FOOT_M, 2] = min(lowest, foot_m)
    return low


def triangles_of(rings: list[np.ndarray]) -> np.ndarray:
    """Cut a surface, rings of (n, 3), into triangles that turn as its outline does, (k, 3, 3). Corners are the
    surface's own where it is valid.

    Where an outline crosses itself, its valid parts are taken, and new corners lie in the surface's plane.
    """
    outline = rings[0]
    after = np.roll(outline, -1, axis=0)
    normal = np.cross(outline, after).sum(axis=0)  # Newell's, twice the area
    if np.linalg.norm(normal) < 1e-9:
        return np.zeros((0, 3, 3))
    normal /= np.linalg.norm(normal)
    if len(rings) == 1 and len(outline) == 3:
        return outline[None]
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    side /= np.linalg.norm(side)
    axes = np.stack([side, np.cross(normal, side)])  # seen from outside the outline turns counter-clockwise
    middle = outline.mean(axis=0)
    flat = [(ring - middle) @ axes.T for ring in rings]
    if len(rings) == 1 and len(outline) == 4 and _is_convex(flat[0]):
        return outline[[(0, 1, 2), (0, 2, 3)]]
    polygon = Polygon(flat[0], flat[1:])
    pieces = polygons_of(polygon if polygon.is_valid else shapely.make_valid(polygon))
    own = {
        (x, y): corner
        for places, ring in zip(flat, rings, strict=True)
        for (x, y), corner in zip(places.tolist(), ring, strict=True)
    }
    found = []
    for triangle in shapely.get_parts([shapely.constrained_delaunay_triangles(piece) for piece in pieces]):
        places = shapely.get_coordinates(shapely.orient_polygons(triangle))[:3]
        found.append([own.get((x, y), middle + (x, y) @ axes) for x, y in places.tolist()])
    return np.array(found).reshape(-1, 3, 3)


def _is_convex(ring: np.ndarray) -> bool:
    edges = np.roll(ring, -1, axis=0) - ring
    following = np.roll(edges, -1, axis=0)
    return bool((edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0] > 0).all())
