"""Counts over the rows of a release, a row group at a time: what the tables are made of. Memory holds a few numbers a
flight.

Motion is that of the plan: positions less the recorded offsets, so that a perturbed flight counts as its clean twin
does.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosfly.formats.captions import FIELDS
from cosfly.formats.pedestrian_paths import TARGET_HEIGHT_M
from cosfly.geometry.axes import box_iou
from release.card.numbers import Place3, Sum, bounded, clean_place
from release.columns import BOX, LANGUAGES, PLACE, POINT, POSE

SAME_FOV_DEG = 0.05
LEAST_STEP_S = 1e-3  # between two frames
STATES_OF = {  # shifted, turned
    (False, False): "unperturbed", (True, False): "position only", (False, True): "rotation only", (True, True): "full",
}  # fmt: skip


@dataclass
class FlightSums:
    """Sums over the frames of one flight. fov_deg, focal_px: of its first frame; zooms: later ones have others.

    path_m: the way of the clean motion through its frames. accel, jerk: squares of the differences of four frames in a
    row, and how many. tail: the last frames in a row, index, s, place.
    """

    track: str
    town: str
    split: str
    walk: str
    fov_deg: float
    focal_px: float | None
    zooms: bool = False
    frames: int = 0
    captions: int = 0
    path_m: float = 0.0
    is_known: bool = True
    accel: tuple[float, int] = (0.0, 0)
    jerk: tuple[float, int] = (0.0, 0)
    tail: list[tuple[int, float, Place3]] = field(default_factory=list)
    height: Sum = field(default_factory=Sum)
    distance: Sum = field(default_factory=Sum)
    visibility: Sum = field(default_factory=Sum)
    width_px: Sum = field(default_factory=Sum)  # of the projected box, where the person is seen
    height_px: Sum = field(default_factory=Sum)
    iou: Sum = field(default_factory=Sum)

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a frame."""
        self.frames += 1
        self.zooms |= abs(bounded(row["fov_deg"]) - self.fov_deg) > SAME_FOV_DEG
        self.captions += row["has_caption"]
        place, time_s = clean_place(row), bounded(row["time_s"])
        if place is None:
            self.is_known, self.tail = False, []
        else:
            self._move(row["frame_index"], time_s, place)
            target = clean_target(row)
            if target is not None:
                self.height.add(place[2] - target[2] + TARGET_HEIGHT_M)
                self.distance.add(math.dist(place, target))
        seen = row["visibility"]
        if seen is not None:
            self.visibility.add(seen)
        if seen is not None and seen > 0.0 and row["target_bbox"] is not None:
            box = [row["target_bbox"][name] for name in BOX]
            self.width_px.add(box[2] - box[0])
            self.height_px.add(box[3] - box[1])
            if row["target_mask_bbox"] is not None:
                self.iou.add(box_iou(np.array(box), np.array([row["target_mask_bbox"][name] for name in BOX])))

    def _move(self, index: int, time_s: float, place: Place3) -> None:
        place = (bounded(place[0]), bounded(place[1]), bounded(place[2]))
        if self.tail:
            self.path_m += math.dist(self.tail[-1][2], place)
        if self.tail and index != self.tail[-1][0] + 1:
            self.tail = []
        self.tail = [*self.tail[-3:], (index, time_s, place)]
        step_s = time_s - self.tail[-2][1] if len(self.tail) > 1 else 0.0
        if step_s < LEAST_STEP_S:
            return
        p = [known[2] for known in self.tail]
        if len(p) >= 3:
            square = sum((a - 2 * b + c) ** 2 for a, b, c in zip(p[-3], p[-2], p[-1], strict=True)) / step_s**4
            self.accel = (self.accel[0] + square, self.accel[1] + 1)
        if len(p) == 4:
            square = sum((d - 3 * c + 3 * b - a) ** 2 for a, b, c, d in zip(*p, strict=True)) / step_s**6
            self.jerk = (self.jerk[0] + square, self.jerk[1] + 1)

    @property
    def accel_rms_mps2(self) -> float | None:
        return math.sqrt(self.accel[0] / self.accel[1]) if self.accel[1] else None

    @property
    def jerk_rms_mps3(self) -> float | None:
        return math.sqrt(self.jerk[0] / self.jerk[1]) if self.jerk[1] else None


