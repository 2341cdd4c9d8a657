"""Random choices, derived from (seed, stage, item), so that none depends on the workers, their order or a resume."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from itertools import count

import numpy as np


def rng_for(seed: int, stage: str, item_id: str) -> np.random.Generator:
    """Return the random generator of one item."""
    return np.random.default_rng(int.from_bytes(draws_for(seed, stage, item_id)[:16], "little"))


def draws_for(seed: int, stage: str, item_id: str) -> bytes:
    """Return 32 random bytes of one item: enough for a few choices, in a twentieth of a generator's time."""
    return hashlib.sha256(f"{seed}/{stage}/{item_id}".encode()).digest()


BLOCK = 8  # draws to a quota that are as far apart as they can be; more hold shares no better where few are drawn
GOLDEN = 0.5 * (5**0.5 - 1)  # blocks turned by this much never coincide


def draw_to_quota(shares: Mapping[str, float], rng: np.random.Generator) -> Iterator[str]:
    """Yield names without end, in random order: after any number of draws each has its share within three.

    The first draws do not depend on how many follow.
    """
    names, ends = _ends(shares)
    start = rng.random()
    for block in count():
        places = (rng.permutation(BLOCK) + (start + block * GOLDEN) % 1.0) / BLOCK
        for place in np.searchsorted(ends, places * ends[-1], side="right").tolist():
            yield names[place]


def draw_by_share(shares: Mapping[str, float], rng: np.random.Generator) -> str:
    """Return one of the names, each with the probability of its share, whatever their order."""
    names, ends = _ends(shares)
    return names[int(np.searchsorted(ends, rng.random() * ends[-1], side="right"))]


def _ends(shares: Mapping[str, float]) -> tuple[list[str], np.ndarray]:
    """Return the sorted names, and the cumulative sum of their shares."""
    names = sorted(shares)
    weights = np.array([shares[name] for name in names], dtype=np.float64)
    if not ((weights >= 0).all() and weights.sum() > 0):
        raise ValueError(f"shares must not be negative and must add up to something positive: {dict(shares)}")
    return names, np.cumsum(weights)
