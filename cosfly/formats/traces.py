"""`drone_trace.json`, the product of step 4: one drone trajectory for each pedestrian trajectory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from cosfly.formats.columns import (
    ANGLES,
    POSE,
    XYZ,
    as_columns,
    column,
    columns,
    is_number,
    read_items,
    rounded,
    step_field,
    text_id,
    times,
    write_items,
)
from cosfly.formats.pedestrian_paths import PLAIN_PACE, pace_field, pace_of
from cosfly.formats.segments import Mission, Segment, flown_as_json, read_flown
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import MISSING, FileFormat, read_object, validated

TRACE_FORMAT = FileFormat("cosfly.drone_trace", "1.0", "drone traces")
ARRAYS = ("time_s", "positions_m", "rotations_deg", "targets_m", "visibility")
UNCHECKED = ("metrics", "solver", "drop_reason", "instead_of", "not_held")
MOST_TRAJECTORIES = 1_000_000  # of a run


class _Part(BaseModel):
    number: int = Field(strict=True, ge=0, lt=MOST_TRAJECTORIES)


@dataclass(frozen=True)
class Excerpt:
    """The whole trajectory from which a part is taken; clothes, stride and weather are drawn for the whole one."""

    path_id: str
    number: int  # its index in its run
    before_m: np.ndarray  # (m, 3), its tracked points up to the first of the part, m >= 1

    def as_json(self) -> dict:
        return {"id": self.path_id, "number": self.number, "before": [rounded(p, 4) for p in self.before_m]}

    @classmethod
    def from_json(cls, record: Any, where: str) -> Excerpt | None:
        if record is None:
            return None
        number = validated(_Part, record, where).number
        return cls(text_id(record, where), number, column(record, "before", where, None, 3))


@dataclass(frozen=True)
class DroneTrace:
    """One drone trajectory, the product of stage 4; n points at the pedestrian's time stamps."""

    path_id: str
    planner: str
    time_s: np.ndarray  # (n,)
    positions_m: np.ndarray  # (n, 3) of the drone
    rotations_deg: np.ndarray  # (n, 3) pitch, yaw, roll of the camera
    targets_m: np.ndarray  # (n, 3) hip of the pedestrian
    visibility: np.ndarray  # (n,) five-ray fraction in [0, 1]
    clearances_m: np.ndarray  # (n,) least signed distance to an obstacle on the straight way to the next point
    metrics: dict = field(default_factory=dict)  # JSON-able
    solver: dict = field(default_factory=dict)  # JSON-able facts of the planner
    drop_reason: str | None = None  # why the prefilter (sec:step6) drops it; None: it is rendered
    segments: tuple[Segment, ...] = ()  # styles of its parts; empty if the drone follows throughout
    mission: Mission | None = None
    instead_of: str | None = None  # the style that the map did not permit, with the reason
    not_held: str | None = None  # the requested and the flown value
    pace: str = PLAIN_PACE  # of the pedestrian trajectory
    part_of: Excerpt | None = None

    @property
    def is_flown(self) -> bool:
        """Whether it is an episode of the closed loop, which may end before its pedestrian trajectory."""
        return "ended" in self.solver

    def drawn_as(self, number: int) -> Excerpt:
        """Return the excerpt that determines its appearance as trajectory `number` of a run."""
        return self.part_of or Excerpt(self.path_id, number, self.targets_m[:1])

    def until(self, end: int, begin: int = 0) -> DroneTrace:
        """Return the trajectory from point `begin` to before point `end`, without segments and mission."""
        cut = {name: getattr(self, name)[begin:end] for name in (*ARRAYS, "clearances_m")}
        return replace(self, **cut, segments=(), mission=None)

    def part(self, number: int, begin: int, end: int) -> DroneTrace:
        """Return the points from `begin` to before `end`, which look as they do in trajectory `number` of a run."""
        return replace(self.until(end, begin), part_of=Excerpt(self.path_id, number, self.targets_m[: begin + 1]))

    def every(self, stride: int) -> DroneTrace:
        """Return every `stride`-th point; each clearance is the least one up to the next point."""
        if stride == 1:
            return self

        def new_index(frame: int) -> int:
            return -(-frame // stride)  # rounded up

        points = np.arange(0, len(self.time_s), stride)
        parts = [replace(part, begin=new_index(part.begin), end=new_index(part.end)) for part in self.segments]
        mission = self.mission
        if mission is not None:
            home_frame = new_index(mission.home_frame)
            mission = replace(mission, at_frame=new_index(mission.at_frame), home_frame=home_frame)
        return replace(
            self,
            **{name: getattr(self, name)[points] for name in ARRAYS},
            clearances_m=np.minimum.reduceat(self.clearances_m, points),
            segments=tuple(part for part in parts if part.begin < part.end),
            mission=mission,
        )

    def as_json(self) -> dict:
        return {
            "id": self.path_id,
            "planner": self.planner,
            **pace_field(self.pace),
            "drop_reason": self.drop_reason,
            **flown_as_json(self.segments, self.mission),
            **{name: text for name in ("instead_of", "not_held") if (text := getattr(self, name))},
            **({} if self.part_of is None else {"part_of": self.part_of.as_json()}),
            "metrics": self.metrics,
            "solver": self.solver,
            "t": rounded(self.time_s, 4),
            "drone": as_columns(np.hstack([self.positions_m, self.rotations_deg]), POSE),
            "target": as_columns(self.targets_m, XYZ),
            "visibility": rounded(self.visibility, 4),
            "clearance": rounded(self.clearances_m, 4),
        }

    @classmethod
    def from_json(cls, record: dict, where: str) -> DroneTrace:
        time_s = times(record, where)
        groups: list[np.ndarray] = []
        for group, names in (("drone", XYZ), ("drone", ANGLES), ("target", XYZ)):
            if not isinstance(record.get(group), dict):
                raise InputError(MISSING, where=f"{where}.{group}", expected="an object with lists of numbers")
            groups.append(columns(record[group], names, f"{where}.{group}", len(time_s)))
        visibility = column(record, "visibility", where, len(time_s))
        clearances_m = column(record, "clearance", where, len(time_s))
        segments, mission = read_flown(record, len(time_s), where)
        return cls(
            path_id=text_id(record, where),
            planner=str(record.get("planner", "")),
            time_s=time_s,
            positions_m=groups[0],
            rotations_deg=groups[1],
            targets_m=groups[2],
            visibility=visibility,
            clearances_m=clearances_m,
            segments=segments,
            mission=mission,
            pace=pace_of(record, where),
            part_of=Excerpt.from_json(record.get("part_of"), f"{where}.part_of"),
            **{name: record[name] for name in UNCHECKED if name in record},
        )


def write_traces(path: Path, traces: list[DroneTrace], header: dict) -> None:
    """Write `drone_trace.json`; header: the map's name, planner settings and seed."""
    write_items(path, TRACE_FORMAT, "traces", traces, header | step_field(traces))


def read_traces(path: Path) -> list[DroneTrace]:
    """Read `drone_trace.json`; raises as `read_items`."""
    return read_items(path, TRACE_FORMAT, "traces", DroneTrace.from_json)


def read_yaw_rate_max(path: Path, default_degps: float) -> float:
    """Return the limit of yaw rate in the settings of `drone_trace.json`, deg/s; the default if they have none."""
    settings = read_object(path, what=TRACE_FORMAT.what).get("settings")
    limit: Any = settings.get("yaw_rate_max_degps") if isinstance(settings, dict) else None
    return float(limit) if is_number(limit) else default_degps
