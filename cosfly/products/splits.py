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

from cosfly.errors import InputError

Split = Literal["train", "val", "test"]
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
        """Give the course at the full seconds that it knows, at most MOST_GAP_S between points apart."""
        known = ~np.isnan(self.target_m[:, :2]).any(axis=1)
        time_s, places_m = self.time_s[known], self.target_m[known]
        begun = np.floor(time_s + ON_TIME_S)
        # Those of the points and of the gaps behind them.
        seconds = np.unique(begun[:, None] + np.arange(MOST_GAP_S + 1))
        before = np.searchsorted(time_s, seconds + ON_TIME_S, side="right") - 1
        after = np.searchsorted(time_s, seconds - ON_TIME_S)
        inside = (before >= 0) & (after < len(time_s))
        seconds, before, after = seconds[inside], before[inside], after[inside]
        seconds = seconds[time_s[after] - time_s[before] <= MOST_GAP_S]
        found = np.empty((len(seconds), 3))
        for axis in range(3) if len(seconds) else ():
            found[:, axis] = np.interp(seconds, time_s, places_m[:, axis])
        return Course(self.name, self.town, seconds, found)


def town_family(town: str) -> str:
    """Give the name that a town has in all of its builds: `Town03` and `Town03_Opt` are one map."""
    while town.endswith(OTHER_BUILD):
        town = town.removesuffix(OTHER_BUILD)
    return town


# --- walks ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Track:
    """A course at the full seconds that it knows: seconds (k,) whole numbers, increasing; places_m (k, 2) x, y."""

    name: str
    family: str
    seconds: np.ndarray
    places_m: np.ndarray

    @cached_property
    def key(self) -> tuple[str, bytes]:
        """What is the same for two flights of one walk and length, but for noise."""
        digest = hashlib.sha256(self.seconds.tobytes())
        digest.update(np.round(self.places_m / SAME_M).tobytes())
        return self.family, digest.digest()


def walks_of(courses: Iterable[Course]) -> dict[str, str]:
    """Tell which courses are of one walk: name -> walk.

    Those are that are of one family of towns and within NEAR_M of each other on the map, in NEAR_SHARE of the full
    seconds that both know and FEW_S at least, or in all of them; and all that are so joined one by one. A walk is
    called by the first of its names in the alphabet, so neither the order of the courses nor their number of flights
    matters.
    """
    tracks = sorted((_track(course) for course in courses), key=lambda track: (track.name, track.key))
    groups = _Groups(track.name for track in tracks)
    once: dict[tuple[str, bytes], _Track] = {}
    for track in tracks:
        if len(track.seconds):
            groups.unite(track.name, once.setdefault(track.key, track).name)
    families = defaultdict(list)
    for track in once.values():
        families[track.family].append(track)
    for family in families.values():
        for one, other in _near_pairs(family):
            groups.unite(one, other)
    return {name: groups.first_of(name) for name in groups.first}


class _Groups:
    """Names that were united, each with the first name of its group."""

    def __init__(self, names: Iterable[str]) -> None:
        self.first = {name: name for name in names}

    def first_of(self, name: str) -> str:
        while self.first[name] != name:
            self.first[name] = name = self.first[self.first[name]]
        return name

    def unite(self, one: str, other: str) -> None:
        first, second = sorted((self.first_of(one), self.first_of(other)))
        self.first[second] = first


def _track(course: Course) -> _Track:
    told = course.at_seconds()
    return _Track(told.name, town_family(told.town), told.time_s, told.target_m[:, :2])


def _near_pairs(tracks: list[_Track]) -> list[tuple[str, str]]:
    """Find the pairs of tracks that are near each other for long enough."""
    from scipy.spatial import cKDTree

    owners = np.repeat(np.arange(len(tracks)), [len(track.seconds) for track in tracks])
    seconds = np.concatenate([track.seconds for track in tracks])
    places_m = np.concatenate([track.places_m for track in tracks])
    order = np.argsort(seconds, kind="stable")
    num_near: dict[tuple[int, int], int] = defaultdict(int)
    for at_once in np.split(order, np.flatnonzero(np.diff(seconds[order])) + 1):
        if len(at_once) > 1:
            near = cKDTree(places_m[at_once]).query_pairs(NEAR_M, output_type="ndarray")
            for one, other in np.sort(owners[at_once][near]).tolist():
                num_near[one, other] += 1
    found = []
    for (one, other), count in num_near.items():
        shared = np.intersect1d(tracks[one].seconds, tracks[other].seconds, assume_unique=True)
        if count >= min(len(shared), max(FEW_S, NEAR_SHARE * len(shared))):
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
    """Hand out groups to splits: group -> split.

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
    num_test = max(1, round(test * len(ranked))) if test else 0
    num_val = max(1, round(val * len(ranked))) if val else 0
    while num_test + num_val >= len(ranked):  # rounding took all: the larger share gives one back
        num_test, num_val = (num_test - 1, num_val) if num_test >= num_val else (num_test, num_val - 1)
    counts: dict[Split, int] = {"test": num_test, "val": num_val, "train": len(ranked) - num_test - num_val}
    names = [split for split, count in counts.items() for _ in range(count)]
    return dict(zip(ranked, names, strict=True))
