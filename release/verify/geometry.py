"""Check the geometry of each row: camera, projection, boxes, depth and flags. Tolerances are those of rounding."""

from __future__ import annotations

from typing import Any

import numpy as np

from cosfly.geometry import BODY_FROM_CAMERA
from cosfly.products.frames import LEGIBLE_CONTRAST, LEGIBLE_HEIGHT_PX, LEGIBLE_SHARE
from release.flight_rows import FlightRows
from release.verify.findings import Findings

PIXEL_PX = 0.5  # a target's pixel: half a pixel is the most that another convention of pixel centres shifts it
DEPTH_M = 0.02  # z-depth of the target: rounded to centimetres at worst
FOV_DEG = 0.01  # the column is rounded to six digits
BOX_PX = 1.0  # our person's projected box, whose corners are exact but may be cut to the image
CENTRE_PX = 1.0  # the principal point is the picture's middle, (w - 1) / 2 in others' convention
SQUARE = 1e-6  # square pixels: fx = fy
STRIDE_SHARE = 0.1  # of the box's longer side: how far a figure in full stride reaches beyond it


def check_geometry(flight: FlightRows, findings: Findings) -> None:
    """Check camera, projection, boxes, depth and flags of a flight's rows."""
    _check_camera(flight, findings)
    _check_projection(flight, findings)
    _check_boxes(flight, findings)
    _check_flags(flight, findings)


def _check_camera(flight: FlightRows, findings: Findings) -> None:
    """Where the camera is the same in all rows, which identity.py holds, the first one tells."""
    told = np.arange(len(flight)) < (len(flight) if flight.zooms else 1)
    (fx, fy, cx, cy), (width, height), fovs = flight.intrinsics.T, flight.size_px.T, flight.numbers("fov_deg")
    is_positive, fov = (fx > 0) & (fy > 0), np.degrees(2.0 * np.arctan(width / (2.0 * fx)))
    is_middle = (np.abs(cx - width / 2) <= CENTRE_PX) & (np.abs(cy - height / 2) <= CENTRE_PX)
    told_again, shown = told & is_positive, lambda i: f"fx {fx[i]}, fy {fy[i]}"
    findings.judge(flight, (
        ("intrinsics", "intrinsics", told & ~is_positive, shown, "focal lengths above 0"),
        ("field_of_view", "fov_deg", told_again & ~(np.abs(fovs - fov) <= FOV_DEG),
         lambda i: f"{fovs[i]} degrees, focal length {fx[i]} px", lambda i: f"{fov[i]:.6f}, of width and focal length"),
        ("intrinsics", "intrinsics", told_again & (np.abs(fx - fy) > SQUARE * fx), shown, "square pixels"),
        ("intrinsics", "intrinsics", told_again & ~is_middle, lambda i: f"principal point ({cx[i]}, {cy[i]})",
         lambda i: f"the middle, ({width[i] / 2:g}, {height[i] / 2:g})"),
    ))  # fmt: skip


def _check_projection(flight: FlightRows, findings: Findings) -> None:
    """The target's pixel and depth are those of pose and camera; NaN behind the camera."""
    body = np.einsum("nji,nj->ni", flight.rotations, flight.target_m - flight.pose[:, :3])
    x, y, z = (body @ BODY_FROM_CAMERA).T
    fx, fy, cx, cy = flight.intrinsics.T
    off_px = np.hypot(flight.uv[:, 0] - (fx * x / z + cx), flight.uv[:, 1] - (fy * y / z + cy))
    off_px[~(z > 0)] = np.nan
    has_target, depth_m = ~np.isnan(flight.target_m[:, 0]), flight.numbers("target_depth_m")
    wrong_px = has_target & ~np.isnan(flight.uv[:, 0]) & ~(off_px <= PIXEL_PX)
    wrong_m = has_target & ~np.isnan(depth_m) & ~(np.abs(depth_m - z) <= DEPTH_M)
    findings.judge(flight, (
        ("projection", "target_uv", wrong_px, lambda i: f"{off_px[i]:.3f} px beside it",
         f"the projected target within {PIXEL_PX} px"),
        ("target_depth", "target_depth_m", wrong_m, lambda i: f"{depth_m[i]:.3f} m",
         lambda i: f"{z[i]:.3f} m, of pose and target"),
    ))  # fmt: skip


