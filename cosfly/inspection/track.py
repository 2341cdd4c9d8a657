"""The inspection of one track: its plan, poses, motion and frames, and its record (sec:step6).

Each check adds its issues to `report` and its figures to `metrics`. The rendered poses are measured against the map,
because the poses of a perturbed track differ from the plan.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel

from cosfly.formats.frames import LEGIBLE_HEIGHT_PX
from cosfly.formats.inspection import Result, TrackInspection
from cosfly.formats.issues import Report
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.formats.playback import Track
from cosfly.formats.playback_file import read_track
from cosfly.formats.traces import DroneTrace
from cosfly.geometry.axes import project, step_s, world_from_camera, wrap_deg
from cosfly.geometry.trajectory_metrics import (
    CLEARANCE_CAP_M,
    CLEARANCE_TOLERANCE_M,
    derivative_rms,
    length_m,
    smoothness_score,
)
from cosfly.inspection import frames as frame_checks
from cosfly.inspection import settings as limits
from cosfly.inspection.report import ReportPicture, pictures_of
from cosfly.inspection.settings import InspectConfig
from cosfly.runtime.errors import InputError
from cosfly.runtime.run_dir import digest_of, folder_digests
from cosfly.runtime.worker import advance

if TYPE_CHECKING:
    from cosfly.geometry.kernels import BoxIndex

TIME_TOLERANCE_S = 1e-3
Metrics = dict[str, float | int | None]


class InspectedTrack(BaseModel):
    """A track's record and pictures, as in `items.jsonl`."""

    record: TrackInspection
    pictures: list[ReportPicture]


def inspect_track(
    folder: Path, root: Path, traces: dict[str, DroneTrace] | None, obstacles: BoxIndex | None, cfg: InspectConfig,
    yaw_rate_max_degps: float,
) -> InspectedTrack:  # fmt: skip
    """Check one track folder.

    Args:
        traces: Plans by id; None if the tree has none.
        obstacles: Of the map; None if there is no map.
        yaw_rate_max_degps: Limit of the plans.
    """
    report = Report()
    track = _read(folder, report)
    trace = None if traces is None else traces.get(trace_id(track))
    metrics: Metrics = {"num_frames": len(track)}
    if trace is not None:
        check_plan(trace, cfg, report, metrics, yaw_rate_max_degps)
        check_poses(track, trace, report)
    elif traces is not None:
        got = f"no trace {trace_id(track)!r}"
        report.warn("no_trace", "trajectory.json: source.scenario_id", got, "the id of a plan")
    if obstacles is not None:
        check_surroundings(track, obstacles, cfg, report, metrics)
    check_motion(track, report)
    check_projection(track, report)
    _check_frames(track, cfg, report, metrics)
    issues = report.merged()
    result: Result = "accepted"
    if report.num("error"):
        result = "rejected"
    elif report.num("warning"):
        result = "review"
    try:
        sha256 = digest_of(folder_digests(folder))
    except InputError:  # reported by `listed_digests`
        sha256 = None
    record = TrackInspection(
        town=track.town, trajectory=track.trajectory, variant=track.variant, is_original=track.is_original,
        folder=folder.relative_to(root).as_posix(), sha256=sha256, trace_id=trace.path_id if trace else None,
        result=result, issues=issues,
        metrics={name: None if value is None else round(value, 4) for name, value in metrics.items()},
    )  # fmt: skip
    return InspectedTrack(record=record, pictures=pictures_of(track, limits.THUMBNAIL_PX, report.issues))


def trace_id(track: Track) -> str:
    """Return the id of the plan in a track's record."""
    return str(track.source.get("scenario_id", ""))


def _read(folder: Path, report: Report) -> Track:
    """Read a track, which raises if poses or times are unusable; report the first deviation from the layout."""
    track = read_track(folder)
    for error in track.issues[:1]:
        where = str(error.where).replace(f"{folder}/", "")
        report.error("layout", where, error.got or error.what, error.expected or "the public layout")
    return track


