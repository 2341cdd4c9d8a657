"""The manoeuvre styles of a trajectory and the mission that ends it, in `drone_trace.json` and `trajectory.json`.

A trajectory without them, as in the paper, follows the target from beginning to end.
"""

from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, BeforeValidator, Field

from cosfly.formats.columns import LARGEST
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import validated

FOLLOW = "follow"  # the default style
MissionKind = Literal["geofence", "battery", "time_over"]
MISSION_KINDS: tuple[MissionKind, ...] = get_args(MissionKind)
Frame = Annotated[int, Field(strict=True, ge=0)]
Coordinate = Annotated[float, Field(strict=True, ge=-LARGEST, le=LARGEST)]


@dataclass(frozen=True)
class Segment:
    """Frames [begin, end) of one manoeuvre style."""

    style: str
    begin: Frame
    end: Frame
    keeps_sight: bool = True  # whether the visibility of the target counts in them


def _coordinates(value: Any) -> list:
    if not isinstance(value, dict):
        raise ValueError("the value must be an object with the fields x, y and z")
    return [value.get(axis) for axis in "xyz"]


Home = Annotated[tuple[Coordinate, Coordinate, Coordinate], BeforeValidator(_coordinates), Field(alias="home")]


@dataclass(frozen=True)
class Mission:
    """An order that ends the tracking: from `at_frame` the drone breaks off, from `home_frame` it flies to `home_m`."""

    kind: MissionKind
    at_frame: Frame
    home_frame: Frame
    home_m: Home

    def order_at(self, frame: int) -> str | None:
        """Return the decision that the mission orders at a frame, None before the first."""
        if frame < self.at_frame:
            return None
        return "break_off" if frame < self.home_frame else "return_to_home"


class _Flown(BaseModel):
    segments: tuple[Segment, ...] | None = None
    mission: Mission | None = None


def flown_as_json(segments: tuple[Segment, ...], mission: Mission | None) -> dict:
    """Return the keys that `read_flown` reads; none without segments and mission."""
    record: dict = {"segments": [asdict(part) for part in segments]} if segments else {}
    if mission is not None:
        record["mission"] = {name: getattr(mission, name) for name in ("kind", "at_frame", "home_frame")}
        record["mission"]["home"] = dict(zip("xyz", mission.home_m, strict=True))
    return record


def mirrored(mission: Mission | None) -> Mission | None:
    """Convert a mission between right-handed and CARLA axes."""
    if mission is None:
        return None
    x, y, z = mission.home_m
    return replace(mission, home_m=(x, -y, z))


def read_flown(record: dict, num_frames: int, where: str) -> tuple[tuple[Segment, ...], Mission | None]:
    """Return segments and mission of a record of `num_frames` frames. where: file and place of the record."""
    flown = validated(_Flown, {name: record.get(name) for name in _Flown.model_fields}, where)
    segments = flown.segments or ()
    mission = flown.mission
    frames: dict[str, int] = {}
    for k, part in enumerate(segments):
        frames |= {f"segments[{k}].begin": part.begin, f"segments[{k}].end": part.end}
    if mission is not None:
        frames |= {"mission.at_frame": mission.at_frame, "mission.home_frame": mission.home_frame}
    for name, frame in frames.items():
        if frame > num_frames:
            expected = f"a frame from 0 to {num_frames}"
            what = "the field names a frame that the track does not have"
            raise InputError(what, where=f"{where}: {name}", got=str(frame), expected=expected)
    return segments, mission
