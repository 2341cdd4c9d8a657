"""What a camera sees of the target: its box and depth, and how much of it is seen (sec:step6)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cosfly.formats.frames import LEGIBLE_CONTRAST, LEGIBLE_HEIGHT_PX, LEGIBLE_SHARE, Camera, TargetMeta
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.geometry.axes import box_corners, mask_box, project
from cosfly.render.contract import NEAR_M, PERSON_ID, Frame

DEPTH_TOLERANCE_M = 0.05  # something this little in front of the target's box does not hide it
NOT_HIDDEN = -1  # no instance id
RING_LEAST_PX = 4  # around a person, whose colours are held against its own
MOST_SAMPLES = 40_000  # rays through the target's box; more are thinned evenly

# Pairs of corners (order of geometry.box_corners) that an edge of the box joins.
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]


@dataclass(frozen=True)
class TargetView:
    """Where the target is in one frame.

    uv: (2,) px of the hip point, NaN behind the camera. depth_m: z-depth of the hip point. box_px: (4,) xmin, ymin,
    xmax, ymax of the projected box, not clipped, NaN where all of it is behind the camera. bbox_px: (4,) the same
    clipped to the image, NaN where none of it is inside.
    """

    uv: np.ndarray
    depth_m: float
    box_px: np.ndarray
    bbox_px: np.ndarray

    @property
    def in_view(self) -> bool:
        """Some of the box is inside the image."""
        return not np.isnan(self.bbox_px).any()


def view_target(target_m: np.ndarray, camera_pose: np.ndarray, camera: Camera) -> TargetView:
    """Project the target's 3D box, which stands round its hip point, (3,) world."""
    uv, z = project(np.asarray(target_m)[None], camera_pose, camera.intrinsic)
    corners = box_corners(target_m, np.array(PERSON_HALF_EXTENTS_M))
    in_camera = (corners - camera_pose[:3, 3]) @ camera_pose[:3, :3]
    seen = _in_front(in_camera)
    box = clipped = np.full(4, np.nan)
    if len(seen):
        points = seen @ camera.intrinsic.T
        points = points[:, :2] / points[:, 2:]
        box = np.array([*points.min(axis=0), *points.max(axis=0)])
        clipped = np.clip(box, 0.0, [camera.width_px, camera.height_px] * 2)
        if (clipped[2:] <= clipped[:2]).any():
            clipped = np.full(4, np.nan)
    return TargetView(uv[0], float(z[0]), box, clipped)


def _in_front(corners: np.ndarray) -> np.ndarray:
    """Corners of the part of a box that is beyond the near plane; corners (8, 3) in camera axes."""
    points = [corner for corner in corners if corner[2] >= NEAR_M]
    for a, b in _EDGES:
        za, zb = corners[a, 2], corners[b, 2]
        if (za < NEAR_M) != (zb < NEAR_M):
            points.append(corners[a] + (corners[b] - corners[a]) * (NEAR_M - za) / (zb - za))
    return np.array(points).reshape(-1, 3)


def box_depths(
    pixels: np.ndarray, center_m: np.ndarray, half_m: np.ndarray, camera_pose: np.ndarray, intrinsic: np.ndarray
) -> np.ndarray:
    """Depth at which rays enter an axis-aligned box.

    Args:
        pixels: (n, 2) px; center_m, half_m: (3,) world; camera_pose: (4, 4) world_from_camera; intrinsic: (3, 3).
    Returns:
        (n,) z-depth in m, at least NEAR_M; infinity where the ray misses the box.
    Source: slab method, Kay and Kajiya 1986; rays have camera z = 1, so that their parameter is z-depth.
    """
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(intrinsic).T @ camera_pose[:3, :3].T
    rays[np.abs(rays) < 1e-12] = 1e-12
    eye = camera_pose[:3, 3]
    low, high = (center_m - half_m - eye) / rays, (center_m + half_m - eye) / rays
    enter = np.maximum(np.minimum(low, high).max(axis=1), NEAR_M)
    leave = np.maximum(low, high).min(axis=1)
    return np.where(leave > enter, enter, np.inf)


def rendered_visibility(
    frame: Frame, target_m: np.ndarray, view: TargetView, camera_pose: np.ndarray, camera: Camera
) -> tuple[float, int]:
    """How much of the target a frame shows.

    The score is the share of the target's projected 3D box that nothing hides: at each pixel centre the box's near
    side, computed, is compared with the depth image; where the person itself was drawn the box is visible. What lies
    outside the image counts as hidden.

    Returns:
        Score in [0, 1], and the number of pixels of the person in the whole mask.
    """
    num_person_px = int(np.count_nonzero(frame.ids == PERSON_ID))
    num_rays, hiding = _rays_to_box(frame, target_m, view, camera_pose, camera)
    return (float(np.count_nonzero(hiding == NOT_HIDDEN)) / num_rays if num_rays else 0.0), num_person_px


