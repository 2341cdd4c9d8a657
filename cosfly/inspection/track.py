"""What the inspection finds out about one flight: its checks of plan, poses and motion, its record (sec:step6).

The poses that were drawn are measured against the map themselves: a perturbed flight is not its plan.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel

from cosfly.formats.frames import LEGIBLE_HEIGHT_PX
from cosfly.formats.inspection import Result as FlightResult
from cosfly.formats.inspection import TrackInspection
from cosfly.formats.issues import Report
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.formats.playback import STATES, Track, read_track
from cosfly.formats.traces import DroneTrace
from cosfly.formats.tracks import read_twin
from cosfly.formats.weather import preset_token
from cosfly.geometry.axes import project, step_s, world_from_camera, wrap_deg
from cosfly.geometry.coverage import Coverage, axis_values
from cosfly.geometry.trajectory_metrics import (
    CLEARANCE_CAP_M,
    CLEARANCE_TOLERANCE_M,
    accel_rms,
    jerk_rms,
    length_m,
    smoothness_score,
)
from cosfly.inspection.files import Checksums, check_files, check_recorded
from cosfly.inspection.frames import FrameNumbers, check_frames, check_others, choose_frames, others_told, target_box
from cosfly.inspection.settings import (
    DRONE_SPEED_MAX_MPS,
    INVALID_DEPTH_MAX,
    POSE_TOLERANCE_M,
    REPROJECTION_TOLERANCE_PX,
    ROTATION_TOLERANCE_DEG,
    TARGET_SPEED_MAX_MPS,
    THUMBNAIL_PX,
    TRACK_QUALITY_MIN,
    InspectConfig,
)
from cosfly.inspection.view import TrackView, draw_track
from cosfly.runtime.errors import InputError, VerifyError
from cosfly.runtime.run_dir import digest_of, folder_digests

if TYPE_CHECKING:
    from cosfly.formats.boxes import BoxMap
    from cosfly.geometry.kernels import BoxIndex

TIME_TOLERANCE_S = 1e-3


class InspectedTrack(BaseModel):
    """A flight's record, and what the report draws of it; so it stands in `items.jsonl`."""

    record: TrackInspection
    view: TrackView
    coverage: Coverage


def inspect_track(
    folder: Path,
    root: Path,
    traces: dict[str, DroneTrace] | None,
    box_map: BoxMap | None,
    obstacles: BoxIndex | None,
    cfg: InspectConfig,
    recorded: Mapping[str, str],
) -> InspectedTrack:
    """Check one flight folder.

    Args:
        traces: the plans by id; None where nobody here planned the flight.
        box_map, obstacles: the map, and what of it is in the way; None where there is none.
        recorded: sha256 by path of what the tree's manifest lists; empty where it has none.
    """
    report = Report()
    flight = _read(folder, report)
    trace = None if traces is None else traces.get(trace_id(flight))
    metrics: dict[str, float | int | None] = {"num_frames": len(flight)}
    if traces is not None and trace is None:
        got = f"no trace {trace_id(flight)!r}"
        report.warn("no_trace", "trajectory.json: source.scenario_id", got, "the id of a planned flight")
    if trace is not None:
        check_plan(trace, cfg, report, metrics)
        check_poses(flight, trace, cfg, report)
    clearance_m = None if obstacles is None else check_surroundings(flight, obstacles, cfg, report, metrics)
    check_shifts(flight, report, metrics)
    if not flight.is_original:
        counts = Counter(flight.states)
        metrics.update({f"frames_{state.replace(' ', '_')}": counts[state] for state in STATES})
    check_motion(flight, cfg, report)
    check_projection(flight, cfg, report)
    check_recorded(flight, root, recorded, report)
    frames = _check_frames(flight, cfg, report, metrics)
    _rendered_metrics(flight, frames, cfg, report, metrics)
    issues = report.merged()
    result: FlightResult = "rejected" if report.num("error") else "review" if report.num("warning") else "accepted"
    record = TrackInspection(
        town=flight.town,
        trajectory=flight.trajectory,
        variant=flight.variant,
        is_original=flight.is_original,
        folder=folder.relative_to(root).as_posix(),
        sha256=_digest(folder),
        trace_id=trace.path_id if trace else None,
        result=result,
        issues=issues,
        metrics={name: None if value is None else round(value, 4) for name, value in metrics.items()},
    )
    view = draw_track(flight, _heights_m(flight), clearance_m, box_map, THUMBNAIL_PX, report.issues)
    return InspectedTrack(record=record, view=view, coverage=coverage_of(flight))


