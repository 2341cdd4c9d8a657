"""Relations between flights: one row a frame, splits that share no walk, pairs, pictures that stand in one place alone.

Of each row 80 bytes are compared with those of all other rows; they come from the worker processes in files (`RowFiles`).
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
from release.verify.findings import Findings
from release.verify.motion import clean_positions
from release.verify.rows import FlightRows
from release.verify.scene import Shown

CELL_M = 0.35  # people in one cell are nearer than the 0.5 m within which flights are built into one walk
# Of the seconds that two flights know, in one cell: they follow one walk; half is enough to build. Of the places of one, the other's too.
LEAST_SECONDS, LEAST_PLACES, WALK_SHARE = 8, 16, 0.7
PLACE_M = 0.01  # two people on one pavement step on the same centimetre by chance, not again and again
MOVED_M, TURNED_DEG = 0.5, 2.0  # between two cameras that cannot take the same picture
GROUND_MOST_M, LEAST_GROUNDS = 0.05, 5  # between twins: rounding of depth as float16; frames, for a median
MOST_SHARED = 64  # flights in one cell; more are a crowd of copies, of which these are enough
NO_SECOND = np.iinfo(np.int64).min  # of rows between two whole seconds, or without a person
# What is kept of a row. sample_id, image, depth: digests, 0 where there is none; place, cell: of the clean person x, y and second, x, y;
# pose: as POSE.
COMPARED = np.dtype(
    [("sample_id", "u8"), ("image", "u8"), ("depth", "u8"), ("place", "u8"), ("cell", "i8", 3), ("pose", "f4", 6)]
)
FLIGHT = np.dtype([("flight", "i8"), ("row", "i8")])


@dataclass
class Summary:
    """What is kept of a flight to compare it with others. rows_file: of its rows. frames_digest: of the indices of its frames, the first three
    of which are first_frames; way_digest: of its poses, "" where these do not move; walk: None where the format has none. kinds, grounds_m: as
    Shown has them."""

    name: str
    rows_file: str
    split: str | None
    walk: str | None
    pair: str | None
    track: str | None
    town: str
    is_foreign: bool
    num_rows: int
    first_frames: list[int]
    frames_digest: str
    way_digest: str
    kinds: list[int]
    grounds_m: list[tuple[int, float]]

    def dumped(self) -> dict[str, Any]:
        return dict(vars(self))


def summary_of(flight: FlightRows, shown: Shown, rows: RowFiles, rows_file: str) -> Summary:
    """Summarize a flight, and write what is compared of its rows. shown: of its pictures, nothing where they were not read."""
    first = flight.rows[0]
    _, target, _ = clean_positions(flight)
    whole = np.abs(flight.time_s - np.round(flight.time_s)) < 1e-3
    is_seen = ~np.isnan(target).any(axis=1)
    known = whole & is_seen
    pose = np.nan_to_num(flight.pose)
    found = np.zeros(len(flight), COMPARED)
    found["sample_id"] = [_digest(str(row.get("sample_id")).encode()) for row in flight.rows]
    found["cell"] = NO_SECOND
    found["cell"][known] = np.column_stack([np.round(flight.time_s[known]), np.floor(target[known, :2] / CELL_M)])
    found["place"][is_seen] = [
        _digest(place.tobytes()) for place in np.round(target[is_seen, :2] / PLACE_M).astype(np.int64)
    ]
    found["pose"] = pose
    if shown.keys:
        found["image"][: len(shown.keys)], found["depth"][: len(shown.keys)] = np.array(shown.keys, np.uint64).T
    rows.write(rows_file, found)
    way = np.round(pose, 4) + 0.0
    return Summary(
        name=flight.name, rows_file=rows_file, split=first.get("split"), walk=str(first["walk"]) if "walk" in first else None, pair=first.get("pair"),
        track=first.get("track"), town=str(first.get("town")), is_foreign=flight.is_foreign, num_rows=len(flight),
        first_frames=flight.index[:3].tolist(), frames_digest=frames_digest(flight.index),
        way_digest=hashlib.sha256(way.tobytes()).hexdigest() if (way != way[0]).any() else "",
        kinds=shown.kinds, grounds_m=shown.grounds_m,
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

    def write(self, name: str, rows: np.ndarray) -> None:
        write_bytes(self.folder / name, rows.tobytes())

    def read(self, name: str) -> np.ndarray:
        return np.frombuffer(read_bytes(self.folder / name, tree=self.folder), COMPARED)

    def groups(self, flights: list[Summary], column: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the rows that have one value of a column, two or more, in the order of flights and rows; zero and NO_SECOND are no values.

        Yields:
            their COMPARED, and FLIGHT: the number of the flight in `flights` and that of the row in it.
        """
        parts, places = [], []
        for k, flight in enumerate(flights):
            rows = self.read(flight.rows_file)
            own = np.flatnonzero(np.atleast_2d(rows[column].T)[0] != (NO_SECOND if column == "cell" else 0))
            place = np.zeros(len(own), FLIGHT)
            place["flight"], place["row"] = k, own
            parts.append(rows[own])
            places.append(place)
        if not parts:
            return
        rows, place = np.concatenate(parts), np.concatenate(places)
        values = np.atleast_2d(rows[column].T)
        order = np.lexsort(values)  # stable: flights and rows stay in their order
        values = values[:, order]
        is_first = np.ones(len(order), np.bool_)
        is_first[1:] = (values[:, 1:] != values[:, :-1]).any(axis=0)
        for group in np.split(order, np.flatnonzero(is_first)[1:]):
            if len(group) > 1:
                yield rows[group], place[group]


