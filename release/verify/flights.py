"""Check one flight in a worker process: its rows, its captions, its pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from cosfly.errors import InputError
from cosfly.products.shown_captions import CaptionReader
from cosfly.work.items import Item, Outcome
from release.flight_rows import FlightRows
from release.record import ReleaseRecord
from release.verify.across import summary_of
from release.verify.findings import Findings
from release.verify.geometry import check_geometry
from release.verify.identity import check_identity
from release.verify.said import check_captions
from release.verify.scene import check_pictures
from release.verify.sources import Entry, FlightSource, flight_rows

Level = Literal["structure", "rows", "pixels"]
# What a senseless value raises in a check of another value; the cause is reported by a check of its own.
SENSELESS = (ValueError, KeyError, TypeError, IndexError, ArithmeticError, AttributeError)


@dataclass(frozen=True)
class Context:
    """What the record says that the checks of flights need. by_town: splits
    share no town either. both: every flight's twin is released too. captions: by run the settings of its caption
    stage, if its source has one."""

    window_frames: int | None = None
    by_town: bool = False
    both: bool = False
    captions: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def of_record(cls, record: ReleaseRecord) -> Context:
        asked, captions = record.settings, dict[str, dict[str, Any]]()
        for source in record.provenance.sources:
            own = [stage.config for stage in source.stages if stage.stage == "caption"]
            captions[source.run] = own[0] if len(own) == 1 else {}
        both = asked.pairs == "both" and len(asked.tracks) == 2
        return cls(asked.window_frames, record.splits.by == "town", both, captions)

    def caption_settings(self, flight: FlightRows) -> dict[str, Any]:
        """Return the settings of a flight's captions; folders above a town are part of a run's name."""
        name = flight.name.split("/")[0]
        runs = [run for run in self.captions if name == run or name.startswith(f"{run}_")]
        return self.captions[max(runs, key=len)] if runs else {}


def make_worker(
    source: FlightSource, level: Level, context: Context, reader: CaptionReader | None
) -> Callable[[Item], Outcome]:
    """Worker factory: return the function that checks one flight and returns its summary, None if it is unreadable."""

    def work(item: Item) -> Outcome:
        findings, summary = Findings(), None
        entry, clean = item.payload  # the clean flight of a perturbed one
        try:
            flight = flight_rows(source, entry)
            twin = flight_rows(source, clean) if clean is not None else None
            if not len(flight):
                raise InputError("no rows", got="0")
            _check_flight(flight, twin, source, entry, level, context, reader, findings)
            summary = vars(summary_of(flight))
        except InputError as error:
            findings.error("unreadable", entry.name, f"{error.what}: {error.got}", "a flight that can be read")
        except SENSELESS as error:
            findings.error("senseless", entry.name, f"{type(error).__name__}: {error}", "rows that can be read")
        return Outcome({"findings": findings.dumped(), "summary": summary})

    return work


def _check_flight(
    flight: FlightRows,
    twin: FlightRows | None,
    source: FlightSource,
    entry: Entry,
    level: Level,
    context: Context,
    reader: CaptionReader | None,
    findings: Findings,
) -> None:
    """Run all checks of a flight; a value that makes a check impossible is a finding."""

    def read_captions() -> None:
        shown = flight.shown(twin, context.caption_settings(flight))
        for lie in reader(shown) if reader is not None else ():
            findings.error(lie.code, lie.where, lie.got, lie.expected)

    checks: list[Callable[[], None]] = [
        lambda: check_identity(flight, findings),
        lambda: check_geometry(flight, findings),
        lambda: check_captions(flight, context.window_frames, findings),
        read_captions,
    ]
    if level == "pixels":
        checks.append(lambda: check_pictures(flight, source.pictures(entry), findings))
    for check in checks:
        try:
            with np.errstate(divide="ignore", invalid="ignore"):
                check()
        except SENSELESS as error:
            findings.error("senseless", flight.name, f"{type(error).__name__}: {error}", "values to compute with")
