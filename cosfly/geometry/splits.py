"""Walks, and splits that share none of them.

Two flights after one person on one way show the same places at the same times, whatever their names, planners, runs and
builds of the town are: a student that learnt from one of them has seen the answers to the other. Training sets and
releases hand out whole walks. Knows positions and names only, no files.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from cosfly.formats.predictions import Split
from cosfly.runtime.errors import InputError

SPLITS: tuple[Split, ...] = ("train", "val", "test")  # the order in which scarce groups are handed out

OTHER_BUILD = "_Opt"  # what the name of a town's other build ends with
NEAR_M = 0.5  # a third of a second of walking: steps that differ, rounded numbers, and other ground stay within
NEAR_SHARE = 0.5  # of the seconds that two flights share; people who cross are near for one or two
FEW_S = 5  # below so many near seconds all must be: two who begin at one place are near for some
MOST_GAP_S = 2.0  # between the points that a place is interpolated from
ON_TIME_S = 1e-3  # a point so near to a full second stands on it
SAME_M = 1e-3  # flights that differ by less are compared with others once


@dataclass(frozen=True)
class Course:
    """Where the person of a flight was, without any perturbation.

    name: of the walk as the tree has it, `run/town/trajectory`; courses of one name are one walk, whatever is known of
    them. time_s (n,) increasing; target_m (n, 3) right-handed, NaN where nobody knows.
    """

    name: str
    town: str
    time_s: np.ndarray
    target_m: np.ndarray

    def at_seconds(self) -> Course:
        """Return the course at the full seconds that it knows, at most MOST_GAP_S between points apart."""
        known = ~np.isnan(self.target_m[:, :2]).any(axis=1)
        time_s, places_m = self.time_s[known], self.target_m[known]
        # Those of the points and of the gaps behind them.
        seconds = np.unique(np.floor(time_s + ON_TIME_S)[:, None] + np.arange(MOST_GAP_S + 1))
        before = np.searchsorted(time_s, seconds + ON_TIME_S, side="right") - 1
        after = np.searchsorted(time_s, seconds - ON_TIME_S)
        inside = (before >= 0) & (after < len(time_s))
        gaps_s = time_s[after[inside]] - time_s[before[inside]]
        seconds = seconds[inside][gaps_s <= MOST_GAP_S]
        found = np.empty((len(seconds), 3))
        for axis in range(3) if len(seconds) else ():
            found[:, axis] = np.interp(seconds, time_s, places_m[:, axis])
        return Course(self.name, self.town, seconds, found)

    @cached_property
    def key(self) -> tuple[str, bytes]:
        """What is the same for two flights of one walk and length, but for noise, where both are `at_seconds`."""
        digest = hashlib.sha256(self.time_s.tobytes())
        digest.update(np.round(self.target_m[:, :2] / SAME_M).tobytes())
        return town_family(self.town), digest.digest()


def town_family(town: str) -> str:
    """Return the name that a town has in all of its builds: `Town03` and `Town03_Opt` are one map."""
    while town.endswith(OTHER_BUILD):
        town = town.removesuffix(OTHER_BUILD)
    return town


# --- walks ------------------------------------------------------------------------------------------------------------


def walks_of(courses: Iterable[Course]) -> dict[str, str]:
    """Return which courses are of one walk: name -> walk.

    Those are that are of one family of towns and within NEAR_M of each other on the map, in NEAR_SHARE of the full
    seconds that both know and FEW_S at least, or in all of them; and all that are so joined one by one. A walk is
    called by the first of its names in the alphabet, so neither the order of the courses nor their number of flights
    matters.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    tracks = sorted((course.at_seconds() for course in courses), key=lambda track: (track.name, track.key))
    once: dict[tuple[str, bytes], Course] = {}
    pairs = [(one.name, once.setdefault(one.key, one).name) for one in tracks if len(one.time_s)]
    families = defaultdict(list)
    for track in once.values():
        families[town_family(track.town)].append(track)
    pairs += [pair for family in families.values() for pair in _near_pairs(family)]
    number = {name: k for k, name in enumerate(dict.fromkeys(track.name for track in tracks))}  # by alphabet
    ends = np.array([(number[one], number[other]) for one, other in pairs], dtype=np.int32).reshape(-1, 2).T
    joined = coo_array((np.ones(ends.shape[1], dtype=bool), tuple(ends)), shape=(len(number), len(number)))
    first: dict[int, str] = {}
    groups = connected_components(joined, directed=False)[1].tolist() if number else []
    return {name: first.setdefault(group, name) for name, group in zip(number, groups, strict=True)}