def hidden_shares(
    frame: Frame, target_m: np.ndarray, view: TargetView, camera_pose: np.ndarray, camera: Camera, other_ids: np.ndarray
) -> tuple[float, float]:
    """Return what hides the target's box: the shares of it, in [0, 1], that others hide and that the map hides."""
    num_rays, hiding = _rays_to_box(frame, target_m, view, camera_pose, camera)
    if num_rays == 0:
        return 0.0, 0.0
    num_others = int(np.isin(hiding, other_ids).sum())
    return num_others / num_rays, float(np.count_nonzero(hiding != NOT_HIDDEN) - num_others) / num_rays


def _rays_to_box(
    frame: Frame, target_m: np.ndarray, view: TargetView, camera_pose: np.ndarray, camera: Camera
) -> tuple[int, np.ndarray]:
    """Look at the target's box through pixel centres.

    Returns:
        how many rays enter the box, those outside the image included; and for each inside the image, (k,), the id of
        what was drawn in front of the box, NOT_HIDDEN where that is nothing or the person.
    """
    nothing = 0, np.empty(0, np.int64)
    if not view.in_view:
        return nothing
    x0, y0, x1, y1 = view.box_px
    # A box that reaches far out of the image needs no ray for every pixel out there.
    stride = max(1.0, float(np.sqrt((x1 - x0) * (y1 - y0) / MOST_SAMPLES)))
    columns, rows = np.arange(np.floor(x0), np.ceil(x1), stride), np.arange(np.floor(y0), np.ceil(y1), stride)
    pixels = np.stack(np.meshgrid(np.floor(columns), np.floor(rows)), axis=-1).reshape(-1, 2)
    half_m = np.array(PERSON_HALF_EXTENTS_M)
    near = box_depths(pixels + 0.5, np.asarray(target_m), half_m, camera_pose, camera.intrinsic)
    pixels, near = pixels[np.isfinite(near)].astype(np.int64), near[np.isfinite(near)]
    if len(pixels) == 0:
        return nothing
    inside = ((pixels >= 0) & (pixels < [camera.width_px, camera.height_px])).all(axis=1)
    at = pixels[inside, 1], pixels[inside, 0]
    free = (frame.depth[at] >= near[inside] - DEPTH_TOLERANCE_M) | (frame.ids[at] == PERSON_ID)
    return len(pixels), np.where(free, NOT_HIDDEN, frame.ids[at].astype(np.int64))


def contrast_of(rgb: np.ndarray, is_person: np.ndarray) -> float | None:
    """How much the person's colours differ from those around it: CIE76, of the upper or the lower half, the greater.

    Args:
        rgb: (h, w, 3) uint8; is_person: (h, w) bool.
    Returns:
        None where no pixel is the person's, or none is around it.
    """
    if not is_person.any():
        return None
    x0, y0, x1, y1 = mask_box(is_person).astype(int).tolist()
    around = max(RING_LEAST_PX, (y1 - y0) // 2)
    part = np.s_[max(0, y0 - around) : y1 + around, max(0, x0 - around) : x1 + around]
    colours = cv2.cvtColor(rgb[part].astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    inside = is_person[part]
    is_upper = np.arange(part[0].start, part[0].start + len(inside))[:, None] < (y0 + y1) / 2
    halves = [half for half in (inside & is_upper, inside & ~is_upper) if half.any()]
    if inside.all():
        return None
    ground = colours[~inside].mean(axis=0)
    return max(float(np.linalg.norm(colours[half].mean(axis=0) - ground)) for half in halves)


def legibility(meta: TargetMeta, contrast: float | None) -> dict[str, float | bool | None]:
    """Return `height_px`, `contrast` and `legible` of a target in a frame: whether a person can be made out, beside
    `visible`, which geometry tells."""
    height_px = 0.0 if meta.bbox_2d is None else round(meta.bbox_2d[3] - meta.bbox_2d[1], 2)
    contrast = None if contrast is None else round(contrast, 2)
    is_legible = (
        meta.visible
        and height_px >= LEGIBLE_HEIGHT_PX
        and meta.visibility >= LEGIBLE_SHARE
        and (contrast or 0.0) >= LEGIBLE_CONTRAST
    )
    return {"height_px": height_px, "contrast": contrast, "legible": is_legible}
