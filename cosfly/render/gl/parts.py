"""Drawable parts, and the choice of those that a camera sees, without OpenGL.

A part is a unit mesh (meshes.py) with half sizes, a rotation, a colour and a material number of the shader.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.render.contract import FAR_M, LAYER_STEP, NEAR_M, STANDING_LAYER, chance
from cosfly.runtime.compiled import njit

# Materials, the same numbers as in scene.frag.glsl.
(
    PLAIN, FACADE, ROAD, SIDEWALK, GRASS, LEAVES, BARK, CAR_PAINT, CABIN, RUBBER, METAL, BRICK, WATER, FENCE, ROAD_LINE,
    LAMP, GRAVEL, SIGNAL, BUS, CLOTH, CONCRETE, TILES,
) = range(22)  # fmt: skip
NUM_MATERIALS = 22
GROUND_MATERIALS = (SIDEWALK, ROAD_LINE, ROAD, GRAVEL, WATER, GRASS)
DRAW_ORDER = (*(m for m in range(NUM_MATERIALS) if m not in GROUND_MATERIALS), *GROUND_MATERIALS)

PART = np.dtype(
    [
        ("center", "3f4"),  # m, relative to the scene's origin
        ("half", "3f4"),  # half sizes, m
        ("quaternion", "4f4"),  # world_from_part: x, y, z, w
        ("color", "4f4"),  # linear RGB, and the seed of its object in [0, 1)
        ("tag", "u4"),  # as packed by `tags`
        ("bias", "f4"),  # depth bias of its layer
    ]
)
# A vertex of a triangle of no mesh: position and normal as in a mesh, then the fields of its part.
LOOSE_VERTEX = np.dtype([("position", "3f4"), ("normal", "3f4"), *((name, PART[name]) for name in PART.names or ())])

BRIGHT = 0.5  # least red of a lamp's glass; its housing is darker
# Radii of an object on the image.
SMALLEST_PX = 0.4  # a smaller object is not drawn
FAR_PX = 14.0  # a smaller object is drawn in its simple form
NEVER_PX = 1e9  # no object is as large
LEAST_HALF_M = 1e-3  # half size of a flat part


@dataclass(frozen=True)
class Parts:
    """k drawable parts of objects. Positions are relative to the scene's origin.

    A part is drawn while the radius of its object on the image lies in [min_px, max_px).
    """

    records: np.ndarray  # (k,) PART
    mesh: np.ndarray  # (k,) uint8 mesh numbers
    centers: np.ndarray  # (k, 3) float64 m, the centers of the records before rounding
    object_centers: np.ndarray  # (k, 3) float32 m
    object_radii: np.ndarray  # (k,) float32 m
    min_px: np.ndarray  # (k,) float32
    max_px: np.ndarray  # (k,) float32

    def __len__(self) -> int:
        return len(self.records)

    @staticmethod
    def concatenate(parts: list[Parts]) -> Parts:
        return Parts(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])})

    def select(self, keep: np.ndarray) -> Parts:
        return Parts(**{name: column[keep] for name, column in vars(self).items()})

    def relative_to(self, origin_m: np.ndarray) -> Parts:
        """Return the same parts relative to a further origin, (3,): float32 is most precise near 0."""
        if not origin_m.any():
            return self
        records = self.records.copy()
        records["center"] = self.centers - origin_m
        object_centers = (self.object_centers - origin_m).astype(np.float32)
        return replace(self, records=records, centers=self.centers - origin_m, object_centers=object_centers)

    def lamps(self) -> np.ndarray:
        """Return the positions of the lit lamps, (n, 3)."""
        is_lamp = (materials_of(self.records) == LAMP) & (self.records["color"][:, 0] > BRIGHT)
        return self.records["center"][is_lamp].astype(np.float64)


@dataclass(frozen=True)
class Boxes:
    """n boxes of one kind."""

    centers: np.ndarray  # (n, 3) m, relative to the scene's origin
    half: np.ndarray  # (n, 3) half sizes, m
    turns: np.ndarray  # (n, 3, 3) world_from_box
    ids: np.ndarray  # (n,) instance ids
    seeds: np.ndarray  # (n,) in [0, 1)
    kind: int
    tiers: np.ndarray  # (n,) in [0, 1), the order of surfaces in one layer

    def __len__(self) -> int:
        return len(self.centers)

    def select(self, keep: np.ndarray) -> Boxes:
        columns = ("centers", "half", "turns", "ids", "seeds", "tiers")
        return replace(self, **{name: getattr(self, name)[keep] for name in columns})

    def lengthwise(self) -> Boxes:
        """Return the same boxes with x as their longer horizontal axis, turned by 90 degrees if needed."""
        across = self.half[:, 1] > self.half[:, 0]
        half = self.half.copy()
        turns = self.turns.copy()
        half[across] = half[across][:, [1, 0, 2]]
        turns[across] = turns[across] @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, half=half, turns=turns)

    def variation(self, number: int) -> np.ndarray:
        """Return a further fixed number in [0, 1) for each box."""
        return chance(self.seeds, number)

    def pick(self, palette: np.ndarray) -> np.ndarray:
        """Return a colour of a palette, (k, 3), for each box, (n, 3)."""
        return palette[(self.variation(0) * len(palette)).astype(int)]

    def part(
        self, mesh: int, half: np.ndarray, material: int, color: np.ndarray | tuple[float, ...], *,
        offset: np.ndarray | None = None, turn: np.ndarray | None = None, min_px: float = 0.0, max_px: float = NEVER_PX,
        layer: int | None = None,
    ) -> Parts:  # fmt: skip
        """Return one part of each box.

        Args:
            mesh: Number of the unit mesh, see meshes.py.
            half: (n, 3) or (3,) half sizes of the part in its own axes, m.
            material: Number in the shader, see PLAIN.
            color: (n, 3) or (3,) linear RGB.
            offset: (n, 3) from the centre of the box, in box axes, m.
            turn: (3, 3) or (n, 3, 3) box_from_part.
            min_px, max_px: The part is drawn while the radius of the box on the image lies in [min_px, max_px).
            layer: Of a surface; None for what stands on the ground.
        """
        num_boxes = len(self)
        centers = self.centers.astype(np.float64)
        records = np.zeros(num_boxes, PART)
        records["center"] = centers
        if offset is not None:
            offset_m = np.einsum("nij,nj->ni", self.turns, offset)
            records["center"] += offset_m  # to the rounded centre: rounding the sum would move vertices by an ulp
            centers = centers + offset_m
        records["half"] = np.maximum(half, LEAST_HALF_M)
        if num_boxes:
            records["quaternion"] = Rotation.from_matrix(self.turns if turn is None else self.turns @ turn).as_quat()
        records["color"][:, :3] = color
        records["color"][:, 3] = self.seeds
        records["tag"] = tags(self.kind, material, self.ids)
        records["bias"] = LAYER_STEP * (STANDING_LAYER if layer is None else layer + self.tiers)
        return Parts(
            records=records, mesh=np.full(num_boxes, mesh, np.uint8), centers=centers,
            object_centers=self.centers.astype(np.float32),
            object_radii=np.linalg.norm(self.half, axis=1).astype(np.float32),
            min_px=np.full(num_boxes, min_px, np.float32), max_px=np.full(num_boxes, max_px, np.float32),
        )  # fmt: skip


@dataclass(frozen=True)
class LooseTriangles:
    """Triangles of no unit mesh: those of n objects (meshes of a map), and the ground.

    Triangles of a material without objects are the ground, which is always drawn and casts no shadow.
    """

    vertices: dict[int, np.ndarray]  # by material: (3 k,) LOOSE_VERTEX, three to a triangle
    objects: dict[int, np.ndarray]  # by material: (k,) ascending, the row of the object of each triangle
    centers: np.ndarray  # (n, 3) float64 m, of the objects, relative to the scene's origin
    radii: np.ndarray  # (n,) m, of the objects


def tags(kinds: np.ndarray | int, materials: np.ndarray | int, ids: np.ndarray) -> np.ndarray:
    """Pack kind (bits 0-7), material (8-15) and instance id (16-31), as the shader unpacks them."""
    kinds, materials, ids = (np.asarray(part).astype(np.uint32) for part in (kinds, materials, ids))
    return kinds | materials << np.uint32(8) | ids << np.uint32(16)


def materials_of(records: np.ndarray) -> np.ndarray:
    """Return the materials of records, (k,) uint32."""
    return (records["tag"] >> 8) & 0xFF


# --- cameras ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CameraView:
    """A camera, relative to the scene's origin."""

    world_from_camera: np.ndarray  # (3, 3)
    eye: np.ndarray  # (3,) m
    intrinsic: np.ndarray  # (3, 3) px
    width_px: int
    height_px: int

    def part_rows_in_view(self, parts: Parts) -> np.ndarray:
        """Return the rows of the parts to draw: the highest layer first, in a layer the nearest object first.

        Thus most of what is hidden fails the depth test and is not shaded.
        """
        least_px = np.maximum(parts.min_px, np.float32(SMALLEST_PX))
        rows, away_m = self._spheres_in_view(parts.object_centers, parts.object_radii, least_px, parts.max_px)
        return rows[np.lexsort((away_m, -parts.records["bias"][rows]))]

    def sphere_rows_in_view(self, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Return the rows of the spheres that may be seen, the nearest first.

        Args:
            centers: (n, 3), relative to the scene's origin.
            radii: (n,) float32, m.
        """
        least_px = np.full(len(radii), SMALLEST_PX, np.float32)
        most_px = np.full(len(radii), np.inf, np.float32)
        rows, away_m = self._spheres_in_view(centers.astype(np.float32), radii, least_px, most_px)
        return rows[np.argsort(away_m, kind="stable")]

    def _spheres_in_view(
        self, centers: np.ndarray, radii: np.ndarray, min_px: np.ndarray, max_px: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the result of `spheres_in_view`, with this camera as its arguments."""
        middle = self.intrinsic[:2, 2]
        size = np.array([self.width_px, self.height_px])
        # tangents: of the angles from the optical axis to the farther border, horizontally and vertically. slants: 1 /
        # cosine of these angles, because the kernel measures distances from a border's plane across the axis.
        tangents = np.maximum(middle, size - middle) / np.diag(self.intrinsic)[:2]
        slants = np.sqrt(1.0 + tangents**2)
        eye = self.eye.astype(np.float32)
        turn = np.ascontiguousarray(self.world_from_camera, np.float32)
        return spheres_in_view(centers, radii, min_px, max_px, eye, turn, tangents, slants, float(self.intrinsic[0, 0]))

    def can_show(self, center: np.ndarray, radius: float) -> bool:
        """Return whether something within a sphere may be seen; center: (3,) relative to the scene's origin."""
        return len(self.sphere_rows_in_view(center[None], np.array([radius], np.float32))) > 0

    def rectangle_px(self, points: np.ndarray) -> tuple[int, int, int, int] | None:
        """Return the pixels that a hull of points, (n, 3), may cover: x0, y0, x1, y1; None outside the picture."""
        in_camera = (points - self.eye.astype(np.float32)) @ self.world_from_camera.astype(np.float32)
        if in_camera[:, 2].max() <= NEAR_M:
            return None
        if in_camera[:, 2].min() <= NEAR_M:
            return 0, 0, self.width_px, self.height_px
        projected = in_camera @ self.intrinsic.T
        pixels = projected[:, :2] / projected[:, 2:]
        size = [self.width_px, self.height_px]
        x0, y0 = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, size).astype(int).tolist()
        x1, y1 = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int).tolist()
        return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None


@njit(cache=True, nogil=True)
def spheres_in_view(  # type: ignore[no-untyped-def]
    centers, radii, min_px, max_px, eye, turn, tangents, slants, focal_px
):
    """Find the spheres that a camera may see with a radius on the image in [min_px, max_px), in one pass.

    Args:
        centers: (k, 3) float32, m.
        radii, min_px, max_px: (k,) float32.
        eye: (3,) float32, m.
        turn: (3, 3) float32, world_from_camera.
        tangents, slants: (2,) float64, tangent and 1 / cosine of the widest angles to the sides and up.
        focal_px: float.

    Returns:
        (n,) int64 ascending rows of the spheres in view, and (n,) float32 m, where each begins along the optical axis.
    """
    rows = np.empty(len(centers), np.int64)
    away = np.empty(len(centers), np.float32)
    count = 0
    near = np.float32(NEAR_M)
    focal = np.float32(focal_px)
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
            rows[count] = k
            away[count] = z - radius
            count += 1
    return rows[:count], away[:count]
