"""What `stats.json` holds, and cells and rows of its tables: rounded figures, None where there is nothing to say."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from statistics import fmean
from typing import Literal

from pydantic import BaseModel, ConfigDict

from release.card.numbers import Sum, spread_of
from release.record import Spread
from release.stats.counting import FlightSums

Cell = str | int | float | None


class Table(BaseModel):
    """One table. paper: the label of the paper's; rows: as long as `head`; plot: how the page draws it beside.

    bars: the second column as bars, named by the first. stacked: all columns of numbers, a bar a row. heat: the numbers of a row and column of names.
    """

    model_config = ConfigDict(extra="forbid")

    key: str
    title: str
    paper: str | None = None
    note: str = ""
    head: list[str]
    rows: list[list[Cell]]
    plot: Literal["bars", "stacked", "heat"] | None = None


class Absent(BaseModel):
    """What the paper tells of its data and this release cannot: not in it, never made up."""

    model_config = ConfigDict(extra="forbid")

    what: str
    paper: str
    why: str


class Stats(BaseModel):
    """The whole file. content_digest: of the release that was counted."""

    model_config = ConfigDict(extra="forbid")

    name: str
    content_digest: str
    tables: list[Table]
    absent: list[Absent]


SPREAD = ["axis", "mean", "std", "least", "most", "values"]  # the head of a table of spread rows


def pairs(front: str, counted: Iterable[tuple[str, int]]) -> list[list[Cell]]:
    """Give a row for each name and its count."""
    return [[front + name, count] for name, count in counted]


def spread_row(title: str, spread: Spread) -> list[Cell]:
    """Give a row under the head SPREAD."""
    return [title, spread.mean, spread.std, spread.min, spread.max, spread.count]


def mean_over(flights: Iterable[FlightSums], of: Callable[[FlightSums], Sum]) -> float | None:
    """Mean over flights of a flight's mean, of those that have one."""
    return spread_over(flights, of).mean


def spread_over(flights: Iterable[FlightSums], of: Callable[[FlightSums], Sum]) -> Spread:
    """Spread over flights of a flight's mean, of those that have one."""
    means = (of(flight).spread().mean for flight in flights)
    return spread_of(mean for mean in means if mean is not None)


def mean_cell(values: Iterable[float]) -> float | None:
    """Mean, rounded; None of nothing."""
    known = list(values)
    return round(fmean(known), 4) if known else None


def rounded(*values: float | None) -> list[Cell]:
    return [None if value is None else round(value, 3) for value in values]


def percent(count: int, total: int) -> float | None:
    """Share of a total in percent, rounded; None of nothing."""
    return round(100.0 * count / total, 2) if total else None


def ratio(whole: int, part: int) -> float | None:
    return round(whole / part, 2) if part else None
