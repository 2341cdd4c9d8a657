"""A frame's labels drawn over its colours: the 3D boxes of map, target and bystanders, with ids and
distances.

The boxes are projected again from `meta.json` and the map, so a line that does not fit reveals an error in either.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import FrameMeta
from cosfly.formats.kinds import GROUND_KINDS, KIND_NAMES
from cosfly.geometry.axes import box_corners, rotation_matrices, world_from_camera
from cosfly.viz.topview import COLORS, FONT, OTHER_COLOR, Color, draw_text

TARGET_COLOR, OTHERS_COLOR = (255, 214, 10), (90, 220, 255)
LEAST_SHARE = 5e-4  # of the picture: smaller boxes are skipped
MOST_LABELS = 16  # of the largest boxes
FAR_PX = 20_000.0  # lines end this far beyond the picture
# Pairs of corners, in the order of geometry.box_corners, that an edge of a box joins.
EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]


class _Box(NamedTuple):
    """One box to draw."""

    corners_m: np.ndarray  # (8, 3) world
    center_m: np.ndarray  # (3,) world
    color: Color
    label: str


@dataclass(frozen=True)
class Overlay:
    """The boxes of a map and their ids in `instance.png`, (n,)."""

    box_map: BoxMap
    instance_ids: np.ndarray

    def draw(self, rgb: np.ndarray, ids: np.ndarray, meta: FrameMeta) -> np.ndarray:
        """Return the picture with boxes, ids and distances drawn in, (h, w, 3) uint8.

        Args:
            rgb: (h, w, 3) uint8. ids: (h, w) of `instance.png`, which select the boxes.
        """
        picture = np.ascontiguousarray(rgb).copy()
        camera_pose = world_from_camera(meta.drone_pose[:3], meta.drone_pose[3:])
        intrinsic = np.array(meta.camera.intrinsic)
        scale = picture.shape[1] / 1280.0
        labels: list[tuple[str, float, float, Color]] = []
        for boxes, width in ((self._seen(ids), 1), (_moving(meta), 2)):
            for box in boxes:
                lines = _lines(box.corners_m, camera_pose, intrinsic, meta.camera.near_m)
                for begin, end in lines:
                    cv2.line(picture, begin, end, box.color, max(1, round(width * scale)), cv2.LINE_AA)
                if box.label and lines:
                    ends = np.array(lines).reshape(-1, 2)
                    text = f"{box.label} {np.linalg.norm(box.center_m - camera_pose[:3, 3]):.1f} m"
                    labels.append((text, float(ends[:, 0].mean()), float(ends[:, 1].min()), box.color))
        _write_labels(picture, labels, max(0.33, 0.45 * scale))
        return picture

    def _seen(self, ids: np.ndarray) -> list[_Box]:
        """Return the boxes that cover enough of the picture, without ground, the largest last."""
        drawn_ids, counts = np.unique(ids, return_counts=True)
        pixels = dict(zip(drawn_ids.tolist(), counts.tolist(), strict=True))
        seen = np.array([pixels.get(int(number), 0) for number in self.instance_ids.tolist()])
        rows = np.flatnonzero((seen >= LEAST_SHARE * ids.size) & ~self.box_map.is_any_of(GROUND_KINDS))
        rows = rows[np.argsort(seen[rows], kind="stable")]
        turns = rotation_matrices(np.radians(self.box_map.rotations_deg[rows]))
        boxes = []
        for rank, (row, turn) in enumerate(zip(rows.tolist(), turns, strict=True)):
            kind = KIND_NAMES[int(self.box_map.kinds[row])]
            center_m = self.box_map.centers[row]
            corners_m = box_corners(np.zeros(3), self.box_map.half_extents[row]) @ turn.T + center_m
            label = f"{kind} {self.instance_ids[row]}" if rank >= len(rows) - MOST_LABELS else ""
            color = [round(255 - 0.55 * (255 - value)) for value in COLORS.get(kind, OTHER_COLOR)]  # lighter
            boxes.append(_Box(corners_m, center_m, color, label))
        return boxes


def _moving(meta: FrameMeta) -> list[_Box]:
    """Return the boxes of bystanders, then of the target."""
    boxes = []
    for other in meta.others.others if meta.others else ():
        corners_m = box_corners(other.world_location, np.array(other.half_extents_m), other.heading_rad)
        boxes.append(_Box(corners_m, other.world_location, OTHERS_COLOR, str(other.instance_id)))
    center_m = meta.target.world_location
    corners_m = box_corners(center_m, np.array(meta.target.half_extents_m))
    return [*boxes, _Box(corners_m, center_m, TARGET_COLOR, f"target {meta.target.instance_id}")]


def _lines(
    corners_m: np.ndarray, camera_pose: np.ndarray, intrinsic: np.ndarray, near_m: float
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Project the edges of a box, clipped at the near plane, to pairs of pixels."""
    points = (corners_m - camera_pose[:3, 3]) @ camera_pose[:3, :3]
    lines = []
    for a, b in EDGES:
        ends = np.stack([points[a], points[b]])
        (za, zb) = ends[:, 2]
        if max(za, zb) <= near_m:
            continue
        for k, behind in enumerate(ends[:, 2] < near_m):
            if behind:
                ends[k] += (ends[1 - k] - ends[k]) * (near_m - ends[k, 2]) / (ends[1 - k, 2] - ends[k, 2])
        uv = ends @ intrinsic.T
        places = np.clip(uv[:, :2] / uv[:, 2:], -FAR_PX, FAR_PX).round().astype(int)
        lines.append(((int(places[0, 0]), int(places[0, 1])), (int(places[1, 0]), int(places[1, 1]))))
    return lines


def _write_labels(picture: np.ndarray, labels: list[tuple[str, float, float, Color]], size: float) -> None:
    """Write labels (text, x px, y px, colour). A label that overlaps a later one of the list is skipped."""
    height, width = picture.shape[:2]
    taken: list[tuple[float, float, float, float]] = []
    for text, x, y, color in reversed(labels):
        if not (0 <= x < width and -height / 2 <= y < height):
            continue
        (long, high), _ = cv2.getTextSize(text, FONT, size, 1)
        begin = float(np.clip(x - long / 2, 2, max(2, width - long - 2)))
        baseline = float(np.clip(y - 4, high + 2, height - 4))
        x0, y0, x1, y1 = label = begin - 2, baseline - high - 2, begin + long + 2, baseline + 3
        if any(x0 < t[2] and t[0] < x1 and y0 < t[3] and t[1] < y1 for t in taken):
            continue
        taken.append(label)
        cv2.rectangle(picture, (round(x0), round(y0)), (round(x1), round(y1)), (20, 20, 20), -1)
        draw_text(picture, text, begin, baseline, size, color)
