"""What of much goes on the page: flights, frames, points of a path, boxes of a map."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from cosfly.geometry import box_corners
from cosfly.products.boxes import BoxMap
from cosfly.products.captions import Coc
from cosfly.products.kinds import GROUND_KINDS, KIND_NAMES
from cosfly.products.sentences import sentences_of
from release.viewer.schema import Point2, ShownBox, ShownSentence

PATH_POINTS = 240
MOST_BOXES, MARGIN_M = 2_500, 30.0  # of one map
TEXTS = {"C": "critical_components", "R": "reasoning_trace"}  # by the letter of a sentence's name
Flight = TypeVar("Flight")


def spread(count: int, most: int) -> list[int]:
    """Give at most `most` of the numbers below `count`, evenly, first and last included."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most)).round()})


def choose_flights(flights: Sequence[Flight], groups: Sequence[Hashable], most: int) -> list[Flight]:
    """Choose whole groups (the tracks of a trajectory), spread evenly, as many as give no more than `most` flights, and one at least."""
    by_group: dict[Hashable, list[Flight]] = defaultdict(list)
    for flight, group in zip(flights, groups, strict=True):
        by_group[group].append(flight)
    named = list(by_group.values())
    for count in range(len(named), 0, -1):
        chosen = [flight for k in spread(len(named), count) for flight in named[k]]
        if len(chosen) <= most or count == 1:
            return chosen
    return []


def choose_frames(frames: Sequence[int], kinds: Mapping[int, Hashable], most: int) -> list[int]:
    """Choose frames of a flight, in order.

    Args:
        frames: all, ascending. kinds: of those with a caption what it says, such as (verdict, decision).
    Returns:
        first one of each kind, until half of them; then evenly of those with captions, then of the others.
    """
    firsts: dict[Hashable, int] = {}
    for frame in frames:
        if frame in kinds:
            firsts.setdefault(kinds[frame], frame)
    chosen = set(list(firsts.values())[: max(1, most // 2)])
    for wanted in (kinds, set(frames) - set(kinds)):
        others = [frame for frame in frames if frame not in chosen and frame in wanted]
        chosen |= {others[k] for k in spread(len(others), most - len(chosen))}
    return sorted(chosen)


def path_of(points_m: np.ndarray) -> list[Point2]:
    """Give a path from above, (n, 2 or 3) m, by at most PATH_POINTS of its points; those that are not known are left out."""
    known = points_m[~np.isnan(points_m).any(axis=1)]
    return [(round(float(known[k, 0]), 1), round(float(known[k, 1]), 1)) for k in spread(len(known), PATH_POINTS)]


def boxes_of(box_map: BoxMap, near: Sequence[Point2]) -> list[ShownBox]:
    """Give the footprints of the boxes of a map round some places, the largest ones, those that lie below others first."""
    places = np.array(near, dtype=np.float64).reshape(-1, 2)
    if not len(places):
        return []
    low, high = places.min(axis=0) - MARGIN_M, places.max(axis=0) + MARGIN_M
    is_near = ((box_map.maxs[:, :2] >= low) & (box_map.mins[:, :2] <= high)).all(axis=1)
    rows = np.flatnonzero(is_near)
    areas = box_map.half_extents[rows, 0] * box_map.half_extents[rows, 1]
    rows = rows[np.argsort(-areas, kind="stable")[:MOST_BOXES]]
    is_ground = np.isin(box_map.kinds[rows], list(GROUND_KINDS))
    tops = box_map.centers[rows, 2] + box_map.half_extents[rows, 2]
    return [_box(box_map, row) for row in rows[np.lexsort((tops, ~is_ground))]]


def _box(box_map: BoxMap, row: int) -> ShownBox:
    corners = box_corners(box_map.centers[row], box_map.half_extents[row], np.radians(box_map.rotations_deg[row, 1]))
    footprint = corners[[0, 2, 6, 4], :2].round(1).tolist()  # box_corners varies z fastest, then y, then x
    return ShownBox(kind=KIND_NAMES[int(box_map.kinds[row])], corners=[(x, y) for x, y in footprint])


def shown_sentences(coc: Coc, states: Sequence[str] | None) -> list[ShownSentence]:
    """Give the sentences of an answer, each with its state; None where the states are those of another number of sentences."""
    named = list(sentences_of(coc))
    known = states if states is not None and len(states) == len(named) else [None] * len(named)
    return [
        ShownSentence.model_validate({"field": TEXTS[name[0]], "text": text, "state": state})
        for (name, text), state in zip(named, known, strict=True)
    ]
