"""`path.json`, the product of step 3: one pedestrian trajectory for each path id."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from cosfly.formats.columns import (
    as_columns,
    column,
    columns,
    read_items,
    rounded,
    step_field,
    text_id,
    times,
    write_items,
)
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.json_io import FileFormat
from cosfly.runtime.seeding import draw_to_quota, rng_for

# The tracked person: an axis-aligned box round the hip point, which is the target's position everywhere.
PERSON_HALF_EXTENTS_M = (0.3, 0.3, 0.9)
TARGET_HEIGHT_M = 0.9  # hip height over the ground: the box stands on it

PLAIN_PACE = "walk"  # files do not name it

PATHS_FORMAT = FileFormat("cosfly.path", "1.0", "pedestrian paths")


@dataclass(frozen=True)
class PedestrianTrajectory:
    """One pedestrian trajectory, the product of stage 3."""

    path_id: str
    polyline_m: np.ndarray  # (k, 2), the A* route, adapted to the pace
    time_s: np.ndarray  # (n,), even steps from 0
    positions_m: np.ndarray  # (n, 3), feet on the ground
    speeds_mps: np.ndarray  # (n,), 0 at a stop
    pace: str = PLAIN_PACE  # one of speed_model.PACES

    def as_json(self) -> dict:
        return {
            "id": self.path_id,
            **pace_field(self.pace),
            "start": rounded(self.polyline_m[0]),
            "goal": rounded(self.polyline_m[-1]),
            "length_m": round(float(np.linalg.norm(np.diff(self.polyline_m, axis=0), axis=1).sum()), 3),
            "polyline": [rounded(p, 4) for p in self.polyline_m],
            "t": rounded(self.time_s, 4),
            **as_columns(self.positions_m, "xyz"),
            "speed": rounded(self.speeds_mps, 4),
        }

    @classmethod
    def from_json(cls, record: dict, where: str) -> PedestrianTrajectory:
        time_s = times(record, where)
        polyline = column(record, "polyline", where, None, 2)
        positions = columns(record, "xyz", where, len(time_s))
        speeds = column(record, "speed", where, len(time_s))
        return cls(text_id(record, where), polyline, time_s, positions, speeds, pace_of(record, where))


def walk_id(number: int) -> str:
    """Return the id of a map's pedestrian trajectory, counted from 0."""
    return f"path_{number:05d}"


def paces_of(num_walks: int, shares: Mapping[str, float], seed: int) -> list[str]:
    """Draw the paces of a map's trajectories by quota; later ones do not change earlier ones."""
    return [*islice(draw_to_quota(shares, rng_for(seed, "pedestrians", "paces")), num_walks)]


def pace_field(pace: str) -> dict[str, str]:
    """Return the field of a pace in a trajectory's record."""
    return {} if pace == PLAIN_PACE else {"pace": pace}


def pace_of(record: dict, where: str) -> str:
    """Read the pace of a record, PLAIN_PACE where it names none."""
    pace = record.get("pace", PLAIN_PACE)
    if not isinstance(pace, str):
        raise InputError("the pace is not text", where=f"{where}.pace", got=shown(pace), expected="the name of a pace")
    return pace


def write_paths(path: Path, paths: list[PedestrianTrajectory], header: dict) -> None:
    """Write `path.json`; header: the map's name, the seed and the settings."""
    write_items(path, PATHS_FORMAT, "paths", paths, header | step_field(paths))


def read_paths(path: Path) -> list[PedestrianTrajectory]:
    """Read `path.json`."""
    return read_items(path, PATHS_FORMAT, "paths", PedestrianTrajectory.from_json)
