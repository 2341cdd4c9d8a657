"""What a camera can see of drawable parts: in the frustum, large enough, in the form for its size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosfly.render.camera import spheres_in_view
from cosfly.render.contract import FAR_M, NEAR_M
from cosfly.render.gl.parts import Parts

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
        """Rows of the parts to draw, nearest objects first."""
        tangents, slants = self._cone()
        rows, away = spheres_in_view(
            parts.object_centers,
            parts.object_radii,
            np.maximum(parts.min_px, np.float32(SMALLEST_PX)),
            parts.max_px,
            self.eye.astype(np.float32),
            np.ascontiguousarray(self.world_from_camera, np.float32),
            tangents,
            slants,
            float(self.intrinsic[0, 0]),
        )
        return rows[np.lexsort((away, -parts.records["bias"][rows]))]

    def shown(self, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Which spheres may be seen, the nearest first; centers (n, 3), radii (n,) float32, from the scene's origin."""
        in_camera = self._in_camera(centers)
        seen = np.flatnonzero(self._is_inside(in_camera, radii) & (self._size_px(in_camera, radii) >= SMALLEST_PX))
        return seen[np.argsort((in_camera[:, 2] - radii)[seen], kind="stable")]

    def can_show(self, center: np.ndarray, radius: float) -> bool:
        """Tell whether something within a sphere may be seen; center: (3,) relative to the scene's origin."""
        return len(self.shown(center[None], np.array([radius], np.float32))) > 0

    def rectangle_px(self, points: np.ndarray) -> tuple[int, int, int, int] | None:
        """Pixels that a hull of points, (n, 3), may cover: x0, y0, x1, y1; None where it is out of the picture."""
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

    def _is_inside(self, in_camera: np.ndarray, radius: np.ndarray) -> np.ndarray:
        x, y, z = in_camera.T
        tangents, slants = self._cone()
        inside = (z + radius > NEAR_M) & (z - radius < FAR_M)
        inside &= np.abs(x) - z * tangents[0] < radius * slants[0]
        inside &= np.abs(y) - z * tangents[1] < radius * slants[1]
        return inside

    def _cone(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the image's widest angle to each side, (2,): tangent, and how many radii off a sphere's middle may be."""
        middle, size = self.intrinsic[:2, 2], np.array([self.width_px, self.height_px])
        tangents = np.maximum(middle, size - middle) / np.diag(self.intrinsic)[:2]
        return tangents, np.sqrt(1.0 + tangents**2)

    def _size_px(self, in_camera: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Radius on the image."""
        x, y, z = in_camera.T
        return float(self.intrinsic[0, 0]) * radius / np.maximum(np.sqrt(x * x + y * y + z * z) - radius, NEAR_M)
