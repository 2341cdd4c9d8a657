"""`review.jsonl`: what people decided about tracks that the inspection could not decide (`cosfly inspect review`).

It is stored next to `inspect.json` and only grows: a later decision on the same track replaces an earlier one. Each
decision names the inspection by the digest of its file and counts for that inspection only.
"""

from __future__ import annotations

import logging
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


def undecided(inspected: Path) -> list[str]:
    """Return the folders of the tracks in review that nobody has decided."""
    decisions = read_decisions(inspected)
    return [track.folder for track in in_review(read_inspection(inspected).flights) if track.folder not in decisions]


def how_to_decide(folder: Path) -> str:
    """Return the instructions for deciding the tracks that the inspection in `folder` left in review."""
    return (
        f"look at {folder}/report.html, then cosfly inspect review --inspect {folder} --accept TRACK (or --reject) "
        f"--by NAME --reason TEXT"
    )


def in_review(tracks: list[TrackInspection]) -> list[TrackInspection]:
    """Return the tracks in review."""
    return [track for track in tracks if track.result == "review"]


def read_settled(inspected: Path) -> Inspection:
    """Read `inspect.json` with people's decisions applied to the results and the funnel of trajectories."""
    inspection, decisions = read_inspection(inspected), read_decisions(inspected)
    if not decisions:
        return inspection
    tracks = [
        track.model_copy(update={"result": one.verdict, "decided": one.verdict})
        if (one := decisions.get(track.folder))
        else track
        for track in inspection.flights
    ]
    is_planned = any(track.trace_id is not None for track in tracks) or not inspection.funnel.trajectories.rendered
    counts = count_trajectories(tracks, planned=is_planned)
    trajectories = inspection.funnel.trajectories.model_copy(update=counts)
    trajectories.check()
    funnel = inspection.funnel.model_copy(update={"trajectories": trajectories})
    return inspection.model_copy(update={"flights": tracks, "funnel": funnel})
