"""All that is checked of one flight, in a worker process: its rows, its captions, its pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np

from cosfly.errors import InputError
from cosfly.products.actions import ActionSet
from cosfly.products.shown_captions import CaptionReader
from cosfly.work.items import Item, Outcome
from release.depth import depth_record
from release.flight_rows import FlightRows
from release.record import DepthCoding, DepthCodingName, MadeBy, ReleaseRecord
from release.verify.across import RowFiles, summary_of
from release.verify.by_rule import check_settings
from release.verify.drawn_again import DrawSettings, check_draws
from release.verify.findings import Findings
from release.verify.geometry import check_geometry
from release.verify.identity import check_identity
from release.verify.motion import check_motion
from release.verify.said import check_captions
from release.verify.scene import PictureKeys, check_pictures
from release.verify.sources import Entry, FlightSource, flight_rows

Level = Literal["structure", "rows", "pixels"]
Value = TypeVar("Value")
# What a value of no sense does to a check that takes it for one: each value is judged by itself, so that the cause is
# named too.
SENSELESS = (ValueError, KeyError, TypeError, IndexError, ArithmeticError, AttributeError)
LOSSLESS = depth_record("float32", ())  # as in a playback tree


@dataclass(frozen=True)
class Context:
    """What the record says that the checks of flights need. actions: the closed set of decisions. by_town: splits
    share no town either. both: every flight's twin is released too. rounded_as: the coding that the depth went
    through, whatever it is stored as. settings, draws: by run; settings by stage, of those that stand once in its
    source."""

    actions: ActionSet
    window_frames: int | None = None
    depth: DepthCoding = field(default_factory=lambda: LOSSLESS)
    by_town: bool = False
    both: bool = False
    rounded_as: DepthCodingName = "float32"
    settings: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    draws: dict[str, DrawSettings | None] = field(default_factory=dict)

    @classmethod
    def of_record(cls, record: ReleaseRecord) -> Context:
        asked, coded = record.settings, record.depth or LOSSLESS
        made: dict[str, dict[str, MadeBy]] = {}
        for source in record.provenance.sources:
            names = [stage.stage for stage in source.stages]
            made[source.run] = {stage.stage: stage for stage in source.stages if names.count(stage.stage) == 1}
        settings = {run: {name: stage.config for name, stage in stages.items()} for run, stages in made.items()}
        if any(
            source.review_sha256 for source in record.provenance.sources
        ):  # people may have accepted what it did not
            settings = {run: {**stages, "inspect": {}} for run, stages in settings.items()}
        return cls(
            record.actions, asked.window_frames, coded, record.splits.by == "town",
            asked.pairs == "both" and len(asked.tracks) == 2, coded.coding, settings,
            {run: DrawSettings.of_stages(stages) for run, stages in made.items()},
        )  # fmt: skip


def _of_run(found: Mapping[str, Value], flight: FlightRows) -> Value | None:
    """Give what is said of a flight's run, of which folders above a town count as part."""
    name = flight.name.split("/")[0]
    runs = [run for run in found if name == run or name.startswith(f"{run}_")]
    return found[max(runs, key=len)] if runs else None


@dataclass(frozen=True)
class FlightJob:
    """One flight to check, and the clean flight beside a perturbed one. rows_file: the name of what is kept of its
    rows."""

    entry: Entry
    rows_file: str
    twin: Entry | None = None


def make_worker(
    source: FlightSource, level: Level, context: Context, reader: CaptionReader | None, rows: RowFiles
) -> Callable[[Item], Outcome]:
    """Worker factory: give the function that checks one flight, and gives what is compared with others, None where it
    cannot be read."""

    def work(item: Item) -> Outcome:
        findings, job = Findings(), item.payload
        summary = None
        try:
            flight = flight_rows(source, job.entry)
            twin = flight_rows(source, job.twin) if job.twin is not None else None
            if not len(flight):
                raise InputError("no rows", got="0")
            with np.errstate(divide="ignore", invalid="ignore"):
                is_sane = _check_rows(flight, twin, context, reader, findings)
                keys = PictureKeys()
                if level == "pixels":
                    keys = _check_pictures(flight, source, job.entry, context, is_sane, findings)
                summary = vars(summary_of(flight, keys, rows, job.rows_file))
        except InputError as error:
            findings.error("unreadable", job.entry.name, f"{error.what}: {error.got}", "rows that can be read")
        except SENSELESS as error:
            if not findings.kinds:
                raise
            findings.error("not_checked", job.entry.name, f"{type(error).__name__}: {error}", "rows of sense")
        return Outcome({"findings": findings.dumped(), "summary": summary})

    return work


def _check_rows(
    flight: FlightRows, twin: FlightRows | None, context: Context, reader: CaptionReader | None, findings: Findings
) -> bool:
    """Do all checks of rows, whatever the first gives; a value that makes one impossible is a finding. Tells whether
    there was none."""
    settings = _of_run(context.settings, flight) or {}

    def read_captions() -> None:
        shown = flight.shown(twin, context.actions, settings.get("caption", {}))
        for lie in reader(shown) if reader is not None else ():
            findings.error(lie.code, lie.where, lie.got, lie.expected)

    checks: list[Callable[[], None]] = [
        lambda: check_identity(flight, context.actions, findings),
        lambda: check_geometry(flight, findings),
        lambda: check_motion(flight, twin, settings.get("render", {}).get("perturbation", {}), findings),
        lambda: check_captions(flight, context.window_frames, findings),
        lambda: check_settings(flight, settings, findings),
        lambda: check_draws(flight, _of_run(context.draws, flight), findings),
        read_captions,
    ]
    is_sane = True
    for check in checks:
        try:
            check()
        except SENSELESS as error:
            is_sane = False
            expected = "values that can be computed with"
            findings.error("senseless", flight.name, f"{type(error).__name__}: {error}", expected)
    return is_sane


def _check_pictures(
    flight: FlightRows, source: FlightSource, entry: Entry, context: Context, is_sane: bool, findings: Findings
) -> PictureKeys:
    try:
        return check_pictures(flight, source.pictures(entry), context.depth, context.rounded_as, findings)
    except InputError as error:
        findings.error("unreadable", flight.name, f"{error.what}: {error.got}", "pictures that can be read")
    except SENSELESS as error:
        if is_sane:
            raise
        findings.error("not_checked", flight.name, f"pictures: {type(error).__name__}: {error}", "rows of sense")
    return PictureKeys()