def clean_target(row: Mapping[str, Any]) -> Place3 | None:
    """Return where the person would be without the frame's perturbation, m; None where that is not known."""
    target, offset = row["target"], row["target_offset"]
    if target is None or offset is None:
        return None
    x, y, z = (target[axis] - offset[axis] for axis in POINT)
    return x, y, z


@dataclass
class Counts:
    """All counts of a release."""

    frames: int = 0
    flights: dict[tuple[str, ...], FlightSums] = field(default_factory=dict)  # by PLACE
    image_px: Counter[str] = field(default_factory=Counter)
    step_s: Counter[float] = field(default_factory=Counter)
    last: tuple[tuple[str, ...], int, float] | None = None
    decisions: Counter[str] = field(default_factory=Counter)
    labels: Counter[str] = field(default_factory=Counter)
    confusion: Counter[tuple[str, str]] = field(default_factory=Counter)
    verdicts: Counter[tuple[str, str]] = field(default_factory=Counter)  # verdict, track
    repairs: Counter[str] = field(default_factory=Counter)
    lengths: dict[tuple[str, str], Sum] = field(default_factory=lambda: defaultdict(Sum))  # language, field
    weather: Counter[tuple[str | None, str | None]] = field(default_factory=Counter)
    events: Counter[tuple[str, str, str]] = field(default_factory=Counter)  # track, event, outcome
    states: Counter[str] = field(default_factory=Counter)  # of perturbed flights: which of the two offsets are not zero

    def add(self, row: Mapping[str, Any]) -> None:
        """Count a row; rows of a flight come one after the other."""
        self.frames += 1
        place = tuple(row[name] for name in PLACE)
        if place not in self.flights:
            focal_px = bounded(row["intrinsics"]["fx"]) if row["intrinsics"] else None
            names = {name: row[name] for name in ("track", "town", "split", "walk")}
            self.flights[place] = FlightSums(**names, fov_deg=bounded(row["fov_deg"]), focal_px=focal_px)
        self.flights[place].add(row)
        self.image_px[f"{row['width_px']} x {row['height_px']} px"] += 1
        if self.last is not None and self.last[:2] == (place, row["frame_index"] - 1):
            self.step_s[round(row["time_s"] - self.last[2], 3)] += 1
        self.last = (place, row["frame_index"], row["time_s"])
        self.weather[row["weather"], row["time_of_day"]] += 1
        self._perturbed(row)
        if row["has_caption"]:
            self._caption(row)

    def _perturbed(self, row: Mapping[str, Any]) -> None:
        for event, outcome in (row["perturbation"] or {}).items():
            if outcome is not None:
                self.events[row["track"], event, outcome] += 1
        offset, walker = row["drone_offset"], row["target_offset"]
        if row["track"] == "perturbed" and offset is not None:
            shift_m, turn_deg = (math.hypot(*(offset[name] for name in names)) for names in (POINT, POSE[3:]))
            walker_m = 0.0 if walker is None else math.hypot(*(walker[name] for name in POINT))
            is_shifted, is_turned = shift_m > 0.0 or walker_m > 0.0, turn_deg > 0.0
            self.states[STATES_OF[is_shifted, is_turned]] += 1

    def _caption(self, row: Mapping[str, Any]) -> None:
        decision, label, verdict = (row[name] or "none" for name in ("decision", "label", "verdict"))
        self.decisions[decision] += 1
        self.labels[label] += 1
        self.confusion[label, decision] += 1
        self.verdicts[verdict, row["track"]] += 1
        self.repairs[row["repair_strategy"] or "none: the first answer was accepted"] += 1
        for language in LANGUAGES:
            for name in FIELDS[:2]:
                self.lengths[language, name].add(len(row[f"caption_{language}_{name}"] or ""))
