"""Cells and rows of tables: rounded figures, None where there is nothing to say."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from statistics import fmean

from release.card.numbers import Sum, spread_of
from release.record import Spread
from release.stats.counting import FlightSums
from release.stats.schema import Cell

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
