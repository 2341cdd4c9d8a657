"""Counts of a release from one pass over its rows: those of each track, and the numbers of the release, their sums.

Card, statistics and `release verify` use them. Motion is the plan's: positions minus the recorded offsets, over all
points, so that a perturbed track counts as its clean one does. Sums are of whole millionths, so they are exact and the
same in any order.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.formats.weather import preset_token
from cosfly.geometry.trajectory_metrics import ACCEL_RMS_MAX_MPS2, JERK_RMS_MAX_MPS3, smoothness_score
from release.columns import CAPTION_FIELDS, COUNTED, LANGUAGES, VALUE_COLUMNS
from release.reading import TrackRows, bounded, read_tracks
from release.record import Counts, Numbers, Shard, Spread

DIGITS = 4  # of a number in the record
MILLION = 1_000_000
LEAST_STEP_S = 1e-3  # between two points
SAME_FOV_DEG = 0.05
REVIEW_BELOW = 0.5  # of the smoothness score (sec:step6)
HOVER_MPS, TURN_DEGPS = 0.3, 5.0  # an action that is slower is hover; one that turns faster is a turn
MOVES = (("forward", "backward"), ("left", "right"), ("up", "down"))  # by the sign of the velocities of an action
ACTION_CLASSES = (*(name for pair in MOVES for name in pair), "turn left", "turn right", "hover")
POOLED = ("height_m", "distance_m", "visibility")  # sums over all frames of the release
TAB = "\t"  # between the names of a pair that is counted
# Columns of yes and no whose frames are counted.
FLAGS = ("is_perturbed", "target_in_view", "target_visible", "target_legible", "has_caption")
STATES = ("unperturbed", "position only", "rotation only", "full")  # index: 1 for a shift plus 2 for a turn
# Columns that are read.
COLUMNS = (
    "sample_id", "track", "split", "walk", "pair", "style", "pace", "weather", "time_of_day", "frame_index", "width_px",
    "height_px", "fov_deg", "intrinsics", "pose", "drone_offset", "target", "target_offset", "target_heading_deg",
    "target_bbox", "target_mask_bbox", "visibility", "perturbation", "action", *FLAGS, *COUNTED, *VALUE_COLUMNS,
    *CAPTION_FIELDS,
)  # fmt: skip


class Sum(BaseModel):
    """Sums of values, exact, because they are in whole millionths."""

    count: int = 0
    total: int = 0  # sum of the values
    squares: int = 0  # sum of their squares, in millionths of millionths
    low: int | None = None  # least value
    high: int | None = None

    @classmethod
    def of(cls, values: Iterable[float | None]) -> Sum:
        """Add up values; None and NaN are skipped. Raise InputError as `bounded`."""
        known = (value for value in values if value is not None and not math.isnan(value))
        parts = [round(bounded(value) * MILLION) for value in known]
        squares = sum(part * part for part in parts)
        low, high = min(parts, default=None), max(parts, default=None)
        return cls(count=len(parts), total=sum(parts), squares=squares, low=low, high=high)

    @classmethod
    def all(cls, sums: Iterable[Sum]) -> Sum:
        """Add up sums."""
        parts = list(sums)
        low = min((part.low for part in parts if part.low is not None), default=None)
        high = max((part.high for part in parts if part.high is not None), default=None)
        count, total, squares = (sum(getattr(part, name) for part in parts) for name in ("count", "total", "squares"))
        return cls(count=count, total=total, squares=squares, low=low, high=high)

    def spread(self) -> Spread:
        """Return the sums as the record has them."""
        if self.low is None or self.high is None:
            return Spread()
        std = math.sqrt(self.count * self.squares - self.total * self.total) / self.count
        values = (self.total / self.count, std, self.low, self.high)
        mean, std, low, high = (round(value / MILLION, DIGITS) for value in values)
        return Spread(count=self.count, mean=mean, std=std, min=low, max=high)


# --- a track ----------------------------------------------------------------------------------------------------------


class TrackCount(BaseModel):
    """The counts of one track."""

    name: str
    track: str  # clean or perturbed
    split: str | None
    walk: str | None
    pair: str | None
    frames: int
    points: int
    frames_digest: str  # of the indices of its frames
    fov: str  # its field of view in degrees, or `changing`
    motion: dict[str, float | None]  # duration, length, acceleration and jerk without perturbation, None if not known
    sums: dict[str, Sum]  # over its frames
    counts: dict[str, Counts]  # what is counted -> frames by its value; pairs of values are joined by TAB
    example: dict[str, str | None]  # its first caption

    @property
    def town(self) -> str:
        return self.name.split("/")[1]

    @property
    def trajectory(self) -> str:
        """What it shares with its other track."""
        return self.name.rpartition("/")[0]


def count_release(folder: Path, shards: Iterable[Shard]) -> list[TrackCount]:
    """Count all tracks of a release in one pass over its rows; no picture is read."""
    return [count_track(*track) for shard in shards for track in read_tracks(folder, shard, COLUMNS)]


def frames_digest(indices: np.ndarray) -> str:
    """Return a digest of the frame indices of a track, (n,)."""
    return hashlib.sha256(indices.astype(np.int64).tobytes()).hexdigest()


def count_track(frames: TrackRows, points: TrackRows) -> TrackCount:
    """Count the rows of a track, n frames. Raise InputError where a number is out of range."""
    first, rows = frames.rows[0], frames.rows
    to_drone_m = frames.pose[:, :3] - frames.target_m
    clean_m = to_drone_m - frames.drone_offset[:, :3] + frames.target_offset  # without perturbation
    fovs = frames.numbers("fov_deg")
    is_zooming = bool((np.abs(fovs - fovs[0]) > SAME_FOV_DEG).any())
    captioned = [row for row in rows if row["has_caption"]]
    measured = {
        "height_m": to_drone_m[:, 2], "distance_m": np.linalg.norm(to_drone_m, axis=1),
        "clean_altitude_m": clean_m[:, 2] + TARGET_HEIGHT_M, "clean_distance_m": np.linalg.norm(clean_m, axis=1),
        "visibility": frames.visibility,
        **{name: np.array([len(row[name] or "") for row in captioned], float) for name in CAPTION_FIELDS},
    }  # fmt: skip
    return TrackCount(
        name=frames.name, **{name: first[name] for name in ("track", "split", "walk", "pair")}, frames=len(rows),
        points=len(points), frames_digest=frames_digest(frames.index),
        fov="changing" if is_zooming else f"{round(bounded(first['fov_deg']), 1):g}", motion=_motion(points),
        sums={name: Sum.of(values.tolist()) for name, values in measured.items()},
        counts={name: dict(counter) for name, counter in _counts(frames, points, captioned).items()},
        example={name: captioned[0][name] for name in ("sample_id", *CAPTION_FIELDS)} if captioned else {},
    )  # fmt: skip


def _motion(points: TrackRows) -> dict[str, float | None]:
    """Return duration, length, and RMS acceleration and jerk of the motion without perturbation."""
    clean_m = points.pose[:, :3] - points.drone_offset[:, :3]
    steps_s = np.diff(points.time_s)
    motion: dict[str, float | None] = {"duration_s": bounded(float(points.time_s[-1] - points.time_s[0]))}
    motion |= dict.fromkeys(("length_m", "accel_rms_mps2", "jerk_rms_mps3"))
    if np.isnan(clean_m).any():
        return motion
    motion["length_m"] = bounded(float(np.linalg.norm(np.diff(clean_m, axis=0), axis=1).sum()))
    for name, order in (("accel_rms_mps2", 2), ("jerk_rms_mps3", 3)):
        differences, steps = np.diff(clean_m, order, axis=0), steps_s[order - 1 :]
        if len(differences) and steps.min() >= LEAST_STEP_S:
            squares = (differences**2).sum(axis=1) / steps ** (2 * order)
            motion[name] = bounded(math.sqrt(float(squares.mean())))
    return motion


def action_class(action: Mapping[str, float]) -> str:
    """Return the class of an action: its greatest velocity, else its turn, else hover."""
    velocities = [action[name] for name in ("forward_mps", "left_mps", "up_mps")]
    if math.hypot(*velocities) >= HOVER_MPS:
        velocity, (positive, negative) = max(zip(velocities, MOVES, strict=True), key=lambda pair: abs(pair[0]))
        return negative if velocity < 0 else positive
    turn = action["yaw_rate_degps"]
    if abs(turn) < TURN_DEGPS:
        return "hover"
    return "turn left" if turn > 0 else "turn right"


def _counts(frames: TrackRows, points: TrackRows, captioned: list[dict[str, Any]]) -> dict[str, Counter[str]]:
    """Return `TrackCount.counts`; `captioned` are the rows with a caption."""
    rows, first = frames.rows, frames.rows[0]
    counts = {name: Counter(row[name] or "none" for row in captioned) for name in COUNTED}
    flags = counts["flags"] = Counter(name for row in rows for name in FLAGS if row[name])
    for language in LANGUAGES:
        flags[language] = sum(row[f"caption_{language}_reasoning_trace"] is not None for row in captioned)
    flags["legibility_known"] = sum(row["target_legible"] is not None for row in rows)
    labelled = [row for row in captioned if row["label"] is not None]
    flags["with_label"] = len(labelled)
    flags["decision_equals_label"] = sum(row["decision"] == row["label"] for row in labelled)
    counts["image_px"] = Counter({f"{first['width_px']} x {first['height_px']}": len(rows)})
    counts["action"] = Counter(action_class(row["action"]) for row in rows if row["action"] is not None)
    counts["values"] = Counter({name: sum(row[name] or 0 for row in captioned) for name in VALUE_COLUMNS})
    counts["step_s"] = Counter(f"{round(step, 3):g}" for step in np.diff(points.time_s).tolist())
    counts["confusion"] = Counter(f"{row['label'] or 'none'}{TAB}{row['decision'] or 'none'}" for row in captioned)
    counts["sky"] = Counter()
    for row in rows:
        sky = (row["weather"], row["time_of_day"])
        if any(sky):
            counts["sky"][TAB.join(preset_token(name) if name else "not known" for name in sky)] += 1
    events = (event for row in rows for event in (row["perturbation"] or {}).items())
    counts["events"] = Counter(f"{first['track']}{TAB}{event}{TAB}{text}" for event, text in events if text is not None)
    counts["states"] = Counter()
    if first["track"] == "perturbed":
        is_known = ~np.isnan(frames.drone_offset).any(axis=1)
        drone, target = frames.drone_offset[is_known], np.nan_to_num(frames.target_offset)[is_known]
        is_shifted = drone[:, :3].any(axis=1) | target.any(axis=1)
        is_turned = drone[:, 3:].any(axis=1)
        counts["states"] = Counter(STATES[index] for index in (is_shifted + 2 * is_turned).tolist())
    return counts


# --- a release --------------------------------------------------------------------------------------------------------


def numbers_of(tracks: Sequence[TrackCount], num_frames: int) -> Numbers:
    """Compute every number of the card and the statistics from the counts of at least one track; `num_frames` is the
    setting, the most frames of a track."""
    counts = {name: _sorted(total_of(tracks, name)) for name in tracks[0].counts}
    for name in ("town", "track", "fov"):
        frames = Counter[str]()
        for track in tracks:
            frames[getattr(track, name)] += track.frames
        counts[name] = _sorted(frames)
        counts[f"tracks_by_{name}"] = _sorted(Counter(getattr(track, name) for track in tracks))
    trajectories = dict[str, TrackCount]()  # one track of each: the clean one if it is released
    for track in sorted(tracks, key=lambda track: track.track != "clean"):
        trajectories.setdefault(track.trajectory, track)
    motions = [(track.motion["accel_rms_mps2"], track.motion["jerk_rms_mps3"]) for track in trajectories.values()]
    known = [(accel, jerk) for accel, jerk in motions if accel is not None and jerk is not None]
    scores = [smoothness_score(accel, jerk) for accel, jerk in known]
    within = sum(accel <= ACCEL_RMS_MAX_MPS2 and jerk <= JERK_RMS_MAX_MPS3 for accel, jerk in known)
    below = sum(score < REVIEW_BELOW for score in scores)
    counts["motion"] = {"known": len(known), "within": within, "score_below": below}
    sums = _sums(tracks, list(trajectories.values())) | {"smoothness": Sum.of(scores)}
    return Numbers(
        frames=sum(track.frames for track in tracks), flights=len(tracks), trajectories=len(trajectories),
        flights_shorter_than_num_frames=sum(track.frames < num_frames for track in tracks), counts=counts,
        spreads={name: values.spread() for name, values in sums.items()},
        example=next((track.example for track in tracks if track.example), {}),
    )  # fmt: skip


def _sums(tracks: Sequence[TrackCount], trajectories: Sequence[TrackCount]) -> dict[str, Sum]:
    """Return sums over the tracks, over means of the trajectories (tab:dist_stats), and over all frames."""
    motions = ("length_m", "accel_rms_mps2", "jerk_rms_mps3")
    means = ("clean_altitude_m", "clean_distance_m", "visibility")
    return {
        "track_frames": Sum.of(track.frames for track in tracks),
        "track_duration_s": Sum.of(track.motion["duration_s"] for track in tracks),
        **{f"trajectory_{name}": Sum.of(track.motion[name] for track in trajectories) for name in motions},
        **{f"trajectory_{name}": Sum.of(track.sums[name].spread().mean for track in trajectories) for name in means},
        **{name: Sum.all(track.sums[name] for track in tracks) for name in (*POOLED, *CAPTION_FIELDS)},
    }


def total_of(tracks: Iterable[TrackCount], name: str) -> Counter[str]:
    """Return the counts of a name over tracks."""
    total = Counter[str]()
    for track in tracks:
        total.update(track.counts[name])
    return total


def _sorted(counts: Counter[str]) -> Counts:
    """Return counts, largest first, then by name: the order does not depend on the rows' order."""
    return dict(sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])))