def _check_boxes(flight: FlightRows, findings: Findings) -> None:
    """Boxes lie in the picture the right way round, round the target; ours is that of the projected person."""
    box, mask, size = flight.box, flight.mask_box, np.tile(flight.size_px, 2)
    slack = np.inf if flight.is_foreign else 0.5
    has_box, has_mask = ~np.isnan(box[:, 0]), ~np.isnan(mask[:, 0])

    def turned(one: np.ndarray) -> Any:
        return (one[:, 2:] <= one[:, :2]).any(axis=1) | (one < -slack).any(axis=1) | (one > size + slack).any(axis=1)

    def shown(one: np.ndarray):  # type: ignore[no-untyped-def]
        return lambda i: one[i].round(1).tolist()

    inside = "min before max, inside the picture"
    findings.judge(flight, (
        ("box", "target_bbox", has_box & turned(box), shown(box), inside),
        ("box", "target_mask_bbox", has_mask & turned(mask), shown(mask), inside),
    ))  # fmt: skip
    if flight.is_foreign:
        return
    corners = flight.projected_corners
    expected = np.clip(np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1), 0.0, size)
    slack_px = 1.5 + STRIDE_SHARE * (box[:, 2:] - box[:, :2]).max(axis=1, keepdims=True)  # a mask's edges lie on pixels
    outside = (mask[:, :2] < box[:, :2] - slack_px).any(axis=1) | (mask[:, 2:] > box[:, 2:] + slack_px).any(axis=1)
    findings.judge(flight, (
        ("box", "target_bbox", has_box & (np.abs(box - expected).max(axis=1) > BOX_PX), shown(box),
         lambda i: f"{expected[i].round(1).tolist()}, the projected box of the person"),
        ("box", "target_mask_bbox", has_box & outside, shown(mask), "inside target_bbox"),
        ("box", "target_mask_bbox", has_mask & ~has_box, shown(mask), "null where target_bbox is"),
    ))  # fmt: skip


def _check_flags(flight: FlightRows, findings: Findings) -> None:
    in_view, visible = flight.flags("target_in_view"), flight.flags("target_visible")
    visibility = flight.numbers("visibility")
    has_target = ~np.isnan(flight.target_m[:, 0])
    has_box, has_mask = ~np.isnan(flight.box[:, 0]), ~np.isnan(flight.mask_box[:, 0])
    legible, height_px = flight.flags("target_legible"), flight.numbers("target_height_px")
    reads = visible & (height_px >= LEGIBLE_HEIGHT_PX) & (visibility >= LEGIBLE_SHARE)
    reads &= flight.numbers("target_contrast") >= LEGIBLE_CONTRAST
    box_px = np.nan_to_num(flight.box[:, 3] - flight.box[:, 1])
    is_ours = not flight.is_foreign
    findings.judge(flight, (("flags", *rule) for rule in (
        ("target_visible", visible & ~in_view, "true, and not in view", "a target that is seen is in view"),
        ("target_in_view", in_view & ~has_target, "true, and no target", "a target where it is in view"),
        ("target_legible", (legible != reads) & ~np.isnan(height_px), "not as the bounds say",
         "true where visible, height, contrast and visibility are enough, else false"),
        ("target_height_px", np.abs(height_px - box_px) > 0.01, "another height than target_bbox", "its height"),
        ("target_bbox", (in_view != has_box) & is_ours, "null in view, or not null out of view", "a box in view alone"),
        ("target_visible", visible & ~has_mask & is_ours, "true, and no pixel of the person", "a box of its pixels"),
    )))  # fmt: skip
