"""Does the geometry of each row agree with itself: camera, pose, target, pixel, box, depth, flags? Needs no picture.

Tolerances are those of rounding and of conventions, never of noise: what a row says was computed from what else it says.
"""

from __future__ import annotations

import numpy as np

from cosfly.geometry import BODY_FROM_CAMERA
from release.verify.findings import Findings
from release.verify.rows import FlightRows

PIXEL_PX = 0.5  # a target's pixel: half a pixel is the most that another convention of pixel centres shifts it
DEPTH_M = 0.02  # z-depth of the target: rounded to centimetres at worst
FOV_DEG = 0.01  # the column is rounded to six digits
BOX_PX = 1.0  # our person's projected box, whose corners are exact but may be cut to the image
CENTRE_PX = 1.0  # the principal point is the picture's middle, (w - 1) / 2 in others' convention
SQUARE = 1e-6  # square pixels: fx = fy
STRIDE_SHARE = 0.1  # of the box's longer side
FOREIGN_BOX_PX = 3.0  # how far beside a box of somebody else's person its hip may lie


def check_geometry(flight: FlightRows, findings: Findings) -> None:
    """Check camera, projection, boxes, depth and flags of a flight's rows."""
    _check_camera(flight, findings)
    uv, depth = project_targets(flight)
    _check_projection(flight, uv, depth, findings)
    _check_boxes(flight, findings)
    _check_flags(flight, findings)


def to_camera(flight: FlightRows, points_m: np.ndarray) -> np.ndarray:
    """Give points (n, 3), one for each row, in the axes of its camera, (n, 3)."""
    body = np.einsum("nji,nj->ni", flight.rotations, points_m - flight.pose[:, :3])
    return body @ BODY_FROM_CAMERA


def project_targets(flight: FlightRows) -> tuple[np.ndarray, np.ndarray]:
    """Project each row's target: (n, 2) px and (n,) z-depth in m; NaN behind the camera."""
    in_camera = to_camera(flight, flight.target_m)
    z = in_camera[:, 2]
    fx, fy, cx, cy = flight.intrinsics.T
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = np.stack([fx * in_camera[:, 0] / z + cx, fy * in_camera[:, 1] / z + cy], axis=1)
    uv[~(z > 0)] = np.nan
    return uv, z


def _check_camera(flight: FlightRows, findings: Findings) -> None:
    """Where the camera is the same in all rows, which identity.py holds, the first one tells."""
    fovs = flight.numbers("fov_deg")
    for i in range(len(flight) if flight.zooms else 1):
        fx, fy, cx, cy = flight.intrinsics[i]
        width, height = flight.size_px[i]
        fov = fovs[i]
        if not (fx > 0 and fy > 0):
            findings.error("intrinsics", flight.where(i, "intrinsics"), f"fx {fx}, fy {fy}", "focal lengths above 0")
            return
        expected = float(np.degrees(2.0 * np.arctan(width / (2.0 * fx))))
        if not abs(fov - expected) <= FOV_DEG:
            got = f"{fov} degrees, and a focal length of {fx} px"
            findings.error("field_of_view", flight.where(i, "fov_deg"), got, f"{expected:.6f} degrees, of width and focal length")  # fmt: skip
        if abs(fx - fy) > SQUARE * fx:
            findings.error("intrinsics", flight.where(i, "intrinsics"), f"fx {fx}, fy {fy}", "square pixels")
        if not (abs(cx - width / 2) <= CENTRE_PX and abs(cy - height / 2) <= CENTRE_PX):
            findings.error("intrinsics", flight.where(i, "intrinsics"), f"principal point ({cx}, {cy})", f"the middle, ({width / 2:g}, {height / 2:g})")  # fmt: skip


def _check_projection(flight: FlightRows, uv: np.ndarray, depth: np.ndarray, findings: Findings) -> None:
    off = np.hypot(*(flight.uv - uv).T)
    known = ~np.isnan(flight.uv[:, 0])
    has_target = ~np.isnan(flight.target_m[:, 0])
    for i in np.flatnonzero(known & has_target & ~(off <= PIXEL_PX)):
        findings.error("projection", flight.where(i, "target_uv"), f"{off[i]:.3f} px beside it", f"the projected target within {PIXEL_PX} px")  # fmt: skip
    recorded = flight.numbers("target_depth_m")
    for i in np.flatnonzero(~np.isnan(recorded) & has_target & ~(np.abs(recorded - depth) <= DEPTH_M)):
        findings.error("target_depth", flight.where(i, "target_depth_m"), f"{recorded[i]:.3f} m", f"{depth[i]:.3f} m, of pose and target")  # fmt: skip