def _digest(folder: Path) -> str | None:
    """Return the digest of a flight's files; None where its checksums cannot be read, which `check_checksums`
    reports."""
    try:
        return digest_of(folder_digests(folder))
    except InputError:
        return None


def coverage_of(flight: Track) -> Coverage:
    """Count the frames of a flight."""
    box = flight.target.bbox if flight.target.mask_bbox is None else flight.target.mask_bbox
    offsets_m = flight.positions_m - flight.targets_m
    heights_px, heading_deg = box[:, 3] - box[:, 1], flight.target_headings_deg
    values = axis_values(offsets_m, heading_deg, heights_px, flight.target.visibility, TARGET_HEIGHT_M)
    weather, time = (name and preset_token(name) for name in flight.weather.values())
    return Coverage.of(values, flight.styles, [flight.pace] * len(flight), skies=[(weather, time)] * len(flight))


def trace_id(flight: Track) -> str:
    """Return the id of the plan that a flight says it was rendered from."""
    return str(flight.source.get("scenario_id", ""))


def _read(folder: Path, report: Report) -> Track:
    """Read a flight strictly; if only the layout is broken, read on and report what is."""
    try:
        return read_track(folder)
    except InputError as error:
        flight = read_track(folder, strict=False)  # raises when poses or times are unusable
        where = str(error.where).replace(f"{folder}/", "")
        report.error("layout", where, error.got or error.what, error.expected or "the strict layout")
        return flight


def check_plan(trace: DroneTrace, cfg: InspectConfig, report: Report, metrics: dict) -> None:
    """Judge the planned trajectory: smoothness, and what the prefilter said."""
    dt_s = step_s(trace.time_s)
    accel, jerk = accel_rms(trace.positions_m, dt_s), jerk_rms(trace.positions_m, dt_s)
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


def check_surroundings(
    flight: Track, obstacles: BoxIndex, cfg: InspectConfig, report: Report, metrics: dict[str, float | int | None]
) -> np.ndarray:
    """Measure the poses of a flight against the map: clearance of the drone, five-ray visibility, a person in an
    obstacle; gives the first, (n,) m: of the way to the next pose, of the poses alone where shifts moved them.
    """
    from cosfly.geometry.kernels import signed_distances, swept_distances, visibility

    gaps_m = signed_distances(obstacles, flight.positions_m, CLEARANCE_CAP_M)[0]
    if flight.is_original:
        way_m = flight.positions_m[:, None]
        if flight.between is not None:  # what was not drawn was flown: no straight line from frame to frame
            between_m = flight.between[..., :3]
            way_m = np.concatenate([way_m, np.where(np.isnan(between_m), way_m, between_m)], axis=1)
        swept_m = swept_distances(obstacles, way_m.reshape(-1, 3), CLEARANCE_CAP_M)[0]
        gaps_m = swept_m.reshape(len(flight), -1).min(axis=1)
    metrics.update(clearance_min_m=float(gaps_m.min()))
    for i in np.flatnonzero((gaps_m < cfg.clearance_min_m - CLEARANCE_TOLERANCE_M) | (gaps_m <= 0)):
        code, where = "collision" if gaps_m[i] <= 0 else "clearance", f"trajectory.json: points[{i}].drone_pose"
        report.error(code, where, f"{gaps_m[i]:.2f} m", f"at least {cfg.clearance_min_m:g} m to every obstacle")
    known = np.flatnonzero(~np.isnan(flight.targets_m).any(axis=1))
    if not len(known):
        return gaps_m
    inside, _ = signed_distances(obstacles, flight.targets_m[known], 0.0)
    for i in known[inside < 0]:
        report.error(
            "collision", f"trajectory.json: points[{i}].target.world_location", "in an obstacle", "free ground"
        )
    judged = known[flight.keeps_sight[known]]
    rows = judged if len(judged) else known
    five_ray = float(visibility(obstacles, flight.positions_m[rows], flight.targets_m[rows]).mean())
    metrics.update(five_ray_mean=five_ray)
    if len(judged) and five_ray < cfg.five_ray_mean_min:
        expected = f"a mean of at least {cfg.five_ray_mean_min:g}"
        report.error("five_ray_visibility", "trajectory.json: points", f"{five_ray:.3f}", expected)
    return gaps_m


