"""`compare.json` as tables of text: figures, axes with their intervals, and wins against each other planner."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, Field, model_validator

from cosfly.planners.compare import AXES, FIGURES
from cosfly.planners.contract import title_of
from cosfly.reading.documents import read_object, validation_errors
from cosfly.work.stage_folder import read_manifest


@dataclass(frozen=True)
class TextTable:
    """A table for the terminal; the first column is words, the others are numbers."""

    title: str
    columns: list[str]
    rows: list[list[str]]


class _Change(BaseModel):
    delta: float
    relative_percent: float | None


class _Interval(BaseModel):
    difference: float
    low: float
    high: float


class _Wins(BaseModel):
    count: int
    of: int
    rate: float


class _Time(BaseModel):
    mean_ms: float


class _Comparison(BaseModel):
    """What the tables are made of: `compare.json`, and the times of its manifest."""

    means: dict[str, dict[str, float]] = Field(min_length=1)
    deltas: dict[str, dict[str, _Change]]
    axes: dict[str, dict[str, float]]
    axis_differences: dict[str, dict[str, _Interval]]
    win_rates: dict[str, dict[str, _Wins]]
    timings: dict[str, _Time]

    @model_validator(mode="after")
    def _is_whole(self) -> _Comparison:
        planners, figures, axes = list(self.means), {name for name, _, _ in FIGURES}, {*AXES, "mean"}
        for table, names, rows in (
            (self.means, planners, figures), (self.deltas, planners[1:], figures), (self.axes, planners, axes),
            (self.axis_differences, planners[1:], axes), (self.win_rates, planners[1:], set()), (self.timings, planners, set()),
        ):  # fmt: skip
            if list(table) != names:
                raise ValueError(f"tables of different planners: {names} and {list(table)}")
            if any(rows - set(row) for row in table.values()):
                raise ValueError("a table lacks a row")
        return self


def text_tables(product: Path) -> list[TextTable]:
    """Read `compare.json` and its manifest back as tables of text: figures, axes, and wins against each other planner.

    Raises:
        InputError: they are not what a comparison writes.
    """
    found = read_object(product, what="comparison")
    with validation_errors(product):
        record = _Comparison.model_validate(found | {"timings": read_manifest(product.parent).facts.get("timings")})
    first, *others = planners = list(record.means)
    titles = [title_of(planner) for planner in planners]
    axes = [
        [name.replace("_", " "), *(f"{record.axes[planner][name]:.3f}" for planner in planners)]
        for name in (*AXES, "mean")
    ]
    differences = ["difference"] if len(others) == 1 else [f"less {title_of(other)}" for other in others]
    columns = ["figure", *titles, *(column for title in differences for column in (title, "%"))]
    tables = [
        TextTable("Means over the walks that all fly", columns, _figure_rows(record)),
        TextTable("Axis scores, higher is better", ["axis", *titles], axes),
    ]
    for other, intervals in record.axis_differences.items():
        rows = [
            [name.replace("_", " "), *(f"{value:+.3f}" for value in (row.difference, row.low, row.high))]
            for name, row in intervals.items()
        ]
        title = f"Axis scores, {title_of(first)} less {title_of(other)}, and 95 % of what other walks would give"
        tables.append(TextTable(title, ["axis", "difference", "from", "to"], rows))
    for other, rates in record.win_rates.items():
        rows = [[name.replace("_", " "), f"{row.count} of {row.of}", f"{row.rate:.3f}"] for name, row in rates.items()]
        title = f"{title_of(first)} against {title_of(other)}, walk by walk"
        tables.append(TextTable(title, ["criterion", "count", "rate"], rows))
    return tables


def _figure_rows(record: _Comparison) -> list[list[str]]:
    rows = []
    for name, title, digits in FIGURES:
        rows.append([title, *(f"{figures[name]:.{digits}f}" for figures in record.means.values())])
        for change in record.deltas.values():
            relative = change[name].relative_percent
            rows[-1] += [f"{change[name].delta:+.{digits}f}", "n/a" if relative is None else f"{relative:+.1f}"]
    times = [f"{time.mean_ms:.1f}" for time in record.timings.values()]
    return [*rows, ["planning time (ms)", *times, *[""] * 2 * len(record.deltas)]]
