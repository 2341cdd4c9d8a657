"""`PURSUITS/<episode>.json`: one flown flight of the closed loop (`cosfly fly`), frame by frame.

Of each frame: what it shows of the target, what the student answered when it had seen it, and the command that was
flown from it to the next. World axes are the project's: right-handed, m, degrees.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, NonNegativeInt, model_validator

from cosfly.geometry.motion import ACTION
from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model

PURSUITS = "pursuits"  # the folder of them in what `cosfly fly` writes
PURSUIT_FORMAT = FileFormat("cosfly.pursuit", "1.0", "pursuit")
MOST_WORDS = 4000  # characters that are kept of what a student said

# Of a frame. lead: of the plan, before the student was asked. late: no answer within the limit; unreadable: not of the
# form that was asked for; invalid: no decision of the set, or a command that is none; none: the engine gave nothing.
# After an answer that is not ok the drone hovers. end: the last frame, at which nobody is asked.
Answer = Literal["lead", "ok", "late", "unreadable", "invalid", "none", "end"]
# finished: flown to the walk's end; crashed: an obstacle or the ground came within the drone's radius; lost: the target
# was not seen for `fly.lost_s`; left: the drone flew out of the map's bounds.
Ended = Literal["finished", "crashed", "lost", "left"]

_Triple = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
_Least = Annotated[FiniteFloat, Field(ge=0)]


class PursuitFrame(Record):
    """One frame. command: as ACTION (cosfly/geometry/motion.py), None of the last. answer_s: how long the student took,
    None where nobody was asked. words: what it said, its reasons or, where they cannot be read, the raw answer.

    in_view: some of the target's box is in the picture; visible: and enough of it is not hidden, `visibility` its
    share; num_pixels of the person. distance_m: over ground, drone to hip; height_m: of the drone over the ground under
    the target; clearance_m: the least distance to an obstacle or the ground on the way to the next frame; speed_mps:
    of the drone at the frame. pose: x, y, z, pitch, yaw, roll of the camera. target_m: the hip.
    """

    time_s: FiniteFloat
    answer: Answer
    action: str | None = None
    command: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    answer_s: _Least | None = None
    words: str | None = Field(None, max_length=MOST_WORDS)
    in_view: bool
    visible: bool
    visibility: Annotated[FiniteFloat, Field(ge=0, le=1)]
    num_pixels: NonNegativeInt
    distance_m: _Least
    height_m: FiniteFloat
    clearance_m: FiniteFloat
    speed_mps: _Least
    pose: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
    target_m: _Triple


class WalkStyle(Record):
    """How hard a walk is to follow, whoever flies: its pace; the mean turn of who walks, deg/s; the share of its frames
    that hide the person from a drone right behind, at the distance and the height at which the flight began."""

    pace: str
    turn_degps: _Least
    hidden_share: Annotated[FiniteFloat, Field(ge=0, le=1)]


class Pursuit(Record):
    """One flight. episode: its id, unique in a folder. list_sha256: of the list of episodes that it is of, None of a
    run's own walks. controller_sha256: of the table that turned decisions into commands, None of a student that
    commands. num_walk_frames: of the whole walk, those before the first decision (`lead`) not counted: a flight that
    ended early has fewer."""

    episode: str = Field(min_length=1)
    student: str
    engine: str
    town: str
    map_sha256: str
    walk: str
    seed: int
    style: WalkStyle
    dt_s: Annotated[FiniteFloat, Field(gt=0)]
    camera_px: tuple[int, int]
    fov_deg: Annotated[FiniteFloat, Field(gt=0, lt=180)]
    drone_radius_m: _Least
    list_sha256: str | None = None
    controller_sha256: str | None = None
    ended: Ended
    num_walk_frames: int = Field(ge=1)
    frames: tuple[PursuitFrame, ...] = Field(min_length=2)

    @model_validator(mode="after")
    def _is_a_flight(self) -> Self:
        answers, times_s = [frame.answer for frame in self.frames], [frame.time_s for frame in self.frames]
        if "end" in answers[:-1] or answers[-1] != "end" or "lead" in answers[self.num_lead :]:
            raise ValueError("frames are `lead`, then decisions, then one `end`")
        if any(later <= earlier for earlier, later in pairwise(times_s)):
            raise ValueError("times must increase")
        if any((frame.command is None) != (frame.answer == "end") for frame in self.frames):
            raise ValueError(f"all frames but the last have a command, {', '.join(ACTION)}")
        if len(self.flown) > self.num_walk_frames:
            raise ValueError(f"{len(self.flown)} frames of a walk of {self.num_walk_frames}")
        return self

    @property
    def num_lead(self) -> int:
        """Frames of the plan with which the flight began, before the first decision."""
        return next((i for i, frame in enumerate(self.frames) if frame.answer != "lead"), len(self.frames))

    @property
    def flown(self) -> tuple[PursuitFrame, ...]:
        """The frames that the student answers for: those after its first decision."""
        return self.frames[self.num_lead + 1 :]

    @property
    def decisions(self) -> tuple[PursuitFrame, ...]:
        """The frames at which it was asked."""
        return self.frames[self.num_lead : -1]


def pursuit_file(folder: Path, episode: str) -> Path:
    """Where the record of an episode stands in what `cosfly fly` writes."""
    return folder / PURSUITS / f"{episode}.json"


def write_pursuit(path: Path, pursuit: Pursuit) -> None:
    """Write the record of one flight, whole or not at all."""
    write_model(path, pursuit, PURSUIT_FORMAT)


def read_pursuit(path: Path) -> Pursuit:
    """Read the record of one flight; raises as `read_model`."""
    return read_model(path, Pursuit, PURSUIT_FORMAT, tree=path.parent)
