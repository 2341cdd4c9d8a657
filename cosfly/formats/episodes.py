"""The results of `cosfly fly`: records of closed-loop episodes, `episodes/<episode>.json`, and `score.json`.

The record of an episode has, for each frame, the visibility of the target, the student's answer, and the command that
was flown from it to the next. A score has the sums of each episode, so that folders of several maps can be merged.
World axes: right-handed, metres, degrees.
"""

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, NonNegativeInt, model_validator

from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model

EPISODES = "episodes"  # folder of the records
EPISODE_FORMAT = FileFormat("cosfly.episode", "2.0", "episode")
SCORE = "score.json"
SCORE_FORMAT = FileFormat("cosfly.score", "2.0", "score")
MOST_WORDS = 4000  # characters of an answer that are kept

Answer = Literal[
    "lead",  # a frame of the plan, before the first decision
    "ok",
    # After the next four the drone hovers.
    "late",  # no answer within the limit
    "unreadable",  # an answer in another form than requested
    "invalid",  # an unknown decision or an invalid command
    "none",  # no answer
    "end",  # the last frame, without a decision
]
Ended = Literal[
    "finished",  # flown to the end of the pedestrian trajectory
    "crashed",  # an obstacle or the ground came within the drone's radius
    "lost",  # the target was not visible for `fly.lost_s`
    "left",  # the drone flew out of the map's bounds
]

_NotNegative = Annotated[FiniteFloat, Field(ge=0)]


class EpisodeFrame(Record):
    time_s: FiniteFloat
    answer: Answer
    action: str | None = None
    # As ACTION (cosfly/geometry/motion.py); None in the last frame.
    command: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    answer_s: _NotNegative | None = None  # time of the decision
    words: str | None = Field(None, max_length=MOST_WORDS)  # the student's reasons, or its raw answer if unreadable
    in_view: bool  # a part of the target's box is in the picture
    visible: bool  # enough of it is not hidden
    visibility: Annotated[FiniteFloat, Field(ge=0, le=1)]  # the share that is not hidden
    num_pixels: NonNegativeInt  # of the target
    distance_m: _NotNegative  # from the drone to the target's hip, over ground
    height_m: FiniteFloat  # of the drone over the target's ground
    clearance_m: FiniteFloat  # least distance to an obstacle or the ground until the next frame
    speed_mps: _NotNegative  # of the drone
    # x, y, z, pitch, yaw, roll of the camera.
    pose: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
    target_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat]  # the hip


class Episode(Record):
    episode: str = Field(min_length=1)  # its id, unique in a folder
    student: str
    engine: str
    town: str
    map_sha256: str
    walk: str  # id of the pedestrian trajectory
    seed: int
    pace: str  # of the pedestrian
    dt_s: Annotated[FiniteFloat, Field(gt=0)]
    camera_px: tuple[int, int]
    fov_deg: Annotated[FiniteFloat, Field(gt=0, lt=180)]
    drone_radius_m: _NotNegative
    list_sha256: str | None = None  # of the benchmark's list; None for own trajectories
    controller_sha256: str | None = None  # of the table of commands; None if the student returns commands
    ended: Ended
    num_walk_frames: int = Field(ge=1)  # after the lead, in the whole trajectory; an early end has fewer
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
        text = f"{self.value:{digits}}"
        if self.low is None or self.high is None or not self.low < self.high:
            return text
        return f"{text} ({self.low:{digits}} to {self.high:{digits}})"


class EpisodeScore(Record):
    episode: str
    town: str
    walk: str  # map and trajectory: episodes of one are correlated
    ended: Ended
    answers: dict[Answer, NonNegativeInt]  # counts
    sums: dict[str, tuple[FiniteFloat, _NotNegative]]  # figure -> numerator and denominator


class Score(Record):
    """The score of one student."""

    student: str = Field(min_length=1)
    engine: str
    episodes_sha256: str  # of the tasks; only scores with equal ones are comparable
    list_sha256: str | None = None  # of the published list; None for own trajectories
    most_decisions: NonNegativeInt = 0  # as `fly.most_decisions`, which shortens episodes; 0: whole episodes
    confidence: Annotated[FiniteFloat, Field(gt=0, lt=1)]
    resamples: int = Field(ge=1)
    figures: dict[str, Figure]  # by measures.MEASURES
    flights: tuple[EpisodeScore, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _has_each_episode_once(self) -> Self:
        counts = Counter((flight.town, flight.episode) for flight in self.flights)
        if repeated := [f"{town}/{episode}" for (town, episode), count in counts.items() if count > 1]:
            raise ValueError(f"the score file lists episode {repeated[0]} twice")
        return self


def read_score(folder: Path) -> Score:
    """Read the score in an output directory of `cosfly fly`; raises as `read_model`."""
    if not (folder / SCORE).exists():
        expected = f"an output directory of `cosfly fly`, with {SCORE}"
        raise InputError("there is no score", where=folder, expected=expected, fix="run cosfly fly --out DIR first")
    return read_model(folder / SCORE, Score, SCORE_FORMAT, tree=folder)
