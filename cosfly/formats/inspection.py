"""`inspect.json`, the product of step 6: one record per track and the funnel."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, FiniteFloat

from cosfly.formats.issues import Issue
from cosfly.formats.playback import ORIGINAL
from cosfly.geometry.coverage import Coverage
from cosfly.runtime.errors import InputError
from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model

INSPECT_FORMAT = FileFormat("cosfly.inspect", "1.0", "inspection")

Result = Literal["accepted", "review", "rejected"]
RESULTS: tuple[Result, ...] = ("accepted", "review", "rejected")


class TrackInspection(Record):
    """The result of one track. folder: relative to the playback tree. sha256: of its files (`digest_of`). Metrics are
    None where unknown."""

    town: str
    trajectory: str
    variant: str
    is_original: bool | None = None  # None in older inspections and for unreadable tracks
    folder: str
    sha256: str | None = None  # None in older inspections and for unreadable tracks
    trace_id: str | None
    result: Result
    issues: list[Issue]
    metrics: dict[str, FiniteFloat | int | None]
    # By a person, after the inspection (review.py); `inspect.json` never holds it.
    decided: Literal["accepted", "rejected"] | None = Field(None, exclude=True)

    @property
    def track(self) -> Literal["clean", "perturbed"]:
        is_clean = self.variant == ORIGINAL if self.is_original is None else self.is_original
        return "clean" if is_clean else "perturbed"

    @property
    def reason(self) -> str | None:
        """Code of the worst finding, None when the flight is accepted; `review` of one that a person rejected."""
        if self.decided == "rejected":
            return "review"
        return self.issues[0].code if self.result != "accepted" and self.issues else None


class TrajectoryFunnel(Record):
    """planned = sum(dropped) + not_rendered + rendered; rendered = accepted + review + rejected."""

    planned: int
    dropped: dict[str, int]
    not_rendered: int
    rendered: int
    accepted: int
    review: int
    rejected: int

    def check(self) -> None:
        """Assert that nothing was lost on the way."""
        assert self.planned == sum(self.dropped.values()) + self.not_rendered + self.rendered, self
        assert self.rendered == self.accepted + self.review + self.rejected, self


class TrackFunnel(Record):
    """inspected = accepted + review + rejected; `reasons` counts the worst finding of those in review or rejected."""

    inspected: int
    accepted: int
    review: int
    rejected: int
    without_trace: int
    reasons: dict[str, int]


class Funnel(Record):
    """From planned trajectories to accepted flights (sec:step6); a trajectory is as good as its worst flight."""

    trajectories: TrajectoryFunnel
    flights: TrackFunnel


class Inspection(Record):
    """The whole file."""

    settings: dict[str, Any]
    funnel: Funnel
    coverage: Coverage | None = None  # of the accepted tracks; None in older inspections
    flights: list[TrackInspection]


def count_trajectories(flights: list[TrackInspection], *, planned: bool) -> dict[str, int]:
    """Count rendered trajectories by the result of their worst track: `rendered`, `accepted`, `review`, `rejected`.

    Args:
        planned: count plans, so that tracks without one are ignored; otherwise count folders.
    """
    results: dict[str, set[str]] = {}
    for flight in flights:
        name = flight.trace_id if planned else str(Path(flight.folder).parent)
        if name is not None:
            results.setdefault(name, set()).add(flight.result)
    worst = Counter(next(r for r in reversed(RESULTS) if r in found) for found in results.values())
    return {"rendered": len(results)} | {result: worst[result] for result in RESULTS}


def write_inspection(path: Path, inspection: Inspection) -> None:
    """Write `inspect.json`."""
    write_model(path, inspection, INSPECT_FORMAT)


def read_inspection(path: Path) -> Inspection:
    """Read `inspect.json`."""
    inspection = read_model(path, Inspection, INSPECT_FORMAT)
    counts = Counter(flight.folder for flight in inspection.flights)
    if twice := [folder for folder, count in counts.items() if count > 1]:
        raise InputError(
            "a flight has two records", where=f"{path}: flights", got=twice[0], expected="one for each folder"
        )
    return inspection