def _near_pairs(tracks: list[Course]) -> list[tuple[str, str]]:
    """Find the pairs of tracks that are near each other for long enough."""
    from scipy.spatial import cKDTree

    owners = np.repeat(np.arange(len(tracks)), [len(track.time_s) for track in tracks])
    seconds = np.concatenate([track.time_s for track in tracks])
    places_m = np.concatenate([track.target_m[:, :2] for track in tracks])
    order = np.argsort(seconds, kind="stable")
    num_near: dict[tuple[int, int], int] = defaultdict(int)
    for at_once in np.split(order, np.flatnonzero(np.diff(seconds[order])) + 1):
        if len(at_once) > 1:
            near = cKDTree(places_m[at_once]).query_pairs(NEAR_M, output_type="ndarray")
            for one, other in np.sort(owners[at_once][near]).tolist():
                num_near[one, other] += 1
    found = []
    for (one, other), count in num_near.items():
        num_shared = len(np.intersect1d(tracks[one].time_s, tracks[other].time_s, assume_unique=True))
        if count >= min(num_shared, max(FEW_S, NEAR_SHARE * num_shared)):
            found.append((tracks[one].name, tracks[other].name))
    return found


# --- splits -----------------------------------------------------------------------------------------------------------


def assign_splits(
    groups: Iterable[str],
    fractions: Mapping[Split, float],
    seed: int,
    *,
    too_few: Literal["refuse", "fill"],
    what: str = "walks",
    fix: str = "give more of them, or set a fraction to 0",
) -> dict[str, Split]:
    """Assign groups to splits: group -> split.

    Groups are ranked by a hash of (seed, group); the first go to test, the next to val, the rest to train, in numbers
    as near to the fractions as a whole group allows and at least one for each split that has a share.

    Args:
        fractions: shares of `val` and `test`, together below 1; 0 or none: no such split.
        too_few: with fewer groups than splits: refuse, or fill train, then val, and leave the rest empty.
        what, fix: for the message.
    """
    ranked = sorted(set(groups), key=lambda group: hashlib.sha256(f"{seed}/distill.split/{group}".encode()).digest())
    val, test = fractions.get("val", 0.0), fractions.get("test", 0.0)
    wanted = [split for split in SPLITS if split == "train" or fractions.get(split, 0.0) > 0]
    if len(ranked) < len(wanted):
        if too_few == "refuse" or not ranked:
            raise InputError(
                f"too few {what} to split without a leak",
                got=str(len(ranked)),
                expected=f"{len(wanted)} or more, one for each of {', '.join(wanted)}",
                fix=fix,
            )
        return dict(zip(ranked, wanted, strict=False))
    num_test, num_val = (max(1, round(share * len(ranked))) if share else 0 for share in (test, val))
    while num_test + num_val >= len(ranked):  # rounding took all: the larger share gives one back
        num_test, num_val = (num_test - 1, num_val) if num_test >= num_val else (num_test, num_val - 1)
    counts: dict[Split, int] = {"test": num_test, "val": num_val, "train": len(ranked) - num_test - num_val}
    return dict(zip(ranked, (split for split, count in counts.items() for _ in range(count)), strict=True))