def _check_boxes(flight: FlightRows, findings: Findings) -> None:
    """Boxes lie in the picture the right way round, round the target; ours is that of the projected person."""
    size = np.tile(flight.size_px, 2)
    for name, box in (("target_bbox", flight.box), ("target_mask_bbox", flight.mask_box)):
        known = ~np.isnan(box[:, 0])
        slack = 0.5 if not flight.is_foreign else np.inf
        with np.errstate(invalid="ignore"):
            wrong = known & ((box[:, 2:] <= box[:, :2]).any(axis=1) | (box < -slack).any(axis=1) | (box > size + slack).any(axis=1))  # fmt: skip
        for i in np.flatnonzero(wrong):
            findings.error("box", flight.where(i, name), box[i].round(1).tolist(), "min before max, inside the picture")
    known = ~np.isnan(flight.box[:, 0])
    if flight.is_foreign:
        inside = (flight.uv >= flight.box[:, :2] - FOREIGN_BOX_PX) & (flight.uv <= flight.box[:, 2:] + FOREIGN_BOX_PX)
        in_picture = (flight.uv >= 0).all(axis=1) & (flight.uv <= flight.size_px).all(axis=1)
        for i in np.flatnonzero(known & in_picture & ~inside.all(axis=1)):
            findings.error(
                "box", flight.where(i, "target_bbox"), flight.box[i].round(1).tolist(), "a box round target_uv"
            )
        return
    expected = person_boxes(flight)
    off = np.abs(flight.box - expected).max(axis=1)
    for i in np.flatnonzero(known & (off > BOX_PX)):
        findings.error("box", flight.where(i, "target_bbox"), flight.box[i].round(1).tolist(), f"{expected[i].round(1).tolist()}, the projected box of the person")  # fmt: skip
    # A figure in full stride reaches a little beyond its box; the edges of a mask lie on pixel borders.
    sides = flight.box[:, 2:] - flight.box[:, :2]
    slack_px = 1.5 + STRIDE_SHARE * sides.max(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        outside = (flight.mask_box[:, :2] < flight.box[:, :2] - slack_px).any(axis=1) | (flight.mask_box[:, 2:] > flight.box[:, 2:] + slack_px).any(axis=1)  # fmt: skip
    for i in np.flatnonzero(outside & known):
        findings.error("box", flight.where(i, "target_mask_bbox"), flight.mask_box[i].tolist(), "inside target_bbox")
    for i in np.flatnonzero(~known & ~np.isnan(flight.mask_box[:, 0])):
        findings.error(
            "box", flight.where(i, "target_mask_bbox"), flight.mask_box[i].tolist(), "null where target_bbox is"
        )


def person_boxes(flight: FlightRows) -> np.ndarray:
    """Project the box of a person of ours at each row's target, cut to the picture: (n, 4) px, NaN where a corner lies behind the camera."""
    uv = flight.projected_corners
    size = np.tile(flight.size_px, 2)
    return np.clip(np.concatenate([uv.min(axis=1), uv.max(axis=1)], axis=1), 0.0, size)


def _check_flags(flight: FlightRows, findings: Findings) -> None:
    in_view, visible = flight.flags("target_in_view"), flight.flags("target_visible")
    visibility = flight.numbers("visibility")
    has_target, has_uv = ~np.isnan(flight.target_m[:, 0]), ~np.isnan(flight.uv[:, 0])
    has_box, has_mask = ~np.isnan(flight.box[:, 0]), ~np.isnan(flight.mask_box[:, 0])
    is_ours = np.full(len(flight), not flight.is_foreign)
    rules = (
        ("target_visible", visible & ~in_view, "true, and not in view", "a target that is seen is in view"),
        ("target_in_view", in_view & ~has_target, "true, and no target", "a target where it is in view"),
        ("target_uv", in_view & has_target & ~has_uv & (flight.numbers("target_depth_m") > 0), "null", "a pixel: the target is in view"),
        ("target", ~has_target & (has_uv | has_box | has_mask), "null, but a pixel or a box", "a position where there is one"),
        ("visibility", (visibility > 0) & ~in_view & is_ours, "above 0, and not in view", "0 out of view"),
        ("target_visible", visible & (visibility <= 0), "true, visibility 0", "a visibility above 0"),
        ("target_bbox", is_ours & (in_view != has_box), "null, and in view, or the other way round", "a box where the target is in view"),
        ("target_visible", is_ours & visible & ~has_mask, "true, and no pixel of the person", "a box of the person's pixels"),
    )  # fmt: skip
    for column, wrong, got, expected in rules:
        for i in np.flatnonzero(wrong):
            findings.error("flags", flight.where(i, column), got, expected)
    _check_threshold(flight, visible, visibility, has_mask & in_view, findings)
    if not has_target.any():
        findings.error("no_target", flight.name, f"{len(flight)} rows without a target", "somebody who is followed")


def _check_threshold(
    flight: FlightRows, visible: np.ndarray, visibility: np.ndarray, could_be: np.ndarray, findings: Findings
) -> None:
    """Who shows pixels is called visible from one score on, the same for a whole run: no hidden one has a higher score."""
    if flight.is_foreign or not (visible & could_be).any() or not (~visible & could_be).any():
        return
    least, most = visibility[visible & could_be].min(), visibility[~visible & could_be].max()
    if most > least + 1e-6:
        i = int(np.flatnonzero(~visible & could_be & (visibility == most))[0])
        findings.error("flags", flight.where(i, "target_visible"), f"false at visibility {most:.3f}", f"true: another row is at {least:.3f}")  # fmt: skip
