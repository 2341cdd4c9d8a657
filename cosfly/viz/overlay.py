"""A frame's labels drawn over its colours: the 3D boxes of map, target and bystanders, with ids and distances.

The boxes are projected again from `meta.json` and the map, so a line that does not fit reveals an error in either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import shapely

from cosfly.formats.boxes import BoxMap
from cosfly.formats.frames import FrameMeta
from cosfly.formats.kinds import GROUND_KINDS, KIND_NAMES
from cosfly.geometry.axes import box_corners, rotation_matrices, world_from_camera
from cosfly.viz.topview import COLORS, FONT, OTHER_COLOR, Color, draw_text

TARGET_COLOR, OTHERS_COLOR = (255, 214, 10), (90, 220, 255)
LEAST_SHARE = 5e-4  # of the picture: smaller boxes are skipped
MOST_LABELS = 16  # of the largest boxes
FAR_PX = 20_000.0  # lines end this far beyond the picture
WIDTH_PX = 1280.0  # of a picture whose lines and letters have the sizes below; those of others are scaled
MAP_LINE_PX, MOVING_LINE_PX = 1, 2
TEXT_SIZE, LEAST_TEXT_SIZE = 0.45, 0.33
PALENESS = 0.45  # share by which colours of the map are moved towards white
LABEL_BACKGROUND = (20, 20, 20)
LABEL_GAP_PX = 4  # between a box and its label
# Pairs of corners, in the order of geometry.box_corners, that an edge of a box joins.
EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]


class _Label(NamedTuple):
    """A text over a box."""

    text: str
    x: float  # px, of its middle
    y: float  # px, of the top of the box
    color: Color


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
        scale = picture.shape[1] / WIDTH_PX
        labels: list[_Label] = []  # the more important ones last
        for boxes, width in ((self._largest_last(ids), MAP_LINE_PX), (_moving(meta), MOVING_LINE_PX)):
            for box in boxes:
                lines = _lines(box.corners_m, camera_pose, intrinsic, meta.camera.near_m)
                for begin, end in lines:
                    cv2.line(picture, begin, end, box.color, max(1, round(width * scale)), cv2.LINE_AA)
                if box.label and lines:
                    ends = np.array(lines).reshape(-1, 2)
                    text = f"{box.label} {np.linalg.norm(box.center_m - camera_pose[:3, 3]):.1f} m"
                    labels.append(_Label(text, float(ends[:, 0].mean()), float(ends[:, 1].min()), box.color))
        _write_labels(picture, labels, max(LEAST_TEXT_SIZE, TEXT_SIZE * scale))
        return picture

    def _largest_last(self, ids: np.ndarray) -> list[_Box]:
        """Return the boxes that cover enough of the picture, without ground, the largest last."""
        drawn_ids, counts = np.unique(ids, return_counts=True)
        num_px_of = dict(zip(drawn_ids.tolist(), counts.tolist(), strict=True))
        num_px = np.array([num_px_of.get(instance_id, 0) for instance_id in self.instance_ids.tolist()])
        rows = np.flatnonzero((num_px >= LEAST_SHARE * ids.size) & ~self.box_map.is_any_of(GROUND_KINDS))
        rows = rows[np.argsort(num_px[rows], kind="stable")]
        turns = rotation_matrices(np.radians(self.box_map.rotations_deg[rows]))
        boxes = []
        for rank, (row, turn) in enumerate(zip(rows.tolist(), turns, strict=True)):
            kind = KIND_NAMES[int(self.box_map.kinds[row])]
            center_m = self.box_map.centers[row]
            corners_m = box_corners(np.zeros(3), self.box_map.half_extents[row]) @ turn.T + center_m
            label = f"{kind} {self.instance_ids[row]}" if rank >= len(rows) - MOST_LABELS else ""
            color = [round(255 - (1 - PALENESS) * (255 - value)) for value in COLORS.get(kind, OTHER_COLOR)]
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
        if max(points[a, 2], points[b, 2]) <= near_m:
            continue
        ends = np.stack([_clipped(points[a], points[b], near_m), _clipped(points[b], points[a], near_m)])
        uv = ends @ intrinsic.T
        pixels = np.clip(uv[:, :2] / uv[:, 2:], -FAR_PX, FAR_PX).round().astype(int)
        lines.append(((int(pixels[0, 0]), int(pixels[0, 1])), (int(pixels[1, 0]), int(pixels[1, 1]))))
    return lines


def _clipped(end: np.ndarray, other_end: np.ndarray, near_m: float) -> np.ndarray:
    """Return an end of a line, (3,) in camera axes, moved along the line to the near plane if it is in front of it."""
    if end[2] >= near_m:
        return end
    return end + (other_end - end) * (near_m - end[2]) / (other_end[2] - end[2])


def _write_labels(picture: np.ndarray, labels: list[_Label], size: float) -> None:
    """Write labels into a picture, in place. A label that overlaps a later one of the list is skipped."""
    height_px, width_px = picture.shape[:2]
    taken: list[shapely.Polygon] = []
    for label in reversed(labels):
        # A box may begin above the picture: then its label is written at the upper edge.
        if not (0 <= label.x < width_px and -height_px / 2 <= label.y < height_px):
            continue
        (text_width_px, text_height_px), _ = cv2.getTextSize(label.text, FONT, size, 1)
        left = float(np.clip(label.x - text_width_px / 2, 2, max(2, width_px - text_width_px - 2)))
        baseline = float(np.clip(label.y - LABEL_GAP_PX, text_height_px + 2, height_px - 4))
        low = round(left - 2), round(baseline - text_height_px - 2)
        high = round(left + text_width_px + 2), round(baseline + 3)
        area = shapely.box(*low, *high)
        if any(area.intersects(other) for other in taken):
            continue
        taken.append(area)
        cv2.rectangle(picture, low, high, LABEL_BACKGROUND, -1)
        draw_text(picture, label.text, left, baseline, size, label.color)
