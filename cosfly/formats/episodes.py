"""`episodes/<episode>.json`: the record of a closed-loop episode (`cosfly fly`), frame by frame; `score.json`: the
score of one student, with the sums of each episode, so that folders of several maps can be merged.

Each frame has the visibility of the target, the student's answer to it, and the command flown from it to the next.
World axes: right-handed, metres, degrees.
"""

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, NonNegativeInt, model_validator

from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model

EPISODES = "episodes"  # folder of the records
EPISODE_FORMAT = FileFormat("cosfly.episode", "2.0", "episode")
SCORE, SCORE_FORMAT = "score.json", FileFormat("cosfly.score", "2.0", "score")
MOST_WORDS = 4000  # characters of an answer that are kept

# lead: a frame of the plan, before the first decision. late: no answer within the limit. unreadable: an answer in
# another form than requested. invalid: an unknown decision or an invalid command. none: no answer. end: the last frame,
# without a decision. After late, unreadable, invalid and none the drone hovers.
Answer = Literal["lead", "ok", "late", "unreadable", "invalid", "none", "end"]
# finished: flown to the end of the pedestrian trajectory; crashed: an obstacle or the ground came within the drone's
# radius; lost: the target was not visible for `fly.lost_s`; left: the drone flew out of the map's bounds.
Ended = Literal["finished", "crashed", "lost", "left"]

_Triple = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
_Least = Annotated[FiniteFloat, Field(ge=0)]


class EpisodeFrame(Record):
    """One frame. command: as ACTION (cosfly/geometry/motion.py), None in the last. answer_s: time of the decision.
    words: the student's reasons, or its raw answer if unreadable.

    in_view: a part of the target's box is in the picture; visible: enough of it is not hidden; visibility: the share
    that is not hidden; num_pixels: of the target. distance_m: drone to hip over ground; height_m: drone over the
    target's ground; clearance_m: least distance to an obstacle or the ground until the next frame; speed_mps: of the
    drone. pose: x, y, z, pitch, yaw, roll of the camera. target_m: the hip.
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


class Episode(Record):
    """The record of an episode. episode: its id, unique in a folder. walk: the pedestrian trajectory. list_sha256:
    of the benchmark's list, None for own trajectories. controller_sha256: of the table of commands, None if the student
    returns commands. num_walk_frames: frames after the lead frames in the whole trajectory; an early end has fewer."""

    episode: str = Field(min_length=1)
    student: str
    engine: str
    town: str
    map_sha256: str
    walk: str
    seed: int
    pace: str  # of the pedestrian
    dt_s: Annotated[FiniteFloat, Field(gt=0)]
    camera_px: tuple[int, int]
    fov_deg: Annotated[FiniteFloat, Field(gt=0, lt=180)]
    drone_radius_m: _Least
    list_sha256: str | None = None
    controller_sha256: str | None = None
    ended: Ended
    num_walk_frames: int = Field(ge=1)
    frames: tuple[EpisodeFrame, ...] = Field(min_length=2)

    @property
    def num_lead(self) -> int:
        """The number of frames before the first decision."""
        return next((i for i, frame in enumerate(self.frames) if frame.answer != "lead"), len(self.frames))

    @property
    def flown(self) -> tuple[EpisodeFrame, ...]:
        """The frames after the first decision."""
        return self.frames[self.num_lead + 1 :]

    @property
    def decisions(self) -> tuple[EpisodeFrame, ...]:
        """The frames with a decision."""
        return self.frames[self.num_lead : -1]


def episode_file(folder: Path, episode: str) -> Path:
    """Return the path of an episode's record in an output directory of `cosfly fly`."""
    return folder / EPISODES / f"{episode}.json"


def write_episode(path: Path, record: Episode) -> None:
    """Write the record of an episode atomically."""
    write_model(path, record, EPISODE_FORMAT)


def read_episode(path: Path) -> Episode:
    """Read the record of an episode; raises as `read_model`."""
    return read_model(path, Episode, EPISODE_FORMAT, tree=path.parent)


class Figure(Record):
    """A figure over `count` samples with its interval; all None if unknown."""

    value: float | None
    low: float | None
    high: float | None
    count: int

    def shown(self, digits: str) -> str:
        """Return the figure as text, `62.0% (58.1% to 65.3%)` for the format `.1%`, without an interval of width 0."""
        if self.value is None:
            return "-"
        is_wide = self.low is not None and self.high is not None and self.low < self.high
        return f"{self.value:{digits}}" + (f" ({self.low:{digits}} to {self.high:{digits}})" if is_wide else "")


class EpisodeScore(Record):
    """The measures of one episode. answers: counts of the student's
    answers. sums: figure -> numerator and denominator."""

    episode: str
    town: str
    walk: str  # map and trajectory: episodes of one are correlated
    ended: Ended
    answers: dict[Answer, NonNegativeInt]
    sums: dict[str, tuple[FiniteFloat, _Least]]


class Score(Record):
    """The score of one student. episodes_sha256: of the tasks; only equal ones are comparable. list_sha256: of the
    published list, None for own trajectories. figures: by measures.MEASURES."""

    student: str = Field(min_length=1)
    engine: str
    episodes_sha256: str
    list_sha256: str | None = None
    confidence: Annotated[FiniteFloat, Field(gt=0, lt=1)]
    resamples: int = Field(ge=1)
    figures: dict[str, Figure]
    flights: tuple[EpisodeScore, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _has_each_episode_once(self) -> Self:
        counts = Counter((flight.town, flight.episode) for flight in self.flights)
        if repeated := [f"{town}/{episode}" for (town, episode), count in counts.items() if count > 1]:
            raise ValueError(f"the score file lists episode {repeated[0]} twice")
        return self


def read_score(folder: Path) -> Score:
    """Read the score in an output directory of `cosfly fly`; raises as `read_model`."""
    return read_model(folder / SCORE, Score, SCORE_FORMAT, tree=folder)
