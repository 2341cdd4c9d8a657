"""`review.jsonl`: what people decided of flights that the inspection could not. Written by `cosfly inspect review`,
read by whoever takes flights by their result.

It stands beside `inspect.json` and only grows: a decision is never changed, a later one of the same flight counts
instead. Each names the inspection that it was made on by the digest of that file; on another one nobody decided
anything.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from pydantic import Field

from cosfly.formats.inspection import Inspection, TrackInspection, count_trajectories, read_inspection
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_file
from cosfly.runtime.journal import Journal
from cosfly.runtime.json_io import Record

log = logging.getLogger(__name__)

REVIEW = "review.jsonl"
Verdict = Literal["accepted", "rejected"]


class Choice(Record):
    """What somebody says of a flight by its folder in the playback tree, or of a trajectory by that above it."""

    folder: str
    verdict: Verdict
    reason: str = Field(min_length=1, max_length=2000)


class Decision(Choice):
    """A line of `review.jsonl`. inspection: sha256 of `inspect.json`; sha256: of the flight's files, as that has it;
    at: UTC, ISO 8601."""

    inspection: str
    sha256: str | None
    by: str = Field(min_length=1, max_length=200)
    at: str


def read_decisions(inspected: Path) -> dict[str, Decision]:
    """Read what was decided on an inspection: folder -> the last decision; empty where nobody decided.

    Args:
        inspected: path of `inspect.json`.
    """
    path, digest = inspected.with_name(REVIEW), sha256_file(inspected)
    journal, found = Journal(path), dict[str, Decision]()
    for decision in journal.read_as(Decision.model_validate):
        if decision.inspection != digest:
            raise InputError(
                "a decision on another inspection",
                where=f"{path}:{journal.line_num}",
                got=f"{decision.folder}, {decision.verdict} by {decision.by} at {decision.at}",
                expected=f"decisions on {inspected}",
                fix=f"move {REVIEW} away and decide again with cosfly inspect review, or put that inspection back",
            )
        found[decision.folder] = decision
    if journal.is_cut_short:
        log.warning("%s: the last decision was cut short by a kill and does not count: decide it again", path)
    if num_damaged := journal.num_damaged - journal.is_cut_short:
        raise InputError(
            "a decision that was changed", where=path, got=f"{num_damaged} damaged lines",
            fix="put the file back, or move it away and decide again with cosfly inspect review",
        )  # fmt: skip
    return found


def undecided(inspected: Path) -> list[str]:
    """Name the flights, by folder, that wait for a person: those in review that nobody has decided."""
    decisions = read_decisions(inspected)
    flights = read_inspection(inspected).flights
    return [flight.folder for flight in flights if flight.result == "review" and flight.folder not in decisions]


def summary(inspected: Path) -> str:
    """Return in a line how far the review is, with the names of flights that are open."""
    queue = [flight.folder for flight in read_inspection(inspected).flights if flight.result == "review"]
    decisions = read_decisions(inspected)
    verdicts = [decisions[folder].verdict for folder in queue if folder in decisions]
    waiting, others = undecided(inspected), len(decisions.keys() - set(queue))
    counts = f"{verdicts.count('accepted')} accepted, {verdicts.count('rejected')} rejected, {len(waiting)} open"
    text = f"{len(queue)} flights in review: {counts}" + (f"; {others} others rejected" if others else "")
    return text + (f" ({', '.join(waiting[:3])}{', ...' if len(waiting) > 3 else ''})" if waiting else "")


def how_to_decide(folder: Path) -> str:
    """Return how a person decides the flights that an inspection, in `folder`, left in review."""
    return (
        f"look at {folder}/report.html, then cosfly inspect review --inspect {folder} --accept FLIGHT (or --reject) "
        f"--by NAME --reason TEXT"
    )


def add_decisions(inspected: Path, choices: Iterable[Choice], by: str) -> list[Decision]:
    """Put choices on record; all of them, or none.

    A trajectory's folder stands for its flights in review; rejected with it are those that were accepted.
    """
    read_decisions(inspected)  # what stands there must be of this inspection
    digest, at = sha256_file(inspected), datetime.now(UTC).isoformat(timespec="seconds")
    flights = read_inspection(inspected).flights
    decisions = []
    for choice in choices:
        for flight in _chosen(choice, flights, inspected):
            if flight.result == "rejected" and choice.verdict == "accepted":
                raise InputError(
                    "a flight that breaks a rule cannot be accepted",
                    where=flight.folder,
                    got=flight.reason or "rejected",
                    expected="a flight in review",
                    fix="mend the flight, or change the threshold and inspect again",
                )
            about = {"inspection": digest, "sha256": flight.sha256, "by": by, "at": at}
            decisions.append(Decision(**choice.model_dump() | {"folder": flight.folder}, **about))
    with Journal(inspected.with_name(REVIEW)) as journal:
        for decision in decisions:
            journal.append(decision.model_dump())
    return decisions


def _chosen(choice: Choice, flights: list[TrackInspection], inspected: Path) -> list[TrackInspection]:
    """Return the flights that a choice means; those of a trajectory that need nobody stay as they are."""
    name = choice.folder.strip("/")
    named = [flight for flight in flights if flight.folder == name]
    below = [flight for flight in flights if flight.folder.rpartition("/")[0] == name]
    meant = ("review",) if choice.verdict == "accepted" else ("review", "accepted")
    found = named or [flight for flight in below if flight.result in meant] or below
    if not found:
        known = ", ".join([flight.folder for flight in flights if flight.result == "review"][:3])
        raise InputError(
            "no such flight",
            where=inspected,
            got=choice.folder,
            expected=f"the folder of a flight or of its trajectory, as {known}",
        )
    return found


def read_settled(inspected: Path) -> Inspection:
    """Read `inspect.json` with what people decided in it: results and the funnel of trajectories are those after
    review.
    """
    inspection, decisions = read_inspection(inspected), read_decisions(inspected)
    if not decisions:
        return inspection
    flights = [_settled(flight, decisions.get(flight.folder)) for flight in inspection.flights]
    is_planned = any(flight.trace_id is not None for flight in flights) or not inspection.funnel.trajectories.rendered
    counts = count_trajectories(flights, planned=is_planned)
    trajectories = inspection.funnel.trajectories.model_copy(update=counts)
    trajectories.check()
    funnel = inspection.funnel.model_copy(update={"trajectories": trajectories})
    return inspection.model_copy(update={"flights": flights, "funnel": funnel})


def _settled(flight: TrackInspection, decision: Decision | None) -> TrackInspection:
    if decision is None:
        return flight
    return flight.model_copy(update={"result": decision.verdict, "decided": decision.verdict})
