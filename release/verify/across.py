"""Relations between flights: one row a frame, splits that share no walk, pairs, pictures that stand in one place alone.

Of each row 80 bytes are compared with those of all other rows; they come from the worker processes in files
(`RowFiles`).
"""

from __future__ import annotations

import hashlib
import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosfly.geometry import wrap_deg
from cosfly.products.issues import Severity
from cosfly.products.splits import town_family
from cosfly.reading.files import read_bytes
from cosfly.work.store import write_bytes
from release.flight_rows import FlightRows
from release.verify.findings import Findings
from release.verify.motion import clean_positions
from release.verify.scene import PictureKeys

CELL_M = 0.35  # people in one cell are nearer than the 0.5 m within which flights are built into one walk
# Of the seconds that two flights know, in one cell: they follow one walk; half is enough to build. Of the places of
# one, the other's too.
LEAST_SECONDS, LEAST_PLACES, WALK_SHARE = 8, 16, 0.7
PLACE_M = 0.01  # two people on one pavement step on the same centimetre by chance, not again and again
MOVED_M, TURNED_DEG = 0.5, 2.0  # between two cameras that cannot take the same picture
GROUND_MOST_M, LEAST_GROUNDS = 0.05, 5  # between twins: rounding of depth as float16; frames, for a median
MOST_SHARED = 64  # flights in one cell; more are a crowd of copies, of which these are enough
NO_SECOND = np.iinfo(np.int64).min  # of rows between two whole seconds, or without a person
# What is kept of a row. sample_id, image, depth: digests, 0 where there is none; place, cell: of the clean person x, y
# and second, x, y;
# pose: as POSE.
COMPARED = np.dtype(
    [("sample_id", "u8"), ("image", "u8"), ("depth", "u8"), ("place", "u8"), ("cell", "i8", 3), ("pose", "f4", 6)]
)


@dataclass
class Summary:
    """What is kept of a flight to compare it with others. rows_file: of its rows. first: of its first row what is the
    same in all. frames_digest: of the indices of its frames, the first three of which are first_frames; way_digest: of
    its poses, "" where these do not move. kinds, grounds_m: as PictureKeys has them."""

    name: str
    rows_file: str
    split: str | None
    walk: str | None
    pair: str | None
    track: str | None
    town: str
    num_rows: int
    is_foreign: bool
    first_frames: list[int]
    frames_digest: str
    way_digest: str
    kinds: list[int]
    grounds_m: list[tuple[int, float]]

    @property
    def trajectory(self) -> str:
        return self.name.rpartition("/")[0]

    @property
    def run(self) -> str:
        return self.name.partition("/")[0]


def summary_of(flight: FlightRows, keys: PictureKeys, rows: RowFiles, rows_file: str) -> Summary:
    """Summarize a flight, and write what is compared of its rows. keys: of its pictures, nothing where they were not
    read."""
    first: dict[str, Any] = {name: flight.rows[0].get(name) for name in ("split", "walk", "pair", "track", "town")}
    _, target, _ = clean_positions(flight)
    is_seen = ~np.isnan(target).any(axis=1)
    known = is_seen & (np.abs(flight.time_s - np.round(flight.time_s)) < 1e-3)
    pose = np.nan_to_num(flight.pose)
    found = np.zeros(len(flight), COMPARED)
    found["sample_id"] = [_digest(str(row.get("sample_id")).encode()) for row in flight.rows]
    found["cell"] = NO_SECOND
    found["cell"][known] = np.column_stack([np.round(flight.time_s[known]), np.floor(target[known, :2] / CELL_M)])
    places = np.round(target[is_seen, :2] / PLACE_M).astype(np.int64)
    found["place"][is_seen] = [_digest(place.tobytes()) for place in places]
    found["pose"] = pose
    if keys.pictures:
        found["image"][: len(keys.pictures)], found["depth"][: len(keys.pictures)] = np.array(
            keys.pictures, np.uint64
        ).T
    write_bytes(rows.folder / rows_file, found.tobytes())
    way = np.round(pose, 4) + 0.0
    moves = bool((way != way[0]).any())
    return Summary(
        **first | {"town": str(first["town"])}, name=flight.name, rows_file=rows_file, num_rows=len(flight),
        is_foreign=flight.is_foreign,
        first_frames=flight.index[:3].tolist(), frames_digest=frames_digest(flight.index),
        way_digest=hashlib.sha256(way.tobytes()).hexdigest() if moves else "", kinds=keys.kinds,
        grounds_m=keys.grounds_m,
    )  # fmt: skip


def frames_digest(indices: np.ndarray) -> str:
    """Give a digest of a flight's frame indices, (n,)."""
    return hashlib.sha256(indices.astype(np.int64).tobytes()).hexdigest()


def _digest(data: bytes) -> int:
    return int.from_bytes(hashlib.blake2b(data, digest_size=8).digest(), "big")


