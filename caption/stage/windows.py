"""Phase 1: cut flights into windows (causal locality, sec:appendix_e).

The observed frames and the future leave this module as two types, so that a prompt cannot hold the future by accident.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from caption.schema import (
    FutureMotion,
    ObservedFrame,
    ObservedWindow,
    Window,
    WindowConfig,
    observed_frames,
)
from caption.verification.actions import TABLE, measure
from cosfly.formats.captions import KeyframeRecord, LabelFrom, Language
from cosfly.formats.frames import files_in
from cosfly.formats.places import sample_id
from cosfly.formats.playback import Track
from cosfly.formats.segments import Mission


def current_frames(num_points: int, cfg: WindowConfig) -> range:
    """Return the indices that have a whole past and a whole future."""
    return range(cfg.num_frames - 1, num_points - cfg.future_frames, cfg.stride)


def cut_windows(flight: Track, cfg: WindowConfig, twin: Track | None = None) -> Iterator[Window]:
    """Yield a flight's windows in order of time. A flight shorter than a window gives none.

    Args:
        twin: the clean flight beside a perturbed one; futures are cut from it.
    """
    motion, frames = label_motion(flight, twin), frames_of(flight)
    folders = [flight.frame_folder(i) for i in range(len(flight))]
    files = [files_in(folder) for folder in folders]
    missing = {i for i, names in enumerate(files) if "rgb.png" not in names} if cfg.require_images else set()
    currents = list(current_frames(len(flight), cfg))
    keyframes: list[KeyframeRecord | None] = [None] * len(currents)
    if cfg.keyframes:
        futures = (cut_future(flight, motion, i, cfg.future_frames) for i in currents)
        chosen = choose_keyframes([TABLE.label_of(measure(future)) for future in futures], cfg.keyframe_stride)
        currents, keyframes = [currents[i] for i in chosen], list(chosen.values())
    for current, keyframe in zip(currents, keyframes, strict=True):
        observed = _observe(flight, frames, slice(current - cfg.num_frames + 1, current + 1), folders, files)
        problem = "unusable_frame" if missing.intersection(observed.indices) else None
        if problem is None and order_comes_within(flight.mission, current, cfg.future_frames):
            problem = "order_to_come"
        future = cut_future(flight, motion, current, cfg.future_frames)
        yield Window(observed, future, problem, keyframe)


def choose_keyframes(labels: list[str | None], stride: int) -> dict[int, KeyframeRecord]:
    """Choose the windows at which the label changes, the first one, and each `stride`-th after a chosen one.

    Returns:
        index -> {reason: start | change | stride, skipped: windows left out up to the next chosen one, missed: changes
        of the label among them, counted anew from the labels}.
    """
    chosen: dict[int, KeyframeRecord] = {}
    last = -1
    for i, label in enumerate(labels):
        reason = "start" if i == 0 else "change" if label != labels[i - 1] else "stride" if i - last == stride else None
        if reason is None:
            chosen[last].skipped += 1
        else:
            chosen[i] = KeyframeRecord(reason=reason, skipped=0, missed=0)
            last = i
    for i in missed_changes(labels, set(chosen)):
        chosen[max(k for k in chosen if k < i)].missed += 1
    return chosen


def missed_changes(labels: list[str | None], chosen: set[int]) -> list[int]:
    """Return the windows at which the label changes and that were not chosen."""
    return [i for i in range(1, len(labels)) if labels[i] != labels[i - 1] and i not in chosen]


def frames_of(flight: Track) -> tuple[ObservedFrame, ...]:
    """Return what was known at each frame of a flight."""
    return observed_frames(
        flight.time_s,
        flight.positions_m,
        flight.rotations_deg,
        flight.targets_m,
        flight.target.uv,
        flight.target.bbox if flight.target.mask_bbox is None else flight.target.mask_bbox,
        flight.target.in_view,
        flight.target.visible,
        flight.target.visibility,
        np.ones(len(flight), dtype=bool) if flight.target.legible is None else flight.target.legible,
        *(np.full((len(flight), 5), np.nan) if flight.bystanders is None else flight.bystanders).T[[0, 1, 4]],
    )


def goal_of(flight: Track) -> dict[Language, str] | None:
    """Return the goal in words, of a flight in which there are other people."""
    return None if flight.goal is None or flight.bystanders is None else {"en": flight.goal.en, "zh": flight.goal.zh}


def _observe(
    flight: Track, frames: tuple[ObservedFrame, ...], span: slice, folders: list[Path], files: list[frozenset[str]]
) -> ObservedWindow:
    """Take the observed frames out of a flight: nothing of what follows stays reachable."""
    return ObservedWindow(
        sample_id=sample_id(flight.flight_id, span.stop - 1),
        town=flight.town,
        trajectory=flight.trajectory,
        variant=flight.variant,
        indices=tuple(range(span.start, span.stop)),
        width_px=flight.camera.width_px,
        height_px=flight.camera.height_px,
        frames=frames[span],
        frame_folders=tuple(folders[span]),
        frame_files=tuple(files[span]),
        mission=known_of(flight.mission, span.stop - 1),
        goal=goal_of(flight),
    )


def known_of(mission: Mission | None, frame: int) -> str | None:
    """Return the kind of a mission at a frame at which its order stands; before, nobody knows that there will be
    one."""
    return None if mission is None or mission.order_at(frame) is None else mission.kind


def order_comes_within(mission: Mission | None, current: int, future_frames: int) -> bool:
    """Return whether an order of which nobody knows at frame `current` moves the drone after it: no label could be told
    from what is seen."""
    return mission is not None and current < mission.at_frame <= current + future_frames


def cut_future(flight: Track, motion: LabelMotion, current: int, future_frames: int) -> FutureMotion:
    """Return the motion after frame `current`: as it is without perturbation, or as it was flown where that is not
    known.

    Args:
        motion: of the whole flight; what was visible comes from the flight itself.
    """
    used = slice(current - 1, current + future_frames + 1)
    if not all(motion.is_known[used]):
        motion = as_flown(flight, "perturbed")
    span = slice(current, current + future_frames + 1)
    step_s = flight.time_s[current] - flight.time_s[current - 1]
    before_m, now_m = motion.positions_m[current - 1 : current + 1].tolist()
    return FutureMotion(
        indices=tuple(range(current + 1, current + future_frames + 1)),
        time_s=flight.time_s[span],
        positions_m=motion.positions_m[span],
        yaw_deg=motion.yaw_deg[span],
        targets_m=motion.targets_m[span],
        visible=flight.target.visible[span],
        speed_before_mps=math.dist(now_m, before_m) / float(step_s),
        label_from=motion.label_from,
        order=None if flight.mission is None else flight.mission.order_at(current),
    )


# --- the motion that labels come from ---------------------------------------------------------------------------------

# Offsets that are drawn anew for every frame are no manoeuvre, so a label made of them is noise. The clean motion of a
# perturbed flight is that of its twin (`ORI`); without one, what was recorded is taken off (`Flight.planned`).
# Visibility is no part of it: what was seen was seen from where the camera was.


@dataclass(frozen=True)
class LabelMotion:
    """Poses of n frames and where they come from. positions_m, targets_m (n, 3); yaw_deg (n,). NaN where not known."""

    label_from: LabelFrom
    positions_m: np.ndarray
    yaw_deg: np.ndarray
    targets_m: np.ndarray

    @cached_property
    def is_known(self) -> list[bool]:
        """Tell of each frame whether its pose is known; a list, as each window asks for a few."""
        return (~(np.isnan(self.positions_m).any(axis=1) | np.isnan(self.yaw_deg))).tolist()


def as_flown(flight: Track, label_from: LabelFrom) -> LabelMotion:
    """Return the motion of a flight as it was flown, perturbation and all."""
    return LabelMotion(label_from, flight.positions_m, flight.rotations_deg[:, 1], flight.targets_m)


def label_motion(flight: Track, twin: Track | None = None) -> LabelMotion:
    """Return a flight's motion without perturbation, in the best way there is.

    Args:
        twin: the clean flight of the same frames (`read_twin`), None where there is none.
    Returns:
        Rows are NaN where a frame was perturbed and nobody recorded by how much.
    """
    if flight.is_original:
        return as_flown(flight, "flight")
    if twin is not None:
        return as_flown(twin, "twin")
    poses, targets_m = flight.planned
    return LabelMotion("offsets", poses[:, :3], poses[:, 4], targets_m)
