"""All that is checked of one flight, in a worker process: its rows, its captions, its pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from cosfly.errors import InputError
from cosfly.products.frames import INVALID_DEPTH_M, SKY_DEPTH_M
from cosfly.products.shown_captions import CaptionReader
from cosfly.work.items import Item, Outcome
from release.record import DepthCoding, DepthCodingName
from release.verify.across import RowFiles, summary_of
from release.verify.by_rule import check_drawn, check_inspected, check_style
from release.verify.drawn_again import Drawn, check_draws
from release.verify.findings import Findings
from release.verify.geometry import check_geometry
from release.verify.identity import check_identity
from release.verify.motion import check_motion
from release.verify.rows import FlightRows
from release.verify.said import check_captions
from release.verify.scene import NOTHING_SHOWN, check_pictures
from release.verify.sources import Entry, FlightSource, flight_rows

Level = Literal["structure", "rows", "pixels"]
Said = TypeVar("Said")
# What a value of no sense does to a check that takes it for one: each value is judged by itself, so that the cause is named too.
SENSELESS = (ValueError, KeyError, TypeError, IndexError, ArithmeticError, AttributeError)


# As in a playback tree.
LOSSLESS = DepthCoding(
    coding="float32", unit="metre", sky=SKY_DEPTH_M, invalid=INVALID_DEPTH_M, min_m=None, max_m=None, max_error_m=0.0
)


@dataclass(frozen=True)
class Told:
    """What the record says that the checks of flights need. settings: of stages, by run and stage. by_town: splits share no town
    either. both: every flight's twin is released too. rounded_as: the coding that the depth went through, whatever it is stored as.
    prompts, drawn: by run. is_reviewed: people may have accepted what the inspection did not."""

    window_frames: int | None = None
    depth: DepthCoding = field(default_factory=lambda: LOSSLESS)
    settings: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)
    by_town: bool = False
    both: bool = False
    rounded_as: DepthCodingName = "float32"
    prompts: dict[str, dict[str, str]] = field(default_factory=dict)
    is_reviewed: bool = False
    drawn: dict[str, Drawn | None] = field(default_factory=dict)

    def of(self, flight: FlightRows, stage: str) -> dict[str, Any]:
        return _of_run({run: values for (run, name), values in self.settings.items() if name == stage}, flight) or {}

    def prompts_of(self, flight: FlightRows) -> dict[str, str]:
        return _of_run(self.prompts, flight) or {}

    def drawn_of(self, flight: FlightRows) -> Drawn | None:
        return _of_run(self.drawn, flight)


def _of_run(found: Mapping[str, Said], flight: FlightRows) -> Said | None:
    """Give what is said of a flight's run, of which folders above a town count as part."""
    name = flight.name.split("/")[0]
    runs = [run for run in found if name == run or name.startswith(f"{run}_")]
    return found[max(runs, key=len)] if runs else None


@dataclass(frozen=True)
class Job:
    """One flight to check, and the clean flight beside a perturbed one. rows_file: the name of what is kept of its rows."""

    entry: Entry
    rows_file: str
    twin: Entry | None = None


def make_worker(
    source: FlightSource, level: Level, told: Told, reader: CaptionReader | None, rows: RowFiles
) -> Callable[[Item], Outcome]:
    """Worker factory: give the function that checks one flight."""

    def work(item: Item) -> Outcome:
        findings = Findings()
        summary = check_flight(source, item.payload, level, told, reader, rows, findings)
        return Outcome({"findings": findings.dumped(), "summary": summary})

    return work


def check_flight(
    source: FlightSource, job: Job, level: Level, told: Told, reader: CaptionReader | None, rows: RowFiles,
    findings: Findings,
) -> dict[str, Any] | None:  # fmt: skip
    """Check one flight; gives what is compared with other flights, None where its rows cannot be read."""
    name = job.entry.name
    try:
        flight = flight_rows(source, job.entry)
        twin = flight_rows(source, job.twin) if job.twin is not None else None
    except InputError as error:
        findings.error("unreadable", name, f"{error.what}: {error.got}", "rows that can be read")
        return None
    if not len(flight):
        findings.error("unreadable", name, "no rows", "the rows of a flight")
        return None
    checks: list[Callable[[], Any]] = [
        lambda: check_identity(flight, findings),
        lambda: check_geometry(flight, findings),
        lambda: check_motion(flight, twin, told.of(flight, "render").get("perturbation", {}), findings),
        lambda: check_captions(flight, told.window_frames, findings),
        lambda: check_drawn(flight, told.of(flight, "render"), findings),
        lambda: check_style(flight, told.of(flight, "plan"), findings),
        lambda: check_draws(flight, told.drawn_of(flight), findings),
        lambda: check_inspected(flight, {} if told.is_reviewed else told.of(flight, "inspect"), findings),
    ]
    if reader is not None:
        checks.append(lambda: _read_captions(flight, twin, told, reader, findings))
    tried = [_tried(check, name, findings) for check in checks]  # all of them, whatever the first gives
    is_sane = all(tried)
    shown = NOTHING_SHOWN
    if level == "pixels":
        try:
            shown = check_pictures(flight, source.pictures(job.entry), told.depth, told.rounded_as, findings)
        except InputError as error:
            findings.error("unreadable", name, f"{error.what}: {error.got}", "pictures that can be read")
        except SENSELESS as error:
            if is_sane:
                raise
            findings.error("not_checked", name, f"pictures: {type(error).__name__}: {error}", "rows of sense")
    try:
        return summary_of(flight, shown, rows, job.rows_file).dumped()
    except SENSELESS as error:
        findings.error("not_checked", name, f"{type(error).__name__}: {error}", "rows of sense")
        return None


def _tried(check: Callable[[], Any], name: str, findings: Findings) -> bool:
    """Do a check; a value that makes none of it possible is a finding."""
    try:
        check()
    except SENSELESS as error:
        findings.error("senseless", name, f"{type(error).__name__}: {error}", "values that can be computed with")
        return False
    return True


def _read_captions(
    flight: FlightRows, twin: FlightRows | None, told: Told, reader: CaptionReader, findings: Findings
) -> None:
    for lie in reader(flight.shown(twin, told.of(flight, "caption"), told.prompts_of(flight))):
        findings.error(lie.code, lie.where, lie.got, lie.expected)
