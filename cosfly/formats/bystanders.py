"""`others.json`, the second product of step 3: people who move during a pedestrian trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosfly.formats.columns import as_columns, column, columns, read_items, records, rounded, text_id, write_items
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.runtime.errors import InputError, shown
from cosfly.runtime.json_io import FileFormat

BYSTANDERS_FILE = "others.json"
BYSTANDERS_FORMAT = FileFormat("cosfly.others", "1.0", "others")
KIND = "Pedestrians"
PERSON_RADIUS_M = 0.3  # of the disc on the ground that covers a person


@dataclass(frozen=True)
class Bystander:
    """A pedestrian next to the target, at n times."""

    positions_m: np.ndarray  # (n, 3), on the ground below the middle
    headings_rad: np.ndarray  # (n,)
    is_look_alike: bool = False  # a hard distractor, which differs from the target in one garment

    @property
    def centers_m(self) -> np.ndarray:
        """Middles of the box, (n, 3)."""
        return self.positions_m + np.array([0.0, 0.0, PERSON_HALF_EXTENTS_M[2]])

    def gap_to_person_m(self, person_m: np.ndarray) -> float:
        """Return the gap between its disc at the first time and a person at (2 or 3,) m; negative: overlap."""
        return float(np.linalg.norm(self.positions_m[0, :2] - person_m[:2])) - 2.0 * PERSON_RADIUS_M

    def at(self, i: int) -> Bystander:
        """Return the bystander at one time."""
        return replace(self, positions_m=self.positions_m[i : i + 1], headings_rad=self.headings_rad[i : i + 1])

    def until(self, end: int) -> Bystander:
        """Return the bystander before time `end`."""
        return replace(self, positions_m=self.positions_m[:end], headings_rad=self.headings_rad[:end])

    def every(self, stride: int) -> Bystander:
        """Return the bystander at every `stride`-th time."""
        return replace(self, positions_m=self.positions_m[::stride], headings_rad=self.headings_rad[::stride])

    def as_json(self) -> dict:
        flags = {"look_alike": True} if self.is_look_alike else {}
        yaw = rounded(np.degrees(self.headings_rad), 3)
        return {"kind": KIND, **flags, **as_columns(self.positions_m, "xyz"), "yaw": yaw}

    @classmethod
    def from_json(cls, record: dict, where: str) -> Bystander:
        if (kind := record.get("kind")) != KIND:
            what = "the kind of the bystander is unknown"
            fix = "make the pedestrian trajectories again"
            raise InputError(what, where=f"{where}.kind", got=shown(kind), expected=KIND, fix=fix)
        positions_m = columns(record, "xyz", where)
        yaw = column(record, "yaw", where, len(positions_m))
        return cls(positions_m, np.radians(yaw), record.get("look_alike") is True)


@dataclass(frozen=True)
class Bystanders:
    """The bystanders of one pedestrian trajectory, at its times; the index in the list identifies each."""

    path_id: str
    others: list[Bystander]

    def as_json(self) -> dict:
        return {"id": self.path_id, "others": [other.as_json() for other in self.others]}

    @classmethod
    def from_json(cls, record: dict, where: str) -> Bystanders:
        entries = records(record, "others", where)
        bystanders = [Bystander.from_json(entry, f"{where}.others[{i}]") for i, entry in enumerate(entries)]
        if len(lengths := {len(bystander.positions_m) for bystander in bystanders}) > 1:
            what = "the bystanders have different numbers of positions"
            got = f"{min(lengths)} to {max(lengths)} positions"
            raise InputError(what, where=f"{where}.others", got=got, expected="the same number for all bystanders")
        return cls(text_id(record, where), bystanders)


def write_bystanders(path: Path, companions: list[Bystanders], header: dict) -> None:
    """Write `others.json`; `header` holds the map's name, the seed and the time step."""
    write_items(path, BYSTANDERS_FORMAT, "paths", companions, header)


def read_bystanders(path: Path) -> list[Bystanders]:
    """Read `others.json`."""
    return read_items(path, BYSTANDERS_FORMAT, "paths", Bystanders.from_json)
