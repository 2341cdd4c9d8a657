"""What stands still in a town stands there for all flights of a run: some frames of each are carried into those of other walks.

A flight alone may be moved or turned as a whole, and its frames still agree with each other. Of each flight a few frames are kept, each
with every so manyth pixel of depth and mask: a camera of fewer pixels, whose depths are exact. Flights whose frames see nothing in common
are not compared.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from cosfly.space.reprojection import View, compare_views
from release.verify.findings import Findings

if TYPE_CHECKING:
    from release.verify.across import RowFiles, Summary
    from release.verify.rows import FlightRows

KEPT_FRAMES, KEPT_COLUMNS = 6, 160  # of a flight; pixels of a row of each, about
OTHERS = 2  # frames of other walks that each is carried into: those whose person is nearest
LEAST_SEEN, LEAST_AGREE = 300, 300  # points of two walks, for a share to mean something
# Points before what is drawn there: of two walks honest 0.001 at most, of one pair of frames 0.005; 0.013 where one walk is 3 m off.
THROUGH_MOST = 0.006
SAME_LEAST = 0.95  # of the instances, of ground the kinds, where the depth agrees; honest 0.984
# Of the points that agree, for two frames to see one place: where most is hidden some depths agree by chance.
MEET_LEAST = 0.5
Kept = tuple[View, np.ndarray]  # with its intrinsics, (4,) fx, fy, cx, cy


def kept_rows(num_rows: int) -> set[int]:
    """Give the rows of a flight whose frames are kept, spread evenly."""
    return set(np.linspace(0, num_rows - 1, min(KEPT_FRAMES, num_rows)).astype(int).tolist())


def can_be_kept(flight: FlightRows, i: int) -> bool:
    """Tell whether a row knows where its person and its camera are, in numbers that points can be carried with."""
    told = np.concatenate([flight.target_m[i], flight.pose[i], flight.intrinsics[i]])
    return bool(np.isfinite(told).all() and (flight.intrinsics[i, :2] > 0.0).all())


def thinned(view: View, intrinsics: np.ndarray) -> Kept:
    """Take every so manyth pixel of a frame that has depth and mask; colours are left out."""
    step = max(1, view.depth.shape[1] // KEPT_COLUMNS)
    first = step // 2
    part = np.s_[first::step, first::step]
    thin = View(view.depth[part].copy(), view.instance[part].copy(), None, view.rotation, view.position_m)
    focal, centre = intrinsics[:2] / step, (intrinsics[2:] - first - 0.5) / step + 0.5
    return thin, np.concatenate([focal, centre]).astype(np.float64)


def _frame_dtype(height: int, width: int) -> np.dtype:
    return np.dtype(
        [("depth", "f4", (height, width)), ("instance", "u1", (height, width, 3)), ("rotation", "f8", (3, 3)), ("position_m", "f8", 3), ("camera", "f8", 4)]
    )  # fmt: skip


def packed(frames: list[Kept]) -> bytes:
    """Give frames of one size as bytes that `unpacked` reads: height and width, then the frames; none: no bytes."""
    if not frames:
        return b""
    size = np.array(frames[0][0].depth.shape, np.int64)
    table = [(view.depth, view.instance, view.rotation, view.position_m, camera) for view, camera in frames]
    return size.tobytes() + np.array(table, _frame_dtype(*size.tolist())).tobytes()


def unpacked(data: bytes) -> list[Kept]:
    if not data:
        return []
    height, width = np.frombuffer(data, np.int64, 2).tolist()
    found = []
    for row in np.frombuffer(data, _frame_dtype(height, width), offset=16):
        depth, instance, rotation, position_m, camera = (np.ascontiguousarray(row[name]) for name in row.dtype.names)
        found.append((View(depth, instance, None, rotation, position_m), camera))
    return found


def check_places(flights: list[Summary], rows: RowFiles, findings: Findings) -> None:
    """Carry the kept frames of each walk into those of the walks beside it, and add up what becomes of their points, by pairs of walks."""
    towns: dict[tuple[str, str], list[Summary]] = defaultdict(list)
    for flight in flights:
        if flight.kept_places_m and not flight.is_foreign:
            towns[flight.name.split("/")[0], flight.town].append(flight)
    for own in towns.values():
        _check_town(own, rows, findings)


def _check_town(flights: list[Summary], rows: RowFiles, findings: Findings) -> None:
    places = np.array([place for flight in flights for place in flight.kept_places_m])
    frames = [(k, number) for k, flight in enumerate(flights) for number in range(len(flight.kept_places_m))]
    walks = [flight.walk or flight.name.rpartition("/")[0] for flight in flights]
    if len(set(walks)) < 2:
        return
    found: dict[tuple[int, int], np.ndarray] = defaultdict(lambda: np.zeros(4, np.int64))
    tree = cKDTree(places)
    # The nearest are those of its own walk, of two flights; of walks that were flown more often fewer others are compared.
    near = tree.query(places, k=min(len(places), 2 * KEPT_FRAMES + 8 * OTHERS))[1]
    last: tuple[int, list[Kept]] = (-1, [])
    for (k, number), others in zip(frames, near, strict=True):
        beside = [frames[other] for other in others.tolist() if walks[frames[other][0]] != walks[k]][:OTHERS]
        if last[0] != k:
            last = k, unpacked(rows.read_kept(flights[k].rows_file))
        view, camera = last[1][number]
        for other, others_number in beside:
            there, others_camera = unpacked(rows.read_kept(flights[other].rows_file))[others_number]
            pair = compare_views(view, there, camera, others_camera)
            meets = pair.agree > MEET_LEAST * pair.seen
            found[min(k, other), max(k, other)] += (pair.seen, pair.through, meets * pair.agree, meets * pair.same)
    by_walks: dict[tuple[str, str], np.ndarray] = defaultdict(lambda: np.zeros(4, np.int64))
    named: dict[tuple[str, str], str] = {}
    for (k, other), counts in found.items():
        pair_of_walks = min(walks[k], walks[other]), max(walks[k], walks[other])
        by_walks[pair_of_walks] += counts
        named.setdefault(pair_of_walks, f"{flights[k].name} and {flights[other].name}")
    for pair_of_walks, (seen, through, agree, same) in by_walks.items():
        if seen >= LEAST_SEEN and through > THROUGH_MOST * seen:
            got = f"{through / seen:.1%} of the points of one before what the other draws there"
            findings.error("scene_town", named[pair_of_walks], got, f"at most {THROUGH_MOST:.1%}: what stands still at one place for both")  # fmt: skip
        elif agree >= LEAST_AGREE and same < SAME_LEAST * agree:
            got = f"{same / agree:.1%} of the instances of the other, where the depth agrees"
            findings.error("scene_town", named[pair_of_walks], got, f"at least {SAME_LEAST:.0%}: what stands still under one id for both")  # fmt: skip
