"""Which windows stay: a training split in which no decision crowds out the others, and no more than were asked for.

Windows are ranked by a hash of the seed and their name. Of what has too many the first in rank stay, so neither the
order of the captions nor the number of workers matters. A window goes or stays with all its languages.
"""

from __future__ import annotations

import hashlib
import math
from array import array
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosfly.products.actions import TOKENS


def _rank(sample_id: str, seed: int) -> int:
    return int.from_bytes(hashlib.sha256(f"{seed}/distill.balance/{sample_id}".encode()).digest()[:8])


def keeps(last_rank: Mapping[str, int], seed: int, decision: str, sample_id: str) -> bool:
    """Tell whether a window stays; last_rank: decision -> rank of the last window that does, none where all do."""
    return decision not in last_rank or _rank(sample_id, seed) <= last_rank[decision]


class WindowRanks:
    """The 64-bit ranks of the windows by flight and decision, which is all that is held of them.

    Twelve bytes a window in two long arrays, not a short one for each flight and decision: the system takes long ones
    back.
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

    def by_kind(self) -> Iterator[tuple[str, str, np.ndarray]]:
        """Yield each flight and decision with the ranks of its windows; needs a window."""
        kind_of, ranks = np.frombuffer(self._kind_of, np.uint32), np.frombuffer(self._ranks, np.uint64)
        parts = np.split(ranks[np.argsort(kind_of, kind="stable")], np.cumsum(np.bincount(kind_of))[:-1])
        return ((*kind, part) for kind, part in zip(self._kinds, parts, strict=True))


def _last(ranks: list[np.ndarray], count: int) -> int:
    """Give the rank of the window that is the last of so many; -1 for none."""
    return int(np.partition(np.concatenate(ranks), count - 1)[count - 1]) if count else -1


@dataclass(frozen=True)
class Balance:
    """What stays of the training split. most_windows: of a decision. windows: decision -> how many there were.

    last_rank: decision that has too many -> rank of the last window that stays.
    """

    most_windows: int
    windows: Mapping[str, int]
    last_rank: Mapping[str, int]

    def cost(self, samples_left_out: int) -> dict[str, Any]:
        """Give `balance` of the manifest. effective_decisions: as many equally frequent ones have the same entropy."""
        after = {decision: min(count, self.most_windows) for decision, count in self.windows.items()}
        return {
            "most_windows": self.most_windows,
            "windows": dict(self.windows),
            "windows_left_out": {name: n - after[name] for name, n in self.windows.items() if n > after[name]},
            "samples_left_out": samples_left_out,
            "effective_decisions": [_effective(self.windows), _effective(after)],
            "absent": [action for action in TOKENS if action not in self.windows],
        }


def balance_of(ranks: WindowRanks, train: Collection[str]) -> Balance:
    """Keep of each decision at most an equal share of the windows, and at least one.

    An equal share is the windows over the decisions that occur. The median or the least of the counts would be no
    measure: a few stray decisions of one or two windows bring them down, and nearly all of the others with them.

    Args:
        train: flights of the training split, at least one.
    """
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    for flight, decision, own in ranks.by_kind():
        if flight in train:
            found[decision].append(own)
    windows = {decision: sum(map(len, own)) for decision, own in sorted(found.items())}
    most = max(1, sum(windows.values()) // len(windows))
    last_rank = {decision: _last(own, most) for decision, own in found.items() if windows[decision] > most}
    return Balance(most, windows, last_rank)


def limit_to(
    ranks: WindowRanks, num_windows: int, train: Collection[str], balance: Balance | None
) -> Mapping[str, int] | None:
    """Choose exactly so many windows, of each decision its share, rounded by largest remainders.

    Args:
        train: flights of the training split, of which `balance` has left out what it does.
    Returns:
        decision -> rank of the last window that stays, -1 where none does; None where there are no more anyway.
    """
    left: dict[str, list[np.ndarray]] = defaultdict(list)
    for flight, decision, own in ranks.by_kind():
        last = balance.last_rank.get(decision) if balance is not None and flight in train else None
        left[decision].append(own if last is None else own[own <= np.uint64(last)])
    counts = {decision: sum(map(len, own)) for decision, own in left.items()}
    total = sum(counts.values())
    if num_windows >= total:
        return None
    wanted = {decision: num_windows * count // total for decision, count in counts.items()}
    by_remainder = sorted(counts, key=lambda name: (-(num_windows * counts[name] % total), _rank(name, ranks.seed)))
    for decision in by_remainder[: num_windows - sum(wanted.values())]:
        wanted[decision] += 1
    return {decision: _last(own, wanted[decision]) for decision, own in left.items()}


def _effective(counts: Mapping[str, int]) -> float:
    """Give the effective number of kinds, the exponential of Shannon's entropy (Hill 1973, order 1)."""
    total = sum(counts.values())
    return round(math.exp(-sum(count / total * math.log(count / total) for count in counts.values())), 2)
