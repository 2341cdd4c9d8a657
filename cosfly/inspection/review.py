"""Decisions of people on tracks that the inspection left in review: `cosfly inspect review`."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

from cosfly.formats.inspection import TrackInspection, read_inspection
from cosfly.formats.review import REVIEW, Choice, Decision, in_review, read_decisions
from cosfly.runtime.errors import InputError
from cosfly.runtime.io import sha256_file
from cosfly.runtime.journal import Journal


def summary(inspected: Path) -> str:
    """Return the state of the review in one line, with the names of open tracks."""
    queue = [track.folder for track in in_review(read_inspection(inspected).flights)]
    decisions = read_decisions(inspected)
    verdicts = [decisions[folder].verdict for folder in queue if folder in decisions]
    waiting, num_others = [folder for folder in queue if folder not in decisions], len(decisions.keys() - set(queue))
    counts = f"{verdicts.count('accepted')} accepted, {verdicts.count('rejected')} rejected, {len(waiting)} open"
    text = f"{len(queue)} flights in review: {counts}" + (f"; {num_others} others rejected" if num_others else "")
    return text + (f" ({', '.join(waiting[:3])}{', ...' if len(waiting) > 3 else ''})" if waiting else "")


def add_decisions(inspected: Path, choices: Iterable[Choice], by: str) -> list[Decision]:
    """Record all choices, or none of them.

    A trajectory's folder means its tracks in review; a rejection also covers those that were accepted.
    """
    read_decisions(inspected)  # existing ones must be of this inspection
    digest, at = sha256_file(inspected), datetime.now(UTC).isoformat(timespec="seconds")
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
            about = {"inspection": digest, "sha256": track.sha256, "by": by, "at": at}
            decisions.append(Decision(**choice.model_dump() | {"folder": track.folder}, **about))
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
        known = ", ".join([track.folder for track in in_review(tracks)][:3])
        expected = f"the folder of a flight or of its trajectory, as {known}"
        raise InputError("no such flight", where=inspected, got=choice.folder, expected=expected)
    return found
