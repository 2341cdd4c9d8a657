"""Compare the flights of a release with each other: what two splits share, and whether twins name each other."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cosfly.geometry.splits import town_family
from release.flight_rows import FlightRows
from release.verify.findings import Findings


@dataclass
class Summary:
    """What is kept of a flight to compare it with others. frames_digest: of its
    frame indices. The rest is of its first row."""

    name: str
    split: str | None
    walk: str | None
    pair: str | None
    track: str | None
    town: str | None
    num_rows: int
    num_points: int
    frames_digest: str

    @property
    def trajectory(self) -> str:
        return self.name.rpartition("/")[0]


def summary_of(flight: FlightRows, num_points: int) -> Summary:
    """Return what is compared of a flight."""
    first = {name: flight.rows[0].get(name) for name in ("split", "walk", "pair", "track", "town")}
    return Summary(
        flight.name, **first, num_rows=len(flight), num_points=num_points, frames_digest=frames_digest(flight.index)
    )


def frames_digest(indices: np.ndarray) -> str:
    """Return a digest of a flight's frame indices, (n,)."""
    return hashlib.sha256(indices.astype(np.int64).tobytes()).hexdigest()


def check_across(flights: list[Summary], *, by_town: bool, both: bool, findings: Findings) -> None:
    """Compare flights with each other.

    Args:
        by_town: splits share no town either. both: every flight's twin is released too.
    """
    _check_splits([flight for flight in flights if flight.split is not None], by_town, findings)
    _check_pairs({flight.name: flight for flight in flights}, both, findings)


def _check_splits(flights: list[Summary], by_town: bool, findings: Findings) -> None:
    """Check that no walk, trajectory or, where splits are by town, town family is in two splits."""
    groups: dict[tuple[str, str], set[str]] = defaultdict(set)
    for flight in flights:
        town = town_family(str(flight.town)) if by_town else None
        for kind, name in (("walk", flight.walk), ("trajectory", flight.trajectory), ("town", town)):
            if name is not None:
                groups[kind, name].add(str(flight.split))
    for (kind, name), splits in groups.items():
        if len(splits) > 1:
            findings.error("leak", f"{kind} {name}", f"in {', '.join(sorted(splits))}", f"each {kind} in one split")


def _check_pairs(flights: Mapping[str, Summary], both: bool, findings: Findings) -> None:
    """Check that the two tracks of a trajectory name each other, and that both are there where both are wanted."""
    for flight in flights.values():
        twin = flights.get(flight.pair or "")
        if flight.pair is None and flight.split is not None and both:
            findings.error("pair", flight.name, "no other track", "both tracks (settings.pairs)")
        elif flight.pair is not None and (
            twin is None
            or (twin.pair, twin.trajectory) != (flight.name, flight.trajectory)
            or twin.track == flight.track
        ):
            findings.error(
                "pair", flight.name, flight.pair, "the other track of the trajectory, whose pair is this track"
            )
