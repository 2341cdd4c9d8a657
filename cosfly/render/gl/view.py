"""Selection of drawable parts for a camera: in the frustum, large enough, in the form for their size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.render.contract import FAR_M, NEAR_M
from cosfly.render.gl.parts import Parts
from cosfly.runtime.compiled import njit

SMALLEST_PX = 0.4  # an object whose radius on the image is below this is not drawn


@dataclass(frozen=True)
class CameraView:
    """A camera relative to the scene's origin: world_from_camera (3, 3), eye (3,), intrinsic (3, 3) px."""

    world_from_camera: np.ndarray
    eye: np.ndarray
    intrinsic: np.ndarray
    width_px: int
    height_px: int

    def rows(self, parts: Parts) -> np.ndarray:
        """Return the rows of the parts to draw, nearest objects first."""
        least_px = np.maximum(parts.min_px, np.float32(SMALLEST_PX))
        rows, away = self._spheres(parts.object_centers, parts.object_radii, least_px, parts.max_px)
        return rows[np.lexsort((away, -parts.records["bias"][rows]))]

    def shown(self, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Return which spheres may be seen, the nearest first; centers (n, 3), radii (n,) float32, from the scene's
        origin."""
        least_px, most_px = (np.full(len(radii), size, np.float32) for size in (SMALLEST_PX, np.inf))
        rows, away = self._spheres(centers.astype(np.float32), radii, least_px, most_px)
        return rows[np.argsort(away, kind="stable")]

    def _spheres(
        self, centers: np.ndarray, radii: np.ndarray, min_px: np.ndarray, max_px: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        middle, size = self.intrinsic[:2, 2], np.array([self.width_px, self.height_px])
        tangents = np.maximum(middle, size - middle) / np.diag(self.intrinsic)[:2]
        eye, turn = self.eye.astype(np.float32), np.ascontiguousarray(self.world_from_camera, np.float32)
        slants = np.sqrt(1.0 + tangents**2)
        return spheres_in_view(centers, radii, min_px, max_px, eye, turn, tangents, slants, float(self.intrinsic[0, 0]))

    def can_show(self, center: np.ndarray, radius: float) -> bool:
        """Return whether something within a sphere may be seen; center: (3,) relative to the scene's origin."""
        return len(self.shown(center[None], np.array([radius], np.float32))) > 0

    def rectangle_px(self, points: np.ndarray) -> tuple[int, int, int, int] | None:
        """Return the pixels that a hull of points, (n, 3), may cover: x0, y0, x1, y1; None outside the picture."""
        in_camera = self._in_camera(points)
        if in_camera[:, 2].max() <= NEAR_M:
            return None
        if in_camera[:, 2].min() <= NEAR_M:
            return 0, 0, self.width_px, self.height_px
        places = in_camera @ self.intrinsic.T
        places = places[:, :2] / places[:, 2:]
        size = [self.width_px, self.height_px]
        x0, y0 = np.clip(np.floor(places.min(axis=0)) - 1, 0, size).astype(int).tolist()
        x1, y1 = np.clip(np.ceil(places.max(axis=0)) + 1, 0, size).astype(int).tolist()
        return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None

    def _in_camera(self, centers: np.ndarray) -> np.ndarray:
        return (centers - self.eye.astype(np.float32)) @ self.world_from_camera.astype(np.float32)


@njit(cache=True, nogil=True)
def spheres_in_view(  # type: ignore[no-untyped-def]
    centers, radii, min_px, max_px, eye, turn, tangents, slants, focal_px
):
    """Find the spheres that a camera may see with a radius on the image in [min_px, max_px), in one pass.

    Args:
        centers: (k, 3) float32 m; radii, min_px, max_px: (k,) float32; eye: (3,) float32 m; turn: (3, 3) float32,
            world_from_camera.
        tangents, slants: (2,) float64, of the widest angles to the sides and up: tangent, and 1 / cosine. focal_px:
            float.
    Returns:
        rows (n,) int64, in their order; (n,) float32 m, how far along the axis each begins.
    """
    rows, away, count = np.empty(len(centers), np.int64), np.empty(len(centers), np.float32), 0
    near, focal = np.float32(NEAR_M), np.float32(focal_px)
    for k in range(len(centers)):
        dx, dy, dz = centers[k, 0] - eye[0], centers[k, 1] - eye[1], centers[k, 2] - eye[2]
        radius = radii[k]
        z = dx * turn[0, 2] + dy * turn[1, 2] + dz * turn[2, 2]
        if not (z + radius > near and z - radius < FAR_M):
            continue
        x = dx * turn[0, 0] + dy * turn[1, 0] + dz * turn[2, 0]
        y = dx * turn[0, 1] + dy * turn[1, 1] + dz * turn[2, 1]
        if abs(x) - z * tangents[0] >= radius * slants[0] or abs(y) - z * tangents[1] >= radius * slants[1]:
            continue
        size_px = focal * radius / max(np.sqrt(x * x + y * y + z * z) - radius, near)
        if min_px[k] <= size_px < max_px[k]:
            rows[count], away[count] = k, z - radius
            count += 1
    return rows[:count], away[:count]
