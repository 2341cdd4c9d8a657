"""`score.json`: what the flights of one student are worth, whoever flew them: `cosfly fly` writes it at its end.

Of each flight it keeps what the figures are made of, so that folders of several maps are put together, and students
held side by side, without the flights.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, FiniteFloat, NonNegativeInt, model_validator

from cosfly.formats.pursuits import Answer, Ended
from cosfly.runtime.json_io import FileFormat, Record, read_model

SCORE, SCORE_FORMAT = "score.json", FileFormat("cosfly.score", "1.0", "score")


class Figure(Record):
    """A figure over `count` samples with its interval; all None where nothing is known."""

    value: float | None
    low: float | None
    high: float | None
    count: int


class FlightScore(Record):
    """Of one flight. groups: the kind of its walk and its map (measures.GROUPS) -> which. answers: how often the
    student, when it was asked, answered how. sums: figure -> what the flight adds to it, and of how many."""

    episode: str
    town: str
    walk: str  # of which map, and which of its walks: flights of one are alike
    groups: dict[str, str]
    ended: Ended
    answers: dict[Answer, NonNegativeInt]
    sums: dict[str, tuple[FiniteFloat, Annotated[FiniteFloat, Field(ge=0)]]]


class Score(Record):
    """Of one student. episodes_sha256: of what was to be flown: only students of the same are comparable. list_sha256:
    of the published list of episodes, None of a run's own walks. trained_on: towns, None where nobody knows.
    figures: by measures.MEASURES; by: kind of group -> group -> figures."""

    student: str = Field(min_length=1)
    engine: str
    episodes_sha256: str
    list_sha256: str | None = None
    trained_on: tuple[str, ...] | None = None
    confidence: Annotated[FiniteFloat, Field(gt=0, lt=1)]
    resamples: int = Field(ge=1)
    figures: dict[str, Figure]
    by: dict[str, dict[str, dict[str, Figure]]]
    flights: tuple[FlightScore, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _has_each_episode_once(self) -> Self:
        counts = Counter((flight.town, flight.episode) for flight in self.flights)
        if twice := [f"{town}/{episode}" for (town, episode), count in counts.items() if count > 1]:
            raise ValueError(f"episode {twice[0]} stands there twice")
        return self


def read_score(folder: Path) -> Score:
    """Read the score of a folder of flights; raises as `read_model`."""
    return read_model(folder / SCORE, Score, SCORE_FORMAT, tree=folder)
