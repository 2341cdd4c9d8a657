"""Which windows stay: a training split in which no decision crowds out the others, and no more than were asked for.

Windows are ranked by a hash of the seed and their name. Of what has too many the first in rank stay, so neither the order of the
captions nor the number of workers matters. A window goes or stays with all its languages.
"""

from __future__ import annotations

import hashlib
import heapq
import math
from array import array
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict

from cosfly.products.actions import action_tokens


def _rank(sample_id: str, seed: int) -> int:
    return int.from_bytes(hashlib.sha256(f"{seed}/distill.balance/{sample_id}".encode()).digest()[:8])


@dataclass(frozen=True)
class Cut:
    """Which windows of the training split stay."""

    seed: int
    ratio: float
    most_windows: int  # of one decision
    windows: Mapping[str, int]  # decision -> windows before the cut
    last_rank: Mapping[str, int]  # decision that has too many -> rank of the last window that stays

    def keeps(self, decision: str, sample_id: str) -> bool:
        return decision not in self.last_rank or _rank(sample_id, self.seed) <= self.last_rank[decision]


class Ranks:
    """The 64-bit ranks of the windows by flight and decision, which is all that is held of them.

    Twelve bytes a window in two long arrays, not a short one for each flight and decision: the system takes long ones back whole.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self._kinds: dict[tuple[str, str], int] = {}  # flight and decision -> their number
        self._kind_of, self._ranks = array("I"), array("Q")  # of each window

    @property
    def flights(self) -> list[str]:
        return list(dict.fromkeys(flight for flight, _ in self._kinds))

    def add(self, flight: str, decision: str, sample_id: str) -> None:
        self._kind_of.append(self._kinds.setdefault((flight, decision), len(self._kinds)))
        self._ranks.append(_rank(sample_id, self.seed))

    def by_kind(self) -> dict[tuple[str, str], np.ndarray]:
        """Give the ranks of each flight and decision, in order; needs a window."""
        kind_of, ranks = np.frombuffer(self._kind_of, np.uint32), np.frombuffer(self._ranks, np.uint64)
        order = np.lexsort((ranks, kind_of))
        parts = np.split(ranks[order], np.cumsum(np.bincount(kind_of))[:-1])
        return dict(zip(self._kinds, parts, strict=True))

    def cut(self, flights: Iterable[str], ratio: float) -> Cut:
        """Find the cut that leaves of each decision at most `ratio` times an equal share, and one window at least.

        An equal share is the windows over the decisions that occur. The median or the least of the counts would be no measure: a few
        stray decisions of one or two windows bring them down, and nearly all of the others with them.

        Args:
            flights: those of the training split, one at least.
            ratio: > 0.
        """
        wanted = set(flights)
        ranks: dict[str, list[np.ndarray]] = defaultdict(list)
        for (flight, decision), found in self.by_kind().items():
            if flight in wanted:
                ranks[decision].append(found)
        windows = {decision: sum(map(len, found)) for decision, found in sorted(ranks.items())}
        most = max(1, math.floor(ratio * sum(windows.values()) / len(windows)))
        last_rank = {
            decision: int(np.partition(np.concatenate(found), most - 1)[most - 1])
            for decision, found in ranks.items()
            if windows[decision] > most
        }
        return Cut(self.seed, ratio, most, windows, last_rank)


# --- so many and no more ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Limit:
    """Which windows stay of all: of each flight and decision those up to a rank."""

    seed: int
    last_rank: Mapping[tuple[str, str], int]

    def keeps(self, flight: str, decision: str, sample_id: str) -> bool:
        return _rank(sample_id, self.seed) <= self.last_rank.get((flight, decision), -1)


def limit_to(ranks: Ranks, num_windows: int, cuts: Mapping[str, Cut | None]) -> Limit | None:
    """Choose exactly so many windows, of each decision and each flight its share; None where there are no more anyway.

    The shares of the decisions are rounded first. Then each decision's windows are dealt to its flights, and what a flight got too
    much or too little of is made up for by its next decision.

    Args:
        cuts: flight -> what has been cut of it already.
    """
    left: dict[str, dict[str, np.ndarray]] = defaultdict(dict)  # decision -> flight -> ranks, in order
    for (flight, decision), own in ranks.by_kind().items():
        cut = cuts[flight]
        last = None if cut is None else cut.last_rank.get(decision)
        left[decision][flight] = own if last is None else own[: np.searchsorted(own, np.uint64(last), side="right")]
    counts = {decision: sum(map(len, flights.values())) for decision, flights in left.items()}
    total = sum(counts.values())
    if num_windows >= total:
        return None
    share = num_windows / total
    order = sorted(counts, key=lambda decision: _rank(decision, ranks.seed))
    wanted = _dealt(num_windows, {decision: (counts[decision] * share, counts[decision]) for decision in order})
    carried: dict[str, float] = defaultdict(float)
    last_rank: dict[tuple[str, str], int] = {}
    for decision in order:
        flights = sorted(left[decision], key=lambda flight: _rank(f"{decision}/{flight}", ranks.seed))
        fraction = wanted[decision] / max(1, counts[decision])
        have = {flight: len(left[decision][flight]) for flight in flights}
        for flight, number in _dealt(
            wanted[decision], {flight: (fraction * have[flight] + carried[flight], have[flight]) for flight in flights}
        ).items():
            carried[flight] += share * have[flight] - number
            if number:
                last_rank[flight, decision] = int(left[decision][flight][number - 1])
    return Limit(ranks.seed, last_rank)


def _dealt(total: int, wishes: Mapping[str, tuple[float, int]]) -> dict[str, int]:
    """Deal `total` in whole numbers as near to the wishes as can be: name -> number.

    Args:
        wishes: name -> (wish, most); the mosts add up to `total` or more. Of equal wishes the first comes first.
    """
    dealt = {name: min(most, max(0, math.floor(wish))) for name, (wish, most) in wishes.items()}
    missing = total - sum(dealt.values())
    step = 1 if missing > 0 else -1
    places = {name: place for place, name in enumerate(wishes)}

    def key(name: str) -> tuple[float, int, str]:
        return step * (dealt[name] - wishes[name][0]), places[name], name

    heap = [key(name) for name, (_, most) in wishes.items() if 0 <= dealt[name] + step <= most]
    heapq.heapify(heap)
    for _ in range(abs(missing)):
        name = heap[0][2]
        dealt[name] += step
        if 0 <= dealt[name] + step <= wishes[name][1]:
            heapq.heapreplace(heap, key(name))
        else:
            heapq.heappop(heap)
    return dealt


# --- what it cost -----------------------------------------------------------------------------------------------------


class Cost(BaseModel):
    """What balance cost the training split: `balance` of the manifest. effective_decisions: before and after, as many equally frequent
    decisions have the same entropy; absent: decisions that no window of the split has."""

    model_config = ConfigDict(frozen=True)

    ratio: float
    most_windows: int
    windows: dict[str, int]  # of each decision that occurs, before
    windows_left_out: dict[str, int]
    samples_left_out: int
    effective_decisions: tuple[float, float]
    absent: list[str]

    def __str__(self) -> str:
        counts = [f"{name} {n} -> {n - self.windows_left_out.get(name, 0)}" for name, n in self.windows.items()]
        before, after = self.effective_decisions
        return (
            f"balance left {sum(self.windows_left_out.values())} of {sum(self.windows.values())} training windows out "
            f"({self.samples_left_out} samples), at most {self.most_windows} a decision: {', '.join(counts)}; "
            f"absent: {', '.join(self.absent) or 'none'}; effective decisions {before:.1f} -> {after:.1f}"
        )


def cost_of(cut: Cut, samples_left_out: int) -> Cost:
    """Say what a cut cost, which left out so many samples of its windows."""
    after = {decision: min(count, cut.most_windows) for decision, count in cut.windows.items()}
    return Cost(
        ratio=cut.ratio,
        most_windows=cut.most_windows,
        windows=dict(cut.windows),
        windows_left_out={name: n - after[name] for name, n in cut.windows.items() if n > after[name]},
        samples_left_out=samples_left_out,
        effective_decisions=(_effective(cut.windows), _effective(after)),
        absent=[action for action in action_tokens() if action not in cut.windows],
    )


def _effective(counts: Mapping[str, int]) -> float:
    """Give the effective number of kinds, the exponential of Shannon's entropy (Hill 1973, order 1)."""
    total = sum(counts.values())
    nats = -sum(count / total * math.log(count / total) for count in counts.values())
    return round(math.exp(nats), 2)
