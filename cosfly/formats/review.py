"""`review.jsonl`: what people decided about tracks that the inspection could not decide (`cosfly inspect review`).

It is stored next to `inspect.json` and only grows: a later decision on the same track replaces an earlier one. Each
decision names the inspection by the digest of its file and counts for that inspection only.
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


class Choice(Record):
    """A person's verdict on a track, named by its folder in the playback tree, or on a trajectory, by the one above."""

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
    path, digest = inspected.with_name(REVIEW), sha256_file(inspected)
    journal, found = Journal(path), dict[str, Decision]()
    for decision in journal.read_as(Decision.model_validate):
        if decision.inspection != digest:
            raise InputError(
                "the decision belongs to another inspection",
                where=f"{path}:{journal.line_num}",
                got=f"{decision.folder}, {decision.verdict} by {decision.by} at {decision.at}",
                expected=f"decisions on {inspected}",
                fix=f"move {REVIEW} away and decide again with cosfly inspect review, or restore that inspection",
            )
        found[decision.folder] = decision
    if journal.is_cut_short:
        log.warning("%s: the last decision was cut short by a kill and does not count; decide it again", path)
    if num_damaged := journal.num_damaged - journal.is_cut_short:
        fix = "restore the file, or move it away and decide again with cosfly inspect review"
        raise InputError("a decision was changed", where=path, got=f"{num_damaged} damaged lines", fix=fix)
    return found


def _queue(inspected: Path) -> tuple[list[str], dict[str, Decision]]:
    """Return the folders of the tracks in review, and the decisions on all tracks."""
    return _folders_in_review(read_inspection(inspected).flights), read_decisions(inspected)


def _folders_in_review(tracks: Iterable[TrackInspection]) -> list[str]:
    return [track.folder for track in tracks if track.result == "review"]


def undecided(inspected: Path) -> list[str]:
    """Return the folders of the tracks in review that nobody has decided."""
    queue, decisions = _queue(inspected)
    return [folder for folder in queue if folder not in decisions]


def how_to_decide(folder: Path) -> str:
    """Return the instructions for deciding the tracks that the inspection in `folder` left in review."""
    return (
        f"look at {folder}/report.html, then cosfly inspect review --inspect {folder} --accept TRACK (or --reject) "
        f"--by NAME --reason TEXT"
    )


def summary(inspected: Path) -> str:
    """Return the state of the review in one line, with the names of open tracks."""
    queue, decisions = _queue(inspected)
    verdicts = [decisions[folder].verdict for folder in queue if folder in decisions]
    waiting, num_others = [folder for folder in queue if folder not in decisions], len(decisions.keys() - set(queue))
    counts = f"{verdicts.count('accepted')} accepted, {verdicts.count('rejected')} rejected, {len(waiting)} open"
    text = f"{len(queue)} flights in review: {counts}" + (f"; {num_others} others rejected" if num_others else "")
    return text + (f" ({', '.join(waiting[:3])}{', ...' if len(waiting) > 3 else ''})" if waiting else "")


def read_settled(inspected: Path) -> Inspection:
    """Read `inspect.json` with people's decisions applied to the results and the funnel of trajectories."""
    inspection, decisions = read_inspection(inspected), read_decisions(inspected)
    if not decisions:
        return inspection
    verdicts = {folder: {"result": one.verdict, "decided": one.verdict} for folder, one in decisions.items()}
    tracks = [track.model_copy(update=verdicts.get(track.folder)) for track in inspection.flights]
    is_planned = any(track.trace_id is not None for track in tracks) or not inspection.funnel.trajectories.rendered
    counts = count_trajectories(tracks, planned=is_planned)
    trajectories = inspection.funnel.trajectories.model_copy(update=counts)
    trajectories.check()
    funnel = inspection.funnel.model_copy(update={"trajectories": trajectories})
    return inspection.model_copy(update={"flights": tracks, "funnel": funnel})


def add_decisions(inspected: Path, choices: Iterable[Choice], by: str) -> list[Decision]:
    """Record all choices, or none of them.

    A trajectory's folder means its tracks in review; a rejection also covers those that were accepted.
    """
    read_decisions(inspected)  # existing ones must be of this inspection
    about = {"inspection": sha256_file(inspected), "by": by, "at": datetime.now(UTC).isoformat(timespec="seconds")}
    tracks, decisions = read_inspection(inspected).flights, list[Decision]()
    for choice in choices:
        for track in _chosen(choice, tracks, inspected):
            if track.result == "rejected" and choice.verdict == "accepted":
                raise InputError(
                    "a flight that breaks a rule cannot be accepted",
                    where=track.folder,
                    got=track.reason or "rejected",
                    expected="a flight in review",
                    fix="fix the flight, or change the threshold and inspect again",
                )
            named = {"folder": track.folder, "sha256": track.sha256}
            decisions.append(Decision(**choice.model_dump() | named | about))
    with Journal(inspected.with_name(REVIEW)) as journal:
        for decision in decisions:
            journal.append(decision.model_dump())
    return decisions


def _chosen(choice: Choice, tracks: list[TrackInspection], inspected: Path) -> list[TrackInspection]:
    """Return the tracks that a choice means."""
    name = choice.folder.strip("/")
    named = [track for track in tracks if track.folder == name]
    below = [track for track in tracks if track.folder.rpartition("/")[0] == name]
    meant = ("review",) if choice.verdict == "accepted" else ("review", "accepted")
    found = named or [track for track in below if track.result in meant] or below
    if not found:
        expected = f"the folder of a flight or of its trajectory, as {', '.join(_folders_in_review(tracks)[:3])}"
        raise InputError("no such flight", where=inspected, got=choice.folder, expected=expected)
    return found
