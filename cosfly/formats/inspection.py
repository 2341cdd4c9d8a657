"""`inspect.json`, the product of step 6: one record per track and the funnel; `review.jsonl` next to it: decisions of
people on tracks that the inspection left in review (`cosfly inspect review`).

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
    results: dict[str, set[Result]] = {}
    for flight in flights:
        name = flight.trace_id if planned else str(Path(flight.folder).parent)
        if name is not None:
            results.setdefault(name, set()).add(flight.result)
    worst = Counter(max(of_trajectory, key=RESULTS.index) for of_trajectory in results.values())
    return {"rendered": len(results)} | {result: worst[result] for result in RESULTS}


def write_inspection(path: Path, inspection: Inspection) -> None:
    """Write `inspect.json`."""
    write_model(path, inspection, INSPECT_FORMAT)


def read_inspection(path: Path) -> Inspection:
    """Read `inspect.json`."""
    inspection = read_model(path, Inspection, INSPECT_FORMAT)
    counts = Counter(flight.folder for flight in inspection.flights)
    if repeated := [folder for folder, count in counts.items() if count > 1]:
        what, fix = "the inspection has two records of the same track", "run the inspection again"
        raise InputError(what, where=f"{path}: flights", got=repeated[0], expected="one record for each track", fix=fix)
    return inspection


# --- review.jsonl -----------------------------------------------------------------------------------------------------


class Choice(Record):
    """A person's verdict. folder: Of a track, relative to the playback tree."""

    folder: str
    verdict: Literal["accepted", "rejected"]
    reason: str = Field(min_length=1, max_length=2000)


class Decision(Choice):
    """A line of `review.jsonl`. inspection: sha256 of `inspect.json`; sha256: of the track's files as recorded there;
    at: UTC, ISO 8601."""

    inspection: str
    sha256: str | None
    by: str = Field(min_length=1, max_length=200)
    at: str


def read_decisions(inspected: Path) -> dict[str, Decision]:
    """Read the last decision on each track, by folder; empty without a file. inspected: path of `inspect.json`."""
    path = inspected.with_name(REVIEW)
    digest = sha256_file(inspected)
    journal = Journal(path)
    decisions: dict[str, Decision] = {}
    for decision in journal.read_as(Decision.model_validate):
        if decision.inspection != digest:
            found = f"for the version with sha256 {decision.inspection[:12]}"
            again = f"move {REVIEW} away and decide again with cosfly inspect review"
            raise InputError(
                f"the review decision was made for a different version of `{inspected.name}`",
                where=f"{path}:{journal.line_num}",
                got=f"{decision.verdict} {decision.folder} by {decision.by} at {decision.at}, {found}",
                expected=f"a decision for {inspected} with sha256 {digest[:12]}",
                fix=f"{again}; or restore the `{inspected.name}` that was reviewed",
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
    before, after = read_inspection(inspected).flights, read_settled(inspected).flights
    now = {track.folder: track.result for track in after}
    counts = Counter(now[track.folder] for track in before if track.result == "review")
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
    verdicts = {folder: decision.verdict for folder, decision in decisions.items()}
    updates = {folder: {"result": verdict, "decided": verdict} for folder, verdict in verdicts.items()}
    tracks = [track.model_copy(update=updates.get(track.folder)) for track in inspection.flights]
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
            raise InputError(
                "the track breaks a rule of the inspection, so it cannot be accepted",
                where=track.folder,
                got=track.reason or "rejected",
                expected="a track with the result `review`",
                fix="render the track again, or change the threshold of this rule, and run the inspection again",
            )
        file = {"folder": track.folder, "sha256": track.sha256, "inspection": digest}
        decisions.append(Decision(**file, verdict=choice.verdict, reason=choice.reason, by=by, at=now))
    with Journal(inspected.with_name(REVIEW)) as journal:
        for decision in decisions:
            journal.append(decision.model_dump())
    return decisions