def check_shifts(flight: Track, report: Report, metrics: dict[str, float | int | None]) -> None:
    """Find the frames of a perturbed flight whose shift hides a target which the clean flight beside it shows."""
    try:
        twin = read_twin(flight)
    except VerifyError as error:
        expected = "a clean flight of the same frames beside it"
        report.warn("no_twin", "trajectory.json", f"{error.what} ({error.got})", expected)
        return
    if twin is None:
        return
    is_hidden = is_shifted(flight) & twin.target.visible & ~flight.target.visible
    metrics.update(num_hidden_by_shift=int(is_hidden.sum()))
    for i in np.flatnonzero(is_hidden):
        where = f"trajectory.json: points[{i}].target.visible"
        report.warn("hidden_by_shift", where, "false, and true in the clean flight", "a shift that falls back")


def is_shifted(flight: Track) -> np.ndarray:
    """Return where drone or person were moved from their plan, (n,) bool; an offset that no file tells counts."""
    return (flight.perturbation.drone_m != 0).any(axis=1) | (flight.perturbation.target_m != 0).any(axis=1)


def check_poses(flight: Track, trace: DroneTrace, cfg: InspectConfig, report: Report) -> None:
    """Check that a flight, its recorded perturbation taken off, is the plan.

    Where a perturbation shifted drone or person, the camera was aimed anew, so only the positions can be compared
    there.
    """
    num_planned = -(-len(trace.time_s) // flight.motion.poses_a_frame)
    if len(flight) < num_planned:
        got, expected = f"{len(flight)} frames", f"{num_planned} planned ones"
        report.warn("shorter_than_planned", "trajectory.json: points", got, expected)
    row = np.searchsorted(trace.time_s, flight.time_s - TIME_TOLERANCE_S).clip(max=len(trace.time_s) - 1)
    off_time = np.abs(trace.time_s[row] - flight.time_s) > TIME_TOLERANCE_S
    for i in np.flatnonzero(off_time):
        where = f"trajectory.json: points[{i}].timing.trace_timestamp"
        report.error("pose_differs", where, f"{flight.time_s[i]:.3f} s", "a time of the plan")
    shifts = flight.perturbation
    turns = wrap_deg(flight.rotations_deg - shifts.rotation_deg - trace.rotations_deg[row])
    checks = (
        (
            "drone_pose",
            flight.positions_m - flight.perturbation.drone_m - trace.positions_m[row],
            POSE_TOLERANCE_M,
            "m",
        ),
        ("drone_pose", np.where(is_shifted(flight)[:, None], 0.0, turns), ROTATION_TOLERANCE_DEG, "deg"),
        (
            "target.world_location",
            flight.targets_m - flight.perturbation.target_m - trace.targets_m[row],
            POSE_TOLERANCE_M,
            "m",
        ),
    )
    for name, difference, tolerance, unit in checks:
        distance = np.abs(np.asarray(difference)).max(axis=1)
        for i in np.flatnonzero((distance > tolerance) & ~off_time):
            where, expected = f"trajectory.json: points[{i}].{name}", f"the plan within {tolerance:g} {unit}"
            report.error("pose_differs", where, f"{distance[i]:.4f} {unit} beside the plan", expected)


def check_motion(flight: Track, cfg: InspectConfig, report: Report) -> None:
    """Find teleports: steps between frames that nothing flies or walks. Recorded perturbations are taken off."""
    drone_offsets_m, target_offsets_m = (
        np.nan_to_num(flight.perturbation.drone_m),
        np.nan_to_num(flight.perturbation.target_m),
    )
    limits = (
        ("drone_pose", flight.positions_m - drone_offsets_m, DRONE_SPEED_MAX_MPS),
        ("target.world_location", flight.targets_m - target_offsets_m, TARGET_SPEED_MAX_MPS),
    )
    for name, positions_m, limit_mps in limits:
        speeds = np.linalg.norm(np.diff(positions_m, axis=0), axis=1) / np.diff(flight.time_s)
        for i in np.flatnonzero(speeds > limit_mps):
            where = f"trajectory.json: points[{i + 1}].{name}"
            report.error("teleport", where, f"{speeds[i]:.1f} m/s", f"at most {limit_mps:g} m/s")


def check_projection(flight: Track, cfg: InspectConfig, report: Report) -> None:
    """Check the recorded pixel, box and depth of the target against pose, intrinsics and target position."""
    for i in range(len(flight)):
        point = f"trajectory.json: points[{i}].target"
        if np.isnan(flight.targets_m[i]).any():
            if flight.target.in_view[i]:
                report.error("target_missing", f"{point}.world_location", "null", "a position: the target is in view")
            continue
        pose = world_from_camera(flight.positions_m[i], flight.rotations_deg[i])
        uv, depth_m = project(flight.targets_m[i : i + 1], pose, flight.camera_at(i).intrinsic)
        box = target_box(flight, i)
        recorded = (
            ("image_uv", flight.target.uv[i], uv[0], REPROJECTION_TOLERANCE_PX, "px"),
            # Another's person is of another size than ours.
            ("bbox_2d", flight.target.bbox[i] if flight.is_ours else box, box, 2 * REPROJECTION_TOLERANCE_PX, "px"),
            ("depth", flight.target.depth_m[i : i + 1], depth_m, 0.01, "m"),
        )
        for name, found, expected, tolerance, unit in recorded:
            if np.isnan(found).any() or np.isnan(expected).any():
                continue
            distance = float(np.abs(found - expected).max())
            if distance > tolerance:
                limit = f"the projection of the target within {tolerance:g} {unit}"
                report.error("projection_differs", f"{point}.{name}", f"{distance:.2f} {unit} beside it", limit)
        if flight.target.in_view[i] and np.isnan(flight.target.uv[i]).any():
            report.error("target_missing", f"{point}.image_uv", "null", "a pixel: the target is in view")


def _check_frames(
    flight: Track, cfg: InspectConfig, report: Report, metrics: dict[str, float | int | None]
) -> FrameNumbers:
    metas = check_files(flight, report)
    told = others_told(flight, metas)
    check_others(flight, told, cfg.clearance_min_m, report, metrics)
    checksums = Checksums(flight, report, is_wanted=cfg.check_checksums)
    chosen = choose_frames(list(metas), cfg.check_pixels, cfg.pixel_sample)
    numbers = check_frames(flight, chosen, told, checksums, cfg, report)
    checksums.compare_others()
    return numbers


def _rendered_metrics(
    flight: Track, frames: FrameNumbers, cfg: InspectConfig, report: Report, metrics: dict[str, float | int | None]
) -> None:
    """Add what the rendered frames say; rendered visibility describes, it never rejects (sec:dataset_stats)."""
    known = flight.target.visibility[~np.isnan(flight.target.visibility)]
    quality = float(np.mean(frames.track_ious)) if frames.track_ious else None
    invalid = max(frames.invalid_depth_shares, default=None)
    told, heights_px = (
        flight.target.legible,
        (flight.target.bbox[:, 3] - flight.target.bbox[:, 1])[flight.target.in_view],
    )
    metrics.update(
        num_frames_checked=frames.num_checked,
        num_frames_compared=frames.num_compared,
        length_m=length_m(flight.positions_m),
        height_mean_m=float(np.nanmean(_heights_m(flight))) if not np.isnan(flight.targets_m).all() else None,
        rendered_visibility_mean=float(known.mean()) if len(known) else None,
        visible_share=float(flight.target.visible.mean()),
        legible_share=None if told is None else float(told.mean()),
        small_share=None if told is None or not len(heights_px) else float((heights_px < LEGIBLE_HEIGHT_PX).mean()),
        in_view_share=float(flight.target.in_view.mean()),
        perturbed_share=float(flight.perturbation.is_perturbed.mean()),
        track_quality=quality,
        invalid_depth_share_max=invalid,
    )
    if not flight.target.visible.any():
        report.warn("never_visible", "trajectory.json: points[].target.visible", "false everywhere", "a target")
    if quality is not None and quality < TRACK_QUALITY_MIN:
        report.warn("track_quality", "instance.png", f"IoU {quality:.3f}", f"at least {TRACK_QUALITY_MIN}")
    if invalid is not None and invalid > INVALID_DEPTH_MAX:
        expected = f"at most {INVALID_DEPTH_MAX:g} of the pixels of a frame"
        report.warn("invalid_depth", "depth.npy", f"{invalid:.3f} of a frame", expected)


def _heights_m(flight: Track) -> np.ndarray:
    """Height of the drone over the person's feet, (n,) m."""
    return flight.positions_m[:, 2] - (flight.targets_m[:, 2] - TARGET_HEIGHT_M)
