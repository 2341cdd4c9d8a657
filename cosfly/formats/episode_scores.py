"""`score.json`: the score of one student, which `cosfly fly` writes at its end.

It contains the sums of each episode, so that folders of several maps can be merged and students compared without the
episodes.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, FiniteFloat, NonNegativeInt, model_validator

from cosfly.formats.episodes import Answer, Ended
from cosfly.runtime.json_io import FileFormat, Record, read_model

SCORE, SCORE_FORMAT = "score.json", FileFormat("cosfly.score", "1.0", "score")


class Figure(Record):
    """A figure over `count` samples with its interval; all None if unknown."""

    value: float | None
    low: float | None
    high: float | None
    count: int


class EpisodeScore(Record):
    """The measures of one episode. groups: kind of group (measures.GROUPS) -> group. answers: counts of the student's
    answers. sums: figure -> numerator and denominator."""

    episode: str
    town: str
    walk: str  # map and trajectory: episodes of one are correlated
    groups: dict[str, str]
    ended: Ended
    answers: dict[Answer, NonNegativeInt]
    sums: dict[str, tuple[FiniteFloat, Annotated[FiniteFloat, Field(ge=0)]]]


class Score(Record):
    """The score of one student. episodes_sha256: of the tasks; only equal ones are comparable. list_sha256: of the
    published list, None for own trajectories. trained_on: towns, None if unknown. figures: by measures.MEASURES;
    by: kind of group -> group -> figures."""

    student: str = Field(min_length=1)
    engine: str
    episodes_sha256: str
    list_sha256: str | None = None
    trained_on: tuple[str, ...] | None = None
    confidence: Annotated[FiniteFloat, Field(gt=0, lt=1)]
    resamples: int = Field(ge=1)
    figures: dict[str, Figure]
    by: dict[str, dict[str, dict[str, Figure]]]
    flights: tuple[EpisodeScore, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _has_each_episode_once(self) -> Self:
        counts = Counter((flight.town, flight.episode) for flight in self.flights)
        if twice := [f"{town}/{episode}" for (town, episode), count in counts.items() if count > 1]:
            raise ValueError(f"episode {twice[0]} is listed twice")
        return self


def read_score(folder: Path) -> Score:
    """Read the score in an output directory of `cosfly fly`; raises as `read_model`."""
    return read_model(folder / SCORE, Score, SCORE_FORMAT, tree=folder)
