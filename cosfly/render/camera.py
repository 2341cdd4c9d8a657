"""Cameras of a trajectory, and the target in their view: box, depth, visibility, legibility (sec:step6)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np
from pydantic import Field

from cosfly.formats.frames import LEGIBLE_CONTRAST, LEGIBLE_HEIGHT_PX, LEGIBLE_SHARE, Camera, TargetMeta
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.formats.segments import Segment
from cosfly.geometry.axes import box_corners, focal_px, mask_box, project
from cosfly.render.contract import NEAR_M, PERSON_ID, Frame
from cosfly.runtime.config import Config
from cosfly.viz.overlay import EDGES

DEPTH_TOLERANCE_M = 0.05  # a surface this little in front of the target's box does not hide it
NO_IDS = np.empty(0, np.int64)
RING_LEAST_PX = 4  # around a person, for the contrast of colours
MOST_SAMPLES = 40_000  # rays through the target's box; more are thinned evenly


@dataclass(frozen=True)
class TargetView:
    """The projected target in one frame; boxes are xmin, ymin, xmax, ymax."""

    uv: np.ndarray  # (2,) px of the hip point; NaN behind the camera
    depth_m: float  # z-depth of the hip point
    box_px: np.ndarray  # (4,) projected box, not clipped; NaN if all of it is behind the camera
    bbox_px: np.ndarray  # (4,) projected box, clipped to the image; NaN if none of it is inside

    @property
    def in_view(self) -> bool:
        """Return whether some of the box is inside the image."""
        return not np.isnan(self.bbox_px).any()


def view_target(target_m: np.ndarray, camera_pose: np.ndarray, camera: Camera) -> TargetView:
    """Project the target's 3D box around its hip point, (3,) world."""
    uv, z = project(np.asarray(target_m)[None], camera_pose, camera.intrinsic)
    corners = box_corners(target_m, np.array(PERSON_HALF_EXTENTS_M))
    corners = (corners - camera_pose[:3, 3]) @ camera_pose[:3, :3]
    points = [corner for corner in corners if corner[2] >= NEAR_M]  # corners of the part beyond the near plane
    for a, b in EDGES:
        za, zb = corners[a, 2], corners[b, 2]
        if (za < NEAR_M) != (zb < NEAR_M):
            points.append(corners[a] + (corners[b] - corners[a]) * (NEAR_M - za) / (zb - za))
    nowhere = np.full(4, np.nan)
    if not points:
        return TargetView(uv[0], float(z[0]), nowhere, nowhere)
    projected = np.array(points) @ camera.intrinsic.T
    pixels = projected[:, :2] / projected[:, 2:]
    box = np.array([*pixels.min(axis=0), *pixels.max(axis=0)])
    clipped = np.clip(box, 0.0, [camera.width_px, camera.height_px] * 2)
    is_outside = (clipped[2:] <= clipped[:2]).any()
    return TargetView(uv[0], float(z[0]), box, nowhere if is_outside else clipped)


def box_depths(
    pixels: np.ndarray, center_m: np.ndarray, half_m: np.ndarray, camera_pose: np.ndarray, intrinsic: np.ndarray
) -> np.ndarray:
    """Return the depth at which rays enter an axis-aligned box.

    Args:
        pixels: (n, 2) px.
        center_m, half_m: (3,) world.
        camera_pose: (4, 4) world_from_camera.
        intrinsic: (3, 3).
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


class RenderedVisibility(NamedTuple):
    """Shares of the target's projected 3D box, each in [0, 1]. The rest of it lies outside the image."""

    score: float  # that nothing hides
    hidden_by_bystanders: float
    hidden_by_map: float


def rendered_visibility(
    frame: Frame, target_m: np.ndarray, view: TargetView, camera_pose: np.ndarray, camera: Camera,
    other_ids: np.ndarray = NO_IDS,
) -> RenderedVisibility:  # fmt: skip
    """Return how much of the target a frame shows.

    At each pixel centre the depth of the box's near side is compared with the depth image. Where the person itself was
    drawn the box is visible. other_ids: instance ids of bystanders.
    """
    if not view.in_view:
        return RenderedVisibility(0.0, 0.0, 0.0)
    x0, y0, x1, y1 = view.box_px
    # A box that reaches far beyond the image does not need a ray for each of its pixels.
    stride = max(1.0, float(np.sqrt((x1 - x0) * (y1 - y0) / MOST_SAMPLES)))
    columns = np.arange(np.floor(x0), np.ceil(x1), stride)
    rows = np.arange(np.floor(y0), np.ceil(y1), stride)
    pixels = np.stack(np.meshgrid(np.floor(columns), np.floor(rows)), axis=-1).reshape(-1, 2)
    half_m = np.array(PERSON_HALF_EXTENTS_M)
    near = box_depths(pixels + 0.5, np.asarray(target_m), half_m, camera_pose, camera.intrinsic)
    is_in_box = np.isfinite(near)
    near = near[is_in_box]
    pixels = pixels[is_in_box].astype(np.int64)
    num = len(pixels)
    if num == 0:
        return RenderedVisibility(0.0, 0.0, 0.0)
    is_inside = ((pixels >= 0) & (pixels < [camera.width_px, camera.height_px])).all(axis=1)
    columns, rows = pixels[is_inside].T
    is_free = frame.depth[rows, columns] >= near[is_inside] - DEPTH_TOLERANCE_M
    is_free |= frame.ids[rows, columns] == PERSON_ID
    num_free = np.count_nonzero(is_free)
    num_others = np.count_nonzero(np.isin(frame.ids[rows, columns][~is_free], other_ids))
    return RenderedVisibility(num_free / num, num_others / num, (len(is_free) - num_free - num_others) / num)


