"""Which windows stay: a training split in which no decision crowds out the others, and no more than were asked for.

Windows are ranked by a hash of the seed and their name. Of what has too many the first in rank stay, so neither the order of the
captions nor the number of workers matters. A window goes or stays with all its languages.
"""

from __future__ import annotations

import hashlib
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


def keeps(last_rank: Mapping[str, int], seed: int, decision: str, sample_id: str) -> bool:
    """Tell whether a window stays; last_rank: decision -> rank of the last window that does, none where all do."""
    return decision not in last_rank or _rank(sample_id, seed) <= last_rank[decision]


@dataclass(frozen=True)
class Cut:
    """Which windows of the training split stay."""

    seed: int
    ratio: float
    most_windows: int  # of one decision
    windows: Mapping[str, int]  # decision -> windows before the cut
    last_rank: Mapping[str, int]  # decision that has too many -> rank of the last window that stays

    def keeps(self, decision: str, sample_id: str) -> bool:
        return keeps(self.last_rank, self.seed, decision, sample_id)


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


def limit_to(ranks: Ranks, num_windows: int, cuts: Mapping[str, Cut | None]) -> Mapping[str, int] | None:
    """Choose exactly so many windows, of each decision its share, rounded by largest remainders; None where there are no more anyway.

    Args:
        cuts: flight -> what has been cut of it already.
    Returns:
        decision -> rank of the last window that stays, -1 where none does.
    """
    left: dict[str, list[np.ndarray]] = defaultdict(list)
    for (flight, decision), own in ranks.by_kind().items():
        cut = cuts[flight]
        last = None if cut is None else cut.last_rank.get(decision)
        left[decision].append(own if last is None else own[own <= np.uint64(last)])
    counts = {decision: sum(map(len, found)) for decision, found in left.items()}
    total = sum(counts.values())
    if num_windows >= total:
        return None
    wanted = {decision: num_windows * count // total for decision, count in counts.items()}
    by_remainder = sorted(counts, key=lambda name: (-(num_windows * counts[name] % total), _rank(name, ranks.seed)))
    for decision in by_remainder[: num_windows - sum(wanted.values())]:
        wanted[decision] += 1
    return {
        decision: int(np.sort(np.concatenate(found))[wanted[decision] - 1]) if wanted[decision] else -1
        for decision, found in left.items()
    }


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