def check_plan(
    trace: DroneTrace, cfg: InspectConfig, report: Report, metrics: Metrics, yaw_rate_max_degps: float
) -> None:
    """Check the smoothness of the plan, the yaw rate of its camera, and the result of its prefilter."""
    dt_s = step_s(trace.time_s)
    accel, jerk = (derivative_rms(trace.positions_m, order, dt_s) for order in (2, 3))
    score = smoothness_score(accel, jerk)
    metrics.update(accel_rms_mps2=accel, jerk_rms_mps3=jerk, smoothness=score)
    where = f"plan {trace.path_id}"
    if trace.drop_reason is not None:
        report.error("prefiltered", where, trace.drop_reason, "a plan that passed the prefilter")
    if accel > cfg.accel_rms_max_mps2:
        report.error("acceleration", where, f"{accel:.2f} m/s^2", f"at most {cfg.accel_rms_max_mps2:g} m/s^2 RMS")
    if jerk > cfg.jerk_rms_max_mps3:
        report.error("jerk", where, f"{jerk:.2f} m/s^3", f"at most {cfg.jerk_rms_max_mps3:g} m/s^3 RMS")
    if score < cfg.smoothness_min:
        report.warn("smoothness", where, f"S = {score:.3f}", f"at least {cfg.smoothness_min:g}")
    turn_degps = float(np.abs(wrap_deg(np.diff(trace.rotations_deg[:, 1]))).max(initial=0.0)) / dt_s
    if turn_degps > yaw_rate_max_degps + limits.YAW_RATE_TOLERANCE_DEGPS:
        expected = f"at most {yaw_rate_max_degps:g} deg/s (plan.yaw_rate_max_degps)"
        report.error("yaw_rate", where, f"{turn_degps:.1f} deg/s", expected)


def check_surroundings(track: Track, obstacles: BoxIndex, cfg: InspectConfig, report: Report, metrics: Metrics) -> None:
    """Measure the poses against the map: clearance of the drone, five-ray visibility, a target in an obstacle.

    The clearance is that of the path to the next pose, in a perturbed track that of the poses only.
    """
    from cosfly.geometry.kernels import signed_distances, swept_distances, visibility

    gaps_m = signed_distances(obstacles, track.positions_m, CLEARANCE_CAP_M)[0]
    if track.is_original:
        gaps_m = swept_distances(obstacles, track.positions_m, CLEARANCE_CAP_M)[0]
    metrics.update(clearance_min_m=float(gaps_m.min()))
    for i in np.flatnonzero((gaps_m < cfg.clearance_min_m - CLEARANCE_TOLERANCE_M) | (gaps_m <= 0)):
        code = "collision" if gaps_m[i] <= 0 else "clearance"
        where = f"trajectory.json: points[{i}].drone_pose"
        report.error(code, where, f"{gaps_m[i]:.2f} m", f"at least {cfg.clearance_min_m:g} m to every obstacle")
    with_target = np.flatnonzero(~np.isnan(track.targets_m).any(axis=1))
    if not len(with_target):
        return
    inside, _ = signed_distances(obstacles, track.targets_m[with_target], 0.0)
    for i in with_target[inside < 0]:
        where = f"trajectory.json: points[{i}].target.world_location"
        report.error("collision", where, "in an obstacle", "free ground")
    judged = with_target[track.keeps_sight[with_target]]
    rows = judged if len(judged) else with_target
    five_ray = float(visibility(obstacles, track.positions_m[rows], track.targets_m[rows]).mean())
    metrics.update(five_ray_mean=five_ray)
    if len(judged) and five_ray < cfg.five_ray_mean_min:
        expected = f"a mean of at least {cfg.five_ray_mean_min:g}"
        report.error("five_ray_visibility", "trajectory.json: points", f"{five_ray:.3f}", expected)


def is_shifted(track: Track) -> np.ndarray:
    """Return where drone or target were shifted from the plan, (n,) bool; an unknown offset counts as a shift."""
    return (track.perturbation.drone_m != 0).any(axis=1) | (track.perturbation.target_m != 0).any(axis=1)