def check_across(flights: list[Summary], rows: RowFiles, *, by_town: bool, both: bool, findings: Findings) -> None:
    """Compare flights with each other.

    Args:
        by_town: splits share no town either. both: every flight's twin is released too.
    """
    _check_ids(flights, rows, findings)
    _check_splits(flights, rows, by_town, findings)
    _check_pairs({flight.name: flight for flight in flights}, both, findings)
    _check_copies(flights, findings)
    _check_kinds(flights, findings)
    _check_grounds({flight.name: flight for flight in flights}, findings)
    for column in ("image", "depth"):
        _check_pictures(flights, rows, column, findings)


def _where(flights: list[Summary], place: np.ndarray) -> str:
    return f"{flights[place['flight']].name} row {place['row']}"


def _check_ids(flights: list[Summary], rows: RowFiles, findings: Findings) -> None:
    for _, places in rows.groups(flights, "sample_id"):
        shown = " and ".join(_where(flights, place) for place in places[:2])
        findings.error("duplicate", f"{shown}: sample_id", f"{len(places)} rows of one id", "one row a frame")


def _check_splits(flights: list[Summary], rows: RowFiles, by_town: bool, findings: Findings) -> None:
    """No walk, trajectory or, where splits are by town, town family stands in two splits, whatever the rows call it."""
    groups: dict[tuple[str, str], set[str]] = defaultdict(set)
    for flight in flights:
        if flight.split is None:
            continue
        if flight.walk is not None:
            groups["walk", flight.walk].add(flight.split)
        groups["trajectory", flight.name.rpartition("/")[0]].add(flight.split)
        if by_town:
            groups["town", town_family(flight.town)].add(flight.split)
    for (kind, name), splits in groups.items():
        if len(splits) > 1:
            findings.error("leak", f"{kind} {name}", f"in {', '.join(sorted(splits))}", "each walk in one split")
    known = [flight for flight in flights if flight.split is not None]
    told: set[tuple[str, str]] = set()
    for one, other, share in same_walks(known, rows):
        if one.split != other.split:
            got = f"{one.split} and {other.split}: the person at the same place in {share:.0%} of the seconds"
            findings.error("leak", f"{one.name} and {other.name}", got, "one walk in one split")
            told.add((one.name, other.name))
        elif one.walk != other.walk and None not in (one.walk, other.walk):
            findings.error(
                "walk", f"{one.name} and {other.name}", f"{one.walk} and {other.walk}", "one name for one walk"
            )
    for one, other, share in same_places(known, rows):
        if one.split != other.split and (one.name, other.name) not in told:
            got = f"{one.split} and {other.split}: {share:.0%} of the places of the person are the other's, at other times"
            findings.error("leak", f"{one.name} and {other.name}", got, "one walk in one split")


