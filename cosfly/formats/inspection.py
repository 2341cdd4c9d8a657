"""`inspect.json`, the product of step 6, and `review.jsonl`, the decisions of people on tracks in review.

`review.jsonl` only grows: a later decision on the same track replaces an earlier one. Each decision names the
inspection by the digest of its file and counts for that inspection only.
"""

import logging
from collections import Counter
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, FiniteFloat

from cosfly.formats.issues import Issue
from cosfly.formats.playback import ORIGINAL
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_file
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import FileFormat, Record, read_model, write_model

log = logging.getLogger(__name__)

INSPECT_FORMAT = FileFormat("cosfly.inspect", "1.0", "inspection")
REVIEW = "review.jsonl"

Result = Literal["accepted", "review", "rejected"]
RESULTS: tuple[Result, ...] = ("accepted", "review", "rejected")


class TrackInspection(Record):
    town: str
    trajectory: str
    variant: str
    is_original: bool | None = None  # None in older inspections and for unreadable tracks
    folder: str  # relative to the playback tree
    sha256: str | None = None  # of its files (`digest_of`); None in older inspections and for unreadable tracks
    trace_id: str | None
    result: Result
    issues: list[Issue]  # the worst first
    metrics: dict[str, FiniteFloat | int | None]  # None where unknown
    # By a person, after the inspection; `inspect.json` never holds it.
    decided: Literal["accepted", "rejected"] | None = Field(None, exclude=True)

    @property
    def track(self) -> Literal["clean", "perturbed"]:
        is_clean = self.variant == ORIGINAL if self.is_original is None else self.is_original
        return "clean" if is_clean else "perturbed"

    @property
    def reason(self) -> str | None:
        """Code of the worst finding; None if the track is accepted, `review` if a person rejected it."""
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
    """From planned trajectories to accepted tracks (sec:step6); a trajectory has the result of its worst track."""

    trajectories: TrajectoryFunnel
    flights: TrackFunnel


class Inspection(Record):
    """The whole file."""

    settings: dict[str, Any]
    funnel: Funnel
    flights: list[TrackInspection]


def count_trajectories(flights: list[TrackInspection], *, planned: bool) -> dict[str, int]:
    """Count rendered trajectories by the result of their worst track: `rendered`, `accepted`, `review`, `rejected`.

    planned: True counts planned trajectories and ignores tracks without one; False counts folders.
    """
    worst: dict[str, Result] = {}  # by trajectory
    for flight in flights:
        name = flight.trace_id if planned else str(Path(flight.folder).parent)
        if name is not None:
            worst[name] = max(worst.get(name, RESULTS[0]), flight.result, key=RESULTS.index)
    counts = Counter(worst.values())
    return {"rendered": len(worst)} | {result: counts[result] for result in RESULTS}


def write_inspection(path: Path, inspection: Inspection) -> None:
    """Write `inspect.json`."""
    write_model(path, inspection, INSPECT_FORMAT)


def read_inspection(path: Path) -> Inspection:
    """Read `inspect.json`."""
    inspection = read_model(path, Inspection, INSPECT_FORMAT)
    counts = Counter(flight.folder for flight in inspection.flights)
    if repeated := [folder for folder, count in counts.items() if count > 1]:
        what = "the inspection has two records of the same track"
        fix = "run the inspection again"
        raise InputError(what, where=f"{path}: flights", got=repeated[0], expected="one record for each track", fix=fix)
    return inspection


# --- review.jsonl -----------------------------------------------------------------------------------------------------


class Choice(Record):
    """A person's verdict on a track."""

    folder: str  # relative to the playback tree
    verdict: Literal["accepted", "rejected"]
    reason: str = Field(min_length=1, max_length=2000)


class Decision(Choice):
    """A line of `review.jsonl`."""

    inspection: str  # sha256 of `inspect.json`
    sha256: str | None  # of the track's files, as recorded there
    by: str = Field(min_length=1, max_length=200)
    at: str  # UTC, ISO 8601


# In the following functions `inspected` is the path of an `inspect.json`.


