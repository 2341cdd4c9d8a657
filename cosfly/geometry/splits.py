"""Groups of tracks of the same pedestrian trajectory, and splits that do not share such a group.

Two tracks of one pedestrian trajectory show the same places at the same times, even with other names, planners, runs or
builds of the town: a student that was trained on one of them has seen the answers to the other. So training sets and
releases assign whole groups, called walks here. A course is the target's motion in one track.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from cosfly.formats.predictions import Split

SPLITS: tuple[Split, ...] = ("train", "val", "test")  # the order in which scarce groups are handed out

OTHER_BUILD = "_Opt"  # suffix of the name of a town's other build
NEAR_M = 0.5  # a third of a second of walking: other time steps, rounding and other ground cause smaller differences
NEAR_SHARE = 0.5  # least share of common seconds in which two tracks are near; people who cross are near for 1 or 2 s
FEW_S = 5  # least number of near seconds, unless all are near: two who begin at one place are near for some seconds
MOST_GAP_S = 2.0  # longest gap between points that a position is interpolated over
ON_TIME_S = 1e-3  # a point this close to a full second counts as at that second


@dataclass(frozen=True)
class Course:
    """The target's positions in a track, without any perturbation."""

    name: str  # `run/town/trajectory`; courses with the same name always belong to one walk
    town: str
    time_s: np.ndarray  # (n,) s, increasing
    target_m: np.ndarray  # (n, 3) m, right-handed, NaN where unknown

    def at_seconds(self) -> Course:
        """Return the course interpolated at full seconds, except in gaps longer than MOST_GAP_S."""
        is_known = ~np.isnan(self.target_m[:, :2]).any(axis=1)
        time_s, places_m = self.time_s[is_known], self.target_m[is_known]
        # Candidates: the full second at or before each point, and those in the longest allowed gap after it.
        seconds = np.unique(np.floor(time_s + ON_TIME_S)[:, None] + np.arange(MOST_GAP_S + 1))
        before = np.searchsorted(time_s, seconds + ON_TIME_S, side="right") - 1
        after = np.searchsorted(time_s, seconds - ON_TIME_S)
        inside = (before >= 0) & (after < len(time_s))
        gaps_s = time_s[after[inside]] - time_s[before[inside]]
        seconds = seconds[inside][gaps_s <= MOST_GAP_S]
        target_m = np.empty((len(seconds), 3))
        if len(seconds):
            for axis in range(3):
                target_m[:, axis] = np.interp(seconds, time_s, places_m[:, axis])
        return Course(self.name, self.town, seconds, target_m)


def town_family(town: str) -> str:
    """Return the name that a town has in all of its builds: `Town03` and `Town03_Opt` are one map."""
    while town.endswith(OTHER_BUILD):
        town = town.removesuffix(OTHER_BUILD)
    return town


# --- walks ------------------------------------------------------------------------------------------------------------


def walks_of(courses: Iterable[Course]) -> dict[str, str]:
    """Return the walk of each course: name of the course -> name of the walk.

    Two courses are one walk if their towns are builds of one town and they are within NEAR_M of each other in at least
    NEAR_SHARE of their common full seconds and at least FEW_S of them, or in all of them. The relation is transitive: a
    walk is a connected component. Its name is the alphabetically first of its courses' names, so it depends neither on
    the order nor on the number of the courses.
    """
    from scipy.cluster.hierarchy import DisjointSet

    sampled = [course.at_seconds() for course in courses]
    walks = DisjointSet(course.name for course in sampled)
    families = defaultdict(list)
    for course in sampled:
        families[town_family(course.town)].append(course)
    for family in families.values():
        for left, right in _near_pairs(family):
            walks.merge(left, right)
    return {name: min(walk) for walk in walks.subsets() for name in walk}


def _near_pairs(courses: list[Course]) -> list[tuple[str, str]]:
    """Return the names of the pairs of courses that are near each other for long enough."""
    from scipy.spatial import cKDTree

    # One entry for each second of each course: the index of the course, the second and the place.
    course_indices = np.repeat(np.arange(len(courses)), [len(course.time_s) for course in courses])
    seconds = np.concatenate([course.time_s for course in courses])
    places_m = np.concatenate([course.target_m[:, :2] for course in courses])
    order = np.argsort(seconds, kind="stable")
    num_near: dict[tuple[int, int], int] = defaultdict(int)  # seconds in which two courses are near
    for same_second in np.split(order, np.flatnonzero(np.diff(seconds[order])) + 1):
        if len(same_second) > 1:
            near = cKDTree(places_m[same_second]).query_pairs(NEAR_M, output_type="ndarray")
            for i, j in np.sort(course_indices[same_second][near]).tolist():
                num_near[i, j] += 1
    pairs = []
    for (i, j), count in num_near.items():
        num_shared = len(np.intersect1d(courses[i].time_s, courses[j].time_s, assume_unique=True))
        if count >= min(num_shared, max(FEW_S, NEAR_SHARE * num_shared)):
            pairs.append((courses[i].name, courses[j].name))
    return pairs


# --- splits -----------------------------------------------------------------------------------------------------------


def assign_splits(groups: Iterable[str], fractions: Mapping[Split, float], seed: int) -> dict[str, Split]:
    """Assign groups to splits: group -> split.

    Groups are ranked by a hash of (seed, group), without the run of a walk, so that equal runs in two folders have
    equal splits. The first go to test, the next to val, the others to train; the numbers are the rounded fractions, and
    at least one for each split that has a share. With fewer groups than splits, train gets one first, then val.

    Args:
        fractions: shares of `val` and `test`, together below 1; 0 or none: no such split.
    """

    def rank(group: str) -> tuple[bytes, str]:
        name = group.split("/", 1)[-1]  # of `run/town/trajectory`, or of a town
        return hashlib.sha256(f"{seed}/distill.split/{name}".encode()).digest(), group

    ranked = sorted(set(groups), key=rank)
    requested = [split for split in SPLITS if split == "train" or fractions.get(split, 0.0) > 0]
    if len(ranked) < len(requested):
        return dict(zip(ranked, requested, strict=False))
    counts: dict[Split, int] = {"test": 0, "val": 0}
    for split in counts:
        share = fractions.get(split, 0.0)
        if share:
            counts[split] = max(1, round(share * len(ranked)))
    while sum(counts.values()) >= len(ranked):  # rounding left none for train: the larger split loses one
        counts["test" if counts["test"] >= counts["val"] else "val"] -= 1
    counts["train"] = len(ranked) - sum(counts.values())
    splits = [split for split, count in counts.items() for _ in range(count)]
    return dict(zip(ranked, splits, strict=True))
