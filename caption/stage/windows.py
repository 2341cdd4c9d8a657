"""Phase 1: cut tracks into windows (causal locality, sec:appendix_e).

The observed frames and the future leave this module as two types, so that a prompt cannot hold the future by accident.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from caption.schema import FutureMotion, ObservedFrame, ObservedWindow, Window, WindowConfig, observed_frames
from cosfly.formats.captions import LabelFrom
from cosfly.formats.frames import files_in
from cosfly.formats.places import sample_id
from cosfly.formats.playback import Track


def current_frames(num_points: int, cfg: WindowConfig) -> range:
    """Return the indices that have a whole past and a whole future."""
    return range(cfg.num_frames - 1, num_points - cfg.future_frames, cfg.stride)


def cut_windows(track: Track, cfg: WindowConfig, twin: Track | None = None) -> Iterator[Window]:
    """Yield the windows of a track in order of time; none if the track is shorter than a window. Futures are cut from
    the twin, the clean track of a perturbed one, if there is one."""
    motion, frames = label_motion(track, twin), frames_of(track)
    folders = [track.frame_folder(i) for i in range(len(track))]
    files = [files_in(folder) for folder in folders]
    without_picture = {i for i, names in enumerate(files) if "rgb.png" not in names}
    for current in current_frames(len(track), cfg):
        mission = track.mission
        order = None if mission is None or mission.order_at(current) is None else mission.kind
        observed = observe(track, frames, slice(current - cfg.num_frames + 1, current + 1), order, folders, files)
        problem = None
        if cfg.require_images and without_picture.intersection(observed.indices):
            problem = "unusable_frame"
        elif mission is not None and current < mission.at_frame <= current + cfg.future_frames:
            problem = "order_to_come"  # which moves the drone and is not known yet
        yield Window(observed, cut_future(track, motion, current, cfg.future_frames), problem)


def frames_of(track: Track) -> tuple[ObservedFrame, ...]:
    """Return what is observed of each frame of a track."""
    target, num_frames = track.target, len(track)
    bystanders = track.bystanders  # columns as COMPANY of cosfly/formats/frames.py
    if bystanders is None:
        bystanders = np.full((num_frames, 5), np.nan)
    return observed_frames(
        track.time_s,
        track.positions_m,
        track.rotations_deg,
        track.targets_m,
        target.uv,
        target.bbox if target.mask_bbox is None else target.mask_bbox,
        target.in_view,
        target.visible,
        target.visibility,
        np.ones(num_frames, dtype=bool) if target.legible is None else target.legible,
        *bystanders.T[[0, 1, 4]],  # others_in_view, other_distance_m, alike_differences
    )


def observe(
    track: Track, frames: tuple[ObservedFrame, ...], span: slice, order: str | None, folders: Sequence[Path] = (),
    files: Sequence[frozenset[str]] = (),
) -> ObservedWindow:  # fmt: skip
    """Return the frames of a span of a track, without a reference to those that follow. order: The kind of the mission
    in force. folders, files: Of all frames, if there are pictures."""
    goal, current = track.goal, span.stop - 1
    return ObservedWindow(
        sample_id=sample_id(track.flight_id, current), town=track.town, trajectory=track.trajectory,
        variant=track.variant, indices=tuple(range(span.start, span.stop)), width_px=track.camera.width_px,
        height_px=track.camera.height_px, frames=frames[span], frame_folders=tuple(folders[span]),
        frame_files=tuple(files[span]), mission=order,
        goal=None if goal is None or track.bystanders is None else {"en": goal.en, "zh": goal.zh},
    )  # fmt: skip


def cut_future(track: Track, motion: LabelMotion, current: int, future_frames: int) -> FutureMotion:
    """Return the motion after frame `current`: that of the whole track without perturbation, or the recorded one if
    that is not known. Visibility is always that of the track itself."""
    if not all(motion.is_known[current - 1 : current + future_frames + 1]):
        motion = recorded_motion(track, "perturbed")
    span = slice(current, current + future_frames + 1)
    step_s = track.time_s[current] - track.time_s[current - 1]
    before_m, now_m = motion.positions_m[current - 1 : current + 1].tolist()
    return FutureMotion(
        indices=tuple(range(current + 1, current + future_frames + 1)), time_s=track.time_s[span],
        positions_m=motion.positions_m[span], yaw_deg=motion.yaw_deg[span], targets_m=motion.targets_m[span],
        visible=track.target.visible[span], speed_before_mps=math.dist(now_m, before_m) / float(step_s),
        label_from=motion.label_from, order=None if track.mission is None else track.mission.order_at(current),
    )  # fmt: skip


# --- the motion that labels come from ---------------------------------------------------------------------------------

# The random offsets of a perturbed track are no manoeuvre, so a label made of them is noise. Its clean motion is that
# of its twin (`ORI`), or its own without the recorded offsets. Visibility is that of the perturbed camera.


@dataclass(frozen=True)
class LabelMotion:
    """Poses of n frames, NaN if not known."""

    label_from: LabelFrom
    positions_m: np.ndarray  # (n, 3), of the drone
    yaw_deg: np.ndarray  # (n,)
    targets_m: np.ndarray  # (n, 3)

    @cached_property
    def is_known(self) -> list[bool]:
        """Whether the pose of each frame is known; a list, because each window reads a few."""
        return (~(np.isnan(self.positions_m).any(axis=1) | np.isnan(self.yaw_deg))).tolist()


def recorded_motion(track: Track, label_from: LabelFrom) -> LabelMotion:
    """Return the motion of a track with its perturbation."""
    return LabelMotion(label_from, track.positions_m, track.rotations_deg[:, 1], track.targets_m)


def label_motion(track: Track, twin: Track | None = None) -> LabelMotion:
    """Return the motion of a track without perturbation: that of its twin, the clean track of the same frames
    (`read_twin`), or its own without the offsets, NaN where these are not recorded."""
    if track.is_original:
        return recorded_motion(track, "flight")
    if twin is not None:
        return recorded_motion(twin, "twin")
    poses, targets_m = track.planned
    return LabelMotion("offsets", poses[:, :3], poses[:, 4], targets_m)