def read_decisions(inspected: Path) -> dict[str, Decision]:
    """Read the last decision on each track, by folder; empty without a file."""
    path = inspected.with_name(REVIEW)
    digest = sha256_file(inspected)
    journal = Journal(path)
    decisions: dict[str, Decision] = {}
    for decision in journal.read_as(Decision.model_validate):
        if decision.inspection != digest:
            text = f"{decision.verdict} {decision.folder} by {decision.by} at {decision.at}"
            raise InputError(
                f"the review decision was made for a different version of `{inspected.name}`",
                where=f"{path}:{journal.line_num}",
                got=f"{text}, for the version with sha256 {decision.inspection[:12]}",
                expected=f"a decision for {inspected} with sha256 {digest[:12]}",
                fix=f"move {REVIEW} away and decide again with cosfly inspect review; or restore the "
                f"`{inspected.name}` that was reviewed",
            )
        decisions[decision.folder] = decision
    if journal.num_damaged:
        log.warning("%s: %d damaged lines do not count; decide these tracks again", path, journal.num_damaged)
    return decisions


def undecided(inspected: Path) -> list[str]:
    """Return the folders of the tracks in review without a decision."""
    return [track.folder for track in read_settled(inspected).flights if track.result == "review"]


def how_to_decide(folder: Path) -> str:
    """Return the instructions for deciding the tracks that the inspection in `folder` left in review."""
    return (
        f"look at {folder}/report.html, then cosfly inspect review --inspect {folder} --accept TRACK (or --reject) "
        f"--by NAME --reason TEXT"
    )


def summary(inspected: Path) -> str:
    """Return the state of the review in one line, with the names of open tracks."""
    settled = {track.folder: track.result for track in read_settled(inspected).flights}
    in_review = [track.folder for track in read_inspection(inspected).flights if track.result == "review"]
    counts = Counter(settled[folder] for folder in in_review)
    waiting = undecided(inspected)
    text = f"{counts.total()} tracks in review: {counts['accepted']} accepted, {counts['rejected']} rejected"
    names = f" ({', '.join(waiting[:3])}{', ...' if len(waiting) > 3 else ''})" if waiting else ""
    return f"{text}, {len(waiting)} open{names}"


def read_settled(inspected: Path) -> Inspection:
    """Read `inspect.json` with people's decisions applied to the results and the funnel of trajectories."""
    inspection = read_inspection(inspected)
    decisions = read_decisions(inspected)
    if not decisions:
        return inspection
    tracks = []
    for track in inspection.flights:
        if track.folder in decisions:
            verdict = decisions[track.folder].verdict
            track = track.model_copy(update={"result": verdict, "decided": verdict})
        tracks.append(track)
    is_planned = any(track.trace_id is not None for track in tracks) or not inspection.funnel.trajectories.rendered
    counts = count_trajectories(tracks, planned=is_planned)
    trajectories = inspection.funnel.trajectories.model_copy(update=counts)
    trajectories.check()
    funnel = inspection.funnel.model_copy(update={"trajectories": trajectories})
    return inspection.model_copy(update={"flights": tracks, "funnel": funnel})


def add_decisions(inspected: Path, choices: Iterable[Choice], by: str) -> list[Decision]:
    """Record all choices, or none of them."""
    read_decisions(inspected)  # existing ones must be of this inspection
    digest = sha256_file(inspected)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    tracks = {track.folder: track for track in read_inspection(inspected).flights}
    decisions: list[Decision] = []
    for choice in choices:
        track = tracks.get(choice.folder.strip("/"))
        if track is None:
            what = "the inspection file lists no track in this folder"
            expected = f"the folder of a track, such as {', '.join(undecided(inspected)[:3])}"
            raise InputError(what, where=inspected, got=choice.folder, expected=expected)
        if track.result == "rejected" and choice.verdict == "accepted":
            what = "the track breaks a rule of the inspection, so it cannot be accepted"
            expected = "a track with the result `review`"
            fix = "render the track again, or change the threshold of this rule, and run the inspection again"
            raise InputError(what, where=track.folder, got=track.reason or "rejected", expected=expected, fix=fix)
        changes = {"folder": track.folder, "sha256": track.sha256, "inspection": digest, "by": by, "at": now}
        decisions.append(Decision(**choice.model_dump() | changes))
    with Journal(inspected.with_name(REVIEW)) as journal:
        for decision in decisions:
            journal.append(decision.model_dump())
    return decisions
