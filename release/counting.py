"""What is counted of each track of a release: the numbers of the card, the statistics and their checks are sums of it.

Motion is the plan's: positions less the recorded offsets, over all points, so that a perturbed track counts as its
clean one does. Sums are of whole millionths, so they are exact and the same in any order.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.formats.weather import preset_token
from cosfly.geometry.axes import box_iou
from cosfly.geometry.coverage import Coverage
from release.columns import CAPTION_FIELDS, COUNTED, LANGUAGES, VALUE_COLUMNS
from release.flight_rows import FlightRows
from release.reading import bounded, read_tracks
from release.record import Shard, Spread

DIGITS = 4
MILLION = 1_000_000
LEAST_STEP_S = 1e-3  # between two points
SAME_FOV_DEG = 0.05
TAB = "\t"  # between the two names of a pair that is counted
# Columns of yes and no whose frames are counted.
FLAGS = ("is_perturbed", "target_in_view", "target_visible", "target_legible", "has_caption")
STATES = {  # shifted, turned
    (False, False): "unperturbed", (True, False): "position only", (False, True): "rotation only", (True, True): "full",
}  # fmt: skip
COLUMNS = (
    "sample_id", "track", "split", "walk", "pair", "style", "pace", "weather", "time_of_day", "frame_index", "width_px",
    "height_px", "fov_deg", "intrinsics", "pose", "drone_offset", "target", "target_offset", "target_heading_deg",
    "target_bbox", "target_mask_bbox", "visibility", "perturbation", "action", *FLAGS, *COUNTED, *VALUE_COLUMNS,
    *CAPTION_FIELDS,
)  # fmt: skip


class Sum(BaseModel):
    """Count, exact sums in whole millionths, least and greatest of values."""

    count: int = 0
    total: int = 0
    squares: int = 0
    low: int | None = None
    high: int | None = None

    @classmethod
    def of(cls, values: Iterable[float]) -> Sum:
        """Add up values; NaN is skipped. Raise InputError as `bounded`."""
        parts = [round(bounded(value) * MILLION) for value in values if not math.isnan(value)]
        ends = (min(parts), max(parts)) if parts else (None, None)
        return cls(
            count=len(parts), total=sum(parts), squares=sum(part * part for part in parts), low=ends[0], high=ends[1]
        )

    @classmethod
    def all(cls, sums: Iterable[Sum]) -> Sum:
        """Add up sums."""
        known = [one for one in sums if one.low is not None and one.high is not None]
        lows, highs = (
            [one.low for one in known if one.low is not None],
            [one.high for one in known if one.high is not None],
        )
        return cls(
            count=sum(one.count for one in known), total=sum(one.total for one in known),
            squares=sum(one.squares for one in known), low=min(lows, default=None), high=max(highs, default=None),
        )  # fmt: skip

    @property
    def mean(self) -> float | None:
        return self.spread().mean

    def spread(self) -> Spread:
        """Return the sums as the record has them."""
        if not self.count or self.low is None or self.high is None:
            return Spread(count=0, mean=None, std=None, min=None, max=None)
        std = math.sqrt(self.count * self.squares - self.total * self.total) / self.count
        values = (self.total / self.count, std, self.low, self.high)
        mean, std, low, high = (round(value / MILLION, DIGITS) for value in values)
        return Spread(count=self.count, mean=mean, std=std, min=low, max=high)


class TrackCount(BaseModel):
    """The counts of one track.

    frames_digest: Of the indices of its frames. fov_deg, focal_px: Of its first frame; zooms: Later ones have others.
    length_m, accel_rms_mps2, jerk_rms_mps3: Of its motion without perturbation, None where that is not known.
    sums: Over its frames. counts: Of the frames by a value of what the key names; pairs of values are joined by TAB.
    """

    name: str
    track: str
    split: str | None
    walk: str | None
    pair: str | None
    frames: int
    points: int
    frames_digest: str
    image_px: str
    fov_deg: float
    focal_px: float | None
    zooms: bool
    duration_s: float
    length_m: float | None
    accel_rms_mps2: float | None
    jerk_rms_mps3: float | None
    sums: dict[str, Sum]
    counts: dict[str, dict[str, int]]
    coverage: Coverage
    example: dict[str, str | None]

    @property
    def town(self) -> str:
        return self.name.split("/")[1]

    @property
    def trajectory(self) -> str:
        """What it shares with its other track."""
        return self.name.rpartition("/")[0]

    @property
    def captions(self) -> int:
        return self.counts["flags"].get("has_caption", 0)

    @property
    def fov(self) -> str:
        """Its field of view, degrees, or that it changes."""
        return "changing" if self.zooms else f"{self.fov_deg:g}"


def count_release(folder: Path, shards: Iterable[Shard]) -> list[TrackCount]:
    """Count all tracks of a release in one pass over its rows; no picture is read."""
    return [count_track(*track) for shard in shards for track in read_tracks(folder, shard, COLUMNS)]


def frames_digest(indices: np.ndarray) -> str:
    """Return a digest of the frame indices of a track, (n,)."""
    return hashlib.sha256(indices.astype(np.int64).tobytes()).hexdigest()


def count_track(frames: FlightRows, points: FlightRows) -> TrackCount:
    """Count the rows of a track, n frames. Raise InputError where a number is out of range."""
    first, rows = frames.rows[0], frames.rows
    offsets_m = frames.pose[:, :3] - frames.target_m
    clean_m = frames.pose[:, :3] - frames.drone_offset[:, :3] - frames.target_m + frames.target_offset
    heights_px = frames.mask_box[:, 3] - frames.mask_box[:, 1]
    seen = [
        box if share > 0.0 else np.full(4, np.nan) for box, share in zip(frames.box, frames.visibility, strict=True)
    ]
    boxes = np.array(seen).reshape(-1, 4)
    named = {name: [row[name] for row in rows if row[name] is not None] for name in ("style", "pace", "label")}
    weather = [
        [preset_token(row[name]) for row in rows if row[name] is not None] for name in ("weather", "time_of_day")
    ]
    told = np.column_stack([offsets_m, frames.numbers("target_heading_deg"), heights_px, frames.visibility])
    captioned = [row for row in rows if row["has_caption"]]
    fovs, both = frames.numbers("fov_deg"), zip(boxes, frames.mask_box, strict=True)
    measured = {
        "height_m": offsets_m[:, 2], "distance_m": np.linalg.norm(offsets_m, axis=1),
        "clean_altitude_m": clean_m[:, 2] + TARGET_HEIGHT_M, "clean_distance_m": np.linalg.norm(clean_m, axis=1),
        "visibility": frames.visibility, "width_px": boxes[:, 2] - boxes[:, 0], "height_px": boxes[:, 3] - boxes[:, 1],
    }  # fmt: skip
    texts = {name: [row[name] or "" for row in captioned] for name in CAPTION_FIELDS}
    return TrackCount(
        name=frames.name, **{name: first[name] for name in ("track", "split", "walk", "pair")}, frames=len(rows),
        points=len(points), frames_digest=frames_digest(frames.index),
        image_px=f"{first['width_px']} x {first['height_px']}", fov_deg=bounded(first["fov_deg"]),
        focal_px=first["intrinsics"] and bounded(first["intrinsics"]["fx"]),
        zooms=bool((np.abs(fovs - fovs[0]) > SAME_FOV_DEG).any()), **_motion(points),
        sums={
            **{name: Sum.of(values.tolist()) for name, values in measured.items()},
            "iou": Sum.of(box_iou(*pair) for pair in both if not np.isnan(pair).any()),
            **{name: Sum.of(float(len(text)) for text in own) for name, own in texts.items()},
        },
        counts=_counts(frames, points, captioned),
        coverage=Coverage.of(told, TARGET_HEIGHT_M, named["style"], named["pace"], named["label"], *weather),
        example={name: captioned[0][name] for name in ("sample_id", *CAPTION_FIELDS)} if captioned else {},
    )  # fmt: skip


def _motion(points: FlightRows) -> dict[str, float | None]:
    """Return duration, length, and RMS acceleration and jerk of the motion without perturbation."""
    clean_m, steps_s = points.pose[:, :3] - points.drone_offset[:, :3], np.diff(points.time_s)
    found: dict[str, float | None] = dict.fromkeys(("length_m", "accel_rms_mps2", "jerk_rms_mps3"))
    if not np.isnan(clean_m).any():
        found["length_m"] = bounded(float(np.linalg.norm(np.diff(clean_m, axis=0), axis=1).sum()))
        for name, order in (("accel_rms_mps2", 2), ("jerk_rms_mps3", 3)):
            differences, steps = np.diff(clean_m, order, axis=0), steps_s[order - 1 :]
            if len(differences) and steps.min() >= LEAST_STEP_S:
                squares = (differences**2).sum(axis=1) / steps ** (2 * order)
                found[name] = bounded(math.sqrt(float(squares.mean())))
    return {"duration_s": bounded(float(points.time_s[-1] - points.time_s[0])), **found}


def _counts(frames: FlightRows, points: FlightRows, captioned: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    rows, track = frames.rows, str(frames.rows[0]["track"])
    counts = {name: Counter(row[name] or "none" for row in captioned) for name in COUNTED}
    counts["flags"] = Counter(name for row in rows for name in FLAGS if row[name])
    counts["flags"]["action"] = sum(row["action"] is not None for row in rows)
    for language in LANGUAGES:
        counts["flags"][language] = sum(row[f"caption_{language}_reasoning_trace"] is not None for row in captioned)
    counts["flags"]["legible_told"] = sum(row["target_legible"] is not None for row in rows)
    counts["flags"]["with_label"] = sum(row["label"] is not None for row in captioned)
    agrees = (row["label"] is not None and row["decision"] == row["label"] for row in captioned)
    counts["flags"]["decision_equals_label"] = sum(agrees)
    counts["values"] = Counter({name: sum(row[name] or 0 for row in captioned) for name in VALUE_COLUMNS})
    counts["step_s"] = Counter(f"{step:.3f}" for step in np.diff(points.time_s).tolist())
    counts["confusion"] = Counter(f"{row['label'] or 'none'}{TAB}{row['decision'] or 'none'}" for row in captioned)
    skies = ((row["weather"], row["time_of_day"]) for row in rows)
    counts["sky"] = Counter(TAB.join(name or "" for name in sky) for sky in skies if sky != (None, None))
    events = (event for row in rows for event in (row["perturbation"] or {}).items())
    counts["events"] = Counter(f"{event}{TAB}{outcome}" for event, outcome in events if outcome is not None)
    counts["states"] = Counter()
    if track == "perturbed":
        offsets, walked = frames.drone_offset, np.nan_to_num(frames.target_offset)
        shifts_m, turns_deg = (np.abs(part).max(axis=1) for part in (offsets[:, :3], offsets[:, 3:]))
        is_known, is_shifted = ~np.isnan(shifts_m), (shifts_m > 0) | (np.abs(walked).max(axis=1) > 0)
        pairs = zip(is_shifted[is_known].tolist(), (turns_deg[is_known] > 0).tolist(), strict=True)
        counts["states"].update(STATES[pair] for pair in pairs)
    return {name: dict(counter) for name, counter in counts.items()}


def total_of(tracks: Iterable[TrackCount], name: str) -> Counter[str]:
    """Return the counts of a name over tracks."""
    total = Counter[str]()
    for track in tracks:
        total.update(track.counts[name])
    return total