def check_poses(track: Track, trace: DroneTrace, report: Report) -> None:
    """Check that a track without its recorded perturbation is the plan.

    A shifted drone or target changes the aim of the camera, so rotations are compared in other frames only.
    """
    stride = round(step_s(track.time_s) / step_s(trace.time_s))  # render.frame_stride
    num_planned = math.ceil(len(trace.time_s) / max(1, stride))
    if len(track) < num_planned:
        where = "trajectory.json: points"
        report.warn("shorter_than_planned", where, f"{len(track)} frames", f"{num_planned} planned ones")
    row = np.searchsorted(trace.time_s, track.time_s - TIME_TOLERANCE_S).clip(max=len(trace.time_s) - 1)
    off_time = np.abs(trace.time_s[row] - track.time_s) > TIME_TOLERANCE_S
    for i in np.flatnonzero(off_time):
        where = f"trajectory.json: points[{i}].timing.trace_timestamp"
        report.error("pose_differs", where, f"{track.time_s[i]:.3f} s", "a time of the plan")
    turns = wrap_deg(track.rotations_deg - track.perturbation.rotation_deg - trace.rotations_deg[row])
    moved_m = track.positions_m - track.perturbation.drone_m - trace.positions_m[row]
    target_moved_m = track.targets_m - track.perturbation.target_m - trace.targets_m[row]
    checks = (
        ("drone_pose", moved_m, limits.POSE_TOLERANCE_M, "m"),
        ("drone_pose", np.where(is_shifted(track)[:, None], 0.0, turns), limits.ROTATION_TOLERANCE_DEG, "deg"),
        ("target.world_location", target_moved_m, limits.POSE_TOLERANCE_M, "m"),
    )
    for name, difference, tolerance, unit in checks:
        distance = np.abs(np.asarray(difference)).max(axis=1)
        for i in np.flatnonzero((distance > tolerance) & ~off_time):
            where = f"trajectory.json: points[{i}].{name}"
            got = f"{distance[i]:.4f} {unit} from the plan"
            report.error("pose_differs", where, got, f"the plan within {tolerance:g} {unit}")


def check_motion(track: Track, report: Report) -> None:
    """Find teleports: impossible steps between frames, without the recorded perturbations."""
    drone_m, target_m = map(np.nan_to_num, (track.perturbation.drone_m, track.perturbation.target_m))
    for name, positions_m, limit_mps in (
        ("drone_pose", track.positions_m - drone_m, limits.DRONE_SPEED_MAX_MPS),
        ("target.world_location", track.targets_m - target_m, limits.TARGET_SPEED_MAX_MPS),
    ):
        speeds = np.linalg.norm(np.diff(positions_m, axis=0), axis=1) / np.diff(track.time_s)
        for i in np.flatnonzero(speeds > limit_mps):
            where = f"trajectory.json: points[{i + 1}].{name}"
            report.error("teleport", where, f"{speeds[i]:.1f} m/s", f"at most {limit_mps:g} m/s")


def check_projection(track: Track, report: Report) -> None:
    """Check the recorded pixel, box and depth of the target against pose, intrinsics and target position."""
    target = track.target
    for i in range(len(track)):
        point = f"trajectory.json: points[{i}].target"
        if np.isnan(track.targets_m[i]).any():
            if target.in_view[i]:
                report.error("target_missing", f"{point}.world_location", "null", "a position: the target is in view")
            continue
        pose = world_from_camera(track.positions_m[i], track.rotations_deg[i])
        uv, depth_m = project(track.targets_m[i : i + 1], pose, track.camera_at(i).intrinsic)
        box = frame_checks.target_box(track, i)
        pixels = limits.REPROJECTION_TOLERANCE_PX
        recorded = (
            ("image_uv", target.uv[i], uv[0], pixels, "px"),
            # The target of another program has another size.
            ("bbox_2d", target.bbox[i] if track.is_ours else box, box, 2 * pixels, "px"),
            ("depth", target.depth_m[i : i + 1], depth_m, 0.01, "m"),
        )
        for name, value, expected, tolerance, unit in recorded:
            if np.isnan(value).any() or np.isnan(expected).any():
                continue
            distance = float(np.abs(value - expected).max())
            if distance > tolerance:
                limit = f"the projection of the target within {tolerance:g} {unit}"
                report.error("projection_differs", f"{point}.{name}", f"{distance:.2f} {unit} from it", limit)
        if target.in_view[i] and np.isnan(target.uv[i]).any():
            report.error("target_missing", f"{point}.image_uv", "null", "a pixel: the target is in view")