@dataclass(frozen=True)
class RowFiles:
    """Files of COMPARED, one a flight, in a folder that is thrown away."""

    folder: Path

    def read(self, flight: Summary) -> np.ndarray:
        return np.frombuffer(read_bytes(self.folder / flight.rows_file, tree=self.folder), COMPARED)

    def groups(self, flights: list[Summary], column: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the rows that have one value of a column, two or more, in the order of flights and rows; zero and
        NO_SECOND are no values.

        Yields:
            their COMPARED, and (k, 2) of each the number of its flight in `flights` and that of the row in it.
        """
        parts, places = [np.zeros(0, COMPARED)], [np.zeros((0, 2), np.int64)]
        for k, flight in enumerate(flights):
            rows = self.read(flight)
            own = np.flatnonzero(np.atleast_2d(rows[column].T)[0] != (NO_SECOND if column == "cell" else 0))
            parts.append(rows[own])
            places.append(np.column_stack([np.full(len(own), k), own]))
        rows, place = np.concatenate(parts), np.concatenate(places)
        values = np.atleast_2d(rows[column].T)
        order = np.lexsort(values)  # stable: flights and rows stay in their order
        begins = np.flatnonzero((np.diff(values[:, order], axis=1) != 0).any(axis=0)) + 1
        for group in np.split(order, begins):
            if len(group) > 1:
                yield rows[group], place[group]


def check_across(flights: list[Summary], rows: RowFiles, *, by_town: bool, both: bool, findings: Findings) -> None:
    """Compare flights with each other.

    Args:
        by_town: splits share no town either. both: every flight's twin is released too.
    """
    for _, places in rows.groups(flights, "sample_id"):
        where = " and ".join(_where(flights, place) for place in places[:2])
        findings.error("duplicate", f"{where}: sample_id", f"{len(places)} rows of one id", "one row a frame")
    _check_splits([flight for flight in flights if flight.split is not None], rows, by_town, findings)
    by_name = {flight.name: flight for flight in flights}
    _check_pairs(by_name, both, findings)
    _check_grounds(by_name, findings)
    _check_copies(flights, findings)
    _check_kinds(flights, findings)
    for column in ("image", "depth"):
        _check_pictures(flights, rows, column, findings)


def _where(flights: list[Summary], place: np.ndarray) -> str:
    return f"{flights[place[0]].name} row {place[1]}"


def _check_splits(flights: list[Summary], rows: RowFiles, by_town: bool, findings: Findings) -> None:
    """No walk, trajectory or, where splits are by town, town family stands in two splits, whatever the rows call it."""
    groups: dict[tuple[str, str], set[str]] = defaultdict(set)
    for flight in flights:
        town = town_family(flight.town) if by_town else None
        for kind, name in (("walk", flight.walk), ("trajectory", flight.trajectory), ("town", town)):
            if name is not None:
                groups[kind, name].add(str(flight.split))
    for (kind, name), splits in groups.items():
        if len(splits) > 1:
            findings.error("leak", f"{kind} {name}", f"in {', '.join(sorted(splits))}", "each walk in one split")
    told: set[tuple[str, str]] = set()
    for one, other, share in same_walks(flights, rows):
        where = f"{one.name} and {other.name}"
        if one.split != other.split:
            got = f"{one.split} and {other.split}: the person at the same place in {share:.0%} of the seconds"
            findings.error("leak", where, got, "one walk in one split")
            told.add((one.name, other.name))
        elif one.walk != other.walk and None not in (one.walk, other.walk):
            findings.error("walk", where, f"{one.walk} and {other.walk}", "one name for one walk")
    for one, other, share in same_places(flights, rows):
        if one.split != other.split and (one.name, other.name) not in told:
            got = f"{one.split} and {other.split}: {share:.0%} of the person's places are the other's, at other times"
            findings.error("leak", f"{one.name} and {other.name}", got, "one walk in one split")


def same_walks(flights: list[Summary], rows: RowFiles) -> Iterator[tuple[Summary, Summary, float]]:
    """Yield flights of one town family whose person is at the same places at the same seconds, and in which share of
    these."""
    for one, other, count in _together(flights, rows, "cell"):
        if count >= WALK_SHARE * LEAST_SECONDS:
            first, second = (set(rows.read(flight)["cell"][:, 0].tolist()) - {NO_SECOND} for flight in (one, other))
            common = len(first & second)
            if common >= LEAST_SECONDS and count >= WALK_SHARE * common:
                yield one, other, count / common


def same_places(flights: list[Summary], rows: RowFiles) -> Iterator[tuple[Summary, Summary, float]]:
    """Yield flights of one town family whose person is at the same places, whenever, and which share of the places of
    one of them that is."""
    for one, other, count in _together(flights, rows, "place"):
        if count >= LEAST_PLACES:
            least = min(len(np.unique(rows.read(flight)["place"])) for flight in (one, other))
            if count >= WALK_SHARE * least:
                yield one, other, count / least


def _together(flights: list[Summary], rows: RowFiles, column: str) -> Iterator[tuple[Summary, Summary, int]]:
    """Yield flights of one town family that share values of a column, and how many."""
    families = [town_family(flight.town) for flight in flights]
    together: Counter[tuple[int, int]] = Counter()
    for _, places in rows.groups(flights, column):
        in_family: dict[str, list[int]] = defaultdict(list)
        for k in np.unique(places[:, 0]).tolist():
            in_family[families[k]].append(k)
        for group in in_family.values():
            together.update(itertools.combinations(group[:MOST_SHARED], 2))
    for (a, b), count in sorted(together.items()):
        yield flights[a], flights[b], count


def _check_pairs(flights: Mapping[str, Summary], both: bool, findings: Findings) -> None:
    """Check that twins name each other; where both tracks are wanted, that each flight has one. A run of one track
    alone has no twins."""
    tracks: dict[str, set[str | None]] = defaultdict(set)
    of_trajectory: dict[str, list[str]] = defaultdict(list)
    for flight in flights.values():
        tracks[flight.run].add(flight.track)
        of_trajectory[flight.trajectory].append(flight.name)
    for flight in flights.values():
        twin, got = flights.get(flight.pair or ""), flight.pair
        if flight.pair is None:
            others = [name for name in of_trajectory[flight.trajectory] if name != flight.name]
            if flight.split is None:
                expected = ""
            elif others:
                got, expected = "null", f"{others[0]}, of the same trajectory"
            elif both and len(tracks[flight.run]) > 1:
                got, expected = "without its twin", "both tracks, as settings.pairs says"
            else:
                expected = ""
        elif twin is None:
            got, expected = f"{flight.pair}, which is not in the release", "a flight of the release"
        elif twin.pair != flight.name or twin.track == flight.track:
            got, expected = f"{flight.pair}, whose pair is {twin.pair}", "two tracks that name each other"
        else:
            expected = "" if twin.trajectory == flight.trajectory else "a flight of the same trajectory"
        if expected:
            findings.error("pair", flight.name, got, expected)


def _check_copies(flights: list[Summary], findings: Findings) -> None:
    """Two flights of two trajectories of a run never have one way through the air; another run may fly the same way in
    other weather."""
    ways: dict[str, Summary] = {}
    for flight in (flight for flight in flights if flight.way_digest):
        other = ways.setdefault(flight.way_digest, flight)
        if other.trajectory != flight.trajectory:
            got = f"the poses of {other.name}, all of them"
            severity: Severity = "error" if other.run == flight.run else "warning"
            findings.add(severity, "copy", flight.name, got, "a flight of its own")


def _check_kinds(flights: list[Summary], findings: Findings) -> None:
    """A thing of a run's town is of one kind in all flights."""
    first: dict[tuple[str, str, int], tuple[int, str]] = {}
    for flight in flights:
        for code in flight.kinds:
            own, kind = code >> 8, code & 255
            known, other = first.setdefault((flight.run, flight.town, own), (kind, flight.name))
            if kind != known:
                got = f"instance {own} of kind {kind}"
                findings.error("instance_kind", flight.name, got, f"kind {known}, as in {other}")


def _check_grounds(flights: Mapping[str, Summary], findings: Findings) -> None:
    """In frames in which the person of both twins stands at one place the ground there is equally high in both."""
    for flight in flights.values():
        twin = flights.get(flight.pair or "")
        if twin is None or flight.track == "clean":
            continue
        others = dict(twin.grounds_m)
        off_m = [height - others[index] for index, height in flight.grounds_m if index in others]
        if len(off_m) >= LEAST_GROUNDS and abs(median := float(np.median(off_m))) > GROUND_MOST_M:
            got = f"ground at the person's feet that is {abs(median):.2f} m {'higher' if median > 0 else 'lower'}"
            findings.error("ground", f"{flight.name} and {twin.name}", got, f"the same within {GROUND_MOST_M:g} m")


def _check_pictures(flights: list[Summary], rows: RowFiles, column: str, findings: Findings) -> None:
    """The same picture from two places is a copy."""
    for found, places in rows.groups(flights, column):
        away = found["pose"][1:].astype(np.float64) - found["pose"][0]
        shifts = np.linalg.norm(away[:, :3], axis=1)
        turns = np.abs(wrap_deg(away[:, 3:])).max(axis=1)
        for k in np.flatnonzero((shifts > MOVED_M) | (turns > TURNED_DEG)):
            got = f"that of {_where(flights, places[0])}, {shifts[k]:.1f} m and {turns[k]:.1f} degrees away"
            # Somebody else's pictures may be drawn, blank or of a town that repeats itself.
            severity: Severity = "warning" if flights[places[k + 1][0]].is_foreign else "error"
            findings.add(severity, "copy", f"{_where(flights, places[k + 1])}: {column}", got, "a picture of its own")