def contrast_of(rgb: np.ndarray, is_person: np.ndarray) -> float | None:
    """Return the contrast of a person to its surroundings: CIE76, the greater of the upper and the lower half.

    Args:
        rgb: (h, w, 3) uint8.
        is_person: (h, w) bool.
    Returns:
        None where no pixel is the person's, or none is around it.
    """
    if not is_person.any():
        return None
    x0, y0, x1, y1 = mask_box(is_person).astype(int).tolist()
    ring_px = max(RING_LEAST_PX, (y1 - y0) // 2)
    top = max(0, y0 - ring_px)
    part = np.s_[top : y1 + ring_px, max(0, x0 - ring_px) : x1 + ring_px]
    is_inside = is_person[part]
    if is_inside.all():
        return None
    colours = cv2.cvtColor(rgb[part].astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    surroundings = colours[~is_inside].mean(axis=0)
    is_upper = np.arange(top, top + len(is_inside))[:, None] < (y0 + y1) / 2
    halves = [half for half in (is_inside & is_upper, is_inside & ~is_upper) if half.any()]
    return max(float(np.linalg.norm(colours[half].mean(axis=0) - surroundings)) for half in halves)


def legibility(meta: TargetMeta, contrast: float | None) -> dict[str, float | bool | None]:
    """Return `height_px`, `contrast` and `legible` of a target in a frame: whether a viewer can recognize a person."""
    height_px = 0.0 if meta.bbox_2d is None else round(meta.bbox_2d[3] - meta.bbox_2d[1], 2)
    contrast = None if contrast is None else round(contrast, 2)
    is_legible = (
        meta.visible
        and height_px >= LEGIBLE_HEIGHT_PX
        and meta.visibility >= LEGIBLE_SHARE
        and (contrast or 0.0) >= LEGIBLE_CONTRAST
    )
    return {"height_px": height_px, "contrast": contrast, "legible": is_legible}


# --- fields of view ---------------------------------------------------------------------------------------------------


class ZoomConfig(Config):
    """Changes of the field of view within a trajectory."""

    mode: Literal["fixed", "dynamic"] = Field(
        "fixed",
        description="fixed: a trajectory keeps one zoom level; dynamic: each part of it draws a level, and meta.json "
        "and trajectory.json have the intrinsics of each frame",
    )
    part_s: float = Field(20.0, ge=1, description="dynamic: length of the parts of a trajectory without segments, s")
    ramp_s: float = Field(4.0, ge=0, description="dynamic: duration of a change of level, s; 0: instantaneous")


def zoomed_deg(
    first_deg: float, fovs_deg: Sequence[float], zoom: ZoomConfig, time_s: np.ndarray, segments: Sequence[Segment],
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Return the field of view at each time, (n,) degrees; each part of the trajectory has another level if possible.

    Within a change the picture grows by equal factors in equal times, with smooth ends.

    Args:
        first_deg: The level of the first part.
        fovs_deg: All levels.
        time_s: (n,).
        segments: The parts; without segments they are `zoom.part_s` long.
        rng: Draws the other levels.
    """
    begins_s = np.arange(time_s[0] + zoom.part_s, time_s[-1], zoom.part_s).tolist()
    if segments:
        begins_s = [float(time_s[segment.begin]) for segment in segments if segment.begin > 0]
    ends_s = [*begins_s, float(time_s[-1])][1:]
    log_focal = np.full(len(time_s), np.log(focal_px(1, first_deg)))
    level_deg = first_deg
    for begin_s, end_s in zip(begins_s, ends_s, strict=True):
        choices = [fov_deg for fov_deg in dict.fromkeys(fovs_deg) if fov_deg != level_deg] or [level_deg]
        next_deg = choices[int(rng.integers(len(choices)))]
        duration_s = min(zoom.ramp_s, end_s - begin_s)
        share = np.clip(time_s - begin_s, 0.0, duration_s) / duration_s if duration_s > 0 else time_s >= begin_s
        log_focal += np.log(focal_px(1, next_deg) / focal_px(1, level_deg)) * share**2 * (3.0 - 2.0 * share)
        level_deg = next_deg
    return np.degrees(2.0 * np.arctan(0.5 / np.exp(log_focal)))