def _check_frames(track: Track, cfg: InspectConfig, report: Report, metrics: Metrics) -> None:
    """Check files and pixels; the visibility of rendered frames is measured but never rejects (sec:dataset_stats)."""
    assert track.folder is not None
    metas = frame_checks.check_files(track, report)
    # Other programs count others in another way.
    bystanders = {i: meta.others for i, meta in metas.items() if track.is_ours and meta and meta.others}
    frame_checks.check_bystanders(track, bystanders, cfg.clearance_min_m, report, metrics)
    digests = frame_checks.listed_digests(track.folder, report) if cfg.check_checksums else {}
    numbers = frame_checks.check_frames(track, metas, bystanders, digests, report)
    for name, digest in digests.items():
        if name not in numbers.read_files:
            advance()
            frame_checks.compare_file(track.folder, name, digest, report)
    _measure_frames(track, numbers, metrics)
    _judge_frames(track, cfg, report, metrics)


def _measure_frames(track: Track, numbers: frame_checks.FrameNumbers, metrics: Metrics) -> None:
    """Add the figures of the frames that do not depend on the map."""
    target = track.target
    visibility = target.visibility[~np.isnan(target.visibility)]
    heights_px = (target.bbox[:, 3] - target.bbox[:, 1])[target.in_view]
    heights_m = track.positions_m[:, 2] - (track.targets_m[:, 2] - TARGET_HEIGHT_M)  # over the target's feet
    is_judged = target.legible is not None and len(heights_px) > 0
    metrics.update(
        num_frames_checked=numbers.num_checked,
        num_frames_compared=numbers.num_compared,
        length_m=length_m(track.positions_m),
        height_mean_m=None if np.isnan(heights_m).all() else float(np.nanmean(heights_m)),
        rendered_visibility_mean=float(visibility.mean()) if len(visibility) else None,
        visible_share=float(target.visible.mean()),
        legible_share=None if target.legible is None else float(target.legible.mean()),
        small_share=float((heights_px < LEGIBLE_HEIGHT_PX).mean()) if is_judged else None,
        in_view_share=float(target.in_view.mean()),
        perturbed_share=float(track.perturbation.is_perturbed.mean()),
        track_quality=float(np.mean(numbers.track_ious)) if numbers.track_ious else None,
        invalid_depth_share_max=max(numbers.invalid_depth_shares, default=None),
    )


def _judge_frames(track: Track, cfg: InspectConfig, report: Report, metrics: Metrics) -> None:
    """Compare the figures of `_measure_frames` with their thresholds."""
    legible, quality = metrics["legible_share"], metrics["track_quality"]
    invalid = metrics["invalid_depth_share_max"]
    if legible is not None and legible < cfg.legible_min:
        where = "trajectory.json: points[].target.legible"
        got = f"true in {legible:.2f} of the frames"
        report.error("illegible", where, got, f"at least {cfg.legible_min:g} of the frames")
    if not track.target.visible.any():
        report.warn("never_visible", "trajectory.json: points[].target.visible", "false everywhere", "a target")
    if quality is not None and quality < limits.TRACK_QUALITY_MIN:
        report.warn("track_quality", "instance.png", f"IoU {quality:.3f}", f"at least {limits.TRACK_QUALITY_MIN}")
    if invalid is not None and invalid > limits.INVALID_DEPTH_MAX:
        expected = f"at most {limits.INVALID_DEPTH_MAX:g} of the pixels of a frame"
        report.warn("invalid_depth", "depth.npy", f"{invalid:.3f} of a frame", expected)
