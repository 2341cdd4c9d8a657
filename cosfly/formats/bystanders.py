"""`others.json`, the second product of step 3: people and cars that move while a walk lasts, and who keeps clear of
whom."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosfly.formats.columns import column, read_items, records, rounded, text_id, write_items
from cosfly.formats.kinds import KINDS
from cosfly.formats.pedestrian_paths import PERSON_HALF_EXTENTS_M
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import FileFormat

OTHERS_FILE = "others.json"
OTHERS_FORMAT = FileFormat("cosfly.others", "1.0", "others")


@dataclass(frozen=True)
class Build:
    """Of what size one kind is: half_extents_m of its box, x along its heading; on the ground it lies within discs of
    one radius, their middles at disc_offsets_m along the heading.
    """

    half_extents_m: tuple[float, float, float]
    disc_radius_m: float
    disc_offsets_m: tuple[float, ...]


# Two people are never nearer than 0.6 m from middle to middle. Three discs of 1.2 m cover a car of 4.4 m by 1.8 m.
BUILDS = {
    "Pedestrians": Build(PERSON_HALF_EXTENTS_M, 0.3, (0.0,)),
    "Car": Build((2.2, 0.9, 0.75), 1.2, (-1.45, 0.0, 1.45)),
}


@dataclass(frozen=True)
class Bystander:
    """One who moves beside the target: kind of BUILDS; positions_m (n, 3) on the ground below its middle; headings_rad
    (n,). A look-alike wears what the target does but for one thing."""

    kind: str
    positions_m: np.ndarray
    headings_rad: np.ndarray
    is_look_alike: bool = False

    @property
    def build(self) -> Build:
        return BUILDS[self.kind]

    @property
    def kind_number(self) -> int:
        return KINDS[self.kind]

    @property
    def centers_m(self) -> np.ndarray:
        """Middles of the box, (n, 3)."""
        return self.positions_m + np.array([0.0, 0.0, self.build.half_extents_m[2]])

    @property
    def discs_m(self) -> np.ndarray:
        """Middles of the discs on the ground, (n, d, 2)."""
        ahead = np.stack([np.cos(self.headings_rad), np.sin(self.headings_rad)], axis=1)
        return self.positions_m[:, None, :2] + np.array(self.build.disc_offsets_m)[None, :, None] * ahead[:, None]

    def gap_to_person_m(self, person_m: np.ndarray) -> float:
        """Room between the discs and a person's at a place, (2 or more,), negative where they overlap; of one time."""
        apart = np.linalg.norm(self.discs_m[0] - person_m[:2], axis=1).min()
        return float(apart) - self.build.disc_radius_m - BUILDS["Pedestrians"].disc_radius_m

    def at(self, i: int) -> Bystander:
        """Return the same at one time alone."""
        return replace(self, positions_m=self.positions_m[i : i + 1], headings_rad=self.headings_rad[i : i + 1])

    def every(self, stride: int) -> Bystander:
        """Return the same at every so many times."""
        return replace(self, positions_m=self.positions_m[::stride], headings_rad=self.headings_rad[::stride])

    def as_json(self) -> dict:
        columns = {axis: rounded(self.positions_m[:, k], 4) for k, axis in enumerate("xyz")}
        told = {"look_alike": True} if self.is_look_alike else {}
        return {"kind": self.kind, **told, **columns, "yaw": rounded(np.degrees(self.headings_rad), 3)}

    @classmethod
    def from_json(cls, record: dict, where: str) -> Bystander:
        kind = record.get("kind")
        if not isinstance(kind, str) or kind not in BUILDS:
            raise InputError("no such kind", where=f"{where}.kind", got=repr(kind)[:60], expected=" or ".join(BUILDS))
        x = column(record, "x", where)
        y, z, yaw = (column(record, name, where, len(x)) for name in ("y", "z", "yaw"))
        return cls(kind, np.stack([x, y, z], axis=1), np.radians(yaw), record.get("look_alike") is True)


@dataclass(frozen=True)
class Bystanders:
    """The others of one walk, at its times. Their number in the list is who they are."""

    path_id: str
    others: list[Bystander]

    def as_json(self) -> dict:
        return {"id": self.path_id, "others": [other.as_json() for other in self.others]}

    @classmethod
    def from_json(cls, record: dict, where: str) -> Bystanders:
        lines = records(record, "others", where)
        others = [Bystander.from_json(line, f"{where}.others[{i}]") for i, line in enumerate(lines)]
        if len({len(other.positions_m) for other in others}) > 1:
            raise InputError("columns of different lengths", where=f"{where}.others")
        return cls(text_id(record, where), others)


def gaps_m(one: Bystander, two: Bystander) -> np.ndarray:
    """How far the discs of two are apart in each step of time, (n - 1,) m, negative where they overlap.

    Between two times both go straight on, so the nearest place within a step is that of the origin to a segment.
    """
    apart = one.discs_m[:, :, None] - two.discs_m[:, None]  # (n, d, e, 2)
    start, along = apart[:-1], np.diff(apart, axis=0)
    squared = np.maximum((along**2).sum(axis=-1), 1e-12)
    share = np.clip(-(start * along).sum(axis=-1) / squared, 0.0, 1.0)
    nearest = np.linalg.norm(start + share[..., None] * along, axis=-1)
    return nearest.min(axis=(1, 2)) - one.build.disc_radius_m - two.build.disc_radius_m


def distances_to_boxes_m(points_m: np.ndarray, other: Bystander) -> np.ndarray:
    """How far a point is from the box of an other at each time, (n,) m, 0 inside; points_m: (n, 3)."""
    offset = points_m - other.centers_m
    cos, sin = np.cos(other.headings_rad), np.sin(other.headings_rad)
    local = np.stack([offset[:, 0] * cos + offset[:, 1] * sin, offset[:, 1] * cos - offset[:, 0] * sin, offset[:, 2]])
    return np.linalg.norm(np.maximum(np.abs(local) - np.array(other.build.half_extents_m)[:, None], 0.0), axis=0)


def write_bystanders(path: Path, companions: list[Bystanders], header: dict) -> None:
    """Write `others.json`; `header` holds the map's name, the seed and the time step."""
    write_items(path, OTHERS_FORMAT, "paths", companions, header)


def read_bystanders(path: Path) -> list[Bystanders]:
    """Read `others.json`; raises as `read_items`."""
    return read_items(path, OTHERS_FORMAT, "paths", Bystanders.from_json)
