"""Drawable parts and their builder: a part is a unit mesh (meshes.py) with half sizes, a rotation, a colour and a
material number of the shader. Independent of OpenGL and of the shapes of things (shapes.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from cosfly.render.contract import LAYER_STEP, STANDING_LAYER, chance

# Materials, the same numbers as in scene.frag.glsl.
(
    PLAIN, FACADE, ROAD, SIDEWALK, GRASS, LEAVES, BARK, CAR_PAINT, CABIN, RUBBER, METAL, BRICK, WATER, FENCE, ROAD_LINE,
    LAMP, GRAVEL, SIGNAL, BUS, CLOTH, CONCRETE, TILES,
) = range(22)  # fmt: skip
NUM_MATERIALS = 22
GROUND_MATERIALS = (SIDEWALK, ROAD_LINE, ROAD, GRAVEL, WATER, GRASS)
DRAW_ORDER = (*(m for m in range(NUM_MATERIALS) if m not in GROUND_MATERIALS), *GROUND_MATERIALS)

PART = np.dtype(
    [("center", "3f4"), ("half", "3f4"), ("quaternion", "4f4"), ("color", "4f4"), ("tag", "u4"), ("bias", "f4")]
)
# A vertex of a triangle that is no instance of a mesh: place and normal as in a mesh, then its part.
LOOSE_VERTEX = np.dtype([("position", "3f4"), ("normal", "3f4"), *((name, PART[name]) for name in PART.names or ())])

FAR_PX, NEVER_PX = 14.0, 1e9  # an object of a smaller radius on the image is drawn in its simple form


@dataclass(frozen=True)
class Parts:
    """Drawable parts, k of them. Positions are relative to the scene's origin.

    records: (k,) PART; mesh: (k,) mesh numbers; centers: (k, 3) float64, the records' centers before they were rounded;
    object_centers (k, 3), object_radii (k,): the whole object a part belongs to; a part is drawn while the object's
    radius on the image lies in [min_px, max_px).
    """

    records: np.ndarray
    mesh: np.ndarray
    centers: np.ndarray
    object_centers: np.ndarray
    object_radii: np.ndarray
    min_px: np.ndarray
    max_px: np.ndarray

    def __len__(self) -> int:
        return len(self.records)

    def select(self, keep: np.ndarray) -> Parts:
        return Parts(*(column[keep] for column in vars(self).values()))

    def about(self, place: np.ndarray) -> Parts:
        """Return the same parts relative to a place, (3,): float32 is most precise near 0."""
        if not place.any():
            return self
        records = self.records.copy()
        records["center"] = self.centers - place
        object_centers = (self.object_centers - place).astype(np.float32)
        return replace(self, records=records, centers=self.centers - place, object_centers=object_centers)


@dataclass(frozen=True)
class Boxes:
    """The boxes of one kind: centers, half (n, 3); turns (n, 3, 3) world_from_box; ids (n,); seeds (n,) in [0, 1).

    tiers: (n,) in [0, 1), of surfaces in their layer.
    """

    centers: np.ndarray
    half: np.ndarray
    turns: np.ndarray
    ids: np.ndarray
    seeds: np.ndarray
    kind: int
    tiers: np.ndarray

    def __len__(self) -> int:
        return len(self.centers)

    def select(self, keep: np.ndarray) -> Boxes:
        columns = ("centers", "half", "turns", "ids", "seeds", "tiers")
        return replace(self, **{name: getattr(self, name)[keep] for name in columns})

    def lengthwise(self) -> Boxes:
        """Return the same boxes with x as their longer horizontal axis: turned by 90 degrees where it is not."""
        across = self.half[:, 1] > self.half[:, 0]
        half, turns = self.half.copy(), self.turns.copy()
        half[across] = half[across][:, [1, 0, 2]]
        turns[across] = turns[across] @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, half=half, turns=turns)

    def chance(self, number: int) -> np.ndarray:
        """Return a further fixed number in [0, 1) for each box."""
        return chance(self.seeds, number)

    def pick(self, palette: np.ndarray) -> np.ndarray:
        """Return a colour of a palette, (k, 3), for each box, (n, 3)."""
        return palette[(self.chance(0) * len(palette)).astype(int)]


@dataclass(frozen=True)
class Loose:
    """Triangles by material. vertices: (3 k,) LOOSE_VERTEX, three to a triangle, relative to the scene's origin.

    things: (k,) ascending, the thing of each triangle; centers (n, 3) float64, radii (n,) of things. Without things
    all triangles are always drawn.
    """

    vertices: dict[int, np.ndarray]
    things: dict[int, np.ndarray]
    centers: np.ndarray
    radii: np.ndarray

    @staticmethod
    def all_of(vertices: dict[int, np.ndarray]) -> Loose:
        return Loose(vertices, {}, np.zeros((0, 3)), np.zeros(0))


@dataclass
class PartBuilder:
    """Parts that are collected kind by kind."""

    _parts: list[Parts] = field(default_factory=list)

    def add(
        self, boxes: Boxes, mesh: int, half: np.ndarray, material: int, color: np.ndarray | tuple[float, ...], *,
        offset: np.ndarray | None = None, turn: np.ndarray | None = None, min_px: float = 0.0, max_px: float = NEVER_PX,
        layer: int | None = None,
    ) -> None:  # fmt: skip
        """Add one part to each box.

        Args:
            half: (n, 3) or (3,) half sizes of the part, in its own axes; offset: (n, 3) from the box's centre, in box
                axes.
            turn: (3, 3) or (n, 3, 3) box_from_part; color: (n, 3) or (3,) linear RGB.
        """
        n = len(boxes)
        if n == 0:
            return
        records = np.zeros(n, PART)
        records["center"] = centers = boxes.centers.astype(np.float64)
        if offset is not None:
            from_middle = np.einsum("nij,nj->ni", boxes.turns, np.broadcast_to(offset, (n, 3)))
            records["center"] += from_middle
            centers = centers + from_middle
        records["half"] = np.maximum(half, 1e-3)
        turns = boxes.turns if turn is None else boxes.turns @ turn
        records["quaternion"] = Rotation.from_matrix(turns).as_quat()
        records["color"][:, :3] = color
        records["color"][:, 3] = boxes.seeds
        records["tag"] = tags(boxes.kind, material, boxes.ids)
        records["bias"] = LAYER_STEP * (STANDING_LAYER if layer is None else layer + boxes.tiers)
        self._parts.append(
            Parts(
                records,
                np.full(n, mesh, np.uint8),
                centers,
                boxes.centers.astype(np.float32),
                np.linalg.norm(boxes.half, axis=1).astype(np.float32),
                np.full(n, min_px, np.float32),
                np.full(n, max_px, np.float32),
            )
        )

    def add_parts(self, parts: Parts) -> None:
        """Add the parts of another builder."""
        self._parts.append(parts)

    def finish(self) -> Parts:
        return Parts(*map(np.concatenate, zip(*(vars(parts).values() for parts in self._parts), strict=True)))


def tags(kind: int, material: int, ids: np.ndarray) -> np.ndarray:
    """Pack kind (bits 0-7), material (8-15) and instance id (16-31), as the shader unpacks them."""
    return np.uint32(kind) | np.uint32(material << 8) | (np.asarray(ids).astype(np.uint32) << np.uint32(16))
