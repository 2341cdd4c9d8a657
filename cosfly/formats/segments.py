"""Styles of a flight's parts, and the mission that ended it: kept in `drone_trace.json` and `trajectory.json`.

A file without them holds a flight that follows the walker, as the paper's do, and no mission.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

from pydantic import Field

from cosfly.formats.columns import is_number
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import validated

FOLLOW = "follow"  # the style where nothing else is said
MISSION_KINDS = ("geofence", "battery", "time_over")
Frame = Annotated[int, Field(strict=True, ge=0)]


@dataclass(frozen=True)
class Segment:
    """Frames [begin, end) of one style. keeps_sight: whether they are judged by how much they see of the target."""

    style: str
    begin: Frame
    end: Frame
    keeps_sight: bool = True


@dataclass(frozen=True)
class Mission:
    """An order that ends a pursuit. kind: of MISSION_KINDS, which the drone knows from `at_frame` on.

    From `at_frame` the drone breaks off, from `home_frame` it flies home, to home_m (x, y, z).
    """

    kind: str
    at_frame: int
    home_frame: int
    home_m: tuple[float, float, float]

    def order_at(self, frame: int) -> str | None:
        """Return the decision that stands as an order at a frame, None before the first."""
        return None if frame < self.at_frame else "break_off" if frame < self.home_frame else "return_to_home"

    def as_json(self) -> dict:
        home = dict(zip("xyz", self.home_m, strict=True))
        return {"kind": self.kind, "at_frame": self.at_frame, "home_frame": self.home_frame, "home": home}


def flown_as_json(segments: tuple[Segment, ...], mission: Mission | None) -> dict:
    """Return the keys that a record has of them: none for a flight that follows from end to end."""
    record: dict = {"segments": [asdict(part) for part in segments]} if segments else {}
    return record | ({"mission": mission.as_json()} if mission is not None else {})


def mirrored(mission: Mission | None) -> Mission | None:
    """Change a mission between right-handed and CARLA axes."""
    if mission is None:
        return None
    x, y, z = mission.home_m
    return replace(mission, home_m=(x, -y, z))


def read_flown(record: dict, num_frames: int, where: str) -> tuple[tuple[Segment, ...], Mission | None]:
    """Read what `flown_as_json` gives. where: what stands in a message before the names of the two keys."""
    segments, mission = (record.get(name) for name in ("segments", "mission"))
    return _segments(segments, num_frames, f"{where}segments"), _mission(mission, num_frames, f"{where}mission")


def _segments(value: Any, num_frames: int, where: str) -> tuple[Segment, ...]:
    segments = () if value is None else validated(tuple[Segment, ...], value, where)
    for k, part in enumerate(segments):
        for name in ("begin", "end"):
            _frame(vars(part), name, num_frames, f"{where}[{k}]")
    return segments


def _mission(value: Any, num_frames: int, where: str) -> Mission | None:
    if value is None:
        return None
    home = value.get("home") if isinstance(value, dict) else None
    if not isinstance(home, dict) or not all(is_number(home.get(axis)) for axis in "xyz"):
        raise InputError("not a mission", where=f"{where}.home", got=repr(home)[:60], expected="numbers x, y, z")
    if value.get("kind") not in MISSION_KINDS:
        raise InputError(
            "unknown kind", where=f"{where}.kind", got=repr(value.get("kind"))[:60], expected=", ".join(MISSION_KINDS)
        )
    at, home_frame = (_frame(value, name, num_frames, where) for name in ("at_frame", "home_frame"))
    return Mission(value["kind"], at, home_frame, (float(home["x"]), float(home["y"]), float(home["z"])))


def _frame(group: dict, name: str, num_frames: int, where: str) -> int:
    value = group.get(name)
    if type(value) is not int or not 0 <= value <= num_frames:
        raise InputError("not a frame", where=f"{where}.{name}", got=repr(value)[:60], expected=f"0 to {num_frames}")
    return value
