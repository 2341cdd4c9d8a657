"""Relations between flights: one row a frame, splits that share no walk, pairs, pictures that stand in one place alone."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosfly.geometry import wrap_deg
from cosfly.splits import town_family
from release.verify.findings import Findings
from release.verify.motion import clean_positions
from release.verify.rows import FlightRows

CELL_M = 0.35  # people in one cell are nearer than the 0.5 m within which flights are built into one walk
LEAST_SECONDS, WALK_SHARE = (
    8,
    0.7,
)  # of the seconds that two flights know, in one cell: they follow one walk; half is enough to build
MOVED_M, TURNED_DEG = 0.5, 2.0  # between two cameras that cannot take the same picture
MOST_SHARED = 64  # flights in one cell; more are a crowd of copies, of which these are enough


@dataclass
class Summary:
    """What is kept of a flight to compare it with others. cells: (second, x, y) of the clean person; pictures: key, row, pose a row."""

    name: str
    split: str | None = None
    walk: str | None = None
    pair: str | None = None
    track: str | None = None
    town: str = ""
    is_foreign: bool = False
    num_rows: int = 0
    ids: list[str] = field(default_factory=list)
    cells: list[tuple[int, int, int]] = field(default_factory=list)
    poses: list[list[float]] = field(default_factory=list)
    colours: list[int] = field(default_factory=list)
    depths: list[int] = field(default_factory=list)

    def dumped(self) -> dict[str, Any]:
        return dict(vars(self))


def summary_of(flight: FlightRows, keys: list[tuple[int, int]]) -> Summary:
    first = flight.rows[0]
    _, target, _ = clean_positions(flight)
    whole = np.abs(flight.time_s - np.round(flight.time_s)) < 1e-3
    known = whole & ~np.isnan(target).any(axis=1)
    cells = np.column_stack([np.round(flight.time_s[known]), np.floor(target[known, :2] / CELL_M)]).astype(int)
    return Summary(
        name=flight.name, split=first.get("split"), walk=first.get("walk"), pair=first.get("pair"), track=first.get("track"),
        town=str(first.get("town")), is_foreign=flight.is_foreign, num_rows=len(flight), ids=[str(row.get("sample_id")) for row in flight.rows],
        cells=[(int(s), int(x), int(y)) for s, x, y in cells],
        poses=[[round(float(v), 4) for v in pose] for pose in np.nan_to_num(flight.pose)],
        colours=[colour for colour, _ in keys], depths=[depth for _, depth in keys],
    )  # fmt: skip


def check_across(flights: list[Summary], *, by_town: bool, both: bool, findings: Findings) -> None:
    """Compare flights with each other.

    Args:
        by_town: splits share no town either. both: every flight's twin is released too.
    """
    _check_ids(flights, findings)
    _check_splits(flights, by_town, findings)
    _check_pairs({flight.name: flight for flight in flights}, both, findings)
    _check_copies(flights, findings)
    for name in ("colours", "depths"):
        _check_pictures(flights, name, findings)


def _check_ids(flights: Iterable[Summary], findings: Findings) -> None:
    counts = Counter(own for flight in flights for own in flight.ids)
    for own, count in counts.items():
        if count > 1:
            findings.error("duplicate", own, f"{count} rows", "one row a frame")


def _check_splits(flights: list[Summary], by_town: bool, findings: Findings) -> None:
    """No walk, trajectory or, where splits are by town, town family stands in two splits, whatever the rows call it."""
    groups: dict[tuple[str, str], set[str]] = defaultdict(set)
    for flight in flights:
        if flight.split is None:
            continue
        groups["walk", str(flight.walk)].add(flight.split)
        groups["trajectory", flight.name.rpartition("/")[0]].add(flight.split)
        if by_town:
            groups["town", town_family(flight.town)].add(flight.split)
    for (kind, name), splits in groups.items():
        if len(splits) > 1:
            findings.error("leak", f"{kind} {name}", f"in {', '.join(sorted(splits))}", "each walk in one split")
    known = [flight for flight in flights if flight.split is not None]
    for one, other, share in same_walks(known):
        if one.split != other.split:
            got = f"{one.split} and {other.split}: the person at the same place in {share:.0%} of the seconds"
            findings.error("leak", f"{one.name} and {other.name}", got, "one walk in one split")
        elif one.walk != other.walk:
            findings.error(
                "walk", f"{one.name} and {other.name}", f"{one.walk} and {other.walk}", "one name for one walk"
            )


def same_walks(flights: list[Summary]) -> Iterable[tuple[Summary, Summary, float]]:
    """Yield flights of one town family whose person is at the same places at the same seconds."""
    at: dict[tuple[str, int, int, int], list[int]] = defaultdict(list)
    for k, flight in enumerate(flights):
        for cell in set(flight.cells):
            at[town_family(flight.town), *cell].append(k)
    together: Counter[tuple[int, int]] = Counter()
    for group in at.values():
        for a, one in enumerate(group[:MOST_SHARED]):
            together.update((one, other) for other in group[a + 1 : MOST_SHARED])
    for (a, b), count in together.items():
        first, second = flights[a], flights[b]
        common = len({cell[0] for cell in first.cells} & {cell[0] for cell in second.cells})
        if common >= LEAST_SECONDS and count >= WALK_SHARE * common:
            yield first, second, count / common


def _check_pairs(flights: Mapping[str, Summary], both: bool, findings: Findings) -> None:
    """Check that twins name each other; where both tracks are wanted, that each flight has one. A run of one track alone has no twins."""
    tracks: dict[str, set[str | None]] = defaultdict(set)
    for flight in flights.values():
        tracks[flight.name.partition("/")[0]].add(flight.track)
    for flight in flights.values():
        if flight.pair is None:
            same = [n for n in flights if n != flight.name and n.rpartition("/")[0] == flight.name.rpartition("/")[0]]
            if same and flight.split is not None:
                findings.error("pair", flight.name, "null", f"{same[0]}, of the same trajectory")
            elif both and flight.split is not None and len(tracks[flight.name.partition("/")[0]]) > 1:
                findings.error("pair", flight.name, "without its twin", "both tracks, as settings.pairs says")
            continue
        twin = flights.get(flight.pair)
        if twin is None:
            findings.error(
                "pair", flight.name, f"{flight.pair}, which is not in the release", "a flight of the release"
            )
        elif twin.pair != flight.name or twin.track == flight.track:
            findings.error("pair", flight.name, f"{flight.pair}, whose pair is {twin.pair}", "two tracks that name each other")  # fmt: skip
        elif twin.name.rpartition("/")[0] != flight.name.rpartition("/")[0]:
            findings.error("pair", flight.name, flight.pair, "a flight of the same trajectory")


def _check_copies(flights: list[Summary], findings: Findings) -> None:
    """Two flights of two trajectories of a run never have one way through the air."""
    ways: dict[tuple, Summary] = {}
    for flight in flights:
        way = tuple(tuple(pose) for pose in flight.poses)
        if len(way) < 2 or len(set(way)) < 2:
            continue
        other = ways.setdefault(way, flight)
        if other is flight or other.name.rpartition("/")[0] == flight.name.rpartition("/")[0]:
            continue
        # Another run may fly the same way on purpose, in other weather.
        is_of_run = other.name.split("/")[0] == flight.name.split("/")[0]
        got = f"the poses of {other.name}, all of them"
        findings.add("error" if is_of_run else "warning", "copy", flight.name, got, "a flight of its own")


def _check_pictures(flights: list[Summary], column: str, findings: Findings) -> None:
    """The same picture from two places is a copy."""
    first: dict[int, tuple[str, list[float]]] = {}
    for flight in flights:
        for own, key, pose in zip(flight.ids, getattr(flight, column), flight.poses, strict=False):
            if not key:
                continue
            known, place = first.setdefault(key, (own, pose))
            if known == own:
                continue
            shift = float(np.linalg.norm(np.subtract(place[:3], pose[:3])))
            turn = float(np.abs(np.asarray(wrap_deg(np.subtract(place[3:], pose[3:])))).max())
            if shift > MOVED_M or turn > TURNED_DEG:
                what = {"colours": "image", "depths": "depth"}[column]
                got, expected = f"that of {known}, {shift:.1f} m and {turn:.1f} degrees away", "a picture of its own"
                # Somebody else's pictures may be drawn, blank or of a town that repeats itself.
                findings.add("warning" if flight.is_foreign else "error", "copy", f"{own}: {what}", got, expected)