def same_walks(flights: list[Summary], rows: RowFiles) -> Iterator[tuple[Summary, Summary, float]]:
    """Yield flights of one town family whose person is at the same places at the same seconds, and in which share of these."""
    families = [town_family(flight.town) for flight in flights]
    together: Counter[tuple[int, int]] = Counter()
    for _, places in rows.groups(flights, "cell"):
        in_family: dict[str, list[int]] = defaultdict(list)
        for k in np.unique(places["flight"]).tolist():
            in_family[families[k]].append(k)
        for group in in_family.values():
            together.update(itertools.combinations(group[:MOST_SHARED], 2))
    for (a, b), count in sorted(together.items()):
        if count < WALK_SHARE * LEAST_SECONDS:
            continue
        common = len(_seconds(rows, flights[a]) & _seconds(rows, flights[b]))
        if common >= LEAST_SECONDS and count >= WALK_SHARE * common:
            yield flights[a], flights[b], count / common


def same_places(flights: list[Summary], rows: RowFiles) -> Iterator[tuple[Summary, Summary, float]]:
    """Yield flights of one town family whose person is at the same places, whenever, and which share of the places of one of them that is."""
    families = [town_family(flight.town) for flight in flights]
    together: Counter[tuple[int, int]] = Counter()
    for _, places in rows.groups(flights, "place"):
        own = np.unique(places["flight"]).tolist()
        pairs = itertools.combinations(own[:MOST_SHARED], 2)
        together.update(pair for pair in pairs if families[pair[0]] == families[pair[1]])
    for (a, b), count in sorted(together.items()):
        least = (
            min(len(np.unique(rows.read(flights[k].rows_file)["place"])) for k in (a, b))
            if count >= LEAST_PLACES
            else 0
        )
        if least and count >= WALK_SHARE * least:
            yield flights[a], flights[b], count / least


def _seconds(rows: RowFiles, flight: Summary) -> set[int]:
    """Give the whole seconds at which a flight knows where the person is."""
    return set(rows.read(flight.rows_file)["cell"][:, 0].tolist()) - {NO_SECOND}


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
    ways: dict[str, Summary] = {}
    for flight in flights:
        if not flight.way_digest:
            continue
        other = ways.setdefault(flight.way_digest, flight)
        if other is flight or other.name.rpartition("/")[0] == flight.name.rpartition("/")[0]:
            continue
        # Another run may fly the same way on purpose, in other weather.
        is_of_run = other.name.split("/")[0] == flight.name.split("/")[0]
        got = f"the poses of {other.name}, all of them"
        findings.add("error" if is_of_run else "warning", "copy", flight.name, got, "a flight of its own")


def _check_kinds(flights: list[Summary], findings: Findings) -> None:
    """A thing of a run's town is of one kind in all flights."""
    first: dict[tuple[str, str, int], tuple[int, str]] = {}
    for flight in flights:
        for code in flight.kinds:
            own, kind = code >> 8, code & 255
            known, other = first.setdefault((flight.name.split("/")[0], flight.town, own), (kind, flight.name))
            if kind != known:
                findings.error("instance_kind", flight.name, f"instance {own} of kind {kind}", f"kind {known}, as in {other}")  # fmt: skip


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
            severity: Severity = "warning" if flights[places[k + 1]["flight"]].is_foreign else "error"
            findings.add(severity, "copy", f"{_where(flights, places[k + 1])}: {column}", got, "a picture of its own")
