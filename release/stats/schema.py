"""`stats.json`: tables of numbers, each named after what of the paper it computes again, and a list of what a release cannot tell."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

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
